"""The HTML page of a synthetic study: statements, box plots and tables."""

from __future__ import annotations

from collections.abc import Mapping

from rigkit.core.tables import Cell, Column, Table, cells, columns
from rigkit.report.pages.page_facts import PageFacts, build_facts_page
from rigkit.report.pictures.study_figure import study_figure
from rigkit.study.study import STUDY_PLANES, Study
from rigkit.study.table import ALL_PLANES, StudyCell, StudyTable


def study_page(found: StudyTable, provenance: Mapping[str, str], *, drawn: bytes | None = None) -> str:
    """Return the study as self-contained HTML; `drawn` is its figure as PNG, if drawn already."""
    held = sum(verdict.holds for verdict in found.verdicts)
    count = len(found.verdicts)
    headline = f"{held} of {count} statements of this study hold" if count else "A study without statements to judge"
    return build_facts_page(
        f"rigkit study: {found.study.title}",
        PageFacts(
            headline=headline,
            badge="" if not count else "all hold" if held == count else "not all hold",
            passed=held == count if count else None,
            sentences=(
                *(f"{v.text}: {v.words}." for v in found.verdicts if not v.holds),
                study_setup(found.study).capitalize() + ".",
            ),
            tables=tuple(study_tables(found)),
        ),
        provenance,
        pictures=[(f"Normal errors: {found.study.title}", lambda: drawn or study_figure(found))],
    )


def study_tables(found: StudyTable) -> tuple[Table, ...]:
    """Return one table for each pose type (medians and quartiles by noise, plane and method), and the statements."""
    study = found.study
    tables = [_median_table(found, str(pose_type)) for pose_type in study.pose_types]
    if found.verdicts:
        rows = tuple(cells(v.text, Cell(v.words, best=True)) for v in found.verdicts)
        tables.append(Table("statements", f"{study.title}: statements", columns("statement | verdict"), rows))
    return tuple(tables)


def cell_table(found: StudyTable) -> Table:
    """Return all statistics of all cells, one row for each cell."""
    heads = columns(
        f"pose type | noise [{found.study.unit}] | method | plane | estimates .0 | missing .0 | median [deg] | "
        "lower quartile [deg] | upper quartile [deg] | lower whisker [deg] | upper whisker [deg] | mean [deg]"
    )
    rows = tuple(
        cells(c.pose_type, c.sigma, c.method, _plane(c.plane), c.count, c.missing)
        + cells(c.median_deg, c.q25_deg, c.q75_deg, c.whisker_low_deg, c.whisker_high_deg, c.mean_deg)
        for c in found.cells
    )
    return Table("cells", found.study.title, heads, rows, study_setup(found.study))


def _median_table(found: StudyTable, pose_type: str) -> Table:
    study = found.study
    rows, missing = [], 0
    for sigma in study.sigmas:
        for plane in (*range(1, STUDY_PLANES + 1), ALL_PLANES):
            found_cells = [found.cell(pose_type=pose_type, sigma=sigma, method=m, plane=plane) for m in study.methods]
            rows.append(cells(f"{sigma:g}", _plane(plane), *map(_quartiles, found_cells)))
            missing += sum(cell.missing for cell in found_cells) if plane == ALL_PLANES else 0
    heads = (Column("noise", study.unit), Column("plane"), *(Column(method, "deg") for method in study.methods))
    note = f"Angle between estimated and true normal: median (quartiles); {study_setup(study)}."
    if missing:
        note += f" {missing} estimates are missing: their directions do not determine an affinity."
    return Table(f"medians-{pose_type}", f"{study.title}: {pose_type} motion", heads, tuple(rows), note)


def _quartiles(cell: StudyCell) -> str | None:
    return f"{cell.median_deg:.2f} ({cell.q25_deg:.2f} to {cell.q75_deg:.2f})" if cell.count else None


def _plane(plane: int) -> str:
    return "all" if plane == ALL_PLANES else str(plane)


def study_setup(study: Study) -> str:
    """Return the simulated setup in words."""
    images = {"1": "image 1", "2": "image 2", "both": "both images"}[str(study.images)]
    corners = STUDY_PLANES * study.board.corner_count
    return f"noise on {study.noise} of {images}; {study.trials} trials of {corners} corners"
