"""Chessboard corners of an image as loose points: peaks of the saddle response that pass the ring test."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray
from rigkit.detection.saddles.response import Level, peaks
from rigkit.detection.saddles.ring import ring_rules
from rigkit.kernels import front
from rigkit.kernels.front import near_any

RING_RADIUS = 2.6
"""Radius of the ring in pixels of the level, for squares of 6 px, or 5 px in frontal views."""

MAX_SHARPNESS = 0.095
"""Largest response of a corner over the square of its contrast on the ring. Edges without blur, smoothed as the level,
give 0.08, sharpened ones 0.09, for all angles and down to squares of 4 px; noise gives 0.12. A few corners of boards in
noise exceed it, which growth adds; of false corners of noise a third."""

SAME_CORNER_PX = 2.0
"""Corners closer than this are the same one, in px, or in px of the coarser of the two levels on which they are found:
several times the error of a loose corner, and less than half of the smallest squares (5 px)."""

MAX_STEP = 1.5
"""Largest Newton step from the peak of the response to the saddle, px of the level."""


DENSE_CELL_PX = 8
"""Side of the cells in which points are counted, px of the level: 3 x 3 cells have 4 x 4 corners of squares of 6 px."""

NOWHERE: FloatArray = np.zeros((0, 2))
"""The pixels of no corners."""


@dataclass(frozen=True, eq=False, slots=True)
class Corners:
    """Loose chessboard corners.

    Attributes
    ----------
    pixels : (N, 2) full resolution, accurate to a few tenths of a pixel.
    angles : (N, 2) rad. Line A (dark to bright with growing angle) in [0, pi), line B (bright to dark) in (A, A + pi).
    contrast : (N,) grey levels.
    scale : (N,) of the level on which the corner was found.
    """

    pixels: FloatArray
    angles: FloatArray
    contrast: FloatArray
    scale: FloatArray

    def __len__(self) -> int:
        return len(self.pixels)

    def of(self, which: BoolArray) -> Corners:
        """Return those `which` (N,)."""
        at = which.nonzero()[0]
        # `pixels[which]` takes four times as long.
        return Corners(
            self.pixels.take(at, axis=0), self.angles.take(at, axis=0), self.contrast.take(at), self.scale.take(at)
        )


@dataclass(frozen=True, eq=False)
class Saddles:
    """Saddle points, and the corners of each level.

    Attributes
    ----------
    points : (N, 2) full resolution, of each level.
    by_level : the corners of each level, including those found on a finer one and those with motion blur.
    moved : which corners of each level have motion blur.
    still : the corners without motion blur, each once.
    """

    points: tuple[FloatArray, ...]
    by_level: tuple[Corners, ...]
    moved: tuple[BoolArray, ...]
    still: tuple[Corners, ...]

    @cached_property
    def pixels(self) -> FloatArray:
        """The saddle points (N, 2) of all levels."""
        return np.concatenate([NOWHERE, *self.points])

    @cached_property
    def smeared(self) -> Corners:
        """The corners with motion blur, each once; only images without boards need them."""
        others: list[Corners] = []
        for own, moved in zip(self.by_level, self.moved, strict=True):
            # On a coarser level a corner may show no motion blur.
            others.append(_without_known(own, moved, [*self.still, *others]))
        return joined(others)


def find_corners(levels: Iterable[Level], finer: Corners | None = None) -> tuple[Corners, Saddles]:
    """Return the chessboard corners of all levels, each once (the finest level wins), and all saddles.

    `finer` : corners of finer levels, if `levels` are only coarser ones; narrow images have none of these.
    """
    kept = [] if finer is None else [finer]
    own: list[Corners] = []
    smeared: list[BoolArray] = []
    saddles: list[FloatArray] = []
    for level in levels:
        found = _corners_of(level, kept)
        saddles.append(found.saddles)
        own.append(Corners(found.pixels, found.angles, found.contrast, np.full(len(found.pixels), level.scale)))
        smeared.append(found.smeared)
        kept.append(own[-1].of(~(found.smeared | found.repeated)))
    return joined(kept), Saddles(tuple(saddles), tuple(own), tuple(smeared), tuple(kept))


def with_finer(level: Level, coarser: Saddles) -> tuple[Corners, Saddles]:
    """Return the corners and saddles as `find_corners` does, of a `level` and of `coarser` ones, known already."""
    found = _corners_of(level, ())
    own = Corners(found.pixels, found.angles, found.contrast, np.full(len(found.pixels), level.scale))
    kept = [own.of(~found.smeared)]
    for corners, moved in zip(coarser.by_level, coarser.moved, strict=True):
        kept.append(_without_known(corners, ~moved, kept))
    return joined(kept), Saddles(
        (found.saddles, *coarser.points), (own, *coarser.by_level), (found.smeared, *coarser.moved), tuple(kept)
    )


def dense(points: FloatArray, level: Level, least: int) -> BoolArray:
    """Return which of the `points` (N, 2) are in 3 x 3 cells of DENSE_CELL_PX of `level` with `least` or more."""
    column, row = ((points - level.offset) / (level.scale * DENSE_CELL_PX)).astype(np.int64).T
    height, width = (side // DENSE_CELL_PX + 1 for side in level.smooth.shape)
    counts = np.bincount(row * width + column, minlength=height * width).reshape(height, width)
    window = cv2.boxFilter(counts.astype(np.float32), -1, (3, 3), normalize=False, borderType=cv2.BORDER_CONSTANT)
    full = cv2.dilate((window >= least).astype(np.uint8), np.ones((3, 3), np.uint8))
    return np.asarray(full[row, column] > 0)


def each_once(by_level: Iterable[Corners]) -> Corners:
    """Return the corners of several levels, the finest first, each once (the finest level wins)."""
    kept: list[Corners] = []
    for own in by_level:
        kept.append(_without_known(own, np.ones(len(own), np.bool_), kept))
    return joined(kept)


def _corners_of(level: Level, known: Sequence[Corners]) -> front.CornersOfLevel:
    """Return the saddles and corners of `level`, with those `known` from finer levels marked as repeated."""
    return front.corners(
        level.smooth,
        *peaks(level),
        (RING_RADIUS, MAX_STEP, MAX_SHARPNESS),
        ring_rules(),
        (level.scale, level.offset),
        np.concatenate([NOWHERE, *(k.pixels for k in known)]),
        SAME_CORNER_PX * level.scale,
    )


def _without_known(found: Corners, which: BoolArray, known: list[Corners]) -> Corners:
    """Return the corners `which` (N,) of `found` that are not among those `known` from finer levels."""
    before = [k.pixels for k in known if len(k)]
    if before and which.any():
        which = which & ~near_any(found.pixels, np.concatenate(before), SAME_CORNER_PX * float(found.scale[0]))
    return found.of(which)


def joined(parts: Sequence[Corners]) -> Corners:
    """Return the corners of all `parts`."""
    if len(parts) == 1:
        return parts[0]
    return Corners(
        np.concatenate([p.pixels for p in parts]),
        np.concatenate([p.angles for p in parts]),
        np.concatenate([p.contrast for p in parts]),
        np.concatenate([p.scale for p in parts]),
    )
