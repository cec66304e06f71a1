"""Frames of videos, image sequences and live cameras, decoded one at a time by OpenCV.

A source is a video file, a pattern of image files such as `img_%04d.png`, or `camera:0`. Orientation tags are not
applied, because a calibration belongs to the sensor.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import cast

import cv2
import numpy as np

from rigkit.core.errors import InputError
from rigkit.core.identifiers import last_number
from rigkit.io.disk.reading import csv_table
from rigkit.io.media.images import Image, is_image, quiet_opencv, require_pixels

_log = logging.getLogger(__name__)

VIDEO_ENDINGS = frozenset({".3gp", ".avi", ".flv", ".m2ts", ".m4v", ".mjpeg", ".mjpg", ".mkv", ".mov", ".mp4", ".mpeg",
                           ".mpg", ".mts", ".ts", ".webm", ".wmv"})  # fmt: skip
LIVE_CAMERA = re.compile(r"camera:(\d{1,2})")
SEQUENCE = re.compile(r"%0?\d?d")
COMPLETE = 0.95
"""Fraction of the announced frames: containers without an index only state the duration."""
TIMESTAMPS = ("sync_index", "cam_id", "frame_index")


def is_video(source: str | Path) -> bool:
    """Return whether `source` names a video, a numbered sequence or a live camera."""
    name = Path(source).name
    return (
        Path(name).suffix.lower() in VIDEO_ENDINGS
        or LIVE_CAMERA.fullmatch(name) is not None
        or SEQUENCE.search(name) is not None
    )


def videos_inside(place: Path) -> list[Path]:
    """Return the videos of a folder that has videos but no images, else `place` itself; hidden files are neither."""
    if is_video(place) or not place.is_dir():
        return [place]
    inside = sorted(path for path in place.iterdir() if path.is_file() and not path.name.startswith("."))
    videos = [path for path in inside if path.suffix.lower() in VIDEO_ENDINGS]
    return [place] if any(map(is_image, inside)) or not videos else videos


class Video:
    """An open video, read forwards; one frame is in memory.

    Attributes
    ----------
    source : the given path.
    count : announced number of frames, 0 if unknown.
    rate_hz : announced frames per second, 0 if unknown.
    live : whether it is a live camera.
    size_px : width and height of the frames.
    next_number : number of the next frame, from 0.
    """

    def __init__(self, source: str | Path, *, colour: bool = False) -> None:
        """Open `source` for grey frames, or RGB frames with `colour`; raises InputError if it cannot be opened."""
        self._colour = colour
        self.source = Path(source)
        number = LIVE_CAMERA.fullmatch(self.source.name)
        self.live = number is not None
        if not self.live and SEQUENCE.search(self.source.name) is None and not self.source.is_file():
            raise InputError(f"video '{source}' does not exist; check the path")
        with quiet_opencv():
            self._capture = cv2.VideoCapture(int(number[1])) if number else cv2.VideoCapture(str(source))
        if not self._capture.isOpened():
            if self.live:
                raise InputError(f"camera '{source}' is not connected, or another program has it")
            # The index of an MP4 is at its end: a truncated one cannot be converted.
            raise InputError(
                f"video '{source}' cannot be decoded: cut off, or of a format that is not read; copy it again, or "
                "convert it to MP4"
            )
        self._capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
        width, height = (int(self._capture.get(p)) for p in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
        self.size_px = width, height
        require_pixels(self.size_px, f"video '{source}'")
        count = self._capture.get(cv2.CAP_PROP_FRAME_COUNT)
        self.count = 0 if self.live or not np.isfinite(count) else max(int(count), 0)
        rate = self._capture.get(cv2.CAP_PROP_FPS)
        self.rate_hz = 0.0 if self.live or not np.isfinite(rate) else max(float(rate), 0.0)
        self.next_number = 0

    def __enter__(self) -> Video:
        return self

    def __exit__(self, *_: object) -> None:
        self._capture.release()

    def frame(self, number: int) -> Image | None:
        """Return frame `number`, from 0; None at the end. Raises InputError for a frame before `next_number`."""
        if number < self.next_number:
            raise InputError(
                f"video '{self.source}': frame {number} is before frame {self.next_number}; ask in rising order"
            )
        with quiet_opencv():
            while self.next_number < number:
                if not self._capture.grab():
                    self._check_end()
                    return None
                self.next_number += 1
            well, picture = self._capture.read()
        if not well:
            self._check_end()
            return None
        self.next_number += 1
        # Decoders of sequences keep grey files grey.
        if picture.ndim == 3:
            picture = cv2.cvtColor(picture, cv2.COLOR_BGR2RGB if self._colour else cv2.COLOR_BGR2GRAY)
        return cast(Image, picture)

    def skip_to_end(self) -> int:
        """Return the true number of remaining frames, by skipping to the end of the video."""
        first = self.next_number
        with quiet_opencv():
            while self._capture.grab():
                self.next_number += 1
        self._check_end()
        return self.next_number - first

    def _check_end(self) -> None:
        """Warn once if the video ends before the announced number of frames; raise InputError if it has none."""
        if self.next_number == 0 and not self.live:
            raise InputError(f"video '{self.source}' has no frames that can be decoded; copy it again, or record anew")
        if self.next_number < COMPLETE * self.count:
            _log.warning(
                f"video '{self.source}': {self.next_number} of {self.count} frames can be decoded; it is cut off or "
                "damaged: copy it again from the camera"
            )
            self.count = 0


def read_timestamps(path: Path, cameras: Mapping[str, int]) -> dict[int, Mapping[str, int]]:
    """Return moment -> camera -> frame number in the camera's video, from 0, from a CSV file with the columns
    TIMESTAMPS.

    `cameras` : number of frames of each camera's video, 0 if unknown. `cam_id` is one of these cameras, or the number
    at its end.

    Raises InputError: a column is missing, a field is no integer, or a camera has no rows.
    """
    head, lines = csv_table(path, "timestamps")
    if not set(TIMESTAMPS) <= set(head):
        raise InputError(f"'{path}': the first line must name the columns {', '.join(TIMESTAMPS)}, a row a frame")
    named = {last_number(name): name for name in reversed(list(cameras))} | {name: name for name in cameras}
    moments: dict[int, dict[str, int]] = {}
    for line, row in lines:
        try:
            at, called, counted = (row[column] for column in TIMESTAMPS)
            camera, moment, frame = named.get(called), int(at), int(counted)
        except ValueError as error:
            raise InputError(
                f"'{path}', line {line}: sync_index and frame_index must be whole numbers; correct the line"
            ) from error
        if camera is not None:
            moments.setdefault(moment, {})[camera] = frame
    numbers = {c: sorted({frames[c] for frames in moments.values() if c in frames}) for c in cameras}
    for camera, own in numbers.items():
        if not own:
            raise InputError(
                f"'{path}' has no rows of camera '{camera}'; its cam_id must be the number at the end of its name"
            )
    places = _places_in_videos(path, numbers, cameras)
    return {moment: {c: places[c][k] for c, k in moments[moment].items()} for moment in sorted(moments)}


def _places_in_videos(
    path: Path, numbers: Mapping[str, Sequence[int]], counts: Mapping[str, int]
) -> dict[str, dict[int, int]]:
    """Return camera -> number in the file -> number in the video, from the sorted numbers and the videos' counts.

    Numbers are those in the video unless they exceed it. By one, where no camera has a 0: they count from 1. By more:
    recorders count from before the recording, so that the first number is the video's first frame, of all cameras if
    none has a 0. As many numbers as frames are these frames: dropped ones leave gaps in the numbers only.
    """
    over = {camera: own[-1] + 1 - counts[camera] for camera, own in numbers.items()}
    without_zero, most = min(own[0] for own in numbers.values()) > 0, max(over.values())
    places: dict[str, dict[int, int]] = {}
    for camera, own in numbers.items():
        first = own[0] if over[camera] > 0 or (without_zero and most > 0) else 0
        if without_zero and most == 1:
            first = 1
        each = len(own) == counts[camera]
        places[camera] = {number: k if each else number - first for k, number in enumerate(own)}
        if not each and 0 < counts[camera] <= own[-1] - first:
            _log.warning(
                "'%s': camera '%s' has numbers of %d frames, its video %d; if this was cut from a longer one, frames "
                "are not of one moment: number them as in the video, from 0",
                path,
                camera,
                own[-1] - first + 1,
                counts[camera],
            )
    return places
