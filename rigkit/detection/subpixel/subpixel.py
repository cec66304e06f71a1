"""Corners of whole lattices to a hundredth of a pixel: the edge model at every corner, guided by the lattice.

The lattice says which way the lines run, how far the cell reaches, and how the lines bend; the fit says where the
corners are, and so gives a better lattice for a second pass, which also tries the cells that were left empty.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

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
    start = Lattice(sheet.pixels, sheet.contrast, True)
    first = _first_pass(image, start, sheet.signs)
    start, holes = _with_holes(first.lattice, sheet.signs != 0.0)
    blur = _typical_blur(first, sheet.parts)
    last, reached, factors = _last_pass(image, start, sheet.signs, blur, first.sigma_px, sheet.parts, radius_px)
    for part in sheet.parts if reached.any() else ():
        # Clutter in the background is small, and would cost as much as the board.
        mine = last.cut(*part)
        reached[part] &= mine.lattice.count > 0 and may_be(mine)
    if reached.any():
        # It matters where exactly the neighbouring lines are, whose edges reach into the windows.
        once = last.without(~reached)
        blur = _typical_blur(once, sheet.parts)
        again, _, others = _last_pass(image, once.lattice, sheet.signs, blur, once.sigma_px, sheet.parts, radius_px)
        factors = np.where([reached[part].any() for part in sheet.parts], others, factors)
        last = last.without(reached).filled(again)
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


def _last_pass(
    image: GreyImage,
    start: Lattice,
    signs: FloatArray,
    blur: FloatArray,
    sigma_px: FloatArray,
    parts: Sequence[Part],
    radius_px: float,
) -> tuple[RefinedLattice, BoolArray, FloatArray]:
    """Fit all corners of the sheet `start`, known to `sigma_px` (R, C); those that fail are left out. Say (R, C) which
    are of boards whose neighbouring lines reach into the windows, and (P,) how correlated noise raises sigmas.

    Noise is told from other residuals, and how that of neighbouring pixels is correlated on each of the `parts`.
    """
    known = start.known
    shape = fit_cells(start.pixels, known)
    _, iterations, converged_px = LAST_PASS
    curvature, curvature_sigma = line_bends_to_fit(start.pixels, sigma_px, known, shape.sides, radius_px)
    owner = np.zeros(known.shape, np.int64)
    for k, part in enumerate(parts):
        owner[part] = k
    mine = owner[known]

    def fitted(which: BoolArray | slice, geometry: Geometry) -> EdgeFit:
        return fit_edges(
            image,
            start.pixels[known][which],
            geometry,
            signs[known][which],
            blur[known][which],
            radius_px=radius_px,
            iterations=iterations,
            converged_px=converged_px,
            curvature_sigma=curvature_sigma[which],
            contrast=start.contrast[known][which],
        )

    geometry = Geometry(shape.sides, curvature, shape.gaps(), ends_of(known, known))
    if _reached_by_others(geometry.gaps, blur[known], mine).any():
        geometry = tilted(geometry, known)
    fit = fitted(slice(None), geometry)
    fit = fitted_beside_paper(image, geometry, fit, fitted, signs[known], mine)
    good = fit.valid & (fit.contrast > 0.0)
    factors = sigma_factors(fit, good, shape.sides, mine, len(parts), radius_px)
    uneven = uneven_factors(fit, good, shape.sides, mine, factors, radius_px)
    reached = np.zeros(known.shape, np.bool_)
    reached[known] = _reached_by_others(geometry.gaps, fit.blur, mine)
    return _spread(start, fit, fit.sigma_px * factors[mine] * uneven), reached, factors


def _reached_by_others(gaps: FloatArray, blur: FloatArray, owner: IntArray) -> BoolArray:
    """Return which corners (N,) are of boards that blur brings the edges of neighbouring lines into REACHED windows of.

    `gaps` (N, 2, 2) as of `Geometry`, `owner` (N,) the number of each corner's board.
    """
    reached = TAIL_SIGMAS * blur > (1.0 - WINDOW_REACH) * gaps.reshape(-1, 4).min(axis=1, initial=np.inf)
    boards: BoolArray = np.bincount(owner, reached) > REACHED * np.bincount(owner)
    return np.asarray(boards[owner])


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
