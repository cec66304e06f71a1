"""Tables of a calibrated rig: cameras, baselines, mounts, intrinsics, boards, and views left out."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np

from rigkit.calibration.rig.board_rig import BoardRig
from rigkit.calibration.rig.certainty.uncertainty import transfer_uncertainty
from rigkit.calibration.rig.result import RigCalibration
from rigkit.calibration.rig.verdicts import lag_words
from rigkit.core.tables import Cell, Column, Table, cells, columns, verdict_cell
from rigkit.core.truth import Feature
from rigkit.geometry.rotation import log_so3
from rigkit.report.tables import rounded_parameters, rounded_words
from rigkit.validation.check import Check


def rig_tables(rig: RigCalibration, checks: Sequence[Check]) -> tuple[Table, ...]:
    """Return the tables of a rig's page."""
    tables = [_cameras(rig)]
    if len(rig.cameras) > 1:
        tables += [_baselines(rig, checks), _mounts(rig)]
    tables.append(_intrinsics(rig))
    tables += [_angles(target, checks) for target in rig.board_rigs]
    if rig.left_out:
        heads, rows = columns("frame | board | why"), tuple(cells(*entry) for entry in rig.left_out)
        note = "Outliers: each camera's own calibration uses these views, the extrinsics do not."
        tables.append(Table("left-out", "Boards left out of the joint solution", heads, rows, note))
    return tuple(tables)


def _cameras(rig: RigCalibration) -> Table:
    heads = columns(
        "camera | model | held-out RMS alone [px] | training RMS alone [px] | held-out RMS in the rig [px] | "
        "training RMS in the rig [px] | centre x [mm] .2 | centre y [mm] .2 | centre z [mm] .2 | rotation [deg]"
    )
    rows = []
    for camera, alone in zip(rig.cameras, rig.single, strict=True):
        centre = camera.cam_from_rig.inverse().translation_mm
        turned = float(np.degrees(np.linalg.norm(log_so3(camera.cam_from_rig.rotation))))
        errors = (alone.heldout_rms_px, alone.rms_px, camera.calibration.heldout_rms_px, camera.rms_px)
        rows.append(cells(camera.name, camera.camera.model, *errors, *centre.tolist(), turned))
    return Table("rig", "Cameras of the rig", heads, tuple(rows), "The frame is that of the first camera.")


def _intrinsics(rig: RigCalibration) -> Table:
    """Return the intrinsics of the joint solution, one column for each camera."""
    sigmas = rig.sigmas
    own_words: list[dict[str, str]] = []
    start = 0
    for camera in rig.cameras:
        end = start + camera.camera.parameters.size
        own_words.append(rounded_parameters(camera.camera, sigmas[start:end]))
        start = end
    rows = tuple(
        cells(name, *(words.get(name, "–") for words in own_words))
        for name in dict.fromkeys(name for words in own_words for name in words)
    )
    heads = (Column("parameter"), *(Column(f"{c.name} ({c.camera.model})") for c in rig.cameras))
    note = "Of the joint solution, with one standard deviation; fx, fy, cx and cy in px."
    return Table("intrinsics", "Intrinsics in the rig", heads, rows, note)


def _mounts(rig: RigCalibration) -> Table:
    """Return the poses of the cameras relative to the first one."""
    sigmas = rig.sigmas
    heads = (Column("camera"), *(Column(f"rotation about {a}", "deg") for a in "xyz"))
    heads += tuple(Column(f"translation along {a}", "mm") for a in "xyz")
    rows = []
    for k, camera in enumerate(rig.cameras[1:], start=1):
        own = sigmas[rig.mount(k)]
        turned, turned_sigma = np.degrees(log_so3(camera.cam_from_rig.rotation)), np.degrees(own[:3])
        values = zip([*turned, *camera.cam_from_rig.translation_mm], [*turned_sigma, *own[3:]], strict=True)
        rows.append(cells(camera.name, *(Cell(float(v), sigma=float(s)) for v, s in values)))
    note = "cam_from_rig: rotation vector and translation, with one standard deviation."
    return Table("mounts", "Extrinsics", heads, tuple(rows), note)


def rig_basis(rig: RigCalibration) -> str:
    """Return the data that the rig's solution is based on, in words."""
    return (
        "Intrinsics and extrinsics are solved jointly; held out: frames not used, with one board pose for all "
        f"cameras. {rig.corner_count} corners, {rig.shared_count} poses shared by several views. Overdispersion "
        f"{rig.overdispersion:.2f}: frames disagree that many times as much as independent corners would (included in "
        "all "
        "sigmas)." + "".join(f" {words[0].upper()}{words[1:]}." for words in lag_words(rig))
    )


def rig_reach(rig: RigCalibration, checks: Sequence[Check]) -> str:
    """Return in words the uncertainty of baselines and of transferred points, and how many measured facts hold."""
    sentences = []
    names = [camera.name for camera in rig.cameras]
    pairs = list(combinations(names, 2))
    if pairs:
        values = {pair: rig.baseline_mm(*pair) for pair in pairs}
        (a, b), (value, sigma) = max(values.items(), key=lambda of: of[1][1])
        least = "" if len(pairs) == 1 else ", the least certain"
        sentences.append(f"Baseline {a} to {b}{least}: {rounded_words(value, sigma)} mm.")
        sure = {pair: transfer_uncertainty(rig, *pair) for pair in pairs}
        known = {pair: transfer for pair, transfer in sure.items() if transfer is not None}
        if known:
            (a, b), transfer = max(known.items(), key=lambda of: of[1].worst_px)
            sentences.append(
                f"Points transferred from {a} to {b}: ±{transfer.median_px:.2g} px (at worst ±{transfer.worst_px:.2g} "
                "px; one standard deviation)."
            )
    if checks:
        held = sum(check.passed for check in checks)
        sentences.append(f"{held} of {len(checks)} measured facts are confirmed.")
    return " ".join(sentences)


def _baselines(rig: RigCalibration, checks: Sequence[Check]) -> Table:
    heads = columns("baseline | solved [mm] | measured [mm] | how | verdict | transfer [px] | transfer at worst [px]")
    rows = []
    for a, b in combinations([c.name for c in rig.cameras], 2):
        value, sigma = rig.baseline_mm(a, b)
        transfer = transfer_uncertainty(rig, a, b)
        sure = (None, None) if transfer is None else (transfer.median_px, transfer.worst_px)
        measured = _measured(checks, f"baseline {a}-{b}", f"baseline {b}-{a}")
        rows.append(cells(f"{a} to {b}", Cell(value, sigma=sigma), *measured, *sure))
    note = (
        "Transfer: standard deviation of a point transferred from one camera's image to the other's, median and worst "
        "of the boards' corners."
    )
    return Table("baselines", "Baselines", heads, tuple(rows), note)


def _angles(target: BoardRig, checks: Sequence[Check]) -> Table:
    heads = columns(
        "boards | angle [deg] | measured [deg] | how | verdict | between first corners [mm] | between centres [mm]"
    )
    rows = []
    for a, b in combinations(target.names, 2):
        value, sigma = target.angle_deg(a, b)
        both = (target.boards[target.index(name)].board for name in (a, b))
        # A symmetric board has no unique first corner to measure from.
        corners: tuple[float | None, float | None] = (None, None)
        if not any(board.looks_same_turned for board in both):
            corners = target.distance_mm(Feature(a, grid=(0, 0)), Feature(b, grid=(0, 0)))
        centres = target.distance_mm(Feature(a, centre=True), Feature(b, centre=True))
        measured = _measured(checks, f"angle {a}-{b}", f"angle {b}-{a}")
        difference_cells = (Cell(value, sigma=sigma) for value, sigma in (corners, centres))
        rows.append(cells(f"{a} and {b}", Cell(value, sigma=sigma), *measured, *difference_cells))
    distances = [c for c in checks if c.kind == "distance"]
    note = f"Solved from {target.image_count} images that show at least two of these boards."
    note += "".join(
        f" {c.name}: {c.ours:.3f} +- {c.our_sigma:.3f} mm, measured {c.measured:g} +- {c.measured_sigma:g} ({c.how}): "
        + ("pass." if c.passed else f"FAIL, off by {c.k:.1f} combined sigmas.")
        for c in distances
    )
    key = f"boards-{target.names[0]}"
    return Table(key, "Rigidly mounted boards", heads, tuple(rows), note)


def _measured(checks: Sequence[Check], *names: str) -> tuple[Cell, Cell, Cell]:
    """Return the cells measured, how, and verdict of the check with one of these names; empty cells without one."""
    known = next((c for c in checks if c.name in names), None)
    if known is None:
        return Cell(None), Cell(""), Cell("")
    verdict = verdict_cell(known.passed, f"FAIL, off by {known.k:.1f} combined sigmas")
    return Cell(known.measured, sigma=known.measured_sigma), Cell(known.how), verdict
