"""Frames that do not come from the page: from watched folders, or from cameras of this machine."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from rigkit.core.errors import InputError
from rigkit.io.manifests.rig_session import frames_of_images
from rigkit.io.media.images import is_image, read_image

POLL_S = 0.3
SETTLED_S = 0.2
"""A file that has not grown for this time is complete."""

_log = logging.getLogger(__name__)


class Frame(NamedTuple):
    """One image per camera, taken together, and the file it is from; "" for a camera."""

    images: list[NDArray[Any]]
    source: str = ""


def frames_of_folders(folders: Sequence[Path], *, until_idle_s: float = float("inf")) -> Iterator[Frame]:
    """Yield every image in a folder by name, also those still to come; of several folders, one per camera, the images
    of the same name or number, as soon as all are there. Ends when none has come for `until_idle_s`.

    Raises InputError at once for a missing folder, later where it has gone. An unreadable image is reported and
    skipped.
    """
    for folder in folders:
        if not folder.is_dir():
            raise InputError(f"coach: '{folder}' is not a folder; give one in which pictures will appear")
    return _polled_frames(folders, until_idle_s)


def _polled_frames(folders: Sequence[Path], until_idle_s: float) -> Iterator[Frame]:
    seen: set[str] = set()
    unread: dict[str, tuple[tuple[int, int], ...]] = {}
    last = time.monotonic()
    while time.monotonic() - last < until_idle_s:
        for name, paths in _moments(folders).items():
            state = None if name in seen else _settled(paths)
            if state is None or unread.get(name) == state:
                continue
            last = time.monotonic()
            try:
                frame = Frame(
                    [read_image(path) for path in paths], ", ".join(dict.fromkeys(path.name for path in paths))
                )
            except InputError as error:
                _log.warning("left out: %s", error)
                # A slow copy may have paused: it is read again once it has grown.
                unread[name] = state
                continue
            seen.add(name)
            yield frame
        time.sleep(POLL_S)


def _settled(paths: Sequence[Path]) -> tuple[tuple[int, int], ...] | None:
    """Return the time of writing, ns, and size of each file; None where one is incomplete, or has just gone."""
    try:
        found = [path.stat() for path in paths]
    except OSError:
        return None
    if any(time.time() - one.st_mtime < SETTLED_S for one in found):
        return None
    return tuple((one.st_mtime_ns, one.st_size) for one in found)


def _pictures(folder: Path) -> list[Path]:
    try:
        return sorted(path for path in folder.iterdir() if is_image(path))
    except OSError as error:
        raise InputError(f"coach: '{folder}' cannot be read any more: {error.strerror}; start again") from error


def _moments(folders: Sequence[Path]) -> dict[str, list[Path]]:
    """Return by name, in order, the images of every moment that all cameras have, one per camera."""
    found = [_pictures(folder) for folder in folders]
    if len(found) == 1:
        return {path.name: [path] for path in found[0]}
    by_path = {str(k): {path.name: path for path in own} for k, own in enumerate(found)}
    try:
        frames = frames_of_images({name: list(own) for name, own in by_path.items()})
    except InputError:
        # No image yet that all cameras have.
        return {}
    moments: dict[str, dict[str, Path]] = {}
    for camera, own in frames.items():
        for image, frame in own.items():
            moments.setdefault(frame, {})[camera] = by_path[camera][image]
    return {f: [m[k] for k in by_path] for f, m in sorted(moments.items()) if len(m) == len(folders)}


def device_frames(numbers: Sequence[int]) -> Iterator[Frame]:
    """Yield the newest frames of cameras of this machine; raises InputError at once where there is none, later where
    one has gone."""
    sources = [cv2.VideoCapture(number) for number in numbers]
    first = _moment(sources, numbers)

    def going_on() -> Iterator[Frame]:
        try:
            yield first
            while True:
                yield _moment(sources, numbers)
        finally:
            _release(sources)

    return going_on()


def _moment(sources: Sequence[cv2.VideoCapture], numbers: Sequence[int]) -> Frame:
    """Return an image of each camera; raises InputError where one gives none."""
    # All are triggered before any image is fetched, so that they are of one moment.
    grabbed = [source.grab() for source in sources]
    read = [source.retrieve() if good else (False, None) for good, source in zip(grabbed, sources, strict=True)]
    silent = [f"{number}" for (got, frame), number in zip(read, numbers, strict=True) if not got or frame is None]
    if silent:
        _release(sources)
        raise InputError(
            f"coach: camera {', '.join(silent)} gives no image; check the cable, and that no other program uses it"
        )
    return Frame([np.asarray(cv2.cvtColor(frame, cv2.COLOR_BGR2RGB)) for _, frame in read if frame is not None])


def _release(sources: Sequence[cv2.VideoCapture]) -> None:
    for source in sources:
        source.release()
