"""`rigkit validate --paper`: the paper's own pipeline on a data set, compared with its printed tables and claims."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from rigkit.affine.registry import AFFINE_METHODS
from rigkit.core.errors import InputError, RigkitError
from rigkit.core.printing import brief
from rigkit.core.progress import Progress, silent
from rigkit.core.tables import Table
from rigkit.io.disk.reading import csv_table, is_number
from rigkit.io.manifests.manifest import Dataset
from rigkit.reconstruction.paper import MOTIONS, OWN_MOTIONS, reconstruct_as_paper
from rigkit.report.pages.page_facts import PageFacts, build_facts_page
from rigkit.report.tables import table_files
from rigkit.validation.checks import ValidationReport, validate
from rigkit.validation.paper_claims import NOTHING_TO_COMPARE, claim_table, estimator_order_table
from rigkit.validation.tables import (
    PaperTables,
    average_table,
    baseline_table,
    best_method,
    estimator_table,
    plane_table,
)
from rigkit.workflows.options.clouds import PaperOptions
from rigkit.workflows.outputs.provenance import software_facts
from rigkit.workflows.reconstruction.datasets import PairFailure, PairJob, over_pairs, ready_dataset, write_for
from rigkit.workflows.reconstruction.pairs import match_images

PAPER = "hajder2021"
"""Folder of the paper's tables, beside the data set."""
NOT_CHECKED = (
    "neither what was measured nor what is declared (pose types, levels, sizes of boards) is checked here; `rigkit "
    "validate` without --paper does that"
)
"""Note under the tables: the errors of this pipeline exceed those of most wrong declarations."""
PLANES_FILE = "planes.csv"
BASELINES = "baselines.csv"

_log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class PaperValidation:
    """The results of the paper's pipeline on a data set.

    Attributes
    ----------
    reports : pairs x estimators. Their sigmas come from the scatter of the points: the pipeline predicts none.
    tables : the paper's tables with the printed numbers beside, and the claims.
    failures : pairs that failed.
    files : relative path -> content of all results, written or not.
    """

    reports: tuple[ValidationReport, ...]
    tables: tuple[Table, ...]
    failures: tuple[PairFailure, ...]
    files: Mapping[str, str]

    __repr__ = brief


def validate_as_paper(
    dataset: Dataset | str | Path, options: PaperOptions | None = None, *, progress: Progress = silent
) -> PaperValidation:
    """Repeat the paper's comparison on the pairs of a data set, and write the results if `options.output` is given.

    Raises InputError, before the work: nothing was measured, or as `ready_dataset`; RigkitError: no pair could be
    reconstructed. Other pairs that fail go into `failures`.
    """
    options = options or PaperOptions()
    known = ready_dataset(dataset, options, measured=True)
    printed = printed_tables(known) or PaperTables()
    found, failures, cameras = over_pairs(
        _paper_reports, known, options, what="repeating the paper on pairs", progress=progress
    )
    reports = tuple(report for of_pair in found for report in of_pair)
    tables = _tables(reports, printed, known.images)
    files = {**table_files(tables, "tables"), **cameras.files}
    if options.pictures:
        files["report.html"] = paper_page(known.name, known.images, tables, software_facts())
    write_for(known, options, files)
    return PaperValidation(reports=reports, tables=tables, failures=failures, files=files)


def printed_tables(dataset: Dataset) -> PaperTables | None:
    """Return the paper's tables if their folder is beside the data set, else None."""
    folder = dataset.root.parent / PAPER
    return load_paper_tables(folder) if folder.is_dir() else None


def load_paper_tables(folder: str | Path) -> PaperTables:
    """Read `planes.csv` and `baselines.csv` of a folder such as datasets/hajder2021.

    Raises InputError if one is missing, a row and the head differ in length, or a cell is not a number.
    """
    return PaperTables(_read_table(Path(folder) / PLANES_FILE), _read_table(Path(folder) / BASELINES))


def _read_table(path: Path) -> dict[str, dict[str, str]]:
    head, rows = csv_table(path, "the paper's table")
    out: dict[str, dict[str, str]] = {}
    for line, row in rows:
        name, *cells = row.values()
        for cell in cells:
            if not is_number(cell):
                raise InputError(f"{path}: line {line}: {cell!r} is not a number; correct it")
        out[_without_unit(name)] = dict(zip(map(_without_unit, head[1:]), cells, strict=True))
    if not out:
        raise InputError(f"{path}: no rows; restore the file")
    return out


def _without_unit(name: str) -> str:
    """Return "measured" for "measured [mm]"."""
    return name.split("[")[0].strip()


def _paper_reports(job: PairJob[PaperOptions]) -> tuple[ValidationReport, ...]:
    """Return the reports of one pair; warns of estimators that fail on it."""
    pair = job.pair
    camera1, camera2 = (loaded.near for loaded in job.cameras.of(pair))
    matched, _, _ = match_images(pair, camera1, camera2, job.options.chain)
    motions = OWN_MOTIONS if job.options.own_solvers else MOTIONS
    reports, errors = [], []
    for method in AFFINE_METHODS:
        try:
            made = reconstruct_as_paper(matched, pose_type=pair.pose_type, affine_method=method, motions=motions)
            reports.append(validate(made, pair.truth, weighted=False))
        except RigkitError as error:
            errors.append(error)
    if not reports:
        raise errors[0]
    for lost in errors:
        _log.warning(f"{lost}")
    return tuple(reports)


def _tables(reports: Sequence[ValidationReport], printed: PaperTables, images: str | None) -> tuple[Table, ...]:
    method = best_method(reports)
    tables = [plane_table(reports, method, printed)]
    if any(check.kind == "baseline" for report in reports for check in report.checks):
        tables.append(baseline_table(reports, printed))
    averages = average_table(reports, method, printed, images, "as in the paper")
    if averages is not None:
        tables.append(averages)
    tables += [estimator_order_table(reports, printed), claim_table(reports, method, printed), estimator_table(reports)]
    return tuple(tables)


def paper_page(name: str, images: str | None, tables: Sequence[Table], provenance: Mapping[str, str]) -> str:
    """Return the page of a data set; `images` is "real", "rendered", or None if undeclared."""
    claims = next(table for table in tables if table.key == "claims")
    tested = [row[1] for row in claims.rows if row[1].value != NOTHING_TO_COMPARE]
    held = sum(not cell.failed for cell in tested)
    sentences = (
        "The paper's own pipeline: chords to neighbouring corners, equal weights, its linear solvers with the formulas "
        "corrected, no refinement, planes by principal components.",
        f"The images are {images}." if images else "Whether the images are real or rendered is not stated.",
        f"What the paper claims passes or fails no check of ours, and {NOT_CHECKED}.",
    )
    facts = PageFacts(
        headline=f"{held} of {len(tested)} statements of the paper that this data set can test are confirmed",
        sentences=sentences,
        tables=(claims, *(table for table in tables if table.key != "claims")),
    )
    return build_facts_page(f"rigkit, as the paper: {name}", facts, provenance)
