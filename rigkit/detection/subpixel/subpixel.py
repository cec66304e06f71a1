"""Corners of whole lattices to a hundredth of a pixel: the edge model at every corner, guided by the lattice.

The lattice says which way the lines run, how far the cell reaches, and how the lines bend; the fit says where the
corners are, and so gives a better lattice for a second pass, which also tries the cells that were left empty.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray, IntArray, upper_median
from rigkit.detection.lattice.lattice import Lattice, LatticeStack
from rigkit.detection.lattice.local_fit import fit_cells, foretold
from rigkit.detection.saddles.response import GreyImage
from rigkit.detection.subpixel.correlation import sigma_factors, uneven_factors
from rigkit.detection.subpixel.edge_curvature import line_bends_to_fit
from rigkit.detection.subpixel.edge_fit import BLUR_RANGE, EdgeFit, fit_edges
from rigkit.detection.subpixel.edge_model import TAIL_SIGMAS, WINDOW_REACH, Geometry, ends_of, tilted
from rigkit.detection.subpixel.outer_squares import fitted_beside_paper
from rigkit.detection.subpixel.refined import RefinedLattice
from rigkit.detection.subpixel.scatter import scatter_factors
from rigkit.detection.subpixel.unsure import strays

Part = tuple[slice, slice]

FIRST_BLUR = 1.0
"""s that the first pass starts from, px."""

FIRST_PASS = (8.0, 4, 0.02)
LAST_PASS = (18.0, 8, 0.01)
"""Radius in px, Gauss-Newton steps at most, and the step in px that ends them: the first pass only has to bring the
lattice to a few hundredths of a pixel; after the last step of the last one there is a ten-thousandth to go."""

REACHED = 0.25
"""Of the corners of a board: where blur brings the edges of neighbouring lines into so many windows, all are fitted
once more. Squares at a slant, or at the rim, do not make a sharp image slower by a third."""

MIN_NEIGHBOURS = 3
"""An empty cell is tried if so many of its eight neighbours are known."""

MIN_CHECKED = 12
MIN_JUDGED = 9
"""A board of fewer corners, or of fewer that so many others predict, is not checked against itself."""

HOLE_MOVE = 0.12
HOLE_CONTRAST = 0.3
HOLE_RESIDUAL = 2.0
HOLE_SIGMA = 3.0
"""What a corner in an empty cell must show: how far from its prediction (cells); contrast, relative residual and sigma
relative to the corners around it."""

DISPLACED_CELLS = 0.06
DISPLACED_SIGMAS = 8.0
"""A corner further than this from where its neighbours say (in cells; and times the board's typical deviation; and
times the standard deviation expected of it) is something else: a finger, a glint, the end of a ruler."""

COVERED_NOISE, COVERED_FACTOR = 0.06, 6.0
COVERED_OFF = 3.5
"""A corner whose noise, relative to its contrast, exceeds this and this times the board's typical one, and that lies
off by this times the typical deviation, is covered in part, by the edge of a ruler or of a hand: its sides are not
alike. On rendered boards under a ruler the factor is 12 and more, on boards with marks in their squares seldom 6; the
noise is 0.065 and more. Glare on single squares of blurred boards, where little other noise is left, makes 0.04."""


def refine(
    image: GreyImage,
    lattices: Sequence[Lattice],
    may_be: Callable[[RefinedLattice], bool] = lambda _: True,
    *,
    radius_px: float = LAST_PASS[0],
) -> list[RefinedLattice]:
    """Return `lattices` with their corners placed by the edge model on the full-resolution grey `image`.

    Corners whose fit fails or that contradict their neighbours are dropped; corners in empty cells that the fit
    confirms are added. Lattices with small squares that `may_be` no boards, as far as one fit tells, are not fitted
    once more. Pixels further from a corner than `radius_px` are not used.
    """
    if not lattices:
        return []
    # All lattices lie on one sheet, so that each step is one call.
    sheet = LatticeStack.of(lattices)
    first = _first_pass(image, Lattice(sheet.pixels, sheet.contrast, True), sheet.signs)
    start, holes = _with_holes(first.lattice, sheet.signs != 0.0)
    before, blur = replace(first, lattice=start), _typical_blur(first, sheet.parts)
    shape = fit_cells(start.pixels, start.known)
    gaps, clutter = shape.gaps(), np.zeros(holes.shape, np.bool_)
    reached = _reached_by_others(start.known, gaps, blur, sheet.parts)
    aslant = bool(reached.any())
    if aslant:
        # It matters where exactly the neighbouring lines are, whose edges reach into the windows.
        theirs = reached[start.known]
        lines = shape.sides[theirs], gaps[theirs]
        windows = _Windows.of(before.without(~reached), *lines, blur, radius_px, aslant=True)
        nearer = _nearer_pass(image, windows, sheet.signs, sheet.parts)
        for part in sheet.parts:
            # Clutter in the background is small, and would cost as much as the board.
            mine = nearer.cut(*part)
            if mine.lattice.count == 0 or not may_be(mine):
                clutter[part] = reached[part]
        before = before.without(reached).filled(nearer)
        blur = _typical_blur(before, sheet.parts)
        before = before.without(clutter)
        shape = fit_cells(before.lattice.pixels, before.lattice.known)
        gaps = shape.gaps()
    windows = _Windows.of(before, shape.sides, gaps, blur, radius_px, aslant=aslant)
    last, factors = _last_pass(image, windows, sheet.signs, sheet.parts)
    if clutter.any():
        last = last.filled(nearer.without(~clutter))
    if holes.any():
        last = _confirmed(last, start, holes)
    checked = _checked(last, sheet.parts)
    # Where corners scatter about the lattice by more than the noise in the image explains (JPEG blocks, aliasing, wavy
    # paper), the sigmas of the board are raised to what is seen.
    scatter = scatter_factors(checked.lattice.pixels, checked.sigma_px, sheet.parts)
    return [
        replace(
            checked.cut(*part),
            lattice=replace(checked.lattice.cut(*part), rising=item.rising),
            sigma_px=checked.sigma_px[part] * raised,
            scatter=raised,
            correlated=factor,
        )
        for part, item, raised, factor in zip(sheet.parts, lattices, scatter.tolist(), factors.tolist(), strict=True)
    ]


def _typical_blur(item: RefinedLattice, parts: Sequence[Part]) -> FloatArray:
    """Return (R, C) the blur of each corner, kept near what is typical of its board."""
    blur = np.full(item.blur_px.shape, FIRST_BLUR)
    for part in parts:
        mine = item.blur_px[part]
        known = np.isfinite(mine)
        if known.any():
            typical = upper_median(mine[known])
            blur[part] = np.where(known, np.clip(mine, 0.7 * typical, 1.4 * typical), typical)
    return blur.clip(*BLUR_RANGE)


def _first_pass(image: GreyImage, start: Lattice, signs: FloatArray) -> RefinedLattice:
    """Fit all corners of the sheet `start`, known to about a tenth of a pixel; those that fail are left out."""
    known = start.known
    shape = fit_cells(start.pixels, known)
    radius_px, iterations, converged_px = FIRST_PASS
    fit = fit_edges(
        image,
        start.pixels[known],
        Geometry(shape.sides, shape.curvature(), shape.gaps(), ends_of(known, known)),
        signs[known],
        np.full(start.count, FIRST_BLUR),
        radius_px=radius_px,
        iterations=iterations,
        converged_px=converged_px,
        mirrored=False,
    )
    return _spread(start, fit, fit.sigma_px)


@dataclass(frozen=True, eq=False, slots=True)
class _Windows:
    """The windows around the corners of a sheet, N of them, and what is known of these before their last fit.

    Attributes
    ----------
    lattice, geometry : where the corners are, (R, C), and what the lattice says of them, (N,).
    curvature_sigma, blur : (N, 2) and (N,), as of `fit_edges`.
    radius_px : of the largest window.
    """

    lattice: Lattice
    geometry: Geometry
    curvature_sigma: FloatArray
    blur: FloatArray
    radius_px: float

    @classmethod
    def of(
        cls,
        start: RefinedLattice,
        sides: FloatArray,
        gaps: FloatArray,
        blur: FloatArray,
        radius_px: float,
        *,
        aslant: bool,
    ) -> _Windows:
        """Return those of the corners of `start`, with `sides` and `gaps` (N, 2, 2), and `blur` (R, C); `aslant` where
        it matters how neighbouring lines are turned."""
        known, pixels = start.lattice.known, start.lattice.pixels
        bends, bends_sigma = line_bends_to_fit(pixels, start.sigma_px, known, sides, radius_px)
        geometry = Geometry(sides, bends, gaps, ends_of(known, known))
        geometry = tilted(geometry, known) if aslant else geometry
        return cls(start.lattice, geometry, bends_sigma, blur[known], radius_px)

    def fit(
        self, image: GreyImage, signs: FloatArray, which: BoolArray | slice, geometry: Geometry, most: tuple[int, float]
    ) -> EdgeFit:
        """Return the fit of the corners `which` (N,), with `geometry` instead of their own, in the `most` steps until
        one is so short, px; `signs` (R, C)."""
        known = self.lattice.known
        return fit_edges(
            image,
            self.lattice.pixels[known][which],
            geometry,
            signs[known][which],
            self.blur[which],
            radius_px=self.radius_px,
            iterations=most[0],
            converged_px=most[1],
            curvature_sigma=self.curvature_sigma[which],
            contrast=self.lattice.contrast[known][which],
        )


def _fit_windows(image: GreyImage, windows: _Windows, signs: FloatArray, mine: IntArray) -> EdgeFit:
    """Fit all corners in their `windows`, and what lies beyond the boards, `mine` (N,), that they are of: without it
    the outermost corners of a blurred board move by tenths of a pixel, and with them the lines through the others."""

    def fitted(which: BoolArray | slice, geometry: Geometry) -> EdgeFit:
        return windows.fit(image, signs, which, geometry, LAST_PASS[1:])

    fit = fitted(slice(None), windows.geometry)
    return fitted_beside_paper(image, windows.geometry, fit, fitted, signs[windows.lattice.known], mine)


def _nearer_pass(image: GreyImage, windows: _Windows, signs: FloatArray, parts: Sequence[Part]) -> RefinedLattice:
    """Return where the corners are, in the windows of the last pass; those that fail are left out."""
    fit = _fit_windows(image, windows, signs, _owners(windows.lattice.known, parts))
    return _spread(windows.lattice, fit, fit.sigma_px)


def _last_pass(
    image: GreyImage, windows: _Windows, signs: FloatArray, parts: Sequence[Part]
) -> tuple[RefinedLattice, FloatArray]:
    """Fit all corners in their `windows`; those that fail are left out. Say (P,) how correlated noise raises sigmas.

    Noise is told from other residuals, and how that of neighbouring pixels is correlated on each of the `parts`.
    """
    mine = _owners(windows.lattice.known, parts)
    fit, geometry, radius_px = _fit_windows(image, windows, signs, mine), windows.geometry, windows.radius_px
    good = fit.valid & (fit.contrast > 0.0)
    factors = sigma_factors(fit, good, geometry.sides, mine, len(parts), radius_px)
    uneven = uneven_factors(fit, good, geometry.sides, mine, factors, radius_px)
    return _spread(windows.lattice, fit, fit.sigma_px * factors[mine] * uneven), factors


def _owners(known: BoolArray, parts: Sequence[Part]) -> IntArray:
    """Return the numbers (N,) of the `parts` that the N `known` corners of a sheet are in."""
    owner = np.zeros(known.shape, np.int64)
    for k, part in enumerate(parts):
        owner[part] = k
    return owner[known]


def _reached_by_others(known: BoolArray, gaps: FloatArray, blur: FloatArray, parts: Sequence[Part]) -> BoolArray:
    """Return which of the `known` corners of a sheet (R, C) are of boards that blur (R, C) brings the edges of
    neighbouring lines into REACHED windows of. `gaps` (N, 2, 2) as of `Geometry`."""
    owner = _owners(known, parts)
    near = TAIL_SIGMAS * blur[known] > (1.0 - WINDOW_REACH) * gaps.reshape(-1, 4).min(axis=1, initial=np.inf)
    boards = np.bincount(owner, near) > REACHED * np.bincount(owner)
    out = np.zeros(known.shape, np.bool_)
    out[known] = boards[owner]
    return out


def _spread(start: Lattice, fit: EdgeFit, sigma_px: FloatArray) -> RefinedLattice:
    """Return the sheet `start` with its corners as fitted, without those that failed."""
    good = fit.valid & (fit.contrast > 0.0)
    cells, shape = np.flatnonzero(start.known)[good], start.contrast.shape
    pixels, single = np.full((start.known.size, 2), np.nan), np.full((5, start.known.size), np.nan)
    pixels[cells] = fit.pixels[good]
    single[:, cells] = np.array([fit.contrast, sigma_px, fit.blur, fit.residual, fit.noise])[:, good]
    contrast, *rest = single.reshape(-1, *shape)
    return RefinedLattice(Lattice(pixels.reshape(*shape, 2), contrast, start.rising), *rest)


def _with_holes(lattice: Lattice, inside: BoolArray) -> tuple[Lattice, BoolArray]:
    """Return the lattice with predictions in the empty cells `inside` among known ones, and which cells these are."""
    known = lattice.known
    holes: BoolArray = inside & ~known
    if holes.any():
        around = cv2.boxFilter(known.astype(np.uint8), -1, (3, 3), normalize=False, borderType=cv2.BORDER_CONSTANT)
        holes &= around >= MIN_NEIGHBOURS
    if not holes.any():
        return lattice, holes
    shape = foretold(lattice.pixels, holes)
    pixels = lattice.pixels.copy()
    pixels[holes] = shape.pixels
    return Lattice(pixels, lattice.contrast, lattice.rising), holes


def _confirmed(item: RefinedLattice, start: Lattice, holes: BoolArray) -> RefinedLattice:
    """Return `item` without those of the `holes` where the fit saw no proper corner."""
    known = item.lattice.known
    settled = known & ~holes
    contrast = item.lattice.contrast
    moved = np.linalg.norm(item.lattice.pixels - start.pixels, axis=2)
    cell = np.full(known.shape, np.nan)
    cell[holes] = fit_cells(start.pixels, holes, degree=1).cell_px()
    with np.errstate(invalid="ignore"):
        good = (moved < HOLE_MOVE * cell) & (contrast > HOLE_CONTRAST * _around(contrast, settled))
        good &= item.residual < HOLE_RESIDUAL * _around(item.residual, settled)
        good &= item.sigma_px < HOLE_SIGMA * _around(item.sigma_px, settled)
    return item.without(holes & ~good)


def _around(values: FloatArray, known: BoolArray) -> FloatArray:
    """Return the mean of `values` (R, C) over the `known` among each cell and its eight neighbours, NaN for none."""
    box = np.ones((3, 3))
    total, count = (
        cv2.filter2D(part, cv2.CV_64F, box, borderType=cv2.BORDER_CONSTANT)
        for part in (np.where(known, values, 0.0), known.astype(np.float64))
    )
    return np.where(count > 0.5, total / np.maximum(count, 0.5), np.nan)


def _checked(item: RefinedLattice, parts: Sequence[Part]) -> RefinedLattice:
    """Return `item` without corners that are covered in part or lie where their neighbours say they cannot."""
    known = item.lattice.known
    shape = fit_cells(item.lattice.pixels, known, leave_out=True)

    def spread(values: FloatArray) -> FloatArray:
        out = np.full(known.shape, np.nan)
        out[known] = values
        return out

    off = item.lattice.pixels[known] - shape.pixels
    distance = np.hypot(off[:, 0], off[:, 1])
    # A prediction from a few corners on one side is no judge of another.
    judged = np.zeros_like(known)
    judged[known] = (shape.support >= MIN_CHECKED) & (shape.gain < 1.5)
    cells = spread(distance / shape.cell_px())
    excess = spread(distance / (item.sigma_px[known] * np.hypot(1.0, shape.gain)))
    gain = spread(shape.gain)
    relative = item.noise / item.lattice.contrast
    drop = np.zeros_like(known)
    for part in parts:
        here, sure = known[part], judged[part]
        if here.sum() < MIN_CHECKED:
            continue
        drop[part] = strays(item.sigma_px[part], cells[part], gain[part])
        if sure.sum() < MIN_JUDGED:
            continue
        typical = upper_median(cells[part][sure])
        usual = upper_median(relative[part][here])
        outlying = (cells[part] > max(DISPLACED_CELLS, DISPLACED_SIGMAS * typical)) & (excess[part] > DISPLACED_SIGMAS)
        covered = relative[part] > max(COVERED_NOISE, COVERED_FACTOR * usual)
        drop[part] |= sure & (outlying | (covered & (cells[part] > COVERED_OFF * typical)))
    return item.without(drop) if drop.any() else item
