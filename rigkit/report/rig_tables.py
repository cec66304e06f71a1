"""What a calibrated rig says of its cameras and boards: figures, sentences, and the tables of its page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from rigkit.calibration.rig.board_rig import BoardRig
from rigkit.calibration.rig.certainty.uncertainty import Transfer, transfer_uncertainty
from rigkit.calibration.rig.result import RigCalibration, RigCamera
from rigkit.core.tables import Cell, Column, Table, cells, columns, verdict_cell
from rigkit.core.truth import Feature
from rigkit.geometry.rotation import log_so3, rotation_angle
from rigkit.report.tables import rounded_parameters, rounded_words
from rigkit.validation.check import Check


@dataclass(frozen=True, slots=True)
class SolvedQuantity:
    """A length (mm) or angle (deg) between two cameras or boards, with its standard deviation."""

    a: str
    b: str
    value: float
    sigma: float


def baselines(rig: RigCalibration) -> list[SolvedQuantity]:
    """Return the distance of every two cameras, mm."""
    return [SolvedQuantity(a, b, *rig.baseline_mm(a, b)) for a, b in combinations([c.name for c in rig.cameras], 2)]


def transfers(rig: RigCalibration) -> list[Transfer | None]:
    """Return the uncertainty of points transferred between every two cameras; None for those without a common field."""
    return [transfer_uncertainty(rig, a, b) for a, b in combinations([c.name for c in rig.cameras], 2)]


def angles(target: BoardRig) -> list[SolvedQuantity]:
    """Return the angle of every two boards on one mount, deg."""
    return [SolvedQuantity(a, b, *target.angle_deg(a, b)) for a, b in combinations(target.names, 2)]


def place(camera: RigCamera) -> tuple[list[float], float]:
    """Return a camera's centre (mm) and rotation (deg) in the frame of the rig."""
    centre: list[float] = camera.cam_from_rig.inverse().translation_mm.tolist()
    return centre, float(np.degrees(rotation_angle(camera.cam_from_rig.rotation)))


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
        centre, rotation_deg = place(camera)
        errors = (alone.heldout_rms_px, alone.rms_px, camera.calibration.heldout_rms_px, camera.rms_px)
        rows.append(cells(camera.name, camera.camera.model, *errors, *centre, rotation_deg))
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
        "all sigmas)."
    )


def rig_reach(rig: RigCalibration, checks: Sequence[Check]) -> str:
    """Return in words the uncertainty of baselines and of transferred points, and how many measured facts hold."""
    sentences = []
    if len(rig.cameras) > 1:
        lengths = baselines(rig)
        worst = max(lengths, key=lambda length: length.sigma)
        least = "" if len(lengths) == 1 else ", the least certain"
        sentences.append(f"Baseline {worst.a} to {worst.b}{least}: {rounded_words(worst.value, worst.sigma)} mm.")
        if known := [transfer for transfer in transfers(rig) if transfer is not None]:
            t = max(known, key=lambda transfer: transfer.worst_px)
            sentences.append(
                f"Points transferred from {t.a} to {t.b}: ±{t.median_px:.2g} px (at worst ±{t.worst_px:.2g} "
                "px; one standard deviation)."
            )
    if checks:
        held = sum(check.passed for check in checks)
        sentences.append(f"{held} of {len(checks)} measured facts are confirmed.")
    return " ".join(sentences)


def _baselines(rig: RigCalibration, checks: Sequence[Check]) -> Table:
    heads = columns("baseline | solved [mm] | measured [mm] | how | verdict | transfer [px] | transfer at worst [px]")
    rows = []
    for length, transfer in zip(baselines(rig), transfers(rig), strict=True):
        sure = (None, None) if transfer is None else (transfer.median_px, transfer.worst_px)
        measured = _measured(checks, "baseline", length)
        rows.append(cells(f"{length.a} to {length.b}", Cell(length.value, sigma=length.sigma), *measured, *sure))
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
    for angle in angles(target):
        a, b = angle.a, angle.b
        both = (target.boards[target.index(name)].board for name in (a, b))
        # A symmetric board has no unique first corner to measure from.
        corners: tuple[float | None, float | None] = (None, None)
        if not any(board.looks_same_turned for board in both):
            corners = target.distance_mm(Feature(a, grid=(0, 0)), Feature(b, grid=(0, 0)))
        centres = target.distance_mm(Feature(a, centre=True), Feature(b, centre=True))
        measured = _measured(checks, "angle", angle)
        difference_cells = (Cell(value, sigma=sigma) for value, sigma in (corners, centres))
        rows.append(cells(f"{a} and {b}", Cell(angle.value, sigma=angle.sigma), *measured, *difference_cells))
    distances = [c for c in checks if c.kind == "distance"]
    note = f"Solved from {target.image_count} images that show at least two of these boards."
    note += "".join(
        f" {c.name}: {c.ours:.3f} ± {c.our_sigma:.3f} mm, measured {c.measured:g} ± {c.measured_sigma:g} ({c.how}): "
        + ("pass." if c.passed else f"FAIL, off by {c.k:.1f} combined sigmas.")
        for c in distances
    )
    key = f"boards-{target.names[0]}"
    return Table(key, "Rigidly mounted boards", heads, tuple(rows), note)


def _measured(checks: Sequence[Check], kind: str, solved: SolvedQuantity) -> tuple[Cell, Cell, Cell]:
    """Return the cells measured, how, and verdict of the check of a solved baseline or angle; empty without one."""
    names = (f"{kind} {solved.a}-{solved.b}", f"{kind} {solved.b}-{solved.a}")
    known = next((c for c in checks if c.name in names), None)
    if known is None:
        return Cell(None), Cell(""), Cell("")
    verdict = verdict_cell(known.passed, f"FAIL, off by {known.k:.1f} combined sigmas")
    return Cell(known.measured, sigma=known.measured_sigma), Cell(known.how), verdict
