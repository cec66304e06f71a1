"""Check the declarations of a pair against its corners: pose type, level, sizes and sides of the boards.

Declarations enter the reconstruction as priors or identities. A wrong one can change the result without any trace in
the measured lengths and angles. So pose type and level are always checked, with the calibrations' uncertainty where it
is known; sizes and sides are reported if contradicted.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray
from rigkit.core.errors import DegenerateError
from rigkit.core.posetype import PoseType
from rigkit.geometry.rotation import exp_so3
from rigkit.identification.board_ids import BOARD_SIDES
from rigkit.reconstruction.calibration_shifts import CalibrationShifts
from rigkit.reconstruction.geometry import PoseTypeDecision
from rigkit.reconstruction.reconstruct import Reconstruction
from rigkit.relative_pose.refinement.level_frames import LevelFrames
from rigkit.relative_pose.refinement.refine import refine_pose
from rigkit.relative_pose.refinement.select import CONTRADICTION_P, TypeEvidence, level_parts
from rigkit.validation.boards import BoardResult
from rigkit.validation.check import Check, compare

DECLARED = ("pose type", "level", "board size", "layout")
"""Kinds of checks of declarations, not of measured quantities."""
MAX_DECLARED_SIGMAS = 38.0
"""Deviation, in standard deviations, for a probability that underflows a float."""


BOARDS_AGREE = 0.003
"""Relative standard deviation of the size of well-measured squares: paper, flatness, pose."""
RULER_MM = 0.25
"""Standard deviation of a square's side if none is stated: half a millimetre of a ruler, read at both ends."""
SIDE_DEG = 15.0
"""Standard deviation of the direction of a declared side of a scene."""
LIMIT_K = 2.0
MAX_TURNED_DEG = 45.0
"""Largest rotation of the camera in the corner of a room for which people name its walls alike."""


def contradicted_boards(boards: Mapping[str, BoardResult], layout: Mapping[str, str]) -> tuple[Check, ...]:
    """Return a failed check for every board whose squares have another size than declared, relative to those of the
    other boards, and for every board that faces another side than the layout says.

    If only two boards disagree, both fail.
    """
    ratio = {name: b.size_ratio for name, b in boards.items()}
    checks = []
    sides = _sides(boards, layout)
    for name, found in boards.items():
        # With three boards or more the median includes the board itself, and is right if one of them is wrong.
        others = [value for other, value in ratio.items() if other != name or len(ratio) > 2]
        side = float(np.sqrt(found.board.square_x_mm * found.board.square_y_mm))
        if others:
            ours = (side * ratio[name] / float(np.median(others)), BOARDS_AGREE * side)
            known = (side, found.board.square_sigma_mm or RULER_MM, "declared; by the other boards")
            checks.append(compare(f"size {name}", "board size", "mm", known, ours, LIMIT_K, found.plane.count))
        if name in layout:
            off = {s: np.degrees(np.arccos(np.clip(found.plane.normal @ to, -1.0, 1.0))) for s, to in sides.items()}
            nearest = min(off, key=lambda s: float(off[s]))
            # 0 if the declared side is the nearest.
            beyond = (float(off[layout[name]] - off[nearest]), float("nan"))
            words = f"declared {layout[name]}, reconstructed {nearest}"
            known = (0.0, SIDE_DEG, words)
            checks.append(compare(f"layout {name}", "layout", "deg", known, beyond, LIMIT_K, found.plane.count))
    return tuple(check for check in checks if not check.passed)


def _sides(boards: Mapping[str, BoardResult], layout: Mapping[str, str]) -> dict[str, FloatArray]:
    """Return the direction that a board on each side of the scene faces.

    If two walls or more are listed, all are rotated about the camera's y axis to fit them: in the corner of a room no
    wall faces the camera's own axes.
    """
    sides = {side: np.array(to) for side, to in BOARD_SIDES.items()}
    walls = [(boards[name].plane.normal, sides[side]) for name, side in layout.items() if name in boards]
    walls = [(normal, to) for normal, to in walls if to[1] == 0.0]
    if len(walls) < 2:
        return sides
    # The sum of the cosines is along cos(turn) + across sin(turn).
    along = sum(float(n[0] * to[0] + n[2] * to[2]) for n, to in walls)
    across = sum(float(n[0] * to[2] - n[2] * to[0]) for n, to in walls)
    most = np.radians(MAX_TURNED_DEG)
    turn = exp_so3([0.0, float(np.clip(np.arctan2(across, along), -most, most)), 0.0])
    return {side: np.asarray(turn @ to) for side, to in sides.items()}


def declaration_checks(
    reconstruction: Reconstruction, shifts: CalibrationShifts | None = None
) -> tuple[tuple[Check, ...], tuple[str, ...]]:
    """Return the checks of the declared pose type and level, and messages about what could not be checked.

    What noise and level do not explain the calibrations may (`shifts`). Both are empty for the general type and "auto",
    which declare nothing.
    """
    if reconstruction.geometry is None:
        return (), ()
    decision, count = reconstruction.geometry.decision, len(reconstruction.cloud)
    if decision.evidence is None or decision.declared in (PoseType.AUTO, PoseType.GENERAL):
        return (), ()
    checks, unchecked = [], []
    # Two level cameras at one height are the planar type, which the others imply.
    for kind, name, pose_type in (
        ("pose type", f"pose type {decision.declared}", decision.declared),
        ("level", "level", PoseType.PLANAR),
    ):
        found = decision.evidence.of(pose_type)
        if found is None:
            unchecked.append(f"{name}: no pose of that type puts the points in front of both cameras")
        else:
            if shifts is not None and found.deviations is not None and found.p_value < CONTRADICTION_P:
                with suppress(DegenerateError):
                    of_cameras = _of_calibrations(shifts, found.pose_type, decision.level_frames)
                    found = replace(found, p_value=found.deviations.p_value(of_cameras))
            checks.append(_check(kind, name, found, decision, count))
    return tuple(checks), tuple(unchecked)


def _of_calibrations(shifts: CalibrationShifts, kind: PoseType, frames: LevelFrames | None) -> FloatArray:
    """Return the covariance (K, K) of the deviations from a pose type that comes from the calibrations: those of the
    general pose, estimated again with each of the moved cameras."""
    base, *moved = (_deviations(r, shifts.known, kind, frames) for r in (shifts.base, *shifts.moved))
    changes = np.array(moved).reshape(-1, len(base)) - base
    return np.asarray(changes.T @ changes)


def _deviations(r: Reconstruction, seen: BoolArray, kind: PoseType, frames: LevelFrames | None) -> FloatArray:
    captured = replace(r.matches.select(seen), pixels1=r.pixels1[seen], pixels2=r.pixels2[seen])
    matches, pose = captured.with_cameras(r.camera1, r.camera2), r.cam2_from_cam1
    if frames is not None:
        matches, pose = frames.matches(matches), frames.level_pose(pose)
    return level_parts(refine_pose(matches, pose), kind)[0]


def _check(kind: str, name: str, found: TypeEvidence, decision: PoseTypeDecision, count: int) -> Check:
    """Return the check of a declaration: the declared deviation is 0, and k is that of a normal with the same p-value.

    Several angles are tested at once: their combined sigma is that of a single angle with the same p-value.
    """
    from scipy.special import ndtri

    assert decision.evidence is not None
    level_deg, ours = (float(np.rad2deg(v)) for v in (decision.evidence.level_sigma_rad, found.deviation_rad))
    k = min(float(-ndtri(0.5 * max(found.p_value, 1e-320))), MAX_DECLARED_SIGMAS)
    limit = float(-ndtri(0.5 * CONTRADICTION_P))
    combined = ours / k if k > 1.0 else max(ours, level_deg)
    return Check(
        name=name,
        kind=kind,
        unit="deg",
        measured=0.0,
        measured_sigma=level_deg,
        how="declared",
        ours=ours,
        our_sigma=float("nan"),
        difference=ours,
        combined_sigma=combined,
        k=k,
        limit_k=limit,
        passed=found.p_value >= CONTRADICTION_P,
        count=count,
    )
