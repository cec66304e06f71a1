"""The sentinel on real captures, and on real pairs of textured scenes: see `bench_sentinel.py`."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from split_halves import load

from rigkit.calibration.calibrate import calibrate
from rigkit.calibration.result import Calibration
from rigkit.cameras.base import Camera
from rigkit.cameras.registry import camera_model
from rigkit.core.detections import BoardView
from rigkit.core.errors import RigkitError
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import unit
from rigkit.io.images import read_image
from rigkit.planning.goal import projection_goal
from rigkit.validation.sentinel.causes import causes_of
from rigkit.validation.sentinel.epipolar import check_scene
from rigkit.validation.sentinel.evidence import Watched
from rigkit.validation.sentinel.judge import ALARM_CHANCE, ALARM_PX, SentinelCheck
from rigkit.validation.sentinel.watch import watched_camera
from sentinel.tally import CHANGED_PX, FRESH, KINDS, SCENE_TURNED_DEG, checked, tell, turned, unchanged

PAIR_PX, PAIR_DEG = 0.1, 0.01
"""How sure published cameras and mounts of pairs are taken to be: over the image, and per axis."""


def real(name: str, data: Path, cache: Path, draws: int) -> None:
    found, size = load(name, data, cache)
    images = list(found.values())
    full = calibrate([v for own in images for v in own], size)
    model, board = full.camera.model, full.boards[0].kind
    print(f"{name}: {model}, board {board}, {full.rms_px:.3f} px")

    def solve(own: list[BoardView]) -> Calibration:
        return calibrate(own, size, model=model, board="auto", folds=0)

    UNCHANGED[name] = unchanged(name, images, draws, solve)
    rng = np.random.default_rng(5)
    for what in KINDS:
        checks = []
        for _ in range(max(draws // 4, 2)):
            order = rng.permutation(len(images)).tolist()
            after = touched(full, what, rng)
            try:
                known = solve([v for i in order[FRESH:] for v in images[i]])
                checks.append(checked(known, [moved(v, full.camera, after) for i in order[:FRESH] for v in images[i]]))
            except RigkitError as error:
                print(f"{name}, {what}: {error}")
        tell(f"{name}: {what}", checks, what)
        powers = [p for c in checks for p in c.powers if p.kind == what]
        SAID.extend(p.chance for p in powers)
        if powers:
            frames = [np.inf if p.frames is None else p.frames for p in powers]
            print(
                f"   said to be found with chance {np.mean([p.chance for p in powers]):.2f}, 9 times in 10 from "
                f"{np.median([p.found_from for p in powers]):.2f} px on, or with {np.median(frames):g} frames"
            )


def touched(full: Calibration, what: str, rng: np.random.Generator) -> Camera:
    """Return a calibrated camera of any model after a change that leaves 0.15 px rms after the best rotation."""
    watched = watched_camera(full, "camera")
    (cause,) = (c for c in causes_of(watched) if c.kind == what)
    amount = rng.standard_normal((cause.directions.shape[1],))
    if what == "distortion":
        amount[1:] = 0.0
    step = cause.directions @ amount
    weight = projection_goal(full.camera).weight
    return full.camera.with_parameters(full.camera.parameters + step * CHANGED_PX / np.sqrt(step @ weight @ step))


UNCHANGED: dict[str, list[SentinelCheck]] = {}
SAID: list[float] = []
"""Checks of unchanged cameras by set, and the chances with which changes were said to be found."""
MAX_FLAGGED = 0.02


def left_out() -> None:
    """Print how many unchanged cameras of every set alarm with the limit that the other sets ask for."""
    flagged = count = 0
    for name, own in UNCHANGED.items():
        others = [c.chance if c.change is not None and c.change.size_px >= ALARM_PX else 1.0
                  for other, checks in UNCHANGED.items() if other != name for c in checks]  # fmt: skip
        limit = min(float(np.quantile(others, MAX_FLAGGED)), ALARM_CHANCE)
        alarms = sum(c.unexplained or (not c.holds and c.chance < limit) for c in own)
        print(f"   {name}: the others ask for a limit of {limit:.2g}: {alarms} of {len(own)} alarm")
        flagged, count = flagged + alarms, count + len(own)
    print(f"== real: unchanged, each set judged by the others' limit: {flagged} of {count} alarm")


def moved(view: BoardView, before: Camera, after: Camera) -> BoardView:
    """Return what another camera would have seen of the same board."""
    rays, valid = before.unproject(view.pixels)
    pixels, seen = after.project(rays)
    use = valid & seen
    pixels = np.clip(pixels[use], -0.5, np.array(before.size_px) - 0.5)
    return BoardView(view.image, view.board, view.grid[use], pixels, view.sigma_px[use])


def pairs(data: Path, seeds: int) -> None:
    """Real pairs: the pose as published, and as if the mount had turned since."""
    found: dict[str, list[SentinelCheck]] = {"nothing": [], "rotation": []}
    for pair in json.loads((data / "scenes/pairs.json").read_text()):
        cameras = tuple(
            camera_model(kind)(tuple(size), np.array(numbers))
            for kind, size, numbers in (pair["camera1"], pair["camera2"])
        )
        true = Rigid3(np.array(pair["cam2_from_cam1_R"]), 100.0 * unit(np.array(pair["cam2_from_cam1_t_direction"])))
        images = [read_image(data / "scenes" / pair[key]) for key in ("image1", "image2")]
        lenses = [lens_covariance(camera) for camera in cameras]
        sizes = [len(own) for own in lenses]
        covariance = np.zeros((sum(sizes) + 6, sum(sizes) + 6))
        covariance[: sizes[0], : sizes[0]] = lenses[0]
        covariance[sizes[0] : sum(sizes), sizes[0] : sum(sizes)] = lenses[1]
        covariance[-6:, -6:] = np.diag([np.radians(PAIR_DEG)] * 3 + [0.1] * 3) ** 2
        for seed in range(seeds):
            rng = np.random.default_rng([seed, 23])
            for what, checks in found.items():
                told = turned(true, SCENE_TURNED_DEG if what == "rotation" else 0.0, rng)
                if what == "nothing" and seed > 0:
                    continue
                watched = Watched(
                    names=("left", "right"), cameras=cameras, cam_from_rig=(Rigid3.identity(), told),
                    covariance=covariance, sigma_px=0.1,
                )  # fmt: skip
                checks.append(check_scene(watched, [images]))
                if checks[-1].holds == (what == "rotation"):
                    print(f"   {pair['name']}: {what}, chance {checks[-1].chance:.2g}, {checks[-1].change}")
    for what, checks in found.items():
        tell(f"pairs: {what}", checks, what)


def lens_covariance(camera: Camera) -> np.ndarray:
    """Return a covariance of a camera's parameters that leaves PAIR_PX over the image, each parameter alike."""
    goal = projection_goal(camera)
    return np.diag(PAIR_PX**2 / (camera.parameters.size * np.maximum(np.diag(goal.weight), 1e-12)))
