"""Images enlarged by repeating lines: screens at 125 or 150 %, heat images, video whose lines were doubled.

Where a factor is no integer, some lines are repeated and others are not, which moves edges by up to half a pixel in
ways that look like a lens. The lines repeat exactly, so that leaving the copies out gives back the image before.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rigkit.core.arrays import BoolArray, FloatArray, median_of
from rigkit.core.detections import BoardDetection

SAMPLED, STRETCH, MORE_SAMPLED = 4, 128, 64
"""Number of places in each line, and number of lines in the middle of the image, by which repetition is detected, and
number of places that are compared before whole lines are: in large blurred images few places are often equal."""

MIN_LINES = 32
"""Smallest number of lines that are left, and of copies: fewer may be equal by chance, as in a print of few modules."""

REGULAR = 2.0
"""Range, in lines, of the distances of the first copies from a regular step, which rounding keeps below this."""

EVEN_FACTOR, MUCH_SURER = 1e-6, 0.4
"""Largest difference of the factor of lines that are all repeated as often from a whole number, and largest sigma of
corners in a drawing, over that without the copies: with modules of 2 to 10 px 0.2 at most, in 28 REAL images enlarged
twice 0.66 and more."""

LEGIBLE = 0.5
"""A print drawn with modules of a few pixels repeats lines, too, but is not legible without the copies: unless they are
left out, more than twice the corners are found."""


@dataclass(frozen=True, eq=False, slots=True)
class Repeated:
    """An image without repeated lines: its pixel (u, v) shows the pixel `factor` * (u, v) + `offset` of the image, each
    (2,)."""

    image: NDArray[np.generic]
    factor: FloatArray
    offset: FloatArray

    def better(self, found: Sequence[BoardDetection], fewer: Sequence[BoardDetection]) -> tuple[BoardDetection, ...]:
        """Return the boards `found` with all lines, or those of `fewer`, which were found in this image.

        Where all lines are repeated as often, no edge is moved, and boards drawn with modules of a few pixels are much
        more certain with all lines.
        """
        restored = tuple(map(self.restored, fewer))
        all_lines, once = (
            np.concatenate([np.zeros(0), *(item.sigma_px for item in items)]) for items in (found, restored)
        )
        if not len(once) > LEGIBLE * len(all_lines):
            return tuple(found)
        even = bool((np.abs(self.factor - np.rint(self.factor)) < EVEN_FACTOR).all())
        exact = even and len(all_lines) and median_of(all_lines) < MUCH_SURER * median_of(once)
        return tuple(found) if exact else restored

    def restored(self, item: BoardDetection) -> BoardDetection:
        """Return `item`, detected in this image, in pixels of the one with repeated lines."""
        sigma_factor = float(np.sqrt(np.mean(self.factor**2)))
        return replace(item, pixels=self.factor * item.pixels + self.offset, sigma_px=sigma_factor * item.sigma_px)


def without_repeated_lines(image: NDArray[np.generic]) -> Repeated | None:
    """Return `image` (H, W, ...) without the rows and columns that repeat the one before; None if there are none."""
    found = [_kept_rows(np.swapaxes(image, 0, 1)), _kept_rows(image)]
    if all(lines is None for lines in found):
        return None
    sides = image.shape[1::-1]
    lines = [_Lines(np.ones(side, bool), 1.0, 0.0) if f is None else f for f, side in zip(found, sides, strict=True)]
    columns, rows = (item.kept for item in lines)
    factor, offset = (np.array([getattr(item, name) for item in lines]) for name in ("factor", "offset"))
    return Repeated(np.ascontiguousarray(image[rows][:, columns]), factor, offset)


class _Lines(NamedTuple):
    """The lines of an image that are `kept` (H,), of which line i is the image's line `factor` * i + `offset`."""

    kept: BoolArray
    factor: float
    offset: float


def _kept_rows(image: NDArray[np.generic]) -> _Lines | None:
    """Return the rows of `image` (H, W, ...) that do not repeat the row before, None if not enough do, regularly."""
    height, width = image.shape[:2]
    if height < 2 * MIN_LINES or width < SAMPLED:
        return None
    sampled = image[:, width // (2 * SAMPLED) :: max(1, width // SAMPLED)]
    middle = slice(max(0, (height - STRETCH) // 2), max(0, (height - STRETCH) // 2) + STRETCH)
    for few in (sampled, image[:, :: max(1, width // MORE_SAMPLED)]):
        if not _as_before(few[middle]).any():
            return None
    same = _as_before(sampled)
    for places in (MORE_SAMPLED, width):
        near, step = np.flatnonzero(same), max(1, width // places)
        if len(near) < MIN_LINES:
            return None
        same[near] = (image[near + 1, ::step] == image[near, ::step]).reshape(len(near), -1).all(axis=1)
    # The first and the last run may be margins of one colour, and are kept as they are.
    starts = np.flatnonzero(~same) + 1
    lines = len(starts) - 1
    if lines < MIN_LINES or starts[-1] - starts[0] - lines < MIN_LINES:
        return None
    # Enlarged by a factor k, line i starts at the next integer after k i + c.
    if np.ptp(starts - np.linspace(starts[0], starts[-1], lines + 1)) >= REGULAR:
        return None
    kept: BoolArray = np.concatenate([[True], ~same])
    kept[: starts[0]] = kept[starts[-1] :] = True
    number, middles = np.arange(starts[0], starts[0] + lines), 0.5 * (starts[:-1] + starts[1:] - 1.0)
    factor, offset = np.polyfit(number, middles, 1)
    return _Lines(kept, float(factor), float(offset))


def _as_before(lines: NDArray[np.generic]) -> BoolArray:
    """Return which of `lines` (N, ...) but the first equal the one before, (N - 1,)."""
    return np.asarray((lines[1:] == lines[:-1]).reshape(len(lines) - 1, -1).all(axis=1))
