"""Frames that do not come from the page: a folder that is watched, a video, or a camera of this machine."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rigkit.core.errors import InputError
from rigkit.io.images import read_image

__all__ = ["Frame", "device_frames", "video_frames", "watched_frames"]

POLL_S = 0.3
SETTLED_S = 0.2
"""A file that has not grown for so long is whole."""
ENDINGS = {".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp"}

Frame = NDArray[Any]


def watched_frames(folder: Path, *, until_idle_s: float = float("inf")) -> Iterator[Frame]:
    """Yield every picture in a folder, those to come as well, by name; ends when none has come for `until_idle_s`.

    Raises InputError where there is no such folder. What is no picture is left alone.
    """
    if not folder.is_dir():
        raise InputError(f"coach: '{folder}' is not a folder; give one in which pictures will appear")
    seen: set[str] = set()
    last = time.monotonic()
    while time.monotonic() - last < until_idle_s:
        for path in sorted(p for p in folder.iterdir() if p.suffix.lower() in ENDINGS and p.name not in seen):
            if time.time() - path.stat().st_mtime < SETTLED_S:
                continue
            seen.add(path.name)
            last = time.monotonic()
            try:
                yield read_image(path)
            except InputError:
                continue
        time.sleep(POLL_S)


def video_frames(path: Path) -> Iterator[Frame]:
    """Yield every frame of a video; raises InputError where it cannot be read."""
    yield from _captured(cv2.VideoCapture(str(path)), f"video '{path}'")


def device_frames(number: int) -> Iterator[Frame]:
    """Yield frames of camera `number` of this machine, the newest each time; raises InputError where there is none."""
    yield from _captured(cv2.VideoCapture(number), f"camera {number}")


def _captured(source: cv2.VideoCapture, name: str) -> Iterator[Frame]:
    try:
        good, frame = source.read()
        if not good:
            raise InputError(f"coach: {name} gives no picture; check the path, or that no other program has it")
        while good:
            yield np.asarray(cv2.cvtColor(frame, cv2.COLOR_BGR2RGB))
            good, frame = source.read()
    finally:
        source.release()
