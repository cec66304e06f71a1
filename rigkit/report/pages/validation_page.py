"""The HTML report of a validation: a self-contained page with an interactive 3D view of every pair, and its tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from rigkit.calibration.certainty.uncertainty import FarProjection
from rigkit.calibration.result import Calibration
from rigkit.core.findings import Severity
from rigkit.core.printing import counted
from rigkit.core.tables import Cell, Column, Table, cells, columns, verdict_cell
from rigkit.reconstruction.reconstruct import Reconstruction
from rigkit.report.pages.page_facts import PageFacts
from rigkit.report.pages.validation_verdict import ValidationVerdict
from rigkit.report.pictures.scene_view import scene_of
from rigkit.report.render import data_uri, render, table_context
from rigkit.report.tables import measured_words
from rigkit.validation.checks import ValidationReport
from rigkit.validation.crosscheck import CrossCheckReport
from rigkit.validation.tables import check_table, mean_normal_error


@dataclass(frozen=True, eq=False, slots=True)
class PairSection:
    """One pair on the page."""

    pair_id: str
    lead: str
    tables: tuple[Table, ...]
    images: tuple[tuple[str, str, bytes], ...]
    """(caption, MIME type, bytes)."""
    scene: Mapping[str, Any] | None
    notes: tuple[str, ...] = ()


def build_page(
    title: str,
    lead: str,
    verdict: ValidationVerdict,
    summary: Sequence[Table],
    pairs: Sequence[PairSection],
    provenance: Mapping[str, str],
    remarks: Sequence[str] = (),
) -> str:
    """Return the self-contained page. Its first 3D view shows the first failed pair, or the first one; `remarks` are
    below the `summary` tables."""
    shown = [
        {
            "pair_id": pair.pair_id,
            "lead": pair.lead,
            "tables": [table_context(table) for table in pair.tables],
            "images": [(caption, data_uri(mime, data)) for caption, mime, data in pair.images],
            "scene": pair.scene,
            "notes": pair.notes,
        }
        for pair in pairs
    ]
    return render(
        "validation.html",
        title=title,
        lead=lead,
        passed=verdict.passed,
        verdict=_first_screen(verdict, pairs),
        remarks=remarks,
        summary=[table_context(table) for table in summary],
        pairs=shown,
        provenance=provenance,
    )


def validation_facts(
    lead: str,
    verdict: ValidationVerdict,
    summary: Sequence[Table],
    pairs: Sequence[PairSection],
    remarks: Sequence[str] = (),
) -> PageFacts:
    """Return the facts of a validation."""
    return PageFacts(
        headline=verdict.headline,
        badge=verdict.badge,
        passed=verdict.passed,
        sentences=(*verdict.sentences, *remarks),
        basis=lead,
        tables=tuple(summary),
        parts={p.pair_id: PageFacts(headline=p.lead, sentences=p.notes, tables=p.tables) for p in pairs},
    )


def _first_screen(verdict: ValidationVerdict, pairs: Sequence[PairSection]) -> dict[str, Any]:
    failed = {fact.pair_id for fact in verdict.failed}
    seen = [pair for pair in pairs if pair.scene is not None]
    shown = next((pair for pair in seen if pair.pair_id in failed), seen[0] if seen else None)
    return {
        "words": verdict.badge,
        "colour": "pass" if verdict.passed else "fail",
        "headline": verdict.headline,
        "fineness": verdict.fineness,
        "failed": verdict.failed,
        "causes": verdict.causes,
        "shown": "" if shown is None else shown.pair_id,
        "scene": None if shown is None else shown.scene,
    }


SUMMARY_WORDS = (
    "Estimator: of the affine transformation at each corner, from the directions of its edges (F2UDIR, F3UDIR, "
    "DET3UDIR, 2SDIR, 3SDIR: L. Hajder, Affine Correspondences in Stereo Vision: Theory, Practice, and Limitations); "
    "the one whose normals agree best with the planes is shown. Angle error: angle between planes fitted to the points "
    "minus the measured one. Normal error: angle between the normal at a corner, from its affine transformation, and "
    "that of its board's plane. Sampson: first-order distance of a corner from its epipolar curve."
)


def summary_table(reports: Sequence[ValidationReport]) -> Table:
    """Return one row for each pair: errors, baseline measured and computed, and verdict."""
    heads = columns(
        "pair | pose type | estimator | points .0 | worst angle error [deg] | mean normal error [deg] | "
        "baseline measured [mm] .1 | baseline [mm] .2 | Sampson rms [px] | verdict"
    )
    rows = []
    for report in reports:
        known = next((c for c in report.checks if c.kind == "baseline"), None)
        angles = [a.error_deg for a in report.angles if a.error_deg is not None]
        measured = None if known is None else Cell(known.measured, sigma=known.measured_sigma)
        rows.append(
            cells(report.pair_id, report.pose_type, report.affine_method, report.count, max(angles, default=None))
            + cells(mean_normal_error([report]), measured, Cell(report.baseline_mm, sigma=report.baseline_sigma_mm))
            + cells(report.sampson_rms_px, verdict_cell(report.passed))
        )
    return Table("summary", "Every pair with its best estimator", heads, tuple(rows))


def camera_table(calibrations: Mapping[str, Calibration]) -> Table:
    """Return one row for each calibrated camera: images, corners, errors and uncertainty."""
    heads = columns(
        "camera | model | images .0 | corners .0 | held-out RMS [px] | training RMS [px] | uncertainty, median [px] "
        ".4 | uncertainty, 95 % [px] .4 | remarks"
    )
    rows = []
    for name, c in calibrations.items():
        uncertainty = FarProjection.of(c).at_corners_px
        middle, high = np.nanquantile(uncertainty, [0.5, 0.95])
        remarks = sum(verdict.severity is not Severity.GOOD for verdict in c.verdicts)
        rows.append(
            cells(name, c.camera.model, len({view.image for view in c.views}), c.corner_count, c.heldout_rms_px)
            + cells(c.rms_px, float(middle), float(high), f"{remarks}, below" if remarks else "none")
        )
    note = (
        "Held out: on images not used for the calibration, with fixed intrinsics and only the board's pose fitted. "
        "Training: on the images used. Both are sqrt(mean |residual|²) over corners. Uncertainty: of the projection "
        "where boards were seen, standard deviation in the worst direction."
    )
    return Table("cameras", "Calibrations", heads, tuple(rows), note)


def camera_remarks(calibrations: Mapping[str, Calibration]) -> tuple[str, ...]:
    """Return the calibrations' verdicts LOOK and BAD, with the camera names."""
    return tuple(
        f"camera {name}: {verdict.text}"
        for name, c in calibrations.items()
        for verdict in c.verdicts
        if verdict.severity is not Severity.GOOD
    )


def pair_section(
    reconstruction: Reconstruction,
    reports: Sequence[ValidationReport],
    images: Sequence[tuple[str, str, bytes]],
) -> PairSection:
    """Return the page's section of one pair.

    Parameters
    ----------
    reconstruction : reconstruction whose cloud is shown.
    reports : reports of all estimators.
    images : (caption, MIME type, bytes).
    """
    shown = next(r for r in reports if r.affine_method == reconstruction.affine_method)
    lead = (
        f"{shown.pose_type} motion, {shown.count} points, {counted(len(shown.boards), 'board')}; shown: "
        f"{shown.affine_method}; baseline {measured_words(shown.baseline_mm, shown.baseline_sigma_mm, 2)} mm; Sampson "
        f"rms {shown.sampson_rms_px:.3f} px"
    )
    tables = (check_table([shown]), _by_estimator(reports))
    notes = (*shown.notes, *(f"not checked: {words}" for words in shown.unchecked))
    return PairSection(shown.pair_id, lead, tables, tuple(images), scene_of(reconstruction), notes)


def crosscheck_table(reports: Sequence[CrossCheckReport]) -> Table:
    """Return one row for each pair and independent method: its results, and what disagrees."""
    heads = columns(
        "pair | method | rotation difference [deg] .4 | direction difference [deg] .4 | baseline [mm] .2 | rms [px] | "
        "used .0 | excluded .0 | disagrees in"
    )
    rows = []
    for report in reports:
        for method in report.methods:
            failed = [c.name for c in report.checks if c.how == method.name and not c.passed]
            compared = any(c.how == method.name for c in report.checks)
            disagrees = Cell(", ".join(failed) or ("nothing" if compared else "-"), failed=bool(failed))
            rows.append(
                cells(report.pair_id, method.name, method.rotation_difference_deg, method.direction_difference_deg)
                + cells(method.baseline_mm, method.rms_px, method.used, method.excluded, disagrees)
            )
    limits = sorted({c.limit_k for r in reports for c in r.checks})
    note = f"Agreement: within k = {', '.join(f'{k:g}' for k in limits)} combined sigmas."
    return Table("crosscheck", "The same pairs by other methods", heads, tuple(rows), note)


def _by_estimator(reports: Sequence[ValidationReport]) -> Table:
    """Return normal errors, flatness and baseline of one pair, with one column for each estimator."""
    heads = (Column("normals"), *(Column(report.affine_method, "", 3) for report in reports))
    ids = list(dict.fromkeys(board.board.board_id for report in reports for board in report.boards))
    boards = [{board.board.board_id: board for board in report.boards} for report in reports]
    rows: list[tuple[Cell, ...]] = []
    for statistic in ("mean", "median"):
        for board_id in ids:
            errors = [b[board_id].normal_errors if board_id in b else None for b in boards]
            values = [None if e is None else getattr(e, f"{statistic}_deg") for e in errors]
            rows.append(cells(f"{statistic} normal error of {board_id}, deg", *values))
    for board_id in ids:
        flat = [b[board_id].plane.rms_mm if board_id in b else None for b in boards]
        rows.append(cells(f"flatness of {board_id}, rms mm", *flat))
    rows.append(cells("baseline, mm", *(Cell(r.baseline_mm, sigma=r.baseline_sigma_mm) for r in reports)))
    return Table("by_estimator", "Affine estimators", heads, tuple(rows))
