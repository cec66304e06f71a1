"""Frames of one video, or of several recorded together, selected and written as PNG files.

A frame is named after its number in the video; frames of one moment share a name.
"""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, nullcontext, suppress
from dataclasses import replace
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


def moments_beside(counts: Mapping[Path, int]) -> list[tuple[int, list[int]]] | None:
    """Return the number and the frames, one of each video, of every moment of which all have a new frame, from the
    timestamps.csv beside the videos; None without one. `counts` : their numbers of frames.

    Raises InputError where there is no such moment, and as `read_timestamps`.
    """
    times = timestamps_next_to(list(counts))
    if times is None:
        return None
    names, moments = [path.stem for path in counts], list[tuple[int, list[int]]]()
    last = [-1] * len(names)
    for moment, at in read_timestamps(times, dict(zip(names, counts.values(), strict=True))).items():
        frames = [at.get(name, -1) for name in names]
        # As in `_moments`: a recorder repeats the last frame where it has no new one.
        if all(old < new < count for old, new, count in zip(last, frames, counts.values(), strict=True)):
            moments.append((moment, frames))
            last = frames
    if not moments:
        raise InputError(f"'{times}': no moment has a frame of every video, {' and '.join(names)}; correct it")
    return moments


def frames_of_videos(
    sources: Mapping[str, Path],
    folder: Path,
    boards: Sequence[Board] = (),
    *,
    timestamps: Path | None = None,
    max_frames: int = MAX_FRAMES,
    progress: Progress = silent,
) -> dict[str, tuple[Path, ...]]:
    """Write selected frames of one video (named ""), or selected moments of several cameras' videos, as PNG files, and
    return these by camera; several cameras have a folder each in `folder`.

    A source is a video, a numbered sequence, or a live camera, which is read until `max_frames` or Ctrl-C. Frames that
    an earlier call kept of the same videos for the same boards are used again. `timestamps` is a file that assigns
    frames to moments (`io.media.video.read_timestamps`); None: frames of the same number are of one moment.

    Raises InputError: unreadable video, no board in any frame of one, `folder` not writable or with other files in it.
    """
    asked = _request(sources, boards, timestamps, max_frames)
    if (kept := _kept_before(folder, asked)) is not None:
        return kept
    with _opened(sources, timestamps) as (videos, moments):
        live = any(video.live for video in videos.values())
        _require_own_folder(folder, live)
        chosen, shots = _chosen_moments(sources, videos, moments, boards, max_frames, progress)
    _claim_folder(folder, sources, live)
    images: dict[str, tuple[Path, ...]] = dict.fromkeys(sources, ())
    with nullcontext() if live else _removed_after_failure(folder, sources):
        for number, pictures in shots.items() if live else moments_of_videos(sources, list(chosen), timestamps):
            for name in chosen[number].views:
                path = folder / name / f"{number:06d}.png"
                write_atomic(path, np.asarray(cv2.imencode(".png", pictures[name], PNG_FAST)[1]).tobytes(), force=True)
                images[name] += (path,)
        if not live:
            stored = {name: [path.relative_to(folder).as_posix() for path in paths] for name, paths in images.items()}
            record = json.dumps({"schema": FRAMES_SCHEMA, "asked": asked, "images": stored}, indent=1)
            write_atomic(folder / RECORD, record + "\n", force=True)
    return images


def numbers_of_moments(
    sources: Mapping[str, Path], boards: Sequence[Board], timestamps: Path | None = None, progress: Progress = silent
) -> list[int]:
    """Return the numbers of the moments that `frames_of_videos` selects; raises as it does for videos."""
    with _opened(sources, timestamps) as (videos, moments):
        return list(_chosen_moments(sources, videos, moments, boards, MAX_FRAMES, progress)[0])


def _chosen_moments(
    sources: Mapping[str, Path],
    videos: Mapping[str, Video],
    moments: Mapping[int, Mapping[str, int]] | None,
    boards: Sequence[Board],
    max_frames: int,
    progress: Progress,
) -> tuple[dict[int, KeptFrame], dict[int, dict[str, Image]]]:
    """Return the selected moments by number, and of live cameras, which cannot be read again, their pictures."""
    choice, looked_at, shots = FrameChoice(max_frames), 0, dict[int, dict[str, Image]]()
    live = any(video.live for video in videos.values())
    if moments is None:
        _warn_of_clocks(videos)
    total = min((v.count for v in videos.values() if v.count), default=0) if moments is None else len(moments)
    # Ctrl-C ends the capture of a live camera.
    with suppress(*((KeyboardInterrupt,) if live else ())):
        for number, pictures in _moments(videos, moments):
            progress(SEARCHING, looked_at, max(total, looked_at + 1))
            looked_at += 1
            if (frame := _described(number, pictures, boards)) is not None:
                choice.offer(frame)
                if live:
                    shots = {k: shot for k, shot in (*shots.items(), (number, pictures)) if k in choice.kept}
            if live and len(choice.kept) >= max_frames:
                break
    # Moments of the timestamps that have no frame are not searched.
    progress(SEARCHING, looked_at, looked_at)
    choice.finish()
    seen = {name for frame in choice.kept.values() for name in frame.views}
    if blind := [path for name, path in sources.items() if name not in seen]:
        names = ", ".join(f"'{path}'" for path in blind)
        shown = None if live or not boards else why_not_detected(blind, boards, progress)
        raise InputError(
            f"{names}: no board in {looked_at} frames; {shown or 'check focus, light and the size of the board'}"
        )
    return choice.kept, {number: shots[number] for number in choice.kept if live}


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
        counts = {name: video.count for name, video in videos.items()}
        yield videos, None if timestamps is None else read_timestamps(timestamps, counts)


def moments_of_videos(
    sources: Mapping[str, Path], numbers: Sequence[int], timestamps: Path | None = None
) -> Iterator[tuple[int, dict[str, Image]]]:
    """Yield the number and the frames by camera of the moments `numbers`, in rising order."""
    with _opened(sources, timestamps) as (videos, moments):
        table = {k: dict.fromkeys(videos, k) for k in numbers} if moments is None else moments
        yield from ((number, pictures) for number, pictures in _moments(videos, table) if number in numbers)


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
    videos = {name: tuple(filter(is_video, camera.images)) for name, camera in session.cameras.items()}
    if not any(videos.values()):
        return session
    sources = {name: paths[0] for name, paths in videos.items() if paths}
    if any(len(paths) > 1 for paths in videos.values()):
        raise InputError(f"{session.path}: several videos of one camera; keep one")
    boards = next(iter(session.cameras.values())).boards
    times = timestamps_next_to(list(sources.values()))
    frames = frames_of_videos(sources, place, boards, timestamps=times, progress=progress)
    cameras: dict[str, Session] = {}
    for name, camera in session.cameras.items():
        still = [path for path in camera.images if path not in videos[name]]
        cameras[name] = replace(camera, images=(*still, *frames.get(name, ())))
    return replace(session, cameras=cameras) if isinstance(session, RigSession) else cameras[""]


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


def _require_own_folder(folder: Path, live: bool) -> None:
    """Raise InputError if the folder cannot be written, or holds anything but frames of videos, which can be taken
    again, unlike those of a `live` camera."""
    ensure_folder_writable(folder)
    own = (folder / RECORD).is_file()
    if folder.is_dir() and any(folder.iterdir()) and (live or not own):
        what = "frames of videos" if own else "other files than frames kept of a video"
        raise InputError(f"'{folder}' holds {what}, which stay as they are; rename or remove that folder")


def _claim_folder(folder: Path, sources: Iterable[str], live: bool) -> None:
    """Mark the folder as one of frames of videos, still without any, and remove the frames of an earlier choice, which
    would be taken for images of this one."""
    if not live:
        write_atomic(folder / RECORD, json.dumps({"schema": FRAMES_SCHEMA, "asked": None}) + "\n", force=True)
    _remove_frames(folder, sources)


def _remove_frames(folder: Path, sources: Iterable[str]) -> None:
    for frame in (path for name in sources for path in (folder / name).glob("[0-9]" * 6 + ".png")):
        frame.unlink()


@contextmanager
def _removed_after_failure(folder: Path, sources: Collection[str]) -> Iterator[None]:
    """Remove the frames, and folders that are empty without them, if the block fails: videos give them again."""
    try:
        yield
    except BaseException:
        with suppress(OSError):
            _remove_frames(folder, sources)
            (folder / RECORD).unlink()
        for place in (*(folder / name for name in sources if name), folder):
            with suppress(OSError):
                place.rmdir()
        raise


def _kept_before(folder: Path, asked: Mapping[str, object]) -> dict[str, tuple[Path, ...]] | None:
    """Return the frames that an earlier call for the same `asked` kept in `folder`, or None."""
    if not (folder / RECORD).is_file():
        return None
    try:
        stored = json.loads(read_text(folder / RECORD, "record"))
        images = {name: tuple(folder / p for p in paths) for name, paths in stored["images"].items()}
        same = stored["schema"] == FRAMES_SCHEMA and stored["asked"] == json.loads(json.dumps(asked))
    except (InputError, ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError):
        return None
    return images if same and all(path.is_file() for paths in images.values() for path in paths) else None
