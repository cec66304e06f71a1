"""`rigkit check` on real boards since pictures of before (`rigkit check --before`): see `bench_check.py`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from halves.captures import load

from checking.tally import FRESH, tell, turned
from rigkit.calibration.calibrate import calibrate
from rigkit.calibration.rig.calibrate import calibrate_rig
from rigkit.cameras.base import Camera
from rigkit.core.detections import BoardView
from rigkit.core.errors import RigkitError
from rigkit.core.identifiers import last_number
from rigkit.geometry.rigid3 import Rigid3
from rigkit.validation.monitoring.baseline import check_since
from rigkit.validation.monitoring.evidence import FreshView, Monitored, evidence_of
from rigkit.validation.monitoring.flipped import consistently_numbered
from rigkit.validation.monitoring.verdict import CalibrationCheck
from rigkit.validation.monitoring.watch import monitored_camera, monitored_rig

RIGS = ("bouguet", "bumblebee", "charuco-stereo")
"""Of these names with -left and -right."""
TURNED_DEG = (0.02, 0.1)
DRAWS = 5
"""Of pictures of before and fresh ones, a calibration."""


def since_cameras(name: str, data: Path, cache: Path, splits: int) -> None:
    """Check pictures of cameras that did not change since others, neither of which the calibration has."""
    found, size = load(name, data, cache)
    images, checks, rng = list(found.values()), list[CalibrationCheck](), np.random.default_rng(31)
    model = calibrate([v for own in images for v in own], size).camera.model
    for _ in range(splits):
        order = rng.permutation(len(images))
        half = len(images) // 2
        known = calibrate([v for i in order[half:] for v in images[i]], size, model=model)
        frames = [[FreshView(f"{i}", 0, v) for v in images[i]] for i in order[:half]]
        _draws(name, monitored_camera(known, "camera"), frames, checks, rng)
    tell(f"{name}: unchanged since", checks, "nothing")


def since_rigs(name: str, data: Path, cache: Path, splits: int) -> None:
    """The same of rigs, and with a mount that turned since."""
    rng = np.random.default_rng(37)
    found: dict[float, list[CalibrationCheck]] = {degrees: [] for degrees in (0.0, *TURNED_DEG)}
    loaded = {side: load(f"{name}-{side}", data, cache) for side in ("left", "right")}
    by_frame = {
        side: {last_number(Path(image).stem): views for image, views in own.items()}
        for side, (own, _) in loaded.items()
    }
    shared = sorted(set(by_frame["left"]) & set(by_frame["right"]))
    for _ in range(splits):
        order = rng.permutation(shared).tolist()
        half = len(order) // 2
        views = {side: [(k, v) for k in order[half:] for v in own[k]] for side, own in by_frame.items()}
        rig = monitored_rig(calibrate_rig(views, {side: size for side, (_, size) in loaded.items()}).mounted)
        frames = [_seen(rig, k, [own[k] for own in by_frame.values()]) for k in order[:half]]
        for degrees, checks in found.items():
            _draws(f"{name}, {degrees:g} deg", rig, frames, checks, np.random.default_rng(len(checks)), degrees)
    for degrees, checks in found.items():
        tell(
            f"{name}, since: turned by {degrees:g} deg",
            checks,
            "rotation" if degrees else "nothing",
            f"{degrees:g} deg",
        )


def _seen(rig: Monitored, frame: str, each: Sequence[Sequence[BoardView]]) -> list[FreshView]:
    """Return a frame, of boards that look the same turned counted from one end by all cameras."""
    out: list[FreshView] = []
    for c, views in enumerate(each):
        out += [consistently_numbered(rig, FreshView(frame, c, view), out) for view in views]
    return out


def _draws(
    name: str,
    monitored: Monitored,
    frames: Sequence[Sequence[FreshView]],
    checks: list[CalibrationCheck],
    rng: np.random.Generator,
    degrees: float = 0.0,
) -> None:
    """Add checks of frames since others, both drawn; the second camera turned between them."""
    for _ in range(DRAWS):
        order = rng.permutation(len(frames)).tolist()
        count = min(FRESH, len(frames) // 2)
        before = [v for k in order[count:] for v in frames[k]]
        fresh = [v for k in order[:count] for v in frames[k]]
        if degrees:
            fresh = [_after_turn(v, monitored.cameras[1], degrees, len(checks)) if v.camera == 1 else v for v in fresh]
        try:
            check = check_since(monitored, partial(evidence_of, views=before), partial(evidence_of, views=fresh))
        except RigkitError as error:
            print(f"{name}: {error}")
            continue
        checks.append(check)
        if not check.holds and not degrees:
            print(f"   {name}: chance {check.chance:.2g}, {check.change}", flush=True)


def _after_turn(fresh: FreshView, camera: Camera, degrees: float, seed: int) -> FreshView:
    """Return what a camera sees that was turned about its own centre."""
    turn = turned(Rigid3.identity(), degrees, np.random.default_rng([seed, 41])).rotation
    view = fresh.view
    pixels, seen = camera.project(camera.unproject(view.pixels)[0] @ turn.T)
    seen &= camera.on_image(pixels)
    return replace(fresh, view=BoardView(view.image, view.board, view.grid[seen], pixels[seen], view.sigma_px[seen]))
