"""Build the tables of a validation in the paper's layout, with the printed numbers next to ours.

L. Hajder, "Affine Correspondences in Stereo Vision: Theory, Practice, and Limitations", tables 1 (orthogonality and
normal errors) and 2 (baselines by estimator). `rigkit.report.tables` formats tables as text.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations

import numpy as np

from rigkit.core.errors import InputError
from rigkit.core.tables import Cell, Column, Table, cells, columns, verdict_cell
from rigkit.validation.checks import ValidationReport

TIE_MM = 1e-3
"""Baselines that differ by less are equal: the table does not show it."""

TIE_DEG = 1e-6
"""Estimators whose normal errors differ by less have the same normals: rounding must not choose between them."""

RIGHT_ANGLE_ERROR, ANGLE_ERROR = "orthogonality error", "angle error"
"""The paper's term, for right angles, and ours for others."""

Printed = Mapping[str, Mapping[str, str]]


@dataclass(frozen=True, slots=True)
class PaperTables:
    """The paper's numbers as printed (strings, to keep their digits).

    Attributes
    ----------
    planes : row ("orthogonality 1-2", "mean normal error 3", ...) -> capture ("regular forward") -> degrees.
    baselines : capture -> column ("measured", "F2UDIR", ...) -> mm.
    """

    planes: Printed = field(default_factory=dict)
    baselines: Printed = field(default_factory=dict)

    def plane(self, row: str, pair_id: str) -> str | None:
        return self.planes.get(row, {}).get(_capture(pair_id))

    def baseline(self, pair_id: str, column: str) -> str | None:
        return self.baselines.get(_capture(pair_id), {}).get(column)


def build_tables(
    reports: Sequence[ValidationReport], paper: PaperTables | None = None, images: str | None = None
) -> tuple[Table, ...]:
    """Return all tables of reports (pairs x estimators): planes, baselines, averages, checks, estimators.

    `images` are "real" or "rendered", None if not stated. Empty tables are left out. Raises InputError without reports.
    """
    if not reports:
        raise InputError("tables: no report; nothing was validated")
    printed = paper or PaperTables()
    method = best_method(reports)
    tables = [plane_table(reports, method, printed), check_table(reports), estimator_table(reports)]
    angles = angle_table([report for report in reports if report.affine_method == method])
    if angles is not None:
        tables.insert(1, angles)
    if any(_measured_baseline(report) is not None for report in reports):
        tables.insert(-2, baseline_table(reports, printed))
    averages = average_table(reports, method, printed, images, "maximum likelihood")
    if averages is not None:
        tables.insert(-2, averages)
    return tuple(tables)


def best_method(reports: Sequence[ValidationReport]) -> str:
    """Return the estimator with the smallest mean normal error over all pairs that every estimator solved.

    The choice uses no measured quantity, so that it does not bias the comparison with these.
    """
    methods = list(dict.fromkeys(report.affine_method for report in reports))
    pairs = {m: {r.pair_id for r in reports if r.affine_method == m} for m in methods}
    common = set.intersection(*pairs.values()) or {r.pair_id for r in reports}
    return best_of(
        {m: mean_normal_error([r for r in reports if r.affine_method == m and r.pair_id in common]) for m in methods}
    )


def best_report(reports: Sequence[ValidationReport]) -> ValidationReport:
    """Return the report with the smallest mean normal error among those of one pair by several estimators."""
    by_method = {report.affine_method: report for report in reports}
    return by_method[best_of({method: mean_normal_error([report]) for method, report in by_method.items()})]


def mean_normal_error(reports: Sequence[ValidationReport]) -> float:
    """Return the mean over the boards of their mean normal errors, degrees; infinite for no boards."""
    errors = [board.normal_errors.mean_deg for report in reports for board in report.boards]
    return float(np.mean(errors)) if errors else np.inf


def best_of(score: Mapping[str, float]) -> str:
    """Return the name with the smallest score; among ties the last, whose estimator uses most information."""
    least = min(score.values())
    return [method for method, value in score.items() if value <= least + TIE_DEG][-1]


def plane_table(reports: Sequence[ValidationReport], method: str, paper: PaperTables) -> Table:
    """Return the paper's table 1 for one estimator: orthogonality, mean and median normal errors."""
    chosen = {r.pair_id: r for r in reports if r.affine_method == method}
    ids = _board_ids(reports)
    number = {board_id: i + 1 for i, board_id in enumerate(ids)}
    rows: list[tuple[Cell, ...]] = []
    for a, b in combinations(ids, 2):
        label = f"orthogonality {number[a]}-{number[b]}"
        own = [Cell(_orthogonality(r, a, b), paper.plane(label, r.pair_id)) for r in chosen.values()]
        rows.append(cells(f"{_angle_error_label(chosen.values(), a, b)} {a}, {b}", *own))
    for kind in ("mean", "median"):
        for board_id in ids:
            label = f"{kind} normal error {number[board_id]}"
            own = [Cell(_normal_error(r, board_id, kind), paper.plane(label, r.pair_id)) for r in chosen.values()]
            rows.append(cells(f"{kind} normal error {board_id}", *own))
    heads = (Column("deg"), *(Column(pair_id, "", 4) for pair_id in chosen))
    return Table("planes", f"Angles between planes and normal errors, {method}", heads, tuple(rows))


def angle_table(reports: Sequence[ValidationReport]) -> Table | None:
    """Return the angles between boards by planes through the points and by those fitted to both images.

    `reports` has one report for each pair. Returns None if no planes were fitted to both images.
    """
    rows: list[tuple[Cell, ...]] = []
    for report in reports:
        for angle in report.angles:
            if angle.lattice_deg is None and angle.coplanar_deg is None:
                continue
            free = (Cell(angle.angle_deg, sigma=angle.sigma_deg), angle.error_deg)
            coplanar = (Cell(angle.coplanar_deg, sigma=angle.coplanar_sigma_deg), angle.coplanar_error_deg)
            lattice = (Cell(angle.lattice_deg, sigma=angle.lattice_sigma_deg), angle.lattice_error_deg)
            normals = [report.lattice_normal_errors.get(name) for name in (angle.a, angle.b)]
            means = [None if errors is None else errors.mean_deg for errors in normals]
            head = (report.pair_id, f"{angle.a}, {angle.b}", angle.measured_deg)
            rows.append(cells(*head, *free, *coplanar, *lattice, *means))
    if not rows:
        return None
    heads = columns(
        "pair | boards | measured [deg] .2 | points' planes [deg] .4 | error [deg] .4 | coplanar points [deg] .4 | "
        "error, coplanar [deg] .4 | lattice planes [deg] .4 | error, lattice [deg] .4 | "
        "mean normal error to lattice, first [deg] .4 | second [deg] .4"
    )
    note = (
        "Points' planes: fitted to the triangulated corners. Coplanar points: maximum likelihood of relative pose and "
        "planes from the corners that both views show, those of a board in one plane. Lattice planes: of relative pose "
        "and boards' poses from all corners of both views, the boards' squares known. Sigmas include the calibrations."
    )
    return Table("angles", "Angles between boards by free, coplanar and lattice planes", heads, tuple(rows), note)


def baseline_table(reports: Sequence[ValidationReport], paper: PaperTables) -> Table:
    """Return the paper's table 2: measured baseline and that of every estimator, the nearest marked.

    Pairs without a measured baseline are left out.
    """
    methods = list(dict.fromkeys(r.affine_method for r in reports))
    rows: list[tuple[Cell, ...]] = []
    for pair_id in dict.fromkeys(r.pair_id for r in reports):
        found = {r.affine_method: r for r in reports if r.pair_id == pair_id}
        known = _measured_baseline(next(iter(found.values())))
        if known is None:
            continue
        off = {method: abs(report.baseline_mm - known[0]) for method, report in found.items()}
        # Estimators with the same pose are all the nearest; if all are, none is marked.
        nearest = [m for m in off if off[m] <= min(off.values()) + TIE_MM]
        row = [Cell(pair_id), Cell(known[0], paper.baseline(pair_id, "measured"), known[1])]
        for method in methods:
            printed = paper.baseline(pair_id, method)
            if method in found:
                report = found[method]
                failed = not report.check("baseline").passed
                best = method in nearest and len(nearest) < len(found)
                row.append(Cell(report.baseline_mm, printed, report.baseline_sigma_mm, best, failed))
            else:
                row.append(Cell(None, printed))
        rows.append(tuple(row))
    heads = (Column("pair"), Column("measured", "mm", 1), *(Column(m, "mm", 2) for m in methods))
    note = "The nearest to the measured one is marked where they differ."
    return Table("baselines", "Baseline by estimator", heads, tuple(rows), note)


def average_table(
    reports: Sequence[ValidationReport], method: str, paper: PaperTables, images: str | None, mode: str
) -> Table | None:
    """Return the averages over all cells that the paper has too, and the ratio of the paper's to ours; None if empty.

    Every row states the kind of `images` (the paper's are real) and the `mode` of the pipeline.
    """
    rows = []
    known_cells = [(row[0], cell) for row in plane_table(reports, method, paper).rows for cell in row[1:]]
    for what in (RIGHT_ANGLE_ERROR, "mean normal error", "median normal error"):
        starts = (what, ANGLE_ERROR) if what == RIGHT_ANGLE_ERROR else (what,)
        both = [(c.value, float(c.paper)) for head, c in known_cells if str(head.value).startswith(starts) and c.paper]
        rows.append(_average_row(f"{what}, {method}", "deg", [(v, p) for v, p in both if isinstance(v, float)]))
    differences = []
    for report in reports:
        known, printed = _measured_baseline(report), paper.baseline(report.pair_id, report.affine_method)
        if known is not None and printed is not None:
            differences.append((abs(report.baseline_mm - known[0]), abs(float(printed) - known[0])))
    rows.append(_average_row("baseline error, all estimators", "mm", differences))
    full = tuple(cells(*row, images or "not stated", mode) for row in rows if row is not None)
    if not full:
        return None
    heads = columns("average | unit | cells .0 | ours .4 | paper .4 | paper / ours .1 | images | mode")
    note = "The paper's images are real: with rendered ones the ratio is not like for like."
    return Table("averages", "Averages over the cells that the paper has", heads, full, note)


def check_table(reports: Sequence[ValidationReport]) -> Table:
    """Return all checks with their verdicts; a quantity that could not be checked is a failed row.

    Estimators with equal results, as those of the same points have, share a row.
    """
    found: dict[tuple[str, tuple[Cell, ...]], list[str]] = {}
    for report in reports:
        for c in report.checks:
            sigma = c.our_sigma if np.isfinite(c.our_sigma) else None
            numbers = (Cell(c.measured, sigma=c.measured_sigma), Cell(c.ours, sigma=sigma), c.difference)
            row = cells(c.name, c.unit, *numbers, c.combined_sigma, c.k, verdict_cell(c.passed), c.count, c.how)
            found.setdefault((report.pair_id, row), []).append(report.affine_method)
        for lost in report.unchecked:
            name, _, why = lost.partition(": ")
            row = cells(name, *[None] * 6, verdict_cell(False, "NOT CHECKED"), 0.0, why)
            found.setdefault((report.pair_id, row), []).append(report.affine_method)
    rows = [cells(pair_id, ", ".join(methods), *row) for (pair_id, row), methods in found.items()]
    heads = columns(
        "pair | estimator | quantity | unit | measured | ours | difference | combined sigma | k .2 | verdict | "
        "points .0 | measured by"
    )
    limits = sorted({c.limit_k for r in reports for c in r.checks})
    note = (
        "k: the difference in combined sigmas (root of the sum of both variances). Passes up to k = "
        f"{', '.join(f'{k:.3g}' for k in limits)}."
    )
    return Table("checks", "Checks against what was measured", heads, tuple(rows), note)


def estimator_table(reports: Sequence[ValidationReport]) -> Table:
    """Return a row for each pair and estimator: angles, normal errors, flatness, baseline, verdict."""
    ids = _board_ids(reports)
    heads = [*columns("pair | estimator | points .0")]
    heads += [Column(f"angle {a}, {b}", "deg") for a, b in combinations(ids, 2)]
    for statistic in ("mean", "median", "lower quartile", "upper quartile"):
        heads += [Column(f"{statistic} normal error {board_id}", "deg") for board_id in ids]
    heads += [Column(f"flatness {board_id}", "mm") for board_id in ids]
    heads += columns("baseline [mm] .2 | Sampson rms [px] | verdict")
    rows = []
    for report in reports:
        row: list[float | str | Cell | None] = [report.pair_id, report.affine_method, report.count]
        by_pair = {frozenset((angle.a, angle.b)): angle for angle in report.angles}
        for two in combinations(ids, 2):
            angle = by_pair.get(frozenset(two))
            row.append(None if angle is None else Cell(angle.angle_deg, sigma=angle.sigma_deg))
        for statistic in ("mean", "median", "lower quartile", "upper quartile"):
            row += [_normal_error(report, board_id, statistic) for board_id in ids]
        flat = {board.board.board_id: board.plane.rms_mm for board in report.boards}
        row += [flat.get(board_id) for board_id in ids]
        baseline = Cell(report.baseline_mm, sigma=report.baseline_sigma_mm)
        rows.append(cells(*row, baseline, report.sampson_rms_px, verdict_cell(report.passed)))
    return Table("estimators", "Every pair with every estimator", tuple(heads), tuple(rows))


def _capture(pair_id: str) -> str:
    """Return the paper's name of a capture: "regular forward" for "regular-forward"."""
    return pair_id.replace("-", " ")


def _board_ids(reports: Sequence[ValidationReport]) -> tuple[str, ...]:
    """Return all board names in the order of the fullest report, then of appearance."""
    fullest = max(reports, key=lambda report: len(report.boards))
    return tuple(dict.fromkeys(b.board.board_id for r in (fullest, *reports) for b in r.boards))


def _orthogonality(report: ValidationReport, a: str, b: str) -> float | None:
    return next((angle.error_deg for angle in report.angles if {angle.a, angle.b} == {a, b}), None)


def _angle_error_label(reports: Iterable[ValidationReport], a: str, b: str) -> str:
    measured = {x.measured_deg for r in reports for x in r.angles if {x.a, x.b} == {a, b}} - {None}
    return RIGHT_ANGLE_ERROR if measured <= {90.0} else ANGLE_ERROR


def _normal_error(report: ValidationReport, board_id: str, statistic: str) -> float | None:
    for board in report.boards:
        if board.board.board_id == board_id:
            return float(getattr(board.normal_errors, statistic.replace(" ", "_") + "_deg"))
    return None


def _measured_baseline(report: ValidationReport) -> tuple[float, float] | None:
    return next(((c.measured, c.measured_sigma) for c in report.checks if c.kind == "baseline"), None)


def _average_row(label: str, unit: str, both: Sequence[tuple[float, float]]) -> tuple[Cell, ...] | None:
    if not both:
        return None
    ours, theirs = (float(np.mean(column)) for column in zip(*both, strict=True))
    ratio = theirs / ours if ours > 0.0 else None
    return cells(label, unit, len(both), ours, theirs, ratio)
