"""The size of a chessboard from grids that the image border may cut in every image."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rigkit.core.arrays import FloatArray
from rigkit.core.detections import BoardDetection
from rigkit.detection.checks.evidence import MIN_EXPECTED_CORNERS
from rigkit.detection.saddles.response import GreyImage, sample

MIN_SHARE_OF_LINE = 0.5
"""Smallest share of the next line within the image, without corners, for a grid to end there."""

MIN_SHARE_OF_GRID = 0.8
"""Smallest share of known corners of a grid; others may be two boards in one. Markers in squares hide few corners."""

UNSEEN_BORDER_PX = 5.0
"""Distance from the image border within which corners may be missed (sharp ones are found from 3 px on)."""

IN_SQUARE = 0.4
"""Sample position in a square, from its inner line: the next line may be predicted slightly too near."""

MIN_SQUARES_BEYOND, MIN_CONTRAST_BEYOND, SURE_BEYOND = 5, 0.1, 3.0
"""A board continues beyond the last line of a grid if at least so many pairs of squares there have the contrast of
those two rows before, by this share in the median and by so many standard deviations. At the rim of a fisheye these are
0.1 to 0.4 and 3.4 to 12 if a board continues, and -0.1 to 0.12 and -3 to 2.4 if it ends (REAL)."""

MIN_IMAGES_OF_GUESS = 2
"""Smallest number of images that determine a size, unless there is only one image."""

MAX_SHARE_ALIKE_PARTS = 0.5
"""Largest share of images in which parts of a board cut by the image border have the same size."""

MIN_SHARE_OF_OTHERS = 0.5
"""Smallest share of the images of a board that show another board too: clutter varies between images."""

FEW, MANY = 0.25, 0.5
"""Bounds of the ratio of images that show more rows of a board to those that show a smaller size. Below FEW the
additional rows are considered wrong (none of 1100 REAL images, sharp and degraded, shows such a row); above MANY they
are accepted, as blur, the rim of a lens or poor light may hide rows in any number of images. In between the size is
ambiguous."""

Size = tuple[int, int]
"""Corners along the longer and the shorter side of a grid."""


@dataclass(frozen=True, slots=True)
class GridExtent:
    """The extent of a grid along its columns and rows.

    Attributes
    ----------
    lengths : corners.
    ends : whether both ends are visible; otherwise the image border cuts it, or the board continues.
    cut : the image border cuts it somewhere.
    """

    lengths: tuple[int, int]
    ends: tuple[bool, bool]
    cut: bool = False

    @property
    def size(self) -> Size:
        return max(self.lengths), min(self.lengths)

    @property
    def whole(self) -> bool:
        return all(self.ends)

    def may_be_part_of(self, size: Size) -> bool:
        """Return whether the grid may be the visible part of a board of this size."""
        return any(
            all(
                length == side if ends else length <= side
                for length, ends, side in zip(self.lengths, self.ends, sides, strict=True)
            )
            for sides in (size, size[::-1])
        )


def grid_extent(found: BoardDetection, image: GreyImage) -> GridExtent | None:
    """Return the extent of a grid in an image; None if too few of its corners are known."""
    if not found.complete and len(found.grid) < max(
        MIN_EXPECTED_CORNERS, MIN_SHARE_OF_GRID * found.columns * found.rows
    ):
        return None
    lattice = found.lattice()
    borders = np.array(image.shape[::-1]) - 1.0
    along_columns = lattice.transpose(1, 0, 2)
    first, last, top, bottom = (
        _next_line(lines, borders) for every in (along_columns, lattice) for lines in (every, every[::-1])
    )
    ends = tuple(
        min(inside for inside, _ in both) >= MIN_SHARE_OF_LINE * lines.shape[1]
        and not any(_continues_beyond(image, side) for side in (lines, lines[::-1]))
        for both, lines in (((first, last), along_columns), ((top, bottom), lattice))
    )
    cut = any(outside > inside for inside, outside in (first, last, top, bottom))
    return GridExtent((found.columns, found.rows), (ends[0], ends[1]), cut)


def _extrapolated_lines(lines: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the extrapolated two lines before the first of a grid (lines, corners of each, 2); NaN where unknown."""
    first, second, third = (lines[k] if k < len(lines) else np.full_like(lines[0], np.nan) for k in range(3))
    # Quadratic, for distortion; linear where the third corner is missing.
    bend = np.nan_to_num(first - 2.0 * second + third)
    return 2.0 * first - second + bend, 3.0 * first - 2.0 * second + 3.0 * bend


def _continues_beyond(image: GreyImage, lines: FloatArray) -> bool:
    """Return whether there are squares beyond the next line before the first of a grid (lines, corners of each, 2): at
    the rim of a lens, in poor light or blur corners of a board may be missed."""
    first, (near, far) = lines[0], _extrapolated_lines(lines)
    places = np.stack([first + IN_SQUARE * (lines[1] - first), near + IN_SQUARE * (far - near)])
    places = 0.5 * (places[:, 1:] + places[:, :-1])
    last = np.array(image.shape[::-1]) - 1.0
    seen = (np.isfinite(places) & (places >= 0.0) & (places <= last)).all(axis=(0, 2))
    # Pairs of adjacent squares.
    pairs = seen[1:] & seen[:-1]
    count = int(np.count_nonzero(pairs))
    if count < MIN_SQUARES_BEYOND:
        return False
    within, beyond = np.diff(sample(image, np.where(seen[:, None], places, 0.0)), axis=1)[:, pairs].astype(np.float64)
    # Rows two apart have the same colours; the background is not correlated with the squares.
    alike = beyond * np.sign(within)
    scatter = float(alike.std()) / np.sqrt(count)
    return bool(
        np.median(alike) > MIN_CONTRAST_BEYOND * np.median(np.abs(within)) and alike.mean() > SURE_BEYOND * scatter
    )


def _next_line(lines: FloatArray, borders: FloatArray) -> tuple[int, int]:
    """Return how many corners of the line before the first of a grid (lines, corners of each, 2; NaN where unknown)
    would be inside the image, and how many outside."""
    beyond, _ = _extrapolated_lines(lines)
    # Corners that are missing are NaN, and not inside.
    inside = ((beyond >= UNSEEN_BORDER_PX) & (beyond <= borders - UNSEEN_BORDER_PX)).all(axis=1)
    return int(np.count_nonzero(inside)), int(np.count_nonzero(np.isfinite(beyond[:, 0]) & ~inside))


def whole_sizes(seen: Sequence[GridExtent]) -> set[Size]:
    """Return the sizes of an image's whole grids."""
    return {grid.size for grid in seen if grid.whole}


def board_size_in(plain: Sequence[Sequence[GridExtent]]) -> tuple[tuple[Size, ...], tuple[int, ...]] | None:
    """Return the size of the chessboard that images show, and the images that show it.

    Several sizes are returned if they are ambiguous, None if there is no evidence.

    plain : the grids of each image.

    Detected corners exist, while others may have been missed. A size is therefore rejected if enough other images show
    more of the board, and a larger one accepted if not too many whole grids are smaller (`FEW`, `MANY`).
    """
    wholes = Counter(size for grids in plain for size in whole_sizes(grids))
    # Blur may hide most of the last lines.
    hidden = Counter(size for grids in plain for size in {g.size for g in grids if any(g.ends) and not g.cut})
    # Parts of a board cut by the image border, or of a tiled floor, have many sizes; the whole board has one.
    often = [size for seen in (wholes, hidden) for size in _by_count(seen) if seen[size] >= MIN_IMAGES_OF_GUESS]
    options = [(size, _images_of_size(plain, size)) for size in often]
    parts = _size_of_parts(plain)
    options += [] if parts is None else [parts]
    weighed = [(_with_ambiguous_size(plain, size, shown), shown) for size, shown in options]
    if weighed:
        return min(weighed, key=lambda option: len(option[0]))
    full = Counter(size for grids in plain for size in {grid.size for grid in grids})
    once = _by_count(wholes) or [size for size in _by_count(full) if full[size] > MAX_SHARE_ALIKE_PARTS * len(plain)]
    if not once or _larger_sizes(plain, once[0]):
        return None
    return (once[0],), _images_of_size(plain, once[0])


def other_sizes(plain: Sequence[Sequence[GridExtent]], size: Size, shown: Sequence[int]) -> tuple[Size, ...]:
    """Return the (visible) sizes of other grids in at least MIN_SHARE_OF_OTHERS of the images `shown` of a board."""
    counts = Counter(other for k in shown for other in {grid.size for grid in plain[k]} - {size})
    return tuple(
        other
        for other in _by_count(counts)
        if counts[other] >= max(MIN_IMAGES_OF_GUESS, MIN_SHARE_OF_OTHERS * len(shown))
    )


def _with_ambiguous_size(plain: Sequence[Sequence[GridExtent]], size: Size, shown: Sequence[int]) -> tuple[Size, ...]:
    """Return `size`, `shown` by these images, with another one if the two are ambiguous."""
    more = _larger_sizes(plain, size)
    if more and (more.total() > len(shown) or max(more.values()) > FEW * len(shown)):
        return size, _by_count(more)[0]
    less = Counter(other for k, grids in enumerate(plain) if k not in shown for other in whole_sizes(grids))
    inside = [other for other in _by_count(less) if other != size and _fits_into(other, size)]
    return (inside[0], size) if inside and MANY * less[inside[0]] > len(shown) else (size,)


def _by_count(counts: Counter[Size]) -> list[Size]:
    """Return sizes by decreasing number of images, then by decreasing area."""
    return sorted(counts, key=lambda size: (-counts[size], -size[0] * size[1]))


def _fits_into(size: Size, other: Size) -> bool:
    return size[0] <= other[0] and size[1] <= other[1]


def _images_of_size(plain: Sequence[Sequence[GridExtent]], size: Size) -> tuple[int, ...]:
    """Return the images with a grid of this size."""
    return tuple(k for k, grids in enumerate(plain) if any(grid.size == size for grid in grids))


def _larger_sizes(plain: Sequence[Sequence[GridExtent]], size: Size) -> Counter[Size]:
    """Return the numbers of images without a grid of this size by the sizes of their larger grids, except those of
    other boards, which occur together with it."""
    joint = {grid.size for k in _images_of_size(plain, size) for grid in plain[k]}
    seen = ({grid.size for grid in grids} for grids in plain)
    return Counter(
        other for sizes in seen if size not in sizes for other in sizes - joint if not _fits_into(other, size)
    )


def _size_of_parts(plain: Sequence[Sequence[GridExtent]]) -> tuple[Size, tuple[int, ...]] | None:
    """Return the size of a board from images of its parts, and the images that show one of its sides completely.

    plain : the grids of each image. None unless each side is complete in at least `MIN_IMAGES_OF_GUESS` images. The
    size that explains most images is chosen. Square boards are excluded: their sides are not distinguishable.
    """
    lengths = sorted({n for grids in plain for g in grids for n, ends in zip(g.lengths, g.ends, strict=True) if ends})
    best: tuple[int, Size, tuple[int, ...]] | None = None
    for size in ((long, short) for long in lengths for short in lengths if long > short):
        fit = [[g for g in grids if any(g.ends) and g.may_be_part_of(size)] for grids in plain]
        shown = tuple(k for k, grids in enumerate(fit) if grids)
        sides_seen = Counter(side for grids in fit for side in _complete_sides(grids, size))
        enough = min(sides_seen[0], sides_seen[1]) >= MIN_IMAGES_OF_GUESS
        if enough and (best is None or len(shown) > best[0]):
            best = len(shown), size, shown
    return None if best is None else best[1:]


def _complete_sides(grids: Sequence[GridExtent], size: Size) -> set[int]:
    """Return which sides (0: the longer, 1) of a board of this size are complete in an image's grids."""
    whole = {n for g in grids for n, ends in zip(g.lengths, g.ends, strict=True) if ends}
    return {k for k, side in enumerate(size) if side in whole}
