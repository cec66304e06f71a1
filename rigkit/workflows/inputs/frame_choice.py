"""Which frames of a video to keep: sharp ones, each with the boards elsewhere than in all others.

A frame is described by how far its boards reach in eight directions of the image, which does not depend on where the
count of their corners begins and changes with every motion but a turn by the symmetry of the board. Frames are taken as
they come and only descriptions are kept: of those nearer to each other than a radius the sharpest stays, and the radius
grows when there are too many (the doubling algorithm of Charikar, Chekuri, Feder and Motwani 2004 for k centres).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from rigkit.core.arrays import FloatArray
from rigkit.core.detections import BoardDetection

DIRECTIONS: FloatArray = np.stack([f(np.arange(8) * (np.pi / 4.0)) for f in (np.cos, np.sin)], axis=-1)

SAME_VIEW = 0.015
"""Boards that reach equally far in all directions, to this part of their own extent, were hardly moved: of a board that
spans 23 degrees, tilts 6 degrees apart differ by 0.008 to 0.013, and 11 degrees by 0.017 to 0.024."""

GROWTH = 1.4
"""The radius grows by this factor when there are twice as many frames as wanted."""

CLEARLY_SHARPER = 0.9
"""A frame takes the place of another one near it if its corners are this much more certain."""

BLURRED = 3.0
"""Frames whose corners are so many times less certain than those of the typical frame kept are left out at the end."""


@dataclass(frozen=True, eq=False, slots=True)
class KeptFrame:
    """A moment: its number, where the boards are by camera (`describe`), and how uncertain their corners are, px."""

    number: int
    views: Mapping[str, FloatArray]
    sigma_px: float


def describe(found: Sequence[BoardDetection]) -> FloatArray | None:
    """Return how far the largest board reaches in each of DIRECTIONS (8,), px; None without a board."""
    if not found:
        return None
    reach: FloatArray = (max(found, key=lambda item: len(item.grid)).pixels @ DIRECTIONS.T).max(axis=0)
    return reach


class FrameChoice:
    """The frames kept so far, at most twice as many as `max_frames`."""

    def __init__(self, max_frames: int) -> None:
        self.kept: dict[int, KeptFrame] = {}
        self.near_copies = 0
        self._max_frames, self._radius = max_frames, SAME_VIEW

    def offer(self, frame: KeptFrame) -> tuple[bool, list[int]]:
        """Consider `frame`; return whether it is kept, and the numbers of those that are no longer."""
        near = [k for k, other in self.kept.items() if _frame_distance(frame, other) < self._radius]
        self.near_copies += bool(near)
        if near and frame.sigma_px > CLEARLY_SHARPER * min(self.kept[k].sigma_px for k in near):
            return False, []
        for k in near:
            del self.kept[k]
        self.kept[frame.number] = frame
        gone = list(near)
        while len(self.kept) > 2 * self._max_frames:
            self._radius *= GROWTH
            gone += self._thin()
        return frame.number in self.kept, gone

    def finish(self) -> list[int]:
        """Leave out blurred frames, and of the rest those that add least; return the numbers of what is left out."""
        before = set(self.kept)
        if self.kept:
            limit = BLURRED * float(np.median([frame.sigma_px for frame in self.kept.values()]))
            self.kept = {k: frame for k, frame in self.kept.items() if frame.sigma_px <= limit}
        if len(self.kept) > self._max_frames:
            self.kept = {k: self.kept[k] for k in sorted(self._farthest())}
        return sorted(before - set(self.kept))

    def _thin(self) -> list[int]:
        """Leave out what is near a sharper one; return the numbers of those."""
        ordered = sorted(self.kept.values(), key=lambda frame: frame.sigma_px)
        rest: list[KeptFrame] = []
        for frame in ordered:
            if all(_frame_distance(frame, other) >= self._radius for other in rest):
                rest.append(frame)
        gone = set(self.kept) - {frame.number for frame in rest}
        self.kept = {frame.number: frame for frame in sorted(rest, key=lambda frame: frame.number)}
        return sorted(gone)

    def _farthest(self) -> list[int]:
        """Return `max_frames` frames, of which each is as far as can be from those before it (Gonzalez 1985), starting
        with the one that most cameras see the sharpest."""
        frames = list(self.kept.values())
        first = min(range(len(frames)), key=lambda k: (-len(frames[k].views), frames[k].sigma_px))
        chosen, distance = [first], np.array([_frame_distance(frames[first], other) for other in frames])
        while len(chosen) < self._max_frames:
            chosen.append(int(distance.argmax()))
            distance = np.minimum(distance, [_frame_distance(frames[chosen[-1]], other) for other in frames])
        return [frames[k].number for k in chosen]


def _frame_distance(one: KeptFrame, two: KeptFrame) -> float:
    """Return how far apart two moments are, in extents of the board: by the camera that sees most of a difference; far
    where one sees the board only once."""
    if one.views.keys() != two.views.keys():
        return float(np.inf)
    return max(_moved(view, two.views[name]) for name, view in one.views.items())


def _moved(one: FloatArray, two: FloatArray) -> float:
    """Return by how much of its extent, where that is smaller, a board was moved from one view to the other."""
    # The second four of DIRECTIONS are opposite to the first.
    extent = min(float((view[:4] + view[4:]).max()) for view in (one, two))
    return float(np.abs(one - two).max()) / max(extent, 1e-9)
