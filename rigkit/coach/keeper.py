"""Frames on disk: every one that is taken is there at once, whole and lossless, with the session that calibrates it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rigkit.core.errors import InputError
from rigkit.io.files import write_atomic
from rigkit.io.images import read_image

__all__ = ["Keeper"]

FRAME_NAME = "frame-{:04d}.png"
FRAME_FOLDER = "images"


class Keeper:
    """A session's folder: `session.toml`, the boards' files, and `images/frame-0001.png` and on."""

    def __init__(self, folder: Path, files: dict[Path, str]) -> None:
        """Make the folder, or go on with it. `files` (path -> text) are the session and its boards.

        Raises InputError where the folder holds another session.
        """
        self.folder = folder
        (folder / FRAME_FOLDER).mkdir(parents=True, exist_ok=True)
        for path, text in files.items():
            if path.exists() and path.read_text(encoding="utf-8") != text:
                raise InputError(f"coach: '{path}' says something else; give another folder, or the same boards")
            if not path.exists():
                write_atomic(path, text)

    @property
    def frames(self) -> list[Path]:
        """The frames taken, in order."""
        return sorted((self.folder / FRAME_FOLDER).glob(FRAME_NAME.format(0).replace("0000", "*")))

    def images(self) -> list[tuple[str, NDArray[Any]]]:
        """Return the frames taken before, by name."""
        return [(path.name, read_image(path)) for path in self.frames]

    def keep(self, image: NDArray[Any]) -> Path:
        """Write a frame, whole or not at all, and return where it is."""
        taken = self.frames
        number = 1 + (int(taken[-1].stem.rsplit("-", 1)[1]) if taken else 0)
        path = self.folder / FRAME_FOLDER / FRAME_NAME.format(number)
        bgr = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
        write_atomic(path, np.asarray(cv2.imencode(".png", bgr)[1]).tobytes())
        return path

    def drop_last(self) -> None:
        """Set the last frame aside: it stays on disk, under a name that no session reads."""
        taken = self.frames
        if taken:
            taken[-1].rename(taken[-1].with_suffix(".png.dropped"))
