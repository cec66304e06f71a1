"""Shared by the benchmarks of `rigkit check`: changes, checks without a change, and counts of alarms."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence

import numpy as np

from rigkit.calibration.result import Calibration
from rigkit.core.detections import BoardView
from rigkit.core.errors import RigkitError
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3, unit
from rigkit.validation.monitoring.evidence import FreshView
from rigkit.validation.monitoring.verdict import CalibrationCheck, check_views
from rigkit.validation.monitoring.watch import monitored_camera

CHANGED_PX, SCENE_TURNED_DEG = 0.15, 0.05
FRESH = 3
KINDS = ("focus", "principal point", "distortion")

TALLY: dict[str, list[int]] = {}
COUNTED = {"beyond_model": True}
"""Whether what lenses may do beyond their models is counted in."""


def tell(title: str, checks: Sequence[CalibrationCheck], what: str, how: str = "") -> None:
    """Print how many of the checks alarm, and how many of these name `what` happened; keep the sums, by `how` pictures
    were taken."""
    alarms = [c for c in checks if not c.holds]
    kinds = Counter("none" if c.change is None else c.change.hypothesis.kind for c in alarms)
    right = kinds[what]
    print(
        f"{title:32s} {len(alarms):3d} of {len(checks)} alarm, {right} of them rightly named: {dict(kinds)}", flush=True
    )
    kind = "unchanged" if what == "nothing" else "changed"
    sums = TALLY.setdefault(f"{kind}, {how} pictures" if how else kind, [0, 0, 0])
    for k, more in enumerate((len(alarms), len(checks), right)):
        sums[k] += more


def checked(known: Calibration, views: Sequence[BoardView]) -> CalibrationCheck:
    monitored = monitored_camera(known, "camera", **COUNTED)
    return check_views(monitored, [FreshView(v.image, 0, v) for v in views])


def unchanged(
    title: str,
    images: Sequence[Sequence[BoardView]],
    draws: int,
    solve: Callable[[list[BoardView]], Calibration],
) -> list[CalibrationCheck]:
    """Check images of a camera that did not change, three, halves, and these in threes, against calibrations from the
    others; return the checks."""
    every: list[CalibrationCheck] = []
    for fresh in (FRESH, len(images) // 2):
        rng, checks, threes = np.random.default_rng([fresh, 3]), [], []
        for _ in range(draws):
            order = rng.permutation(len(images)).tolist()
            try:
                known = solve([v for i in order[fresh:] for v in images[i]])
                checks.append(checked(known, [v for i in order[:fresh] for v in images[i]]))
                for first in range(0, fresh - FRESH + 1, FRESH) if fresh > FRESH else ():
                    threes.append(checked(known, [v for i in order[first : first + FRESH] for v in images[i]]))
            except RigkitError as error:
                print(f"{title}: {error}")
        tell(f"{title}: unchanged, {fresh} of {len(images)}", checks, "nothing")
        if threes:
            tell(f"{title}: unchanged, {fresh} of {len(images)} in threes", threes, "nothing")
        for c in (*checks, *threes):
            if not c.holds:
                print(f"   chance {c.chance:.2g}, {c.change}, size {c.change.size_px if c.change else 0.0:.3f} px, "
                      f"rms {c.rms_px:.3f} -> {c.rms_fixed_px:.3f}, expected {c.expected_px:.3f}")  # fmt: skip
        every += [*checks, *threes]
    return every


def turned(pose: Rigid3, degrees: float, rng: np.random.Generator) -> Rigid3:
    turn = exp_so3(np.radians(degrees) * unit(rng.standard_normal(3)))
    return Rigid3(turn @ pose.rotation, turn @ pose.translation_mm)
