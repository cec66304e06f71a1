"""The tables and the page of a validation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from rigkit.calibration.result import Calibration
from rigkit.core.printing import brief, counted
from rigkit.io.manifests.manifest import Dataset
from rigkit.report.pages.page_facts import PageFacts
from rigkit.report.pages.validation_page import (
    SUMMARY_WORDS,
    PairSection,
    build_page,
    camera_remarks,
    camera_table,
    crosscheck_table,
    summary_table,
    validation_facts,
)
from rigkit.report.pages.validation_verdict import verdict_of
from rigkit.report.tables import TABLE_WRITERS, table_files
from rigkit.validation.checks import ValidationReport
from rigkit.validation.crosscheck import CrossCheckReport
from rigkit.validation.tables import PaperTables, build_tables
from rigkit.workflows.options.clouds import DatasetOptions
from rigkit.workflows.outputs.provenance import digest_line, software_facts
from rigkit.workflows.reconstruction.datasets import LoadedCameras, PairFailure

PAGE = "report.html"
RESERVED = (*(f"tables.{ending}" for ending in TABLE_WRITERS), PAGE)
"""Names of result files, which no pair can have."""


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class PairValidation:
    """The validation of one pair.

    Attributes
    ----------
    reports : one for each estimator, in the order of the registry.
    best : the report of the best estimator, which is shown.
    crosscheck : its comparison with independent methods, or None.
    causes : possible faults of the capture, found before the reconstruction.
    files : relative path -> content of clouds and pictures.
    section : section of the page; None without pictures.
    """

    reports: tuple[ValidationReport, ...]
    best: ValidationReport
    crosscheck: CrossCheckReport | None
    causes: tuple[str, ...]
    files: Mapping[str, bytes]
    section: PairSection | None

    __repr__ = brief

    @property
    def pair_id(self) -> str:
        """Name of the pair."""
        return self.best.pair_id


def validation_files(
    dataset: Dataset,
    cameras: LoadedCameras,
    pairs: Sequence[PairValidation],
    failures: Sequence[PairFailure],
    paper: PaperTables | None,
    *,
    causes: Sequence[str],
    options: DatasetOptions,
    seconds: float,
) -> tuple[PageFacts, dict[str, str | bytes]]:
    """Return the facts on the page, and all results (relative path -> content), with the page if there are pictures."""
    reports = [report for pair in pairs for report in pair.reports]
    compared = [pair.crosscheck for pair in pairs if pair.crosscheck is not None]
    summary = replace(summary_table([pair.best for pair in pairs]), note=SUMMARY_WORDS)
    tables = [summary, *build_tables(reports, paper, dataset.images)]
    if compared:
        tables.insert(-2, crosscheck_table(compared))
    files: dict[str, str | bytes] = {**table_files(tables, "tables"), **cameras.files}
    for pair in pairs:
        files |= pair.files
    sections = [pair.section for pair in pairs if pair.section is not None]
    verdict = verdict_of([pair.best for pair in pairs], reports, compared, causes, complete=not failures)
    lead = f"{counted(len(pairs), 'pair')}, each by {len(pairs[0].reports)} estimators of "
    lead += f"affine transformations, {seconds:.0f} s"
    lead += "".join(f"; not validated: {failure}" for failure in failures)
    # The sections of the pairs have these tables.
    separate = ("checks", "estimators") if sections else ()
    shown = [table for table in tables if table.key not in separate]
    known = _calibrations(dataset, cameras)
    shown += [camera_table(known)] if known else []
    remarks = camera_remarks(known)
    if sections:
        title, facts = f"rigkit validation: {dataset.name}", _facts(dataset, cameras, options)
        files[PAGE] = build_page(title, lead, verdict, shown, sections, facts, remarks)
    return validation_facts(lead, verdict, shown, sections, remarks), files


def _calibrations(dataset: Dataset, cameras: LoadedCameras) -> dict[str, Calibration]:
    """Return the calibrations in use by camera, without cameras that have none."""
    return {
        name: loaded.calibration
        for name, loaded in cameras.known.items()
        if name in dataset.used_cameras and loaded.calibration is not None
    }


def _facts(dataset: Dataset, cameras: LoadedCameras, options: DatasetOptions) -> dict[str, str]:
    """Return versions, hashes and sources that the page states for reproducibility."""
    facts = software_facts("open3d", "pycolmap") | {"chain": options.chain}
    facts["directions"] = f"{options.support}; scale of DET3UDIR: {options.det_scale}"
    facts["manifest"] = f"{dataset.manifest.name}, {digest_line(dataset.manifest)}"
    for name, source in cameras.sources.items():
        label = "calibrated from its session" if isinstance(source, str) else source.name
        facts[f"camera {name}"] = f"{label}, {digest_line(source)}"
    for pair in dataset.pairs:
        there = [path for path in (pair.image1, pair.image2) if path.is_file()]
        facts[f"pair {pair.pair_id}"] = "; ".join(f"{path.name}, {digest_line(path)}" for path in there)
    return facts
