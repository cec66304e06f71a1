"""`rigkit validate`: every pair of a data set and every affine estimator, compared with measured truth."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from rigkit.affine.registry import AFFINE_METHODS
from rigkit.core.choices import PLANE_CHOICES, Planes
from rigkit.core.errors import DegenerateError, RigkitError
from rigkit.core.findings import Finding, Severity
from rigkit.core.printing import brief
from rigkit.core.progress import Progress, silent
from rigkit.io.manifests.manifest import Dataset
from rigkit.io.media.images import to_grey
from rigkit.io.ply import ply_bytes
from rigkit.reconstruction.board_planes import BoardPlanes
from rigkit.reconstruction.calibration_shifts import CalibrationShifts, with_calibrations
from rigkit.reconstruction.geometry import PairGeometry
from rigkit.reconstruction.pairing import MatchedPair
from rigkit.reconstruction.reconstruct import Reconstruction, on_planes, reconstruct_from
from rigkit.report.pages.page_facts import PageFacts
from rigkit.report.pages.validation_page import PairSection, pair_section
from rigkit.report.pictures.drawings import normal_errors_svg, residuals_svg
from rigkit.report.pictures.figures import pair_jpeg, pair_pictures
from rigkit.validation.board_ends import contradicted_counts
from rigkit.validation.checks import ValidationReport, validate_each
from rigkit.validation.crosscheck import CrossCheckReport, crosscheck
from rigkit.validation.diagnose import diagnose, diagnose_cameras
from rigkit.validation.fitted_planes import FittedPlanes
from rigkit.validation.tables import best_report
from rigkit.workflows.options.clouds import ValidateOptions
from rigkit.workflows.reconstruction.datasets import PairFailure, PairJob, over_pairs, ready_dataset, write_for
from rigkit.workflows.reconstruction.pairs import (
    Image,
    find_boards,
    geometry_of,
    measured_shapes,
    planes_of,
    reconstruct_other_chain,
    shifts_of,
)
from rigkit.workflows.validation.paper import printed_tables
from rigkit.workflows.validation.validation_files import RESERVED, PairValidation, validation_files


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class DatasetValidation:
    """The validation of a data set.

    Attributes
    ----------
    pairs : the pairs that were reconstructed.
    failures : the others.
    causes : probable causes of failed checks; severity BAD if a check fails, else LOOK.
    page : the facts on the page.
    files : relative path -> content of all results, written or not.
    seconds : run time.
    """

    pairs: tuple[PairValidation, ...]
    failures: tuple[PairFailure, ...]
    causes: tuple[Finding, ...]
    page: PageFacts
    files: Mapping[str, str | bytes]
    seconds: float

    __repr__ = brief

    @property
    def reports(self) -> tuple[ValidationReport, ...]:
        """The reports of all estimators of all pairs."""
        return tuple(report for pair in self.pairs for report in pair.reports)

    @property
    def crosschecks(self) -> tuple[CrossCheckReport, ...]:
        """The comparisons with independent methods."""
        return tuple(pair.crosscheck for pair in self.pairs if pair.crosscheck is not None)

    @property
    def passed(self) -> bool:
        """Whether every pair was validated and passes all checks."""
        return bool(self.page.passed)


def validate_dataset(
    dataset: Dataset | str | Path, options: ValidateOptions | None = None, *, progress: Progress = silent
) -> DatasetValidation:
    """Validate the pairs of a data set (loaded, or its folder), and write the results if `options.output` is given.

    Raises InputError, before the work: nothing was measured, or as `ready_dataset`; RigkitError: no pair could be
    reconstructed. Other pairs that fail go into `failures`.
    """
    started = time.monotonic()
    options = options or ValidateOptions()
    known = ready_dataset(dataset, options, RESERVED, measured=True)
    paper = printed_tables(known)
    pairs, failures, cameras = over_pairs(
        _validate, known, options, what="reconstructing and validating pairs", progress=progress
    )
    compared = [pair.crosscheck for pair in pairs if pair.crosscheck is not None]
    causes = [cause for pair in pairs for cause in pair.causes]
    causes += diagnose([pair.best for pair in pairs], agreed=all(report.passed for report in compared))
    causes += [f"pair '{report.pair_id}': {words}" for report in compared for words in report.diagnosis]
    seconds = time.monotonic() - started
    page, files = validation_files(
        known, cameras, pairs, failures, paper, causes=causes, options=options, seconds=seconds
    )
    write_for(known, options, files)
    severity = Severity.LOOK if page.passed else Severity.BAD
    return DatasetValidation(
        pairs=tuple(pairs),
        failures=failures,
        causes=tuple(Finding(severity=severity, message=cause) for cause in causes),
        page=page,
        files=files,
        seconds=time.monotonic() - started,
    )


def _validate(job: PairJob[ValidateOptions]) -> PairValidation:
    """Reconstruct one pair with every estimator and validate each."""
    pair = job.pair
    names = (pair.camera1.camera_id, pair.camera2.camera_id)
    camera1, camera2 = (loaded.near for loaded in job.cameras.of(pair))
    found = find_boards(pair, camera1, camera2)
    known = {name: loaded.camera for name, loaded in job.cameras.known.items()}
    causes = diagnose_cameras(pair.pair_id, names, found.boards, pair.boards, known)

    def wrong_squares() -> tuple[str, ...]:
        return tuple(f"pair '{pair.pair_id}': {words}" for words in found.squares_that_fit())

    try:
        matched = found.matched(job.options.chain, job.options.support)
        if matched.identity.missing:
            causes += wrong_squares()
        return _validated(job, matched, found.images, causes)
    except RigkitError as error:
        # Without this, no board was matched at all.
        causes = causes or wrong_squares()
        if not causes:
            raise
        raise type(error)(f"{'; '.join(causes)} ({error})") from error


def _validated(
    job: PairJob[ValidateOptions], matched: MatchedPair, images: tuple[Image, Image], causes: tuple[str, ...]
) -> PairValidation:
    pair = job.pair
    geometry = geometry_of(matched, pair)
    scale = job.options.det_scale
    reconstructions = {
        m: reconstruct_from(geometry, affine_method=m, scale=scale, image1=images[0]) for m in AFFINE_METHODS
    }
    shifts = _shifts(reconstructions, job)
    fitted = _fitted_planes(geometry, job)
    known = [shifts[m] for m in reconstructions]
    reports = validate_each(list(reconstructions.values()), pair.truth, known, fitted, pair.layout)
    counts = contradicted_counts(matched, [to_grey(image) for image in images])
    reports = tuple(replace(report, checks=(*report.checks, *counts)) for report in reports)
    best = best_report(reports)
    files: dict[str, bytes] = {
        f"{pair.pair_id}/{method}.ply": ply_bytes(with_calibrations(r, shifts[method]).cloud)
        for method, r in reconstructions.items()
    }
    shown = reconstructions[best.affine_method]
    if fitted.constrained is not None:
        files[f"{pair.pair_id}/{fitted.planes}.ply"] = ply_bytes(on_planes(shown, fitted.constrained).cloud)
    compared = None
    if job.options.crosscheck:
        other = reconstruct_other_chain(matched, pair)
        shapes = measured_shapes(pair, *job.cameras.of(pair))
        compared = crosscheck(shown, other_chain=other, shifts=shifts[best.affine_method], shapes=shapes)
    section = None
    if job.options.pictures:
        drawn = pair_pictures(shown, *images, pdf=job.options.pdf)
        files |= drawn
        section = _section(reconstructions, shown, reports, drawn)
    return PairValidation(reports=reports, best=best, crosscheck=compared, causes=causes, files=files, section=section)


def _fitted_planes(geometry: PairGeometry, job: PairJob[ValidateOptions]) -> FittedPlanes:
    """Return the boards' planes fitted to both images; only the planes that are checked must exist."""
    chosen = job.options.planes or job.pair.planes
    found: dict[Planes, BoardPlanes] = {}
    for planes in PLANE_CHOICES[1:]:
        try:
            found[planes] = planes_of(geometry, planes, *job.cameras.of(job.pair))
        except DegenerateError:
            if planes == chosen:
                raise
    return FittedPlanes(found.get("coplanar"), found.get("lattice"), chosen)


def _shifts(
    reconstructions: Mapping[str, Reconstruction], job: PairJob[ValidateOptions]
) -> dict[str, CalibrationShifts | None]:
    """Return the effect of the calibrations' covariances on each reconstruction, by estimator.

    It depends on the corners only, so estimators that kept the same corners share it.
    """
    out: dict[str, CalibrationShifts | None] = {}
    for method, r in reconstructions.items():
        same = next((first for first in out if reconstructions[first].same_points(r)), None)
        out[method] = shifts_of(r, *job.cameras.of(job.pair)) if same is None else out[same]
    return out


def _section(
    reconstructions: Mapping[str, Reconstruction],
    shown: Reconstruction,
    reports: tuple[ValidationReport, ...],
    drawn: Mapping[str, bytes],
) -> PairSection:
    """Return the pair's section of the page, with the pictures `drawn` as JPEG."""
    corners, epipolar = (drawn[f"{shown.pair_id}/{name}.png"] for name in ("corners", "epipolar"))
    rms, jpeg = shown.sampson_rms_px, "image/jpeg"
    pictures = [
        ("Corners as found and matched (ring: first corner of a board)", jpeg, pair_jpeg(corners)),
        (f"Epipolar curves of every seventh corner, Sampson rms {rms:.3f} px", jpeg, pair_jpeg(epipolar)),
        ("What the corners leave over", "image/svg+xml", residuals_svg(shown).encode()),
        ("Normal errors of the estimators", "image/svg+xml", normal_errors_svg(reconstructions, reports).encode()),
    ]
    return pair_section(shown, reports, pictures)
