"""The position of a part of a board of known size, from which of its sides are the border of the board.

Beyond the last corners of a board there is one more square, and then the white margin or the background. The image is
evaluated 1.2 squares beyond the last row. If squares continue to alternate, the board continues, and further corners
were missed or are outside the image. If the brightness is uniform and the squares end on one line at the expected
distance, the side is a border. Otherwise the side is unknown. If borders and size allow several positions, the part
remains a part.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray, known_median, median_of
from rigkit.detection.lattice.lattice import Lattice
from rigkit.detection.lattice.local_fit import FLEXIBLE, MIN_PREDICTORS, LocalFit, fit_cells
from rigkit.detection.saddles.response import GreyImage, sample
from rigkit.detection.subpixel.refined import RefinedLattice

MIN_CELL_PX = 6.0
"""Smallest side of a square that is evaluated: within smaller ones blur hides the brightness."""

MAX_BORDER_GAIN = 12.0
"""Largest standard deviation of a prediction for corners of standard deviation 1: for a few hundredths of a pixel this
is less than a tenth of a square."""

WITHIN = np.array([-0.2, 0.0, 0.2])
"""Positions along the row at which a square is sampled, from its middle, in squares."""

SQUARE = np.array([0.35, 0.5, 0.65])
BEYOND = np.array([1.14, 1.2, 1.26])
"""Distances from the last corners at which the last square and the paper beyond it are sampled, in squares: they suit
narrow margins and blur."""

PROFILE = np.arange(0.5, 1.3001, 0.02)
"""Distances from the last corners, in squares, between which the end of the squares is sought."""

ENDS_WITHIN = 0.13
"""Largest distance between the end of the squares and the expected next corners, in squares: some boards are cut."""

STRAIGHT, STRAIGHT_PX = 0.07, 0.7
"""Largest distance of the squares' ends from one line, in squares or (the larger) in px."""

EDGE_WIDTH = 0.12
"""Half width of the edge at the end of the squares, in squares: within it noise may cross the threshold repeatedly."""

WHITE = (0.8, 1.25)
"""Range of the brightness of a white margin, where 0 and 1 are the dark and white squares beside it."""

EVEN = 0.2
"""Largest deviation of the brightness beyond a border from its median, on the same scale."""

SAME_LEVEL = 0.15
"""Largest difference in brightness beyond two borders, on the same scale, that confirm each other without a white
margin: an object along the squares looks like a border, but rarely like another one."""

MIN_STEP = 0.3
"""Smallest step of brightness at the end of a square that is evaluated, on the same scale."""

MAX_NEXT_DARK = 0.35
"""Largest brightness of the next dark square, on the same scale."""

MIN_OUTER_CONTRAST = 0.5
"""Smallest contrast of the outer squares over that of the corners: covered squares are not evaluated."""

MIN_OF_KIND = 2
"""Smallest number of dark and of white squares that are evaluated."""

AGREEING_SQUARES = 0.8
"""Share of the squares that must agree."""


NEXT_SQUARE = np.array([1.35, 1.5, 1.65])
"""Distances from the last corners at which further squares are sampled, in squares."""

MIN_NEXT_SUPPORT = 4
"""Smallest number of corners of a prediction of further squares, whose error may be a part of a square."""

MAX_ALTERNATION, MIN_SIDES_SEEN = 0.5, 2
"""Largest alternation beyond the sides of a board, over the contrast of its last squares, and the smallest number of
sides for which it is known. For 43 boards in REAL images, blurred by 6 to 8 px or moved by 10 to 20 px so that their
size decides (`rigkit.detection.checks.evidence.OF_EXPECTED_SIZE`), it is 0.34 at most, on three sides or more. Of 36
patches of 20 corners and more in 1500 RENDERED cloths, blurred and folded, three have two such sides, one of them with
0.83 or more in each case."""


class Side(Enum):
    """The image beyond one side of a lattice."""

    BORDER = "border"
    CONTINUES = "continues"
    UNKNOWN = "unknown"


@dataclass(frozen=True, slots=True)
class BoardSide:
    """The image beyond one side of a lattice, and its brightness: 0 as the dark squares, 1 as the white ones."""

    side: Side
    level: float = np.nan

    def agrees(self, missing: int) -> bool:
        """Return whether the side is consistent with `missing` further rows."""
        return {Side.BORDER: missing == 0, Side.CONTINUES: missing > 0, Side.UNKNOWN: True}[self.side]

    def is_certain_border(self, every: Sequence[BoardSide]) -> bool:
        """Return whether the side is certainly a border, given `every` side of the board."""
        if self.side is not Side.BORDER:
            return False
        alike = sum(other.side is Side.BORDER and abs(other.level - self.level) < SAME_LEVEL for other in every)
        return alike > 1 or WHITE[0] < self.level < WHITE[1]


def place_part(image: GreyImage, refined: RefinedLattice, sizes: Sequence[tuple[int, int]]) -> RefinedLattice | None:
    """Return `refined` on the grid of the whole board, NaN where nothing was found; None if its position is ambiguous.

    Parameters
    ----------
    image : grey, as for `rigkit.detection.subpixel.subpixel.refine`.
    refined : a part of a board; lattices of a known size are returned unchanged.
    sizes : (columns, rows) of the possible boards, which may be swapped.
    """
    columns, rows = refined.lattice.size
    known = {size for c, r in sizes for size in ((c, r), (r, c))}
    if (columns, rows) in known:
        return refined
    larger = [(c - columns, r - rows) for c, r in known if c >= columns and r >= rows]
    if not larger:
        return None
    every = board_sides(image, refined.lattice)
    cell_px = fit_cells(refined.lattice.pixels, refined.lattice.known).cell_px()
    if known_median(refined.blur_px) > EDGE_WIDTH * float(np.median(cell_px)):
        every = _with_blurred_borders(image, refined.lattice, every)
    top, left, bottom, right = every
    fits = {
        (across, down, before, above)
        for across, down in larger
        for before in range(across + 1)
        for above in range(down + 1)
        if left.agrees(before) and right.agrees(across - before)
        if top.agrees(above) and bottom.agrees(down - above)
    }
    # An additional row (of a shadow or the background) may make a part as wide as the board: the size is no proof.
    seen = all(any(side.is_certain_border(every) for side in axis) for axis in ((left, right), (top, bottom)))
    if len(fits) != 1 or not seen:
        return None
    across, down, before, above = fits.pop()
    return refined.padded((above, down - above), (before, across - before))


def board_sides(image: GreyImage, lattice: Lattice) -> list[BoardSide]:
    """Return the four sides: beyond the first row, the first column, the last row and the last column."""
    return [_side_above_first_row(image, lattice.turned(turns)) for turns in range(4)]


def _with_blurred_borders(image: GreyImage, lattice: Lattice, every: Sequence[BoardSide]) -> list[BoardSide]:
    """Return the sides of a blurred board: unknown ones beyond which squares do not alternate are borders."""
    return [
        replace(one, side=Side.BORDER) if quiet and one.side is Side.UNKNOWN else one
        for one, quiet in zip(every, _alternations_beyond(image, lattice) < MAX_ALTERNATION, strict=True)
    ]


def squares_end(image: GreyImage, lattice: Lattice) -> bool:
    """Return whether the squares do not continue to alternate beyond the sides of `lattice`."""
    every = _alternations_beyond(image, lattice)
    seen = every[np.isfinite(every)]
    return len(seen) >= MIN_SIDES_SEEN and bool((seen < MAX_ALTERNATION).all())


def _alternations_beyond(image: GreyImage, lattice: Lattice) -> FloatArray:
    """Return the alternation (4,) of squares beyond each side over the contrast of the last ones; NaN if unseen."""
    return np.array([_alternation_above_first_row(image, lattice.turned(turns)) for turns in range(4)])


def _alternation_above_first_row(image: GreyImage, lattice: Lattice) -> float:
    squares = _Squares.above(lattice)
    seen = squares.inside(image, _corners_of_next_square()) & squares.near & squares.supported(MIN_NEXT_SUPPORT)
    bright, dark = seen & squares.bright, seen & ~squares.bright
    if min(bright.sum(), dark.sum()) < MIN_OF_KIND:
        return np.nan
    inner, outer, beyond = _medians(squares.brightness(image, _places_in_next_square()))
    contrast = median_of(np.where(squares.bright, outer - inner, inner - outer)[seen])
    return (median_of(beyond[dark]) - median_of(beyond[bright])) / max(contrast, 1e-3)


def _side_above_first_row(image: GreyImage, lattice: Lattice) -> BoardSide:
    """Return the side beyond the first row of `lattice`."""
    squares = _Squares.above(lattice)
    usable = squares.usable(image)
    if usable.sum() < 2 * MIN_OF_KIND:
        return BoardSide(Side.UNKNOWN)
    brightness = squares.brightness(image, _places_to_border())
    inner, outer, beyond = _medians(brightness[:, : 3 * len(SQUARE)])
    contrast = np.where(squares.bright, outer - inner, inner - outer)
    usable &= contrast > MIN_OUTER_CONTRAST * known_median(lattice.contrast)
    if any((usable & kind).sum() < MIN_OF_KIND for kind in (squares.bright, ~squares.bright)):
        return BoardSide(Side.UNKNOWN)
    dark = np.minimum(inner, outer)
    relative = (beyond - dark) / np.maximum(contrast, 1e-3)
    level = median_of(relative[usable])
    steps = np.abs(beyond - outer) > MIN_STEP * contrast
    profiles = brightness[:, 3 * len(SQUARE) :].mean(axis=2)
    border = squares.end_on_one_line(profiles, outer, beyond, usable & steps) | ~steps
    border &= np.abs(relative - level) < EVEN
    if (usable & steps).sum() >= MIN_OF_KIND and border[usable].mean() >= AGREEING_SQUARES:
        return BoardSide(Side.BORDER, level)
    continues = np.where(squares.bright, relative < MAX_NEXT_DARK, relative > 1.0 - MAX_NEXT_DARK)
    return BoardSide(Side.CONTINUES if continues[usable].mean() >= AGREEING_SQUARES else Side.UNKNOWN)


def _medians(brightness: FloatArray) -> FloatArray:
    """Return the medians (3, M) over three parts of `brightness` (M, 3 K, 3), K odd."""
    parts = brightness.reshape(len(brightness), 3, -1)
    middle = parts.shape[2] // 2
    # np.median takes five times as long.
    return np.partition(parts, middle, axis=2)[..., middle].T


def _weights(up: FloatArray, lateral: FloatArray) -> FloatArray:
    """Return the weights (K, 20) of `_Squares.corners` for the pixels at `up` (K,) squares beyond the row and `lateral`
    (K,) from the squares' middles: interpolated between the polynomials of the two corners of the nearer row."""
    weights = np.zeros((len(up), 2, 2, 5))
    for k, (down, near) in enumerate(((1.0 - up, up >= 0.5), (-up, up < 0.5))):
        for shift, share in ((0, 0.5 - lateral), (1, 0.5 + lateral)):
            along = 0.5 + lateral - shift
            terms = [np.ones(len(up)), along, down, 0.5 * along**2, 0.5 * down**2]
            weights[:, k, shift] = np.where(near, share, 0.0)[:, None] * np.stack(terms, axis=1)
    return weights.reshape(len(up), -1)


def _across(*up: FloatArray) -> FloatArray:
    """Return the `_weights` WITHIN the squares at each of the distances `up`."""
    every = np.concatenate(up)
    return _weights(np.repeat(every, len(WITHIN)), np.tile(WITHIN, len(every)))


@functools.cache
def _places_to_border() -> FloatArray:
    return _across(-SQUARE, SQUARE, BEYOND, PROFILE)


@functools.cache
def _places_in_next_square() -> FloatArray:
    return _across(-SQUARE, SQUARE, NEXT_SQUARE)


@functools.cache
def _corners_to_border() -> FloatArray:
    return _weights(np.array([1.0, 1.0, BEYOND[-1], BEYOND[-1]]), np.array([-0.5, 0.5, -0.5, 0.5]))


@functools.cache
def _corners_of_next_square() -> FloatArray:
    return _weights(np.repeat(NEXT_SQUARE[1], 2), WITHIN[[0, -1]])


@dataclass(frozen=True, eq=False, slots=True)
class _Squares:
    """The M squares above the first row of a lattice, including those before its first and after its last corner.

    Attributes
    ----------
    bright : (M,) whether they are white.
    near : (M,) whether one of the two corners of row 0 is known.
    shape : of the cells (row -1, columns -1 .. C), then of (row 0, columns -1 .. C); 2 (M + 1) in all.
    corners : (M, 20, 2) pixels and derivatives of `shape` at the left and the right corner in row -1, then in row 0.
    """

    bright: BoolArray
    near: BoolArray
    shape: LocalFit
    corners: FloatArray

    @classmethod
    def above(cls, lattice: Lattice) -> _Squares:
        wide = lattice.padded((2, 2), (2, 2))
        cells = np.zeros(wide.known.shape, bool)
        cells[1:3, 1:-1] = True
        # The square between two columns is bright if brightness falls with the angle (downwards) across its lower edge.
        bright = wide.signs()[2, 1:-2] < 0.0
        known = wide.known[2, 1:-1]
        shape = fit_cells(wide.pixels, cells, **FLEXIBLE._asdict())
        terms = np.concatenate([shape.pixels[:, None], shape.sides, shape.curvatures], axis=1)
        first, second = terms.reshape(2, -1, *terms.shape[1:])
        corners = np.concatenate([first[:-1], first[1:], second[:-1], second[1:]], axis=1)
        return cls(bright, known[:-1] | known[1:], shape, corners)

    def usable(self, image: GreyImage) -> BoolArray:
        """Return which squares (M,) are large enough and well predicted, and in the image with the paper beyond."""
        sound = (self.shape.gain < MAX_BORDER_GAIN) & (self.shape.shorter_px() > MIN_CELL_PX)
        inside = self.inside(image, _corners_to_border())
        return np.asarray(inside & self.near & self.supported(MIN_PREDICTORS) & self._of_squares(sound))

    def inside(self, image: GreyImage, weights: FloatArray) -> BoolArray:
        """Return which squares (M,) are in the image at all places of the `_weights`."""
        height, width = image.shape
        places = weights @ self.corners
        return np.asarray(((places >= 0.0) & (places <= np.array([width, height]) - 1.0)).all(axis=(1, 2)))

    def supported(self, min_support: int) -> BoolArray:
        """Return which squares (M,) have corners predicted from at least `min_support` corners each."""
        return self._of_squares(self.shape.support >= min_support)

    def _of_squares(self, sound: BoolArray) -> BoolArray:
        """Return for which squares (M,) all four corners are `sound` (2 (M + 1),)."""
        first, second = sound.reshape(2, len(self.bright) + 1)
        both = first & second
        return np.asarray(both[:-1] & both[1:])

    def brightness(self, image: GreyImage, weights: FloatArray) -> FloatArray:
        """Return the brightness (M, K, 3) WITHIN the squares at the K distances of the `_weights` (`_across`)."""
        values = sample(image, weights @ self.corners)
        return values.astype(np.float64).reshape(len(values), -1, len(WITHIN))

    def end_on_one_line(
        self, profiles: FloatArray, outer: FloatArray, beyond: FloatArray, tested: BoolArray
    ) -> BoolArray:
        """Return which squares (M,) change from brightness `outer` to `beyond` once, on the line of those `tested`.

        `profiles` (M, K) : their brightness along PROFILE.
        """
        step = beyond - outer
        step = np.where(np.abs(step) < 1e-3, 1e-3, step)
        past = (profiles - outer[:, None]) / step[:, None] > 0.5
        end = PROFILE[0] + (PROFILE[1] - PROFILE[0]) * ((~past).sum(axis=1) - 0.5)
        from_end = PROFILE - end[:, None]
        clean = ~((from_end < -EDGE_WIDTH) & past).any(axis=1) & ~((from_end > EDGE_WIDTH) & ~past).any(axis=1)
        count = len(self.bright) + 1
        height = np.linalg.norm(self.shape.along_row[:count], axis=1)
        within = np.maximum(STRAIGHT, STRAIGHT_PX / np.maximum(np.minimum(height[:-1], height[1:]), 1.0))
        line = median_of(end[tested]) if tested.any() else 1.0
        return np.asarray(clean & (np.abs(end - line) < within) & (abs(line - 1.0) < ENDS_WITHIN))
