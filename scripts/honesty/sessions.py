"""Errors over sigmas of lens, extrinsics and baseline in sessions of three to twenty images; of boards mounted to each
other, and of a camera on a robot's hand.

Corners are simulated with independent errors, and a smooth error common to an image, as by blur, light or a bending
board. Boards are seen whole, or, as ChArUco boards may be, only on one side of a line across them.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import replace
from itertools import combinations

import numpy as np
from helpers.board_rig_scenes import DIFFERENT, corner_of_a_room, target_views
from helpers.calibration_scenes import BOARD, REACH_DEG, SIZE, lens, random_views

from rigkit.calibration.calibrate import calibrate
from rigkit.calibration.certainty.coverage import covered_by_boards
from rigkit.calibration.certainty.uncertainty import projection_uncertainty
from rigkit.calibration.hand_eye import hand_eye
from rigkit.calibration.result import Calibration
from rigkit.calibration.rig.calibrate import calibrate_rig
from rigkit.cameras.base import Camera
from rigkit.cameras.compare import best_rotation, grid_pixels
from rigkit.cameras.convert import convert_camera
from rigkit.cameras.registry import MODELS
from rigkit.core.arrays import FloatArray
from rigkit.core.detections import BoardView
from rigkit.core.errors import DegenerateError, RigkitError
from rigkit.core.truth import Feature
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import angle_between, exp_so3, log_so3

LENSES = ("reg", "wide", "fish")
"""Of 60, 110 and 185 degrees."""
IMAGES = (3, 4, 5, 7, 10, 20)
COMMON_PX = (0.0, 0.02, 0.05)
CORNERS_PX = 0.03
SHOWN = (0.4, 1.0)
"""Part of a board that is seen where boards are seen in part."""
GRID = (24, 18)
MOUNT = Rigid3(exp_so3(np.array([0.01, -0.08, 0.005])), [-120.0, 3.0, 8.0])
SECOND_CENTRE = np.array([800.0, 622.0])
PLACED_TRIES = 20000
TARGET_AWAY_MM = 1000.0
CAM_FROM_HAND = Rigid3(exp_so3(np.array([0.3, -1.2, 0.4])), [30.0, -60.0, 90.0])
BASE_FROM_BOARD = Rigid3(exp_so3(np.array([2.0, 0.4, -0.3])), [400.0, 120.0, -15.0])
ROBOT_RAD, ROBOT_MM = 2e-4, 0.1
"""What a robot's pose is off by, each number."""

Errors = dict[str, list[float]]
"""Of every quantity, errors in stated sigmas."""


def disturbed(view: BoardView, common_px: float, whole: bool, rng: np.random.Generator) -> BoardView:
    """Return an exact view as detection would have it."""
    x, y = (view.grid / (np.array(BOARD.size) - 1.0) * 2.0 - 1.0).T
    fields = np.stack([x * x, x * y, y * y, x * x * y, x * y * y], axis=-1)
    error = common_px * fields @ rng.normal(size=(5, 2)) + CORNERS_PX * rng.normal(size=view.pixels.shape)
    pixels = np.clip(view.pixels + error, -0.5, np.array(SIZE) - 0.5)
    seen = np.ones(len(pixels), dtype=bool)
    if not whole:
        about = rng.uniform(0.0, 2.0 * np.pi)
        across = np.cos(about) * x + np.sin(about) * y
        seen = across <= np.quantile(across, rng.uniform(*SHOWN))
    sigma = np.full(int(seen.sum()), CORNERS_PX)
    return replace(view, pixels=pixels[seen], grid=view.grid[seen], sigma_px=sigma)


def lens_in_sigmas(found: Calibration, truth: Camera) -> list[float]:
    """Return the errors of the projection where boards were, after the rotation that no camera knows, (u and v)."""
    pixels = grid_pixels(SIZE, GRID).reshape(-1, 2)
    rays, known = truth.unproject(pixels)
    declared = covered_by_boards(found, pixels) & known & found.camera.unproject(pixels)[1]
    pixels, rays = pixels[declared], rays[declared]
    turn = best_rotation(rays, pixels, np.ones(len(pixels)), found.camera)
    error = found.camera.project(rays @ turn.T)[0] - pixels
    variance = np.diagonal(projection_uncertainty(found, pixels).covariance, axis1=1, axis2=2)
    return (error / np.sqrt(variance)).ravel().tolist()


def camera_session(name: str, images: int, common_px: float, whole: bool, rng: np.random.Generator) -> Errors:
    return {"lens": _of_one_camera(name, lens(name), images, common_px, whole, rng)}


def _of_one_camera(
    name: str, truth: Camera, images: int, common_px: float, whole: bool, rng: np.random.Generator
) -> list[float]:
    views, _, _ = random_views(truth, images, rng, reach_deg=REACH_DEG[name], noise_px=0.0)
    views = [disturbed(view, common_px, whole, rng) for view in views]
    return lens_in_sigmas(calibrate(views, SIZE, model=truth.model), truth)


def models_session(name: str, images: int, common_px: float, whole: bool, rng: np.random.Generator) -> Errors:
    """Return the errors with the lens turned into one of each model that can follow it."""
    out: Errors = {}
    for model in MODELS:
        try:
            truth = convert_camera(lens(name), model).camera
            own = _of_one_camera(name, truth, images, common_px, whole, rng)
        except RigkitError:
            continue
        out[f"lens, {model}"] = own
    return out


def pair_session(name: str, images: int, common_px: float, whole: bool, rng: np.random.Generator) -> Errors:
    cameras = {"left": (lens(name), Rigid3.identity()), "right": (lens(name, SECOND_CENTRE), MOUNT)}
    views = _frames(cameras, images, common_px, whole, rng)
    rig = calibrate_rig(views, dict.fromkeys(cameras, SIZE), model=lens(name).model)
    length, sigma = rig.baseline_mm("left", "right")
    mount = rig.cameras[1].cam_from_rig
    off = [*log_so3(mount.rotation @ MOUNT.rotation.T), *(mount.translation_mm - MOUNT.translation_mm)]
    lenses = [lens_in_sigmas(rig.cameras[k].calibration, camera) for k, (camera, _) in enumerate(cameras.values())]
    return {
        "lenses of a pair": [*lenses[0], *lenses[1]],
        "mount": (np.array(off) / rig.sigmas[rig.mount(1)]).tolist(),
        "baseline": [(length - float(np.linalg.norm(MOUNT.translation_mm))) / sigma],
    }


def boards_session(name: str, images: int, common_px: float, whole: bool, rng: np.random.Generator) -> Errors:
    room = corner_of_a_room(rng, DIFFERENT)
    camera = {name: (lens(name), Rigid3.identity())}
    exact = target_views(rng, camera, DIFFERENT, room, images, noise_px=0.0, distance_mm=TARGET_AWAY_MM)
    seen = {k: [(frame, disturbed(view, common_px, whole, rng)) for frame, view in own] for k, own in exact.items()}
    ids = [board.board_id for board in DIFFERENT]
    found = calibrate_rig(seen, {name: SIZE}, model=lens(name).model, rigid_boards=[ids]).board_rigs[0]
    middle = {board.board_id: room[board.board_id].apply(board.points().mean(axis=0)) for board in DIFFERENT}
    out: Errors = {"boards, angles": [], "boards, distances": []}
    for a, b in combinations(ids, 2):
        angle, sigma = found.angle_deg(a, b)
        between = angle_between(room[a].rotation[:, 2], room[b].rotation[:, 2])
        out["boards, angles"].append((angle - 180.0 + float(np.degrees(between))) / sigma)
        length, sigma = found.distance_mm(Feature(a, centre=True), Feature(b, centre=True))
        out["boards, distances"].append((length - float(np.linalg.norm(middle[a] - middle[b]))) / sigma)
    return out


def hand_session(name: str, images: int, common_px: float, whole: bool, rng: np.random.Generator) -> Errors:
    exact, rotations, translations = random_views(lens(name), images, rng, reach_deg=REACH_DEG[name], noise_px=0.0)
    declared = []
    for rotation, translation in zip(rotations, translations, strict=True):
        true = CAM_FROM_HAND.inverse() @ Rigid3(rotation, translation) @ BASE_FROM_BOARD.inverse()
        turn = exp_so3(ROBOT_RAD * rng.normal(size=3))
        declared.append(Rigid3(turn @ true.rotation, true.translation_mm + ROBOT_MM * rng.normal(size=3)))
    found = hand_eye(lens(name), [disturbed(view, common_px, whole, rng) for view in exact], declared)
    turns, moves = found.sigmas()
    out: Errors = {"hand-eye, turns": [], "hand-eye, places": []}
    pairs = ((found.cam_from_mount, CAM_FROM_HAND), (found.stand_from_board, BASE_FROM_BOARD))
    for (pose, true), turn, move in zip(pairs, turns, moves, strict=True):
        out["hand-eye, turns"] += (log_so3(pose.rotation @ true.rotation.T) / turn).tolist()
        out["hand-eye, places"] += ((pose.translation_mm - true.translation_mm) / move).tolist()
    return out


ONE_LENS = (pair_session, boards_session, hand_session)
"""What is tried with the first lens alone."""


def _frames(
    cameras: dict[str, tuple[Camera, Rigid3]], images: int, common_px: float, whole: bool, rng: np.random.Generator
) -> dict[str, list[tuple[str, BoardView]]]:
    """Return what each camera sees of a board that all see whole, frame by frame."""
    out: dict[str, list[tuple[str, BoardView]]] = {name: [] for name in cameras}
    taken = 0
    for _ in range(PLACED_TRIES):
        pose = _placed(rng)
        seen = {name: (c, *c.project((m @ pose).apply(BOARD.points()))) for name, (c, m) in cameras.items()}
        if not all(valid.all() and c.on_image(pixels).all() for c, pixels, valid in seen.values()):
            continue
        for name, (_, pixels, _) in seen.items():
            view = BoardView(f"{name}{taken}.png", BOARD, BOARD.grid(), pixels, np.full(len(pixels), CORNERS_PX))
            out[name].append((f"{taken:03d}", disturbed(view, common_px, whole, rng)))
        taken += 1
        if taken == images:
            return out
    raise DegenerateError("honesty: no board was placed where both cameras see it")


def _placed(rng: np.random.Generator) -> Rigid3:
    axis, tilt = rng.uniform(-np.pi, np.pi), np.radians(rng.uniform(10.0, 45.0))
    turned = exp_so3(tilt * np.array([np.cos(axis), np.sin(axis), 0.0]))
    turned = turned @ exp_so3(np.array([0.0, 0.0, rng.uniform(-np.pi, np.pi)]))
    away = rng.uniform(330.0, 750.0)
    middle = np.array([rng.uniform(-0.55, 0.55) * away, rng.uniform(-0.42, 0.42) * away, away])
    return Rigid3(turned, middle - turned @ BOARD.points().mean(axis=0))


def sessions(images: int, seeds: int, *, models: bool = False) -> dict[tuple[str, str], FloatArray]:
    """Return the errors in stated sigmas of sessions of so many images, by quantity and by how boards are seen; with
    `models` of one camera alone, with lenses of every model."""
    errors: dict[tuple[str, str], list[float]] = defaultdict(list)
    for whole in (True, False):
        for common_px in COMMON_PX:
            for seed in range(seeds):
                for k, name in enumerate(LENSES):
                    alone = (models_session,) if models else (camera_session,)
                    for make in (*alone, *(ONE_LENS if name == LENSES[0] and not models else ())):
                        rng = np.random.default_rng([seed, images, k, int(1e3 * common_px), whole])
                        try:
                            found = make(name, images, common_px, whole, rng)
                        except RigkitError as error:
                            print(f"{images} images, {name}: {error}", flush=True)
                            continue
                        for what, own in found.items():
                            errors[what, "whole" if whole else "in part"] += own
    return {key: np.abs(own) for key, own in errors.items()}
