"""What the verbs on a data set share: options, loading its cameras, and running a function over its pairs.

Cameras without a calibration file are calibrated first. Pairs run independently, in several processes. A camera or pair
that fails does not stop the others.
"""

from __future__ import annotations

import functools
import logging
import os
import re
import traceback
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, TypeVar

from rigkit.calibration.certainty.displaced import uncertain_camera
from rigkit.calibration.result import Calibration
from rigkit.cameras.base import Camera
from rigkit.cameras.uncertain import UncertainCamera
from rigkit.core.errors import InputError, InternalError, RigkitError, interruption
from rigkit.core.processes import over_items, process_count
from rigkit.core.progress import Progress, silent
from rigkit.io.calibrations.calibration_file import calibration_text
from rigkit.io.disk.reading import about
from rigkit.io.manifests.manifest import CameraEntry, Dataset, Pair, load_dataset
from rigkit.workflows.calibration.calibrate import calibrate_camera
from rigkit.workflows.inputs.camera_files import camera_with_calibration, warn_if_bad, warn_if_exact
from rigkit.workflows.options.clouds import DatasetOptions
from rigkit.workflows.outputs.results import CALIBRATIONS, require_folder, write_results

Result = TypeVar("Result")

MAX_FOLDER_BYTES = 200
"""Names of folders have at most 255 bytes, and temporary files need some of them."""

_log = logging.getLogger(__name__)


Options = TypeVar("Options", bound=DatasetOptions)


def ready_dataset(
    dataset: Dataset | str | Path, options: DatasetOptions, reserved: Iterable[str] = (), *, measured: bool = False
) -> Dataset:
    """Return the data set with the pairs that `options` select; `dataset` is loaded, or its folder or manifest.

    Raises InputError: no such pair; no image of any pair; fewer than one process; a pair's name that is one of the file
    names `reserved`, or too long for a folder; results that cannot be written. With `measured`, also if no pair has a
    measured truth.
    """
    process_count(options.jobs)
    known = dataset if isinstance(dataset, Dataset) else load_dataset(dataset)
    known = known.select(options.pairs)
    missing = []
    for pair in known.pairs:
        if pair.pair_id in {*reserved, CALIBRATIONS}:
            raise InputError(f"{known.manifest}: pair '{pair.pair_id}': a file of results has that name; rename it")
        if len(os.fsencode(pair.pair_id)) > MAX_FOLDER_BYTES:
            raise InputError(
                f"{known.manifest}: the name of pair '{pair.pair_id[:20]}...' has more than {MAX_FOLDER_BYTES} bytes; "
                "its results need a folder of that name: shorten it"
            )
        try:
            pair.require_images()
        except InputError as error:
            missing.append(error)
    if missing and len(missing) == len(known.pairs):
        raise missing[0]
    if options.output is not None:
        require_folder(options.output, force=options.force)
    if measured and not any(pair.truth.count for pair in known.pairs):
        raise InputError(
            f"{known.manifest}: nothing was measured of these pairs; add a baseline or angles under [pairs.truth]"
        )
    return known


def write_for(dataset: Dataset, options: DatasetOptions, files: Mapping[str, str | bytes]) -> None:
    """Write the results (relative path -> content) into `options.output`; do nothing if that is None."""
    if options.output is not None:
        write_results(options.output, files, force=options.force, inputs=dataset.inputs)


@dataclass(frozen=True, eq=False)
class LoadedCamera:
    """A camera with its calibration; None for another tool's file, which holds the camera only."""

    camera: Camera
    calibration: Calibration | None

    @property
    def near(self) -> Camera:
        """The camera for points in mm: a `NearCamera` if its entrance pupil moves."""
        return self.camera if self.calibration is None else self.calibration.near

    @functools.cached_property
    def known(self) -> UncertainCamera | None:
        """The camera for points in mm with its covariance; None if the calibration is unknown."""
        return None if self.calibration is None else uncertain_camera(self.calibration, near=True)


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class LoadedCameras:
    """The cameras of a data set.

    Attributes
    ----------
    known : usable cameras by id, also those that no pair uses.
    failed : errors of the other cameras by id.
    files : relative path -> content of the calibrations computed now, for the folder of results.
    sources : by id, the file that a camera was read from, or the text of its new calibration.
    """

    known: Mapping[str, LoadedCamera]
    failed: Mapping[str, RigkitError]
    files: Mapping[str, str]
    sources: Mapping[str, Path | str]

    def of(self, pair: Pair) -> tuple[LoadedCamera, LoadedCamera]:
        """Return the two cameras of a pair; raises the error of one that failed."""
        for entry in (pair.camera1, pair.camera2):
            if entry.camera_id in self.failed:
                raise self.failed[entry.camera_id]
        return self.known[pair.camera1.camera_id], self.known[pair.camera2.camera_id]


def load_cameras(dataset: Dataset, *, recalibrate: bool = False, progress: Progress = silent) -> LoadedCameras:
    """Return the cameras of a data set; those in use without a calibration are calibrated from their sessions.

    Nothing is written: a manifest does not say where files go. Calibrated cameras that no pair uses are loaded too: an
    image may fit one of them better than its declared camera. Raises the first error if no pair has both its cameras.
    """
    known: dict[str, LoadedCamera] = {}
    failed: dict[str, RigkitError] = {}
    files: dict[str, str] = {}
    sources: dict[str, Path | str] = {}
    used = dataset.used_cameras
    for index, entry in enumerate(dataset.cameras):
        name = entry.camera_id
        try:
            if entry.calibration.is_file() and (name not in used or not recalibrate):
                sources[name] = entry.calibration
                known[name] = LoadedCamera(*camera_with_calibration(entry.calibration))
                whole = known[name].calibration
                if name in used:
                    warn_if_bad(entry.calibration, () if whole is None else whole.verdicts)
                    warn_if_exact(entry.calibration, whole)
            elif name in used:
                with about(dataset.manifest):
                    calibration = _calibrate(dataset, entry, progress)
                known[name] = LoadedCamera(calibration.camera, calibration)
                sources[name] = files[_file_of(name, index)] = calibration_text(calibration)
                warn_if_bad(name, calibration.verdicts)
                _log.info(
                    f"camera '{name}' was calibrated from '{entry.session}', for these results alone; `rigkit "
                    "calibrate` keeps a calibration beside its session"
                )
        except RigkitError as error:
            failed[name] = error
            if name not in used:
                _log.info(f"camera '{name}', which no pair uses, is skipped: {error}")
    out = LoadedCameras(known=known, failed=failed, files=files, sources=sources)
    if not any({p.camera1.camera_id, p.camera2.camera_id} <= set(known) for p in dataset.pairs):
        raise next(error for name, error in failed.items() if name in used)
    return out


def _calibrate(dataset: Dataset, entry: CameraEntry, progress: Progress) -> Calibration:
    if entry.session is None:
        raise InputError(
            f"{dataset.manifest}: camera '{entry.camera_id}' has no session to calibrate from; "
            'add session = "session.toml" to its table'
        )
    if entry.calibration.is_dir():
        raise InputError(f"camera '{entry.camera_id}': '{entry.calibration}' is a folder; correct the manifest")
    return calibrate_camera(entry.session, progress=progress)


def _file_of(camera_id: str, index: int) -> str:
    """Return the path of a new calibration in the results; characters that file names cannot have are replaced."""
    safe = re.sub(r"[^\w-]", "_", camera_id)[:40]
    return f"{CALIBRATIONS}/{safe if safe == camera_id else f'{safe}-{index + 1}'}.json"


@dataclass(frozen=True, eq=False, slots=True)
class PairFailure:
    """A pair that failed, and its error."""

    pair_id: str
    error: RigkitError

    def __str__(self) -> str:
        words = str(self.error)
        return words if f"'{self.pair_id}'" in words else f"pair '{self.pair_id}': {words}"


@dataclass(frozen=True, eq=False, slots=True)
class PairJob(Generic[Options]):
    """One pair with its cameras and options, as it is sent to a process."""

    pair: Pair
    cameras: LoadedCameras
    options: Options


def over_pairs(
    work: Callable[[PairJob[Options]], Result],
    dataset: Dataset,
    options: Options,
    *,
    what: str,
    progress: Progress = silent,
) -> tuple[list[Result], tuple[PairFailure, ...], LoadedCameras]:
    """Return `work` of every pair, in order, the pairs that failed, and the cameras.

    Pairs run in up to `options.jobs` processes, so `work` must be a module's function. A pair that fails does not stop
    the others; if all fail, the first pair's error is raised.
    """
    pairs, cameras = dataset.pairs, load_cameras(dataset, recalibrate=options.recalibrate, progress=progress)
    outcomes: dict[str, Result | RigkitError] = {}
    waiting: dict[str, PairJob[Options]] = {}
    for pair in pairs:
        try:
            pair.require_images()
            cameras.of(pair)
            waiting[pair.pair_id] = PairJob(pair, cameras, options)
        except RigkitError as error:
            outcomes[pair.pair_id] = error
    progress(what, 0, len(waiting))
    jobs, attempt = list(waiting.values()), functools.partial(_attempt, work)
    for done, (place, outcome) in enumerate(over_items(attempt, jobs, jobs=options.jobs), start=1):
        progress(what, done, len(jobs))
        outcomes[jobs[place].pair.pair_id] = outcome
    ordered = [(pair.pair_id, outcomes[pair.pair_id]) for pair in pairs]
    failures = tuple(PairFailure(name, outcome) for name, outcome in ordered if isinstance(outcome, RigkitError))
    if failures and len(failures) == len(pairs):
        for failure in failures[1:]:
            _log.info(f"{failure}")
        raise failures[0].error
    return [outcome for _, outcome in ordered if not isinstance(outcome, RigkitError)], failures, cameras


def _attempt(work: Callable[[PairJob[Options]], Result], job: PairJob[Options]) -> Result | RigkitError:
    try:
        return work(job)
    except Exception as error:
        if (stop := interruption(error)) is not None:
            raise stop from None
        if isinstance(error, RigkitError):
            return error
        if isinstance(error, MemoryError):
            return InputError(f"{error or 'out of memory'}; use fewer processes (-j 1), or smaller images")
        # A bug that one pair triggers must not lose the others' results; the traceback locates it.
        return InternalError(
            f"{traceback.format_exc()}this is a bug in rigkit ({error!r}); please report the lines above"
        )
