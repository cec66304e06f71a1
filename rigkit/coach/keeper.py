"""Frames on disk: every one that is taken is there at once, whole and lossless, with the session that calibrates it."""

from __future__ import annotations

import logging
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rigkit.core.errors import InputError
from rigkit.io.disk.reading import read_text
from rigkit.io.disk.writing import write_atomic
from rigkit.io.manifests.rig_session import ONE
from rigkit.io.media.images import read_image

_log = logging.getLogger(__name__)

FRAME_NAME = "frame-{:04d}.png"
KEPT_FRAME = re.compile(r"frame-(\d{4,6})\.png")
FRAME_FOLDER = "images"


def folder_of(name: str, count: int) -> str:
    """Return the folder of the frames of the camera `name`, of `count`, in that of the session."""
    return FRAME_FOLDER if count == 1 else f"{FRAME_FOLDER}/{name}"


class Keeper:
    """A session's folder: `session.toml`, the boards' files, and `images/frame-0001.png` and on; of several cameras
    `images/NAME/frame-0001.png`."""

    def __init__(self, folder: Path, files: dict[Path, str], names: Sequence[str] = (ONE,)) -> None:
        """Make the folder, or go on with it. `files` (path -> text) are the session and its boards, `names` those of
        the cameras.

        Raises InputError where the folder holds another session.
        """
        self.folder, self.names = folder, tuple(names)
        self._places = [folder / folder_of(name, len(self.names)) for name in self.names]
        for place in self._places:
            place.mkdir(parents=True, exist_ok=True)
        for path, text in files.items():
            if path.exists() and read_text(path, "coach:") != text:
                raise InputError(
                    f"coach: '{path}' says something else; give another folder, or the same boards and cameras"
                )
            if not path.exists():
                write_atomic(path, text)

    @property
    def frames(self) -> list[str]:
        """The names of the frames taken, in order."""
        found = {path.name for place in self._places for path in place.iterdir() if KEPT_FRAME.fullmatch(path.name)}
        return sorted(found, key=_number)

    def images(self) -> Iterator[tuple[str, list[NDArray[Any]]]]:
        """Yield the frames taken before that are there of every camera, by name; one of which an image cannot be read
        is told of, and left out."""
        for name in self.frames:
            if all((place / name).exists() for place in self._places):
                try:
                    yield name, [read_image(place / name) for place in self._places]
                except InputError as error:
                    _log.warning("left out: %s", error)

    def keep(self, images: Sequence[NDArray[Any]]) -> str:
        """Write a frame, every image whole or not at all, and return its name."""
        taken = self.frames
        name = FRAME_NAME.format(1 + (_number(taken[-1]) if taken else 0))
        for place, image in zip(self._places, images, strict=True):
            bgr = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
            write_atomic(place / name, np.asarray(cv2.imencode(".png", bgr)[1]).tobytes())
        return name

    def drop(self, name: str) -> None:
        """Set a frame aside: it stays on disk, under a name that no session reads."""
        for path in (place / name for place in self._places):
            if path.exists():
                path.rename(_dropped_path(path))


def _dropped_path(path: Path) -> Path:
    """Return a name for a frame set aside that no other has: after it is undone, the next one is called as it was."""
    dropped = path.with_suffix(".png.dropped")
    again = 1
    while dropped.exists():
        again += 1
        dropped = path.with_suffix(f".png.dropped-{again}")
    return dropped


def _number(name: str) -> int:
    match = KEPT_FRAME.fullmatch(name)
    assert match is not None
    return int(match[1])
