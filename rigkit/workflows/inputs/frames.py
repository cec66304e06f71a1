"""Frames of one video, or of several recorded together, selected and written as PNG files.

A frame is named after its number in the video; frames of one moment share a name.
"""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import cast

import cv2
import numpy as np

from rigkit.core.boards import Board
from rigkit.core.detections import BoardDetection
from rigkit.core.errors import InputError
from rigkit.core.progress import Progress, silent
from rigkit.detection.detect import detect_boards
from rigkit.io.disk.reading import read_text
from rigkit.io.disk.writing import ensure_folder_writable, write_atomic
from rigkit.io.manifests.rig_session import RigSession
from rigkit.io.manifests.session import Session, beside_session
from rigkit.io.media.images import Image
from rigkit.io.media.video import Video, is_video, read_timestamps
from rigkit.workflows.inputs.frame_choice import FrameChoice, KeptFrame, describe
from rigkit.workflows.inputs.identify_board import why_not_detected

_log = logging.getLogger(__name__)

MAX_FRAMES = 40
"""Frames kept of a video: a calibration gains little from more."""

SEARCH_PIXELS = 1.3e6
"""Frames are reduced below this size for the board search: a video of 4K takes a ninth of the time."""

SEARCHING = "looking at frames"
"""Name of the stage in progress reports."""

RECORD, FRAMES_SCHEMA = "frames.json", "rigkit.frames/1"
PNG_FAST = [cv2.IMWRITE_PNG_COMPRESSION, 1]


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class VideoFrames:
    """The frames kept of videos.

    Attributes
    ----------
    folder : folder of the images; several cameras have a folder each in it.
    images : images by camera, "" for a single one.
    looked_at, with_boards, near_copies : numbers of moments searched, of those that show a board, and of those whose
        view repeats another.
    """

    folder: Path
    images: Mapping[str, tuple[Path, ...]]
    looked_at: int
    with_boards: int
    near_copies: int


def frames_folder(sources: Sequence[Path]) -> Path:
    """Return the default folder for the frames of videos, beside the first video."""
    first = sources[0]
    live = first.name.startswith("camera:")
    place = Path() if live else first.parent
    stem = "".join(c if c.isalnum() or c in "-_." else "-" for c in first.stem)
    return place / ("frames" if len(sources) > 1 else f"{stem}-frames")


def timestamps_next_to(sources: Sequence[Path]) -> Path | None:
    """Return timestamps.csv in the folder of several videos, or None."""
    path = sources[0].parent / "timestamps.csv"
    return path if len(sources) > 1 and path.is_file() else None


def frames_of_videos(
    sources: Mapping[str, Path],
    folder: Path,
    boards: Sequence[Board] = (),
    *,
    timestamps: Path | None = None,
    max_frames: int = MAX_FRAMES,
    progress: Progress = silent,
) -> VideoFrames:
    """Write selected frames of one video (named ""), or selected moments of several cameras' videos, as PNG files.

    A source is a video, a numbered sequence, or a live camera, which is read until `max_frames` or Ctrl-C. Frames that
    an earlier call kept of the same videos for the same boards are used again. `timestamps` is a file that assigns
    frames to moments (`io.media.video.read_timestamps`); None: frames of the same number are of one moment.

    Raises InputError: unreadable video, no frame with a board, `folder` not writable or with other files in it.
    """
    asked = _request(sources, boards, timestamps, max_frames)
    kept = _kept_before(folder, asked)
    if kept is not None:
        return kept
    keeper = _FrameFolder(folder, FrameChoice(max_frames))
    looked_at = with_boards = 0
    with _opened(sources, timestamps) as (videos, moments):
        live = any(video.live for video in videos.values())
        _claim_folder(folder, live)
        if moments is None:
            _warn_of_clocks(videos)
        total = min((v.count for v in videos.values() if v.count), default=0) if moments is None else len(moments)
        # Ctrl-C ends the capture of a live camera.
        with suppress(*((KeyboardInterrupt,) if live else ())):
            for number, pictures in _moments(videos, moments):
                looked_at += 1
                progress(SEARCHING, looked_at, max(total, looked_at))
                frame = _described(number, pictures, boards)
                if frame is not None:
                    with_boards += 1
                    keeper.offer(frame, {name: pictures[name] for name in frame.views})
                if live and len(keeper.choice.kept) >= max_frames:
                    break
        # Moments of the timestamps that have no frame are not searched.
        progress(SEARCHING, looked_at, looked_at)
    images = keeper.finish()
    if not images:
        names = ", ".join(f"'{path}'" for path in sources.values())
        shown = None if live or not boards else why_not_detected(list(sources.values()), boards, progress)
        raise InputError(
            f"{names}: no board in {looked_at} frames; {shown or 'check focus, light and the size of the board'}"
        )
    done = VideoFrames(
        folder=folder,
        images={name: images.get(name, ()) for name in sources},
        looked_at=looked_at,
        with_boards=with_boards,
        near_copies=keeper.choice.near_copies,
    )
    if not live:
        _record(done, asked)
    return done


def _warn_of_clocks(videos: Mapping[str, Video]) -> None:
    """Warn if lengths or frame rates differ, so that frames of one number may not be of one moment."""
    for what, stored in (("frames", "count"), ("frames per second", "rate_hz")):
        known = {name: value for name, video in videos.items() if (value := getattr(video, stored))}
        if len({round(value, 2) for value in known.values()}) > 1:
            words = ", ".join(f"{value:.6g} of '{name}'" for name, value in known.items())
            _log.warning(
                "the videos differ in %s, %s: frames of the same number are assumed simultaneous, which may be wrong; "
                "give --timestamps",
                what,
                words,
            )


def _moments(
    videos: Mapping[str, Video], moments: Mapping[int, Mapping[str, int]] | None
) -> Iterator[tuple[int, dict[str, Image]]]:
    """Yield the number of each moment and its frames by camera; moments without a frame are skipped."""
    if moments is None:
        number = 0
        while pictures := {name: x for name, v in videos.items() if (x := v.frame(number)) is not None}:
            yield number, pictures
            number += 1
        return
    for number, frames in moments.items():
        # A recorder repeats the last frame where it has no new one: that is not of this moment.
        fresh = {name: k for name, k in frames.items() if k >= videos[name].next_number}
        pictures = {name: x for name, k in fresh.items() if (x := videos[name].frame(k)) is not None}
        if pictures:
            yield number, pictures


@contextmanager
def _opened(
    sources: Mapping[str, Path], timestamps: Path | None
) -> Iterator[tuple[dict[str, Video], Mapping[int, Mapping[str, int]] | None]]:
    """Open videos, by camera, and yield them with the moments of `timestamps`, as `_moments` takes them."""
    with ExitStack() as stack:
        videos = {name: stack.enter_context(Video(path)) for name, path in sources.items()}
        yield videos, None if timestamps is None else read_timestamps(timestamps, list(sources))


def moments_of_videos(
    sources: Mapping[str, Path], numbers: Collection[int], timestamps: Path | None = None
) -> Iterator[dict[str, Image]]:
    """Yield the frames by camera of the moments `numbers`; moments that lack a camera are skipped."""
    with _opened(sources, timestamps) as (videos, moments):
        for number, pictures in _moments(videos, moments):
            if number in numbers and len(pictures) == len(sources):
                yield pictures


def _described(number: int, pictures: Mapping[str, Image], boards: Sequence[Board]) -> KeptFrame | None:
    """Return the descriptors of the boards in the pictures of a moment; None without a board."""
    views, sigmas = {}, []
    for name, picture in pictures.items():
        found = _boards_in_reduced(picture, boards)
        view = describe(found)
        if view is not None:
            views[name] = view
            sigmas.append(float(np.median(max(found, key=lambda item: len(item.grid)).sigma_px)))
    return KeptFrame(number, views, float(np.mean(sigmas))) if views else None


def _boards_in_reduced(picture: Image, boards: Sequence[Board]) -> list[BoardDetection]:
    """Return the boards of a picture, detected in a reduced one, in pixels of the full picture."""
    factor = max(1, int(np.ceil(np.sqrt(picture.size / SEARCH_PIXELS))))
    if factor > 1:
        height, width = (side // factor for side in picture.shape)
        cut = picture[: height * factor, : width * factor]
        picture = cast(Image, cv2.resize(cut, (width, height), interpolation=cv2.INTER_AREA))
    found = detect_boards(picture, boards)
    shift = 0.5 * (factor - 1.0)
    return [replace(one, pixels=factor * one.pixels + shift, sigma_px=factor * one.sigma_px) for one in found]


def with_frames(session: Session | RigSession, progress: Progress = silent) -> Session | RigSession:
    """Return `session` with its videos replaced by selected frames, which are written beside the session.

    Videos of several cameras are synchronised by the timestamps.csv beside them, if it exists, else by frame number.
    """
    place = beside_session(session.path, "frames")
    own: Mapping[str, Session] = session.cameras if isinstance(session, RigSession) else {"": session}
    videos = {name: tuple(filter(is_video, camera.images)) for name, camera in own.items()}
    if not any(videos.values()):
        return session
    sources = {name: paths[0] for name, paths in videos.items() if paths}
    if any(len(paths) > 1 for paths in videos.values()):
        raise InputError(f"{session.path}: several videos of one camera; keep one")
    boards = next(iter(own.values())).boards
    done = frames_of_videos(
        sources, place, boards, timestamps=timestamps_next_to(list(sources.values())), progress=progress
    )
    cameras: dict[str, Session] = {}
    for name, camera in own.items():
        still = [path for path in camera.images if path not in videos[name]]
        cameras[name] = replace(camera, images=(*still, *done.images.get(name, ())))
    return replace(session, cameras=cameras) if isinstance(session, RigSession) else cameras[""]


class _FrameFolder:
    """Writes the frames that the choice keeps, the newest with a delay: a sharper one of the same view may follow."""

    def __init__(self, folder: Path, choice: FrameChoice) -> None:
        self.choice = choice
        self._folder = folder
        self._written: dict[int, dict[str, Path]] = {}
        self._held: tuple[int, dict[str, Image]] | None = None

    def offer(self, frame: KeptFrame, pictures: dict[str, Image]) -> None:
        kept, gone = self.choice.offer(frame)
        self._forget(gone)
        if kept:
            self._write_held()
            self._held = frame.number, pictures

    def finish(self) -> dict[str, tuple[Path, ...]]:
        """Return the images by camera."""
        self._write_held()
        self._forget(self.choice.finish())
        out: dict[str, list[Path]] = {}
        for number in sorted(self._written):
            for name, path in self._written[number].items():
                out.setdefault(name, []).append(path)
        return {name: tuple(paths) for name, paths in out.items()}

    def _write_held(self) -> None:
        if self._held is None:
            return
        number, pictures = self._held
        self._held = None
        self._written[number] = paths = {name: self._folder / name / f"{number:06d}.png" for name in pictures}
        for name, path in paths.items():
            write_atomic(path, np.asarray(cv2.imencode(".png", pictures[name], PNG_FAST)[1]).tobytes(), force=True)

    def _forget(self, numbers: Sequence[int]) -> None:
        for number in numbers:
            if self._held is not None and self._held[0] == number:
                self._held = None
            for path in self._written.pop(number, {}).values():
                path.unlink(missing_ok=True)


def _request(
    sources: Mapping[str, Path], boards: Sequence[Board], timestamps: Path | None, max_frames: int
) -> dict[str, object]:
    """Return what the selection depends on: the files with size and time of change, and the boards."""
    files = [*sources.values(), *([timestamps] if timestamps else [])]
    state = {str(path.name): [s.st_size, s.st_mtime_ns] for path in files if path.is_file() and (s := path.stat())}
    digest = hashlib.sha256(repr([(b.size, b.pattern) for b in boards]).encode()).hexdigest()
    return {
        "cameras": {name: path.name for name, path in sources.items()},
        "files": state,
        "boards": digest,
        "most": max_frames,
    }


def _claim_folder(folder: Path, live: bool) -> None:
    """Mark the folder as one of kept frames.

    Raises InputError if it holds anything else, or frames of a live camera, which cannot be taken again.
    """
    ensure_folder_writable(folder)
    own = (folder / RECORD).is_file()
    if folder.is_dir() and any(folder.iterdir()) and (live or not own):
        what = "frames of an earlier capture" if own else "other files than frames kept of a video"
        raise InputError(f"'{folder}' holds {what}, which stay as they are; rename or remove that folder")
    if not own:
        write_atomic(folder / RECORD, json.dumps({"schema": FRAMES_SCHEMA, "asked": None}) + "\n")


def _record(done: VideoFrames, asked: Mapping[str, object]) -> None:
    images = {name: [p.relative_to(done.folder).as_posix() for p in paths] for name, paths in done.images.items()}
    counts = {"looked_at": done.looked_at, "with_boards": done.with_boards, "near_copies": done.near_copies}
    text = json.dumps({"schema": FRAMES_SCHEMA, "asked": asked, "images": images, **counts}, indent=1)
    write_atomic(done.folder / RECORD, text + "\n", force=True)


def _kept_before(folder: Path, asked: Mapping[str, object]) -> VideoFrames | None:
    """Return the frames that an earlier call for the same `asked` kept in `folder`, or None."""
    if not (folder / RECORD).is_file():
        return None
    try:
        stored = json.loads(read_text(folder / RECORD, "record"))
        images = {name: tuple(folder / p for p in paths) for name, paths in stored["images"].items()}
        counts = {key: int(stored[key]) for key in ("looked_at", "with_boards", "near_copies")}
        same = stored["schema"] == FRAMES_SCHEMA and stored["asked"] == json.loads(json.dumps(asked))
    except (InputError, ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError):
        return None
    if not same or not all(path.is_file() for paths in images.values() for path in paths):
        return None
    return VideoFrames(folder=folder, images=images, **counts)
