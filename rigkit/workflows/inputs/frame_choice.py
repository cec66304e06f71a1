"""Selection of video frames: sharp ones, each with the boards in another place.

A frame is described by the extent of its largest board in eight image directions. This descriptor does not depend on
the order of the corners, and every motion changes it except a turn by a symmetry of the board. Frames come as a stream
and only descriptors are kept: of frames closer than a radius the sharpest stays, and the radius grows when there are
too many (the doubling algorithm of Charikar, Chekuri, Feder and Motwani 2004 for k centres).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from rigkit.core.arrays import FloatArray
from rigkit.core.detections import BoardDetection

DIRECTIONS: FloatArray = np.stack([f(np.arange(8) * (np.pi / 4.0)) for f in (np.cos, np.sin)], axis=-1)

SAME_VIEW = 0.015
"""Descriptors that differ by less than this fraction of the board's extent are the same view. For a board that spans 23
degrees, tilts that differ by 6 degrees give 0.008 to 0.013, by 11 degrees 0.017 to 0.024."""

GROWTH = 1.4
"""Factor of the radius when twice as many frames are kept as wanted."""

CLEARLY_SHARPER = 0.9
"""A frame replaces a similar one if the sigma of its corners is smaller by this factor."""

BLURRED = 3.0
"""Frames whose corner sigma exceeds the median of the kept frames by this factor are removed at the end."""


@dataclass(frozen=True, eq=False, slots=True)
class KeptFrame:
    """A moment: its number, the descriptor by camera (`describe`), and the mean sigma of the corners, px."""

    number: int
    views: Mapping[str, FloatArray]
    sigma_px: float


def describe(found: Sequence[BoardDetection]) -> FloatArray | None:
    """Return the extent (8,) of the largest board along each of DIRECTIONS, px; None without a board."""
    if not found:
        return None
    reach: FloatArray = (max(found, key=lambda item: len(item.grid)).pixels @ DIRECTIONS.T).max(axis=0)
    return reach


class FrameChoice:
    """The frames kept so far, at most twice as many as `max_frames`."""

    def __init__(self, max_frames: int) -> None:
        self.kept: dict[int, KeptFrame] = {}
        self._max_frames, self._radius = max_frames, SAME_VIEW

    def offer(self, frame: KeptFrame) -> None:
        """Keep `frame`, and remove others for it, unless it repeats one that is about as sharp."""
        near = [k for k, other in self.kept.items() if _frame_distance(frame, other) < self._radius]
        if near and frame.sigma_px > CLEARLY_SHARPER * min(self.kept[k].sigma_px for k in near):
            return
        for k in near:
            del self.kept[k]
        self.kept[frame.number] = frame
        while len(self.kept) > 2 * self._max_frames:
            self._radius *= GROWTH
            self._thin()

    def finish(self) -> None:
        """Remove blurred frames, then the most similar ones."""
        if self.kept:
            limit = BLURRED * float(np.median([frame.sigma_px for frame in self.kept.values()]))
            self.kept = {k: frame for k, frame in self.kept.items() if frame.sigma_px <= limit}
        if len(self.kept) > self._max_frames:
            self.kept = {k: self.kept[k] for k in sorted(self._farthest_first())}

    def _thin(self) -> None:
        """Remove frames that are similar to a sharper one."""
        rest: list[KeptFrame] = []
        for frame in sorted(self.kept.values(), key=lambda frame: frame.sigma_px):
            if all(_frame_distance(frame, other) >= self._radius for other in rest):
                rest.append(frame)
        self.kept = {frame.number: frame for frame in sorted(rest, key=lambda frame: frame.number)}

    def _farthest_first(self) -> list[int]:
        """Return the numbers of `max_frames` frames by farthest-first traversal (Gonzalez 1985).

        It starts with the frame that the most cameras see, the sharpest of these.
        """
        frames = list(self.kept.values())
        first = min(range(len(frames)), key=lambda k: (-len(frames[k].views), frames[k].sigma_px))
        chosen, distance = [first], np.array([_frame_distance(frames[first], other) for other in frames])
        while len(chosen) < self._max_frames:
            chosen.append(int(distance.argmax()))
            distance = np.minimum(distance, [_frame_distance(frames[chosen[-1]], other) for other in frames])
        return [frames[k].number for k in chosen]


def _frame_distance(one: KeptFrame, two: KeptFrame) -> float:
    """Return the distance of two moments, in extents of the board: the largest of all cameras.

    It is infinite if other cameras see the board.
    """
    if one.views.keys() != two.views.keys():
        return float(np.inf)
    return max(_moved(view, two.views[name]) for name, view in one.views.items())


def _moved(one: FloatArray, two: FloatArray) -> float:
    """Return the largest change of a descriptor, as a fraction of the smaller extent of the board."""
    # The second four of DIRECTIONS are opposite to the first.
    extent = min(float((view[:4] + view[4:]).max()) for view in (one, two))
    return float(np.abs(one - two).max()) / max(extent, 1e-9)
