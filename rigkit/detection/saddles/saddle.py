"""Chessboard corners of an image as loose points: peaks of the saddle response that pass the ring test."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray
from rigkit.detection.saddles.response import Level, peaks
from rigkit.detection.saddles.ring import ring_rules
from rigkit.kernels import front
from rigkit.kernels.front import near_any

RING_RADIUS = 2.6
"""Of the ring, in pixels of the level: fits squares of 6 px, and 5 where they are seen straight on."""

MAX_SHARPNESS = 0.095
"""Largest response of a corner, relative to the square of its contrast on the ring. Edges without blur, smoothed as
the level is, make 0.08, sharpened ones 0.09, whatever the angles and down to squares of 4 px; noise makes 0.12. Of the
corners of boards in noise a few show more, which growth finds; of those that noise makes, a third."""

KNOWN_PX = 2.0
"""A corner this near to one of a finer level is the same, in pixels of its own level."""

MAX_STEP = 1.5
"""A Newton step to the saddle that leads further than this from the peak of the response went wrong, level px."""


NOWHERE: FloatArray = np.zeros((0, 2))
"""The pixels of no corners."""


@dataclass(frozen=True, eq=False, slots=True)
class Corners:
    """Loose chessboard corners.

    Attributes
    ----------
    pixels : (N, 2) full resolution, a few tenths of a pixel good.
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
    """Saddle points, and corners that are not among those of the whole image.

    Attributes
    ----------
    pixels : (N, 2) full resolution.
    by_level : the corners of each level, also those that a finer one has found, and those that are corners only if
        something moved.
    moved : which of each level are such.
    still : the others, each once.
    """

    pixels: FloatArray
    by_level: tuple[Corners, ...]
    moved: tuple[BoolArray, ...]
    still: tuple[Corners, ...]

    @cached_property
    def smeared(self) -> Corners:
        """The corners that are some only if something moved, each once; only images without boards need them."""
        others: list[Corners] = []
        for own, moved in zip(self.by_level, self.moved, strict=True):
            # A coarser level may show what is smeared on a finer one as it should be.
            others.append(_without_known(own, moved, [*self.still, *others]))
        return joined(others)


def find_corners(levels: Iterable[Level], finer: Corners | None = None) -> tuple[Corners, Saddles]:
    """Return the chessboard corners of all levels, each once (the finest level wins), and all saddles.

    `finer` : those of the levels before, if only coarser `levels` are to be looked at.
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
    return joined(kept), Saddles(np.concatenate(saddles), tuple(own), tuple(smeared), tuple(kept))


def each_once(by_level: Iterable[Corners]) -> Corners:
    """Return the corners of several levels, the finest first, each once (the finest level wins)."""
    kept: list[Corners] = []
    for own in by_level:
        kept.append(_without_known(own, np.ones(len(own), np.bool_), kept))
    return joined(kept)


def _corners_of(level: Level, known: Sequence[Corners]) -> front.CornersOfLevel:
    """Return the saddles and corners of `level`; those that are `known`, of finer levels, are repeated."""
    return front.corners(
        level.smooth,
        *peaks(level),
        (RING_RADIUS, MAX_STEP, MAX_SHARPNESS),
        ring_rules(),
        (level.scale, level.offset),
        np.concatenate([NOWHERE, *(k.pixels for k in known)]),
        KNOWN_PX * level.scale,
    )


def _without_known(found: Corners, which: BoolArray, known: list[Corners]) -> Corners:
    """Return those of `found`, and `which` (N,), that no finer level has found already."""
    before = [k.pixels for k in known if len(k)]
    if before and which.any():
        which = which & ~near_any(found.pixels, np.concatenate(before), KNOWN_PX * float(found.scale[0]))
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
