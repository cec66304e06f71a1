"""Where a part of a board of known size lies in the board: which of its sides are the board's own border.

Beyond the last corners of a board there is one more square, and then white paper, or what the board is glued to. One
and a quarter squares beyond the last row seen there are three cases. Squares go on alternating: the board goes on, and
what follows was missed, or is out of the image. It is equally bright all along, and the squares end on one line, where
they should: that is a border. Else nothing is known. Borders and the known size together may leave one place for the
part, or several: then it remains a part.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray, known_median
from rigkit.detection.lattice.lattice import Lattice
from rigkit.detection.lattice.local_fit import LocalFit, fit_cells
from rigkit.detection.saddles.response import GreyImage, sample
from rigkit.detection.subpixel.refined import RefinedLattice

MIN_CELL_PX = 6.0
"""In smaller squares a quarter of one is not told from its edges."""

MIN_SUPPORT, MAX_BORDER_GAIN = 6, 12.0
"""Corners behind a prediction, and its standard deviation for corners of standard deviation 1: of a few hundredths of a
pixel, that is less than a tenth of a square."""

WITHIN = np.array([-0.2, 0.0, 0.2])
"""Where the brightness of a square is read, from its middle along the row, in squares."""

SQUARE = np.array([0.35, 0.5, 0.65])
BEYOND = np.array([1.14, 1.2, 1.26])
"""Where the last square and the paper beyond it are read, in squares from the last corners outwards: near enough for
narrow margins, far enough for blur."""

PROFILE = np.arange(0.5, 1.3001, 0.02)
"""Where the end of the dark squares is looked for."""

ENDS_WITHIN = 0.13
"""The squares end this near to where the next corners would be, in squares: some boards are cut a little short."""

STRAIGHT, STRAIGHT_PX = 0.07, 0.7
"""They end this near to one line, in squares or (the larger) in px."""

EDGE_WIDTH = 0.12
"""Half the width of the edge at their end, in squares: noise may cross its middle more than once."""

WHITE = (0.8, 1.25)
"""Brightness of a white margin, 0 for the dark and 1 for the white squares beside it: it is the same paper."""

EVEN = 0.2
"""What lies beyond a border is so even in brightness, on the same scale."""

SAME_LEVEL = 0.15
"""Two borders of one board with this difference in brightness beyond, on the same scale, bear each other out: where
there is no white margin, a sheet that lies along the squares looks like a border, but not like another one."""

MIN_STEP = 0.3
"""Steps of brightness from which the end of a square is looked for, on the same scale."""

MAX_NEXT_DARK = 0.35
"""The next dark square is darker than this, on the same scale."""

MIN_OUTER_CONTRAST = 0.5
"""Contrast of the outer squares relative to that of the corners: squares that something covers say nothing."""

MIN_OF_KIND = 2
"""Dark and white squares that must have been seen to end, or to go on, each."""

AGREEING_SQUARES = 0.8
"""Part of the squares seen that must say the same."""


NEXT_SQUARE = np.array([1.35, 1.5, 1.65])
"""Where the squares would be that follow the last ones of a board, had it more, in squares from the last corners."""

MIN_NEXT_SUPPORT = 4
"""Corners behind a prediction of where they would be: it need not be better than a part of a square."""

MAX_ALTERNATION, MIN_SIDES_SEEN = 0.5, 2
"""They alternate by less than this part of the contrast of the last ones beyond each side of a board that is seen, and
so many sides are. Of 43 boards in REAL images, blurred by 6 to 8 px or moved by 10 to 20 px so that their size decides
(`rigkit.detection.checks.evidence.OF_EXPECTED_SIZE`), it is 0.34 at most and three sides are seen; of 36 patches of 20
corners and more in 1500 RENDERED cloths, blurred and folded, three have two such sides, one of 0.83 at least each:
patches of a pattern have no straight sides."""


class Side(Enum):
    """What lies beyond one side of a lattice."""

    BORDER = "border"
    GOES_ON = "goes on"
    UNKNOWN = "unknown"


@dataclass(frozen=True, slots=True)
class Beyond:
    """What lies beyond one side of a lattice, and how bright it is: 0 as the dark squares, 1 as the white ones."""

    side: Side
    level: float = np.nan

    def agrees(self, missing: int) -> bool:
        """Return whether `missing` rows beyond the side can be what is seen there."""
        return {Side.BORDER: missing == 0, Side.GOES_ON: missing > 0, Side.UNKNOWN: True}[self.side]

    def proven(self, every: Sequence[Beyond]) -> bool:
        """Return whether the side is a border beyond doubt, the others seen as well: `every`, itself included."""
        if self.side is not Side.BORDER:
            return False
        alike = sum(other.side is Side.BORDER and abs(other.level - self.level) < SAME_LEVEL for other in every)
        return alike > 1 or WHITE[0] < self.level < WHITE[1]


def place_part(image: GreyImage, refined: RefinedLattice, sizes: Sequence[tuple[int, int]]) -> RefinedLattice | None:
    """Return `refined` on the grid of the whole board, empty where nothing was found; None where its place is open.

    Parameters
    ----------
    image : grey, as for `rigkit.detection.subpixel.subpixel.refine`.
    refined : a part of a board; lattices of a known size come back as they are.
    sizes : (columns, rows) of the boards that it may be, either way round.
    """
    columns, rows = refined.lattice.size
    known = {size for c, r in sizes for size in ((c, r), (r, c))}
    if (columns, rows) in known:
        return refined
    larger = [(c - columns, r - rows) for c, r in known if c >= columns and r >= rows]
    if not larger:
        return None
    every = sides(image, refined.lattice)
    if known_median(refined.blur_px) > EDGE_WIDTH * float(
        np.median(fit_cells(refined.lattice.pixels, refined.lattice.known).cell_px())
    ):
        every = _ending_in_blur(image, refined.lattice, every)
    top, left, bottom, right = every
    fits = {
        (across, down, before, above)
        for across, down in larger
        for before in range(across + 1)
        for above in range(down + 1)
        if left.agrees(before) and right.agrees(across - before)
        if top.agrees(above) and bottom.agrees(down - above)
    }
    # A row too many (a shadow, what lies beside the board) makes a part as wide as the board: a size alone is no proof.
    seen = all(any(side.proven(every) for side in axis) for axis in ((left, right), (top, bottom)))
    if len(fits) != 1 or not seen:
        return None
    across, down, before, above = fits.pop()
    return refined.padded((above, down - above), (before, across - before))


FourSides = tuple[Beyond, Beyond, Beyond, Beyond]
"""Beyond the first row, the first column, the last row and the last column."""


def sides(image: GreyImage, lattice: Lattice) -> FourSides:
    """Return what lies beyond the first row, the first column, the last row and the last column."""
    first, second, third, fourth = (_above(image, lattice.turned(turns)) for turns in range(4))
    return first, second, third, fourth


def _ending_in_blur(image: GreyImage, lattice: Lattice, every: FourSides) -> FourSides:
    """Return what lies beyond the sides of a board whose edges are too wide to tell: where squares do not go on
    alternating it ends."""
    quiet = [_alternation_above(image, lattice.turned(turns)) < MAX_ALTERNATION for turns in range(4)]
    ends = [
        replace(one, side=Side.BORDER) if ending and one.side is Side.UNKNOWN else one
        for one, ending in zip(every, quiet, strict=True)
    ]
    return ends[0], ends[1], ends[2], ends[3]


def ends_quietly(image: GreyImage, lattice: Lattice) -> bool:
    """Return whether `lattice` is seen to end where it does: beyond its sides the squares do not go on alternating."""
    every = np.array([_alternation_above(image, lattice.turned(turns)) for turns in range(4)])
    seen = every[np.isfinite(every)]
    return len(seen) >= MIN_SIDES_SEEN and bool((seen < MAX_ALTERNATION).all())


def _alternation_above(image: GreyImage, lattice: Lattice) -> float:
    """Return by how much squares beyond the last ones above `lattice` alternate, relative to these; NaN: not seen."""
    squares = _Squares.above(lattice)
    seen = squares.inside(image, float(NEXT_SQUARE[1]), float(WITHIN[-1])) & squares.near
    seen &= squares.supported(MIN_NEXT_SUPPORT)
    bright, dark = seen & squares.bright, seen & ~squares.bright
    if min(bright.sum(), dark.sum()) < MIN_OF_KIND:
        return np.nan
    inner, outer, beyond = (squares.brightness(image, places) for places in (-SQUARE, SQUARE, NEXT_SQUARE))
    contrast = float(np.median(np.where(squares.bright, outer - inner, inner - outer)[seen]))
    return float(np.median(beyond[dark]) - np.median(beyond[bright])) / max(contrast, 1e-3)


def _above(image: GreyImage, lattice: Lattice) -> Beyond:
    """Return what lies beyond the first row of `lattice`."""
    squares = _Squares.above(lattice)
    usable = squares.usable(image)
    if usable.sum() < 2 * MIN_OF_KIND:
        return Beyond(Side.UNKNOWN)
    inner, outer, beyond = (squares.brightness(image, places) for places in (-SQUARE, SQUARE, BEYOND))
    contrast = np.where(squares.bright, outer - inner, inner - outer)
    usable &= contrast > MIN_OUTER_CONTRAST * float(np.nanmedian(lattice.contrast))
    if any((usable & kind).sum() < MIN_OF_KIND for kind in (squares.bright, ~squares.bright)):
        return Beyond(Side.UNKNOWN)
    dark = np.minimum(inner, outer)
    relative = (beyond - dark) / np.maximum(contrast, 1e-3)
    level = float(np.median(relative[usable]))
    steps = np.abs(beyond - outer) > MIN_STEP * contrast
    border = squares.end_on_one_line(image, outer, beyond, usable & steps) | ~steps
    border &= np.abs(relative - level) < EVEN
    if (usable & steps).sum() >= MIN_OF_KIND and border[usable].mean() >= AGREEING_SQUARES:
        return Beyond(Side.BORDER, level)
    goes_on = np.where(squares.bright, relative < MAX_NEXT_DARK, relative > 1.0 - MAX_NEXT_DARK)
    return Beyond(Side.GOES_ON if goes_on[usable].mean() >= AGREEING_SQUARES else Side.UNKNOWN)


@dataclass(frozen=True, eq=False, slots=True)
class _Squares:
    """The M squares above the first row of a lattice, from the one before its first corner to the one after its last.

    Attributes
    ----------
    bright : (M,) whether they are white.
    near : (M,) whether a corner at their foot is known.
    shape : of the cells (row -1, columns -1 .. C) and then of (row 0, columns -1 .. C), 2 (M + 1) in all.
    """

    bright: BoolArray
    near: BoolArray
    shape: LocalFit

    @classmethod
    def above(cls, lattice: Lattice) -> _Squares:
        wide = lattice.padded((2, 2), (2, 2))
        cells = np.zeros(wide.known.shape, bool)
        cells[1:3, 1:-1] = True
        # The square between two columns is bright where brightness falls with the angle (downwards) across its foot.
        bright = wide.signs()[2, 1:-2] < 0.0
        known = wide.known[2, 1:-1]
        shape = fit_cells(wide.pixels, cells, degree=3, ridge=(1e-3, 1e-2))
        return cls(bright, known[:-1] | known[1:], shape)

    def at(self, up: FloatArray, lateral: FloatArray) -> FloatArray:
        """Return (M, K, 2) pixels `up` (K,) squares beyond the row and `lateral` (K,) from the squares' middles."""
        count = len(self.bright)
        far = up >= 0.5
        out = np.zeros((count, len(up), 2))
        for first, rows, which in ((0, 1.0 - up, far), (count + 1, -up, ~far)):
            for shift, share in ((0, 0.5 - lateral), (1, 0.5 + lateral)):
                part = slice(first + shift, first + shift + count)
                along = (0.5 + lateral - shift)[:, None]
                down = rows[:, None]
                place = self.shape.pixels[part, None] + along * self.shape.along_column[part, None]
                place = place + down * self.shape.along_row[part, None]
                place = place + 0.5 * along**2 * self.shape.curvature_column[part, None]
                place = place + 0.5 * down**2 * self.shape.curvature_row[part, None]
                out += np.where(which, share, 0.0)[:, None] * place
        return out

    def usable(self, image: GreyImage) -> BoolArray:
        """Return which squares (M,) and the paper beyond them lie in the image, large enough, and well predicted."""
        shape = self.shape
        sound = shape.gain < MAX_BORDER_GAIN
        side = shape.shorter_px()
        sound &= side > MIN_CELL_PX
        inside = self.inside(image, 1.0, 0.5) & self.inside(image, float(BEYOND[-1]), 0.5)
        return np.asarray(inside & self.near & self.supported(MIN_SUPPORT) & self._of_squares(sound))

    def inside(self, image: GreyImage, up: float, lateral: float) -> BoolArray:
        """Return which squares (M,) lie in the image at `up` squares beyond the row, to `lateral` on both sides."""
        height, width = image.shape
        places = self.at(np.array([up, up]), np.array([-lateral, lateral]))
        return np.asarray(((places >= 0.0) & (places <= np.array([width, height]) - 1.0)).all(axis=(1, 2)))

    def supported(self, min_support: int) -> BoolArray:
        """Return which squares (M,) have `min_support` corners behind the prediction of each of their own."""
        return self._of_squares(self.shape.support >= min_support)

    def _of_squares(self, sound: BoolArray) -> BoolArray:
        """Return for which squares (M,) all four cells at their corners are `sound` (2 (M + 1),)."""
        first, second = sound.reshape(2, len(self.bright) + 1)
        both = first & second
        return np.asarray(both[:-1] & both[1:])

    def brightness(self, image: GreyImage, up: FloatArray) -> FloatArray:
        """Return the median brightness (M,) at `up` squares beyond the row, over the middle part of the squares."""
        places = self.at(np.repeat(up, len(WITHIN)), np.tile(WITHIN, len(up)))
        return np.asarray(np.median(sample(image, places), axis=1), dtype=np.float64)

    def end_on_one_line(self, image: GreyImage, outer: FloatArray, beyond: FloatArray, judged: BoolArray) -> BoolArray:
        """Return which squares (M,) change from brightness `outer` to `beyond` once, where those `judged` do."""
        places = self.at(np.repeat(PROFILE, len(WITHIN)), np.tile(WITHIN, len(PROFILE)))
        values = sample(image, places).reshape(len(outer), len(PROFILE), len(WITHIN)).mean(axis=2)
        step = beyond - outer
        step = np.where(np.abs(step) < 1e-3, 1e-3, step)
        past = (values - outer[:, None]) / step[:, None] > 0.5
        end = PROFILE[0] + (PROFILE[1] - PROFILE[0]) * ((~past).sum(axis=1) - 0.5)
        from_end = PROFILE - end[:, None]
        clean = ~((from_end < -EDGE_WIDTH) & past).any(axis=1) & ~((from_end > EDGE_WIDTH) & ~past).any(axis=1)
        count = len(self.bright) + 1
        height = np.linalg.norm(self.shape.along_row[:count], axis=1)
        within = np.maximum(STRAIGHT, STRAIGHT_PX / np.maximum(np.minimum(height[:-1], height[1:]), 1.0))
        line = float(np.median(end[judged])) if judged.any() else 1.0
        return np.asarray(clean & (np.abs(end - line) < within) & (abs(line - 1.0) < ENDS_WITHIN))
