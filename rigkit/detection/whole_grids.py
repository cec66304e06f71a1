"""How large a chessboard is, from grids of which the frame may cut every one."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rigkit.core.arrays import FloatArray
from rigkit.core.detections import BoardDetection
from rigkit.detection.saddles.response import GreyImage, sample

MIN_SHARE_OF_LINE = 0.5
"""A grid ends where this part of its next line would be seen, but is not: the frame may hide the rest."""

MIN_SHARE_OF_GRID = 0.8
"""A grid has this part of its corners, or may be two boards in one: marks in squares hide few."""

MIN_SURE_CORNERS = 20
"""Lattices of as many corners are no chance."""

UNSEEN_BORDER_PX = 5.0
"""Corners nearer to the image's border may be missed (sharp ones are found from 3 px on): a grid may go on there."""

IN_SQUARE = 0.4
"""Where in a square it is looked at, from the line on: the next line may be foretold a little too near."""

MIN_SQUARES_BEYOND, MIN_CONTRAST_BEYOND, SURE_BEYOND = 5, 0.1, 3.0
"""Beyond the last line of a grid, so many squares beside others that are as those two rows before, with this part of
their contrast and by so many standard deviations, are squares. At the rim of a fisheye these are 0.1 to 0.4 and 3.4 to
12 where a board goes on, and -0.1 to 0.12 and -3 to 2.4 where it ends (REAL)."""

MIN_IMAGES_OF_GUESS = 2
"""A size of chessboards is told from so many images, or from the only one."""

MAX_SHARE_ALIKE_PARTS = 0.5
"""Parts of a board that the frame cuts are of one size in fewer of the images."""

MIN_SHARE_OF_OTHERS = 0.5
"""Of the images that show a board, those with another beside it, at least: what clutter shows changes."""

FEW, MANY = 0.25, 0.5
"""Images that show more of a board than others, in those that show the others' size: so few may see a row beside it
that is none of it (of 1100 REAL images, sharp and made worse, none does), and so many are believed: rows where blur,
the rim of a lens or poor light hide corners are missed in any number of images. Between the two nothing decides."""

Size = tuple[int, int]
"""Corners along the longer side of a grid, and along the other."""


@dataclass(frozen=True, slots=True)
class GridSeen:
    """How far a grid goes, along its columns and rows.

    Attributes
    ----------
    lengths : corners.
    ends : whether it is seen to end there: else the frame cuts it, or few corners of the last line are seen.
    cut : the frame cuts it somewhere.
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

    def may_be_of(self, size: Size) -> bool:
        """Say whether a board of this size looks like that where the frame cuts it."""
        return any(
            all(
                length == side if ends else length <= side
                for length, ends, side in zip(self.lengths, self.ends, sides, strict=True)
            )
            for sides in (size, size[::-1])
        )


def grid_seen(found: BoardDetection, image: GreyImage) -> GridSeen | None:
    """Return how far a grid goes in an image; None where it is no more than a patch."""
    if not found.complete and len(found.grid) < max(MIN_SURE_CORNERS, MIN_SHARE_OF_GRID * found.columns * found.rows):
        return None
    lattice = found.lattice()
    borders = np.array(image.shape[::-1]) - 1.0
    along_columns = lattice.transpose(1, 0, 2)
    first, last, top, bottom = (
        _next_line(lines, borders) for every in (along_columns, lattice) for lines in (every, every[::-1])
    )
    ends = tuple(
        min(inside for inside, _ in both) >= MIN_SHARE_OF_LINE * lines.shape[1]
        and not any(_goes_on(image, side) for side in (lines, lines[::-1]))
        for both, lines in (((first, last), along_columns), ((top, bottom), lattice))
    )
    cut = any(outside > inside for inside, outside in (first, last, top, bottom))
    return GridSeen((found.columns, found.rows), (ends[0], ends[1]), cut)


def _beyond(lines: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the two lines before the first of a grid (lines, corners of each, 2), as far as it foretells them."""
    first, second, third = (lines[k] if k < len(lines) else np.full_like(lines[0], np.nan) for k in range(3))
    # Lenses bend lines; where the third corner is missing they are taken for straight.
    bend = np.nan_to_num(first - 2.0 * second + third)
    return 2.0 * first - second + bend, 3.0 * first - 2.0 * second + 3.0 * bend


def _goes_on(image: GreyImage, lines: FloatArray) -> bool:
    """Say whether squares are seen beyond the next line before the first of a grid (lines, corners of each, 2): at the
    rim of a lens, in poor light or blur a board goes on where its corners are not found."""
    first, (near, far) = lines[0], _beyond(lines)
    places = np.stack([first + IN_SQUARE * (lines[1] - first), near + IN_SQUARE * (far - near)])
    places = 0.5 * (places[:, 1:] + places[:, :-1])
    last = np.array(image.shape[::-1]) - 1.0
    seen = (np.isfinite(places) & (places >= 0.0) & (places <= last)).all(axis=(0, 2))
    # Squares beside each other.
    pairs = seen[1:] & seen[:-1]
    count = int(np.count_nonzero(pairs))
    if count < MIN_SQUARES_BEYOND:
        return False
    within, beyond = np.diff(sample(image, np.where(seen[:, None], places, 0.0)), axis=1)[:, pairs].astype(np.float64)
    # Every second row has the same colours; what lies beyond a board does not change with its squares.
    alike = beyond * np.sign(within)
    scatter = float(alike.std()) / np.sqrt(count)
    return bool(
        np.median(alike) > MIN_CONTRAST_BEYOND * np.median(np.abs(within)) and alike.mean() > SURE_BEYOND * scatter
    )


def _next_line(lines: FloatArray, borders: FloatArray) -> tuple[int, int]:
    """Return how many corners before the first line of a grid (lines, corners of each, 2), NaN where there is none,
    would be in the image, and were not found there, and how many would not, as far as the first line foretells it."""
    beyond, _ = _beyond(lines)
    # Corners that are missing are NaN, and not inside.
    inside = ((beyond >= UNSEEN_BORDER_PX) & (beyond <= borders - UNSEEN_BORDER_PX)).all(axis=1)
    return int(np.count_nonzero(inside)), int(np.count_nonzero(np.isfinite(beyond[:, 0]) & ~inside))


def whole_sizes(seen: Sequence[GridSeen]) -> set[Size]:
    """Return the sizes of an image's grids that the frame does not cut."""
    return {grid.size for grid in seen if grid.whole}


def board_size_in(plain: Sequence[Sequence[GridSeen]]) -> tuple[tuple[Size, ...], tuple[int, ...]] | None:
    """Return the size of the chessboard that images show, and the images that show it; several sizes where they do not
    decide, None where they tell nothing.

    plain : the grids of each image.

    Corners seen are there, corners not seen may have been missed. So a size is not told where other images show more
    of the board, and a larger one is where not too many whole grids are smaller (`FEW`, `MANY`).
    """
    wholes = Counter(size for grids in plain for size in whole_sizes(grids))
    # Of its last lines blur may hide most.
    hidden = Counter(size for grids in plain for size in {g.size for g in grids if any(g.ends) and not g.cut})
    # A part of a board that the frame cuts, or a tiled floor, comes in many sizes; the whole board in one.
    often = [size for seen in (wholes, hidden) for size in _by_count(seen) if seen[size] >= MIN_IMAGES_OF_GUESS]
    options = [(size, _showing(plain, size)) for size in often]
    parts = _size_of_parts(plain)
    options += [] if parts is None else [parts]
    weighed = [(_weighed(plain, size, shown), shown) for size, shown in options]
    if weighed:
        return min(weighed, key=lambda option: len(option[0]))
    full = Counter(size for grids in plain for size in {grid.size for grid in grids})
    once = _by_count(wholes) or [size for size in _by_count(full) if full[size] > MAX_SHARE_ALIKE_PARTS * len(plain)]
    if not once or _more(plain, once[0]):
        return None
    return (once[0],), _showing(plain, once[0])


def other_sizes(plain: Sequence[Sequence[GridSeen]], size: Size, shown: Sequence[int]) -> tuple[Size, ...]:
    """Return the sizes of grids that most of the images that show a board of this size show beside it, as far as they
    are seen."""
    counts = Counter(other for k in shown for other in {grid.size for grid in plain[k]} - {size})
    return tuple(
        other
        for other in _by_count(counts)
        if counts[other] >= max(MIN_IMAGES_OF_GUESS, MIN_SHARE_OF_OTHERS * len(shown))
    )


def _weighed(plain: Sequence[Sequence[GridSeen]], size: Size, shown: Sequence[int]) -> tuple[Size, ...]:
    """Return `size`, `shown` by these images, and with it another one where images do not decide between the two."""
    more = _more(plain, size)
    if more and (more.total() > len(shown) or max(more.values()) > FEW * len(shown)):
        return size, _by_count(more)[0]
    less = Counter(other for k, grids in enumerate(plain) if k not in shown for other in whole_sizes(grids))
    inside = [other for other in _by_count(less) if other != size and _within(other, size)]
    return (inside[0], size) if inside and MANY * less[inside[0]] > len(shown) else (size,)


def _by_count(counts: Counter[Size]) -> list[Size]:
    """Return sizes, those of most images first, of these the larger ones."""
    return sorted(counts, key=lambda size: (-counts[size], -size[0] * size[1]))


def _within(size: Size, other: Size) -> bool:
    return size[0] <= other[0] and size[1] <= other[1]


def _showing(plain: Sequence[Sequence[GridSeen]], size: Size) -> tuple[int, ...]:
    """Return the images with a grid of this size."""
    return tuple(k for k, grids in enumerate(plain) if any(grid.size == size for grid in grids))


def _more(plain: Sequence[Sequence[GridSeen]], size: Size) -> Counter[Size]:
    """Return in how many images grids of which sizes have a row or column more than a board of this size, where they do
    not show it; what other images show beside it is another board."""
    beside = {grid.size for k in _showing(plain, size) for grid in plain[k]}
    seen = ({grid.size for grid in grids} for grids in plain)
    return Counter(other for sizes in seen if size not in sizes for other in sizes - beside if not _within(other, size))


def _size_of_parts(plain: Sequence[Sequence[GridSeen]]) -> tuple[Size, tuple[int, ...]] | None:
    """Return the size of the board of which images show parts, and the images that show where one of its sides ends;
    None where they do not show both.

    plain : the grids of each image. Each side of the board is seen from end to end in `MIN_IMAGES_OF_GUESS` or more,
    and no size explains more images. Parts of a board as long as wide do not tell which of its sides they show.
    """
    lengths = sorted({n for grids in plain for g in grids for n, ends in zip(g.lengths, g.ends, strict=True) if ends})
    best: tuple[int, Size, tuple[int, ...]] | None = None
    for size in ((long, short) for long in lengths for short in lengths if long > short):
        fit = [[g for g in grids if any(g.ends) and g.may_be_of(size)] for grids in plain]
        shown = tuple(k for k, grids in enumerate(fit) if grids)
        sides_seen = Counter(side for grids in fit for side in _complete_sides(grids, size))
        enough = min(sides_seen[0], sides_seen[1]) >= MIN_IMAGES_OF_GUESS
        if enough and (best is None or len(shown) > best[0]):
            best = len(shown), size, shown
    return None if best is None else best[1:]


def _complete_sides(grids: Sequence[GridSeen], size: Size) -> set[int]:
    """Return which sides (0 : the longer, 1) of a board of this size an image's grids show from end to end."""
    whole = {n for g in grids for n, ends in zip(g.lengths, g.ends, strict=True) if ends}
    return {k for k, side in enumerate(size) if side in whole}
