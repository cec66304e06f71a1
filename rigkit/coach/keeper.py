"""Frames on disk: each is written losslessly and atomically as soon as it is taken, beside the session file."""

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
    """Return the frame folder of the camera `name`, one of `count`, relative to the session's."""
    return FRAME_FOLDER if count == 1 else f"{FRAME_FOLDER}/{name}"


class Keeper:
    """A session's folder: `session.toml`, the boards' files, and `images/frame-0001.png` and so on; for several cameras
    `images/NAME/frame-0001.png`."""

    def __init__(self, folder: Path, files: dict[Path, str], names: Sequence[str] = (ONE,)) -> None:
        """Make the folder, or resume the session in it. `files` (path -> text) are the session and its boards, `names`
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
                    f"coach: '{path}' is a session of other boards or cameras; give another folder, or the same "
                    "boards and cameras"
                )
            if not path.exists():
                write_atomic(path, text)

    @property
    def frames(self) -> list[str]:
        """The names of the frames taken, in order."""
        found = {path.name for place in self._places for path in place.iterdir() if KEPT_FRAME.fullmatch(path.name)}
        return sorted(found, key=_number)

    def images(self) -> Iterator[tuple[str, list[NDArray[Any]]]]:
        """Yield the earlier frames that all cameras have, by name; frames with an unreadable image are skipped with a
        warning."""
        for name in self.frames:
            if all((place / name).exists() for place in self._places):
                try:
                    yield name, [read_image(place / name) for place in self._places]
                except InputError as error:
                    _log.warning("left out: %s", error)

    def keep(self, images: Sequence[NDArray[Any]]) -> str:
        """Write a frame, each image atomically, and return its name."""
        taken = self.frames
        name = FRAME_NAME.format(1 + (_number(taken[-1]) if taken else 0))
        for place, image in zip(self._places, images, strict=True):
            bgr = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
            write_atomic(place / name, np.asarray(cv2.imencode(".png", bgr)[1]).tobytes())
        return name

    def drop(self, name: str) -> None:
        """Remove a frame from the session: its files are renamed so that no session reads them."""
        for path in (place / name for place in self._places):
            if path.exists():
                path.rename(_dropped_path(path))


def _dropped_path(path: Path) -> Path:
    """Return a unique name for a removed frame: after an undo, the next frame gets the same name."""
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
