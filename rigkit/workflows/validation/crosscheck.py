"""`rigkit crosscheck`: comparison of pairs with pycolmap, planar PnP and the other chain."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from rigkit.core.printing import brief
from rigkit.core.progress import Progress, silent
from rigkit.core.tables import Table
from rigkit.io.manifests.manifest import Dataset
from rigkit.report.pages.validation_page import crosscheck_table
from rigkit.report.tables import table_files
from rigkit.validation.crosscheck import CrossCheckReport, crosscheck
from rigkit.workflows.options.clouds import DatasetOptions
from rigkit.workflows.reconstruction.datasets import PairFailure, PairJob, over_pairs, ready_dataset, write_for
from rigkit.workflows.reconstruction.pairs import (
    match_images,
    measured_shapes,
    reconstruct_other_chain,
    reconstruct_with,
    shifts_of,
)

FILES = ("crosscheck.md", "crosscheck.json")


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class DatasetCrossCheck:
    """The comparison of a data set with independent methods.

    Attributes
    ----------
    reports : one for each reconstructed pair.
    failures : the other pairs.
    table : all comparisons.
    files : relative path -> content of all results, written or not.
    """

    reports: tuple[CrossCheckReport, ...]
    failures: tuple[PairFailure, ...]
    table: Table
    files: Mapping[str, str | bytes]

    __repr__ = brief

    @property
    def passed(self) -> bool:
        """Whether every pair was compared and agrees."""
        return not self.failures and all(report.passed for report in self.reports)


def crosscheck_dataset(
    dataset: Dataset | str | Path, options: DatasetOptions | None = None, *, progress: Progress = silent
) -> DatasetCrossCheck:
    """Compare the pairs of a data set (loaded, or its folder) with independent methods.

    A pair that cannot be reconstructed goes into `failures`; its error is raised if all fail.
    """
    options = options or DatasetOptions()
    known = ready_dataset(dataset, options, reserved=FILES)
    reports, failures, cameras = over_pairs(_crosscheck, known, options, what="cross-checking pairs", progress=progress)
    table = crosscheck_table(reports)
    files = {**cameras.files, **table_files([table], "crosscheck", "md", "json")}
    write_for(known, options, files)
    return DatasetCrossCheck(reports=tuple(reports), failures=failures, table=table, files=files)


def _crosscheck(job: PairJob[DatasetOptions]) -> CrossCheckReport:
    """Reconstruct one pair and compare it with every independent method."""
    camera1, camera2 = job.cameras.of(job.pair)
    matched, _, _ = match_images(job.pair, camera1.near, camera2.near, job.options.chain)
    other = reconstruct_other_chain(matched, job.pair)
    ours = reconstruct_with(matched, job.pair, "3SDIR")
    shapes = measured_shapes(job.pair, camera1, camera2)
    return crosscheck(ours, other_chain=other, shifts=shifts_of(ours, camera1, camera2), shapes=shapes)
