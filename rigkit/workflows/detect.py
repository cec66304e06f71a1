"""`rigkit detect`: the boards of images, folders and videos, as a corners file and overlays."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeAlias

import cv2
import numpy as np

from rigkit.calibration.views.usable import other_size
from rigkit.cameras.base import Camera
from rigkit.core.arrays import spread_indices
from rigkit.core.boards import Board
from rigkit.core.detections import BoardDetection
from rigkit.core.errors import CheckFailed, InputError
from rigkit.core.printing import brief, counted
from rigkit.core.processes import in_threads, over_items, process_count
from rigkit.core.progress import Progress, silent
from rigkit.detection.detect import detect_boards
from rigkit.detection.doubtful import doubtful_grid
from rigkit.detection.duplicate_marks import duplicate_boards
from rigkit.detection.larger_grid import larger_grid
from rigkit.detection.lattices import MIN_BOARD_CORNERS
from rigkit.io.boards.board_words import board_of_words
from rigkit.io.corners.corners_file import write_corners
from rigkit.io.disk.reading import about, paths_of
from rigkit.io.disk.writing import ensure_writable, write_atomic
from rigkit.io.media.images import (
    Image,
    folder_of_images,
    images_of_folder,
    read_image,
    read_image_of,
    warn_of_unread_formats,
)
from rigkit.io.media.video import is_video, videos_inside
from rigkit.report.pictures.overlay import draw_boards
from rigkit.workflows.inputs.camera_files import import_camera
from rigkit.workflows.inputs.frames import frames_folder, frames_of_videos
from rigkit.workflows.inputs.identify_board import suggestion, why_not_detected
from rigkit.workflows.options.cameras import DetectOptions

_log = logging.getLogger(__name__)

WORTH_PROCESSES = 100
"""Smallest number of images searched in processes by default, whose start takes as long as 30 of 640x480 px: 28 of them
take 0.5 s of processor time in threads and 1.3 s in two processes."""

SEARCHED_AGAIN = 3
"""Largest number of images searched for chessboards larger than declared: a search of each would double the time."""


@dataclass(frozen=True, eq=False, slots=True)
class DetectionResult:
    """The boards found in images.

    Attributes
    ----------
    found : boards by image, in the order given.
    failures : errors by image that cannot be read.
    doubtful : doubts in words by image: an untrusted grid where no board is found, or two boards with the same marks.
    """

    found: Mapping[str, tuple[BoardDetection, ...]]
    failures: Mapping[str, InputError]
    doubtful: Mapping[str, str] = field(default_factory=dict)

    __repr__ = brief


@dataclass(frozen=True, eq=False, slots=True)
class _DetectJob:
    """One image to search, as it is sent to a process."""

    image: Path
    overlay: Path | None
    boards: tuple[Board, ...]
    camera: Camera | None
    options: DetectOptions


def detect_in_images(
    paths: str | Path | Sequence[str | Path], options: DetectOptions | None = None, *, progress: Progress = silent
) -> DetectionResult:
    """Detect the boards of images, videos, and folders of either, and write what `options` ask for.

    Of a video, the frames that `rigkit.workflows.inputs.frames` keeps are searched. An image that cannot be read goes
    into `failures`; its error is raised only if no image can be read.

    Raises InputError, before the work: no such file, no image in a folder, or a file that cannot be written;
    CheckFailed: no image shows a board.
    """
    options = options or DetectOptions()
    if options.min_corners < MIN_BOARD_CORNERS:
        raise InputError(
            f"--min-corners {options.min_corners}: a chessboard of less than 3x3 corners cannot be recognised"
        )
    process_count(options.jobs)  # an impossible number of jobs is refused before the work
    boards = tuple(board_of_words(str(board)) for board in options.boards)
    given = [one for path in paths_of(paths) for one in videos_inside(path)]
    videos, bad = _frames_of(list(filter(is_video, given)), boards, progress)
    if bad and len(given) == len(bad) == 1:
        raise next(iter(bad.values()))
    stills = [path for path in given if str(path) not in bad]
    images = list(images_in([image for path in stills for image in videos.get(path, (path,))]))
    if options.camera is not None and not boards:
        raise InputError("--camera needs boards of known size; give them, such as --board a9x6.toml")
    camera = None if options.camera is None else import_camera(options.camera)
    overlays = _overlay_paths(images, options.overlay)
    read = [*images, *options.boards, *([options.camera] if options.camera else [])]
    ensure_writable([options.output, *overlays], force=options.force, inputs=read)
    tasks = [
        _DetectJob(image, overlay, boards, camera, options) for image, overlay in zip(images, overlays, strict=True)
    ]
    outcomes, doubtful = _over_images(tasks, options.jobs, progress)
    failures = bad | {name: outcome for name, outcome in outcomes.items() if isinstance(outcome, InputError)}
    found = {name: outcome for name, outcome in outcomes.items() if not isinstance(outcome, InputError)}
    if failures and not found:
        more = f"; so it is with {len(failures) - 1} more" if len(failures) > 1 else ""
        raise InputError(f"{next(iter(failures.values()))}{more}")
    if not any(found.values()) and not failures:
        raise CheckFailed(_nothing_found(images, boards, doubtful, progress))
    if boards and not any(one.board_id for items in found.values() for one in items):
        why = why_not_detected(images, boards, progress)
        if why is not None:
            _log.warning(f"none of the boards given is seen whole: {why}")
    elif boards and (other := other_size(found, boards) or _larger_boards(tasks, found)) is not None:
        _log.warning(f"check columns and rows: {other}")
    if options.output is not None and any(found.values()):
        write_corners(options.output, found, force=options.force)
    return DetectionResult(found, failures, doubtful)


def _larger_boards(tasks: Sequence[_DetectJob], found: Mapping[str, tuple[BoardDetection, ...]]) -> str | None:
    """Return in words which larger chessboard most images show where a declared one was found, from a few of them."""
    shown = [task for task in tasks if any(one.board_id for one in found.get(str(task.image), ()))]
    some = [shown[k] for k in spread_indices(len(shown), SEARCHED_AGAIN)]
    words = {str(task.image): larger_grid(_read(task), found[str(task.image)], task.boards) for task in some}
    larger = {name: what for name, what in words.items() if what is not None}
    if 2 * len(larger) <= len(some):
        return None
    name, what = next(iter(larger.items()))
    return f"in '{name}' {what}"


def _nothing_found(
    images: Sequence[Path], boards: Sequence[Board], doubtful: Mapping[str, str], progress: Progress
) -> str:
    """Return why no board was found: what images show instead if that is known, else what to check."""
    looked_for = " or ".join(f"'{board.board_id}'" for board in boards) if boards else "chessboard"
    lead = f"no {'board ' if boards else ''}{looked_for} found in {counted(len(images), 'image')}"
    shown = None if boards else suggestion(images, progress).words
    why = why_not_detected(images, boards, progress) if boards else shown and f"they show --board {shown}"
    if why:
        return f"{lead}; {why}"
    seen = next((f"; in '{name}' {words}" for name, words in doubtful.items()), "")
    return f"{lead}; check focus and exposure, or --min-corners{seen}"


def _frames_of(
    videos: Sequence[Path], boards: Sequence[Board], progress: Progress
) -> tuple[dict[Path, tuple[Path, ...]], dict[str, InputError]]:
    """Return the frames kept of each video, and the errors of videos that give none."""
    kept, bad = {}, {}
    for path in videos:
        try:
            kept[path] = frames_of_videos({"": path}, frames_folder([path]), boards, progress=progress)[""]
        except InputError as error:
            bad[str(path)] = error
    return kept, bad


def images_in(paths: Sequence[Path]) -> Iterator[Path]:
    """Yield images, and those of folders (`folder_of_images`) sorted by name, each once.

    Raises InputError for a path that does not exist or a folder without images.
    """
    seen: set[Path] = set()
    for path in paths:
        inside = [path]
        if path.is_dir():
            inside = images_of_folder(folder := folder_of_images(path))
            warn_of_unread_formats(folder)
        elif not path.exists():
            raise InputError(f"image '{path}' does not exist; check the path")
        for image in inside:
            if image not in seen:
                seen.add(image)
                yield image


def _overlay_paths(images: Sequence[Path], folder: Path | None) -> list[Path | None]:
    """Return the path of each overlay; the folder's name is added where images of several folders share a name."""
    if folder is None:
        return [None] * len(images)
    common = Counter(image.stem for image in images)
    names = [image.stem if common[image.stem] == 1 else "_".join(image.with_suffix("").parts[-3:]) for image in images]
    if len(set(names)) < len(names):
        raise InputError("--overlay: several images would get the same picture name; run the folders one by one")
    return [folder / f"{name}.png" for name in names]


Outcome: TypeAlias = tuple[BoardDetection, ...] | InputError


def _over_images(
    tasks: Sequence[_DetectJob], jobs: int | None, progress: Progress
) -> tuple[dict[str, Outcome], dict[str, str]]:
    """Return the detections by image and the doubts by image (see `_detect`), both in the order of `tasks`."""
    results: dict[int, tuple[Outcome, str | None]] = {}
    few = jobs is None and len(tasks) < WORTH_PROCESSES
    for place, result in enumerate(in_threads(_detect, tasks)) if few else over_items(_detect, tasks, jobs=jobs):
        results[place] = result
        progress("detecting", len(results), len(tasks))
    ordered = [(str(task.image), *results[place]) for place, task in enumerate(tasks)]
    found = {name: outcome for name, outcome, _ in ordered}
    return found, {name: doubt for name, _, doubt in ordered if doubt is not None}


def _read(job: _DetectJob) -> Image:
    if job.camera is None or job.options.camera is None:
        return read_image(job.image)
    return read_image_of(job.image, job.camera.size_px, job.options.camera)


def _detect(job: _DetectJob) -> tuple[Outcome, str | None]:
    """Detect the boards of one image and write its overlay.

    Return the boards, or the error where the image cannot be used; and a doubt in words: an untrusted grid where no
    board is found, or two boards with the same marks.
    """
    cv2.setNumThreads(1)
    try:
        image = _read(job)
        with about(job.image):
            found = detect_boards(image, job.boards, min_corners=job.options.min_corners, camera=job.camera)
        seen = duplicate_boards(image, job.boards) if found else doubtful_grid(image)
    except InputError as error:
        return error, None
    except MemoryError as error:
        words = f"image '{job.image}': {error or 'out of memory'}; use fewer processes (-j 1), or a smaller one"
        return InputError(words), None
    if job.overlay is not None:
        picture = cv2.cvtColor(draw_boards(image, found), cv2.COLOR_RGB2BGR)
        write_atomic(job.overlay, np.asarray(cv2.imencode(".png", picture)[1]).tobytes(), force=job.options.force)
    return found, seen
