"""`rigkit reconstruct` of a data set: oriented clouds of its pairs; needs no measured truth."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from rigkit.core.printing import brief
from rigkit.core.progress import Progress, silent
from rigkit.io.manifests.manifest import Dataset
from rigkit.io.ply import ply_bytes
from rigkit.reconstruction.reconstruct import Reconstruction
from rigkit.report.pictures.figures import pair_pictures
from rigkit.workflows.options.clouds import ReconstructOptions
from rigkit.workflows.reconstruction.datasets import PairFailure, PairJob, over_pairs, ready_dataset, write_for
from rigkit.workflows.reconstruction.pairs import match_images, reconstruct_with, with_calibration_sigmas


@dataclass(frozen=True, eq=False, slots=True)
class PairReconstruction:
    """The reconstruction of one pair, the name of its PLY file, and all its files (relative path -> content)."""

    reconstruction: Reconstruction
    ply: str
    files: Mapping[str, bytes]

    __repr__ = brief


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class DatasetReconstruction:
    """The reconstructed pairs of a data set.

    Attributes
    ----------
    pairs : the pairs that were reconstructed.
    failures : the others.
    files : relative path -> content of all results, written or not.
    """

    pairs: tuple[PairReconstruction, ...]
    failures: tuple[PairFailure, ...]
    files: Mapping[str, str | bytes]

    __repr__ = brief


def reconstruct_dataset(
    dataset: Dataset | str | Path, options: ReconstructOptions | None = None, *, progress: Progress = silent
) -> DatasetReconstruction:
    """Reconstruct the pairs of a data set (loaded, or its folder) and write the results if `options.output` is given.

    A pair that cannot be reconstructed goes into `failures`; its error is raised if all fail.
    """
    options = options or ReconstructOptions()
    known = ready_dataset(dataset, options)
    outcomes, failures, cameras = over_pairs(
        _reconstruct, known, options, what="reconstructing pairs", progress=progress
    )
    files: dict[str, str | bytes] = dict(cameras.files)
    for outcome in outcomes:
        files |= outcome.files
    write_for(known, options, files)
    return DatasetReconstruction(pairs=tuple(outcomes), failures=failures, files=files)


def _reconstruct(job: PairJob[ReconstructOptions]) -> PairReconstruction:
    """Reconstruct one pair and return it with its files."""
    pair, options = job.pair, job.options
    camera1, camera2 = job.cameras.of(pair)
    matched, image1, image2 = match_images(pair, camera1.near, camera2.near, options.chain, options.support)
    r = reconstruct_with(matched, pair, options.method, image1, det_scale=options.det_scale)
    planes = options.planes or pair.planes
    r = with_calibration_sigmas(r, planes, camera1, camera2)
    ply = f"{pair.pair_id}/{options.method if planes == 'free' else planes}.ply"
    files = {ply: ply_bytes(r.cloud)}
    if options.pictures:
        files |= pair_pictures(r, image1, image2)
    return PairReconstruction(r, ply, files)
