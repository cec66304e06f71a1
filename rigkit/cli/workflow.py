"""From a manifest to reconstructions: what `reconstruct`, `validate`, `crosscheck` and `demo` share.

Cameras are calibrated first where a calibration file is missing; pairs are independent and run in several processes.
"""

from __future__ import annotations

import argparse
import contextlib
import functools
import itertools
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias, TypeVar

from rigkit.cli.console import note
from rigkit.core.errors import DegenerateError, InputError, RigkitError
from rigkit.core.processes import worker_pool

if TYPE_CHECKING:
    from rigkit.cameras.base import Camera
    from rigkit.core.arrays import FloatArray
    from rigkit.core.detections import BoardDetection
    from rigkit.core.progress import Progress
    from rigkit.io.manifest import Dataset, Pair
    from rigkit.reconstruction.geometry import PairGeometry
    from rigkit.reconstruction.pairing import MatchedPair
    from rigkit.reconstruction.reconstruct import Reconstruction
    from rigkit.validation.intrinsics import CalibrationShifts

__all__ = [
    "LoadedCamera",
    "PairFailure",
    "add_dataset_arguments",
    "exit_code_of",
    "failed_pairs",
    "find_boards",
    "geometry_of",
    "load_cameras",
    "match_found",
    "match_images",
    "output_folder",
    "over_pairs",
    "read_for",
    "reconstruct_other_chain",
    "reconstruct_with",
    "select_dataset",
    "shifts_of",
    "write_results",
]

Result = TypeVar("Result")

Detections: TypeAlias = "tuple[BoardDetection, ...]"


def add_dataset_arguments(parser: argparse.ArgumentParser, *, optional: bool = False) -> None:
    """Add what every verb on a data set takes; `optional`: the verb also works on something else."""
    number = "?" if optional else None
    parser.add_argument(
        "dataset", metavar="DATASET", nargs=number, help="folder with a dataset.toml, or the file itself"
    )
    parser.add_argument("-p", "--pair", action="append", default=[], metavar="ID", help="only this pair (repeatable)")
    parser.add_argument("-o", "--output", metavar="DIR", help="folder for results (default: a new one, out/<data set>)")
    parser.add_argument("--force", action="store_true", help="replace existing results")
    parser.add_argument("--recalibrate", action="store_true", help="calibrate from the images even if that was done")
    parser.add_argument(
        "--chain", choices=("raw", "rectified"), default="raw", help="captured pixels or perspective views"
    )
    parser.add_argument("-j", "--jobs", type=int, metavar="N", help="processes (default: one a core)")
    parser.add_argument("--json", action="store_true", help="print the result for programs")


def select_dataset(args: argparse.Namespace) -> Dataset:
    """Load the manifest, keep the pairs asked for, and make sure that their images are there."""
    from rigkit.io.manifest import load_dataset

    if args.jobs is not None and args.jobs < 1:
        raise InputError(f"--jobs {args.jobs}: at least one process is needed")
    dataset = load_dataset(args.dataset).select(args.pair)
    for pair in dataset.pairs:
        pair.require_images()
    return dataset


def output_folder(args: argparse.Namespace, name: str) -> Path:
    """Return the folder for results: the one asked for, or the first of out/NAME, out/NAME-2, ... that is free.

    Raises InputError, before the work, where the folder asked for holds results and `--force` is not given, or files
    could not be written there.
    """
    from rigkit.io.files import ensure_folder_writable

    folder = _chosen_folder(args, name)
    ensure_folder_writable(folder)
    return folder


def _chosen_folder(args: argparse.Namespace, name: str) -> Path:
    if args.output:
        folder = Path(args.output)
        if folder.is_dir() and any(folder.iterdir()) and not args.force:
            raise InputError(f"folder '{folder}' is not empty; use --force to replace results in it, or another folder")
        if folder.exists() and not folder.is_dir():
            raise InputError(f"'{folder}' is a file, not a folder; give another name with -o")
        return folder
    base = Path("out") / name
    if args.force:
        return base
    names = itertools.chain([base], (base.with_name(f"{base.name}-{number}") for number in itertools.count(2)))
    return next(folder for folder in names if not folder.exists())


def write_results(
    folder: Path, files: Mapping[str, str | bytes], *, force: bool, inputs: Iterable[str | Path] = ()
) -> None:
    """Write all files (relative path -> content) into `folder`, or none; never over one of `inputs`."""
    from rigkit.io.files import ensure_writable, write_together

    placed = {folder / name: data for name, data in files.items()}
    ensure_writable(placed, force=force, inputs=inputs)
    write_together(placed, force=force)


@dataclass(frozen=True, eq=False, slots=True)
class LoadedCamera:
    """A camera and the covariance of its parameters; None where the file does not say (another tool's camera)."""

    camera: Camera
    covariance: FloatArray | None


def load_cameras(dataset: Dataset, *, recalibrate: bool, progress: Progress) -> dict[str, LoadedCamera]:
    """Return the cameras of a data set, calibrating those in use from their sessions where that was not done yet.

    A new calibration is kept beside its session where files can be written there. Cameras that no pair uses come along
    where they are calibrated: an image may fit one of them better than the camera that it is said to be from.
    """
    from rigkit.io.calibration_file import save_calibration
    from rigkit.workflows.calibrate_rig import calibrate_camera

    cameras: dict[str, LoadedCamera] = {}
    used = {name for pair in dataset.pairs for name in (pair.camera1.camera_id, pair.camera2.camera_id)}
    for entry in dataset.cameras:
        unused = entry.camera_id not in used
        if entry.calibration.is_file() and (unused or not recalibrate):
            cameras[entry.camera_id] = _load(entry.calibration)
            continue
        if unused:
            continue
        if entry.session is None:
            raise InputError(
                f"{dataset.manifest}: camera '{entry.camera_id}' has no session to calibrate from; "
                'add session = "session.toml" to its table'
            )
        if entry.calibration.is_dir():
            raise InputError(f"camera '{entry.camera_id}': '{entry.calibration}' is a folder; correct the manifest")
        calibration = calibrate_camera(entry.session, progress=progress)
        try:
            save_calibration(entry.calibration, calibration, force=True)
        except InputError as error:
            note(f"{error}; the new calibration is used, but not kept")
        cameras[entry.camera_id] = LoadedCamera(calibration.camera, calibration.covariance)
    return cameras


def _load(path: Path) -> LoadedCamera:
    from rigkit.io.calibration_file import is_calibration, load_calibration, load_camera

    if not is_calibration(path):
        return LoadedCamera(load_camera(path), None)
    calibration = load_calibration(path)
    return LoadedCamera(calibration.camera, calibration.covariance)


def find_boards(pair: Pair, camera1: Camera, camera2: Camera) -> tuple[Detections, Detections, Any, Any]:
    """Return the boards found in either image of a pair, and the images; raises InputError where there are none.

    The cameras show where corners were missed, which parts are of one board, what is covered, and how lines bend; a
    camera that no pose of a board fits is left aside.
    """
    from rigkit.detection.detect import detect_boards
    from rigkit.io.images import to_grey

    images = []
    found: list[Detections] = []
    for path, camera, entry in ((pair.image1, camera1, pair.camera1), (pair.image2, camera2, pair.camera2)):
        image = read_for(camera, path, f"pair '{pair.pair_id}', camera '{entry.camera_id}'")
        detections = detect_boards(to_grey(image), pair.boards, camera=camera)
        if not detections:
            sizes = ", ".join(sorted({f"{b.columns}x{b.rows}" for b in pair.boards}))
            raise InputError(
                f"pair '{pair.pair_id}': no board ({sizes}) found in '{path}'; check the image and the boards"
            )
        images.append(image)
        found.append(detections)
    return found[0], found[1], images[0], images[1]


def read_for(camera: Camera, path: str | Path, whose: str) -> Any:
    """Return an image; raises InputError also where it is of another size than the camera was calibrated at."""
    from rigkit.io.images import read_image

    image = read_image(path)
    size = (image.shape[1], image.shape[0])
    if size != camera.size_px:
        raise InputError(
            f"{whose}: image '{path}' is {size[0]}x{size[1]} px but the calibration is for "
            f"{camera.size_px[0]}x{camera.size_px[1]}; use images of that size, or recalibrate"
        )
    return image


def match_images(pair: Pair, camera1: Camera, camera2: Camera, chain: str) -> tuple[MatchedPair, Any, Any]:
    """Return the matched corners of a pair, and its two images."""
    found1, found2, image1, image2 = find_boards(pair, camera1, camera2)
    return match_found(pair, camera1, camera2, found1, found2, chain), image1, image2


def match_found(
    pair: Pair,
    camera1: Camera,
    camera2: Camera,
    detections1: Sequence[BoardDetection],
    detections2: Sequence[BoardDetection],
    chain: str,
) -> MatchedPair:
    """Match the boards found in the two images of a pair as the manifest declares it."""
    from rigkit.reconstruction.pairing import match_pair

    return match_pair(
        pair.pair_id,
        camera1,
        camera2,
        detections1,
        detections2,
        pair.boards,
        layout=pair.layout or None,
        angles=pair.truth.angles,
        chain="rectified" if chain == "rectified" else "raw",
    )


def geometry_of(matched: MatchedPair, pair: Pair) -> PairGeometry:
    """Return pose and points of matched corners as the manifest declares the pair."""
    import numpy as np

    from rigkit.reconstruction.geometry import pair_geometry

    level = None if pair.level_sigma_deg is None else float(np.deg2rad(pair.level_sigma_deg))
    return pair_geometry(matched, pose_type=pair.pose_type, level_sigma_rad=level)


def reconstruct_with(matched: MatchedPair, pair: Pair, method: str, image1: Any = None) -> Reconstruction:
    """Reconstruct matched corners as the manifest declares the pair."""
    from rigkit.reconstruction.reconstruct import reconstruct_from

    return reconstruct_from(geometry_of(matched, pair), affine_method=method, image1=image1)


def shifts_of(reconstruction: Reconstruction, camera1: LoadedCamera, camera2: LoadedCamera) -> CalibrationShifts | None:
    """Return what the calibrations' uncertainty does to a reconstruction; None where a camera has no covariance."""
    from rigkit.validation.intrinsics import calibration_shifts

    if camera1.covariance is None or camera2.covariance is None:
        return None
    return calibration_shifts(
        reconstruction,
        camera1.covariance,
        None if camera1 is camera2 else camera2.covariance,
        level_sigma_rad=reconstruction.level_sigma_rad,
    )


def reconstruct_other_chain(matched: MatchedPair, pair: Pair) -> Reconstruction | None:
    """Reconstruct the same corners in the other pixels (raw or rectified); None where they do not fit."""
    try:
        return reconstruct_with(matched.in_chain("rectified" if matched.chain == "raw" else "raw"), pair, "3SDIR")
    except DegenerateError:
        return None


@dataclass(frozen=True, eq=False, slots=True)
class PairFailure:
    """A pair that came to nothing, and why."""

    pair_id: str
    error: RigkitError

    def __str__(self) -> str:
        words = str(self.error)
        return words if f"'{self.pair_id}'" in words else f"pair '{self.pair_id}': {words}"


def over_pairs(
    work: Callable[[Any], Result], jobs: Sequence[Any], processes: int | None, what: str, progress: Progress
) -> tuple[list[Result], tuple[PairFailure, ...]]:
    """Return `work(job)` for every job, in their order, and the pairs that came to nothing.

    Several processes work where that helps. A pair that cannot be done does not take the others with it; only if there
    is no result at all is the first pair's error raised.
    """
    count = min(len(jobs), processes or os.cpu_count() or 1)
    progress(what, 0, len(jobs))
    outcomes: list[Result | RigkitError] = []
    with contextlib.ExitStack() as stack:
        attempt = functools.partial(_attempt, work)
        each = map if count <= 1 else stack.enter_context(worker_pool(count)).map
        results: Iterable[Result | RigkitError] = each(attempt, jobs)
        for done, outcome in enumerate(results, start=1):
            progress(what, done, len(jobs))
            outcomes.append(outcome)
    failures = tuple(
        PairFailure(job.pair.pair_id, outcome)
        for job, outcome in zip(jobs, outcomes, strict=True)
        if isinstance(outcome, RigkitError)
    )
    if failures and len(failures) == len(jobs):
        for failure in failures[1:]:
            note(str(failure))
        raise failures[0].error
    return [outcome for outcome in outcomes if not isinstance(outcome, RigkitError)], failures


def _attempt(work: Callable[[Any], Result], job: Any) -> Result | RigkitError:
    try:
        return work(job)
    except RigkitError as error:
        return error


def failed_pairs(failures: Sequence[PairFailure]) -> dict[str, dict[str, str]]:
    """Return what a program needs to know of `failures`; nothing where there are none."""
    return {"failed": {failure.pair_id: str(failure.error) for failure in failures}} if failures else {}


def exit_code_of(failures: Sequence[PairFailure], otherwise: int) -> int:
    """Say which pairs came to nothing; return the exit code that the first of them asks for, else `otherwise`."""
    for failure in failures:
        note(str(failure))
    return failures[0].error.exit_code if failures else otherwise
