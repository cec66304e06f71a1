"""`rigkit check` on real captures, and on real pairs of textured scenes: see `bench_check.py`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from halves.captures import load

from checking.tally import CHANGED_PX, FRESH, KINDS, checked, tell, unchanged
from rigkit.calibration.calibrate import calibrate
from rigkit.calibration.result import Calibration
from rigkit.cameras.base import Camera
from rigkit.core.detections import BoardView
from rigkit.core.errors import RigkitError
from rigkit.planning.goal import projection_goal
from rigkit.validation.monitoring.hypotheses import hypotheses_of
from rigkit.validation.monitoring.verdict import ALARM_CHANCE, ALARM_PX, CalibrationCheck
from rigkit.validation.monitoring.watch import monitored_camera


def real(name: str, data: Path, cache: Path, draws: int) -> None:
    found, size = load(name, data, cache)
    images = list(found.values())
    full = calibrate([v for own in images for v in own], size)
    model, board = full.camera.model, full.boards[0].kind
    print(f"{name}: {model}, board {board}, {full.rms_px:.3f} px")

    def solve(own: list[BoardView]) -> Calibration:
        # With folds, as users do: without them no other size of the model is a rival where no board was.
        return calibrate(own, size, model=model)

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


def ordered(name: str, data: Path, cache: Path) -> None:
    """Check the first and the last images of a capture, as their names order them, against the others: they may be
    unlike these, as images of another day are and random ones are not."""
    found, size = load(name, data, cache)
    images, checks = list(found.values()), []
    for fresh in dict.fromkeys((FRESH, len(images) // 4, len(images) // 2)):
        for parts in ((images[:fresh], images[fresh:]), (images[-fresh:], images[:-fresh])):
            own, others = ([v for image in part for v in image] for part in parts)
            try:
                checks.append(checked(calibrate(others, size), own))
            except RigkitError as error:
                print(f"{name}: {error}")
    tell(f"{name}: the first or last", checks, "nothing")


def touched(full: Calibration, what: str, rng: np.random.Generator) -> Camera:
    """Return a calibrated camera of any model after a change that leaves 0.15 px rms after the best rotation."""
    monitored = monitored_camera(full, "camera")
    (hypothesis,) = (c for c in hypotheses_of(monitored) if c.kind == what)
    amount = rng.standard_normal((hypothesis.directions.shape[1],))
    if what == "distortion":
        amount[1:] = 0.0
    step = (hypothesis.directions @ amount)[: full.camera.parameters.size]
    weight = projection_goal(full.camera).weight
    return full.camera.with_parameters(full.camera.parameters + step * CHANGED_PX / np.sqrt(step @ weight @ step))


UNCHANGED: dict[str, list[CalibrationCheck]] = {}
SAID: list[float] = []
"""Checks of unchanged cameras by set, and the chances with which changes were said to be found."""
MAX_FLAGGED = 0.02


def left_out() -> None:
    """Print how many unchanged cameras of every set alarm with the limit that other sets, if any, ask for."""
    if len(UNCHANGED) < 2:
        return
    flagged = count = 0
    for name, own in UNCHANGED.items():
        others = [c.chance if c.change is not None and c.change.max_px >= ALARM_PX else 1.0
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
