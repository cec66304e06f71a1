"""Tables of a calibrated rig: its cameras, its baselines, and what was left out."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np

from rigkit.calibration.rig import RigCalibration
from rigkit.geometry.rotation import log_so3
from rigkit.validation.checks import Check
from rigkit.validation.tables import Cell, Column, Table

__all__ = ["rig_tables"]


def rig_tables(rig: RigCalibration, checks: Sequence[Check]) -> tuple[Table, ...]:
    """Return the tables that stand first on the page of a rig."""
    tables = [_cameras(rig), _baselines(rig, checks)]
    if rig.left_out:
        columns = (Column("frame"), Column("board"), Column("why"))
        rows = tuple((Cell(frame), Cell(board), Cell(reason)) for frame, board, reason in rig.left_out)
        note = "Each camera's own calibration uses these views; the mounts do not rest on them."
        tables.append(Table("left-out", "Boards left out of the joint solution", columns, rows, note))
    return tuple(tables)


def _cameras(rig: RigCalibration) -> Table:
    columns = (
        Column("camera"),
        Column("model"),
        Column("held-out RMS alone", "px"),
        Column("training RMS alone", "px"),
        Column("RMS in the rig", "px"),
        *(Column(f"centre {axis}", "mm", 2) for axis in "xyz"),
        Column("turned by", "deg"),
    )
    rows = []
    for camera, alone in zip(rig.cameras, rig.single, strict=True):
        centre = camera.cam_from_rig.inverse().translation_mm
        turned = float(np.degrees(np.linalg.norm(log_so3(camera.cam_from_rig.rotation))))
        rows.append(
            (
                Cell(camera.name),
                Cell(camera.camera.model),
                Cell(alone.heldout_rms_px),
                Cell(alone.rms_px),
                Cell(camera.rms_px),
                *(Cell(float(c)) for c in centre),
                Cell(turned),
            )
        )
    note = (
        f"All intrinsics and mounts solved together: RMS {rig.rms_px:.3f} px over {rig.corner_count} corners, "
        f"{rig.shared_count} boards seen by several cameras at once. The frame is that of the first camera."
    )
    return Table("rig", "Cameras of the rig", columns, tuple(rows), note)


def _baselines(rig: RigCalibration, checks: Sequence[Check]) -> Table:
    columns = (Column("baseline"), Column("solved", "mm"), Column("measured", "mm"), Column("how"), Column("verdict"))
    rows = []
    for a, b in combinations([c.name for c in rig.cameras], 2):
        value, sigma = rig.baseline_mm(a, b)
        known = next((c for c in checks if c.name in (f"baseline {a}-{b}", f"baseline {b}-{a}")), None)
        measured = Cell(None) if known is None else Cell(known.measured, sigma=known.measured_sigma)
        verdict = "" if known is None else "pass" if known.passed else f"FAIL, off by {known.k:.1f} combined sigmas"
        rows.append(
            (
                Cell(f"{a} to {b}"),
                Cell(value, sigma=sigma),
                measured,
                Cell("" if known is None else known.how),
                Cell(verdict, failed=known is not None and not known.passed),
            )
        )
    return Table("baselines", "Distances between the cameras", columns, tuple(rows))
