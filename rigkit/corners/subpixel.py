"""Corners of whole lattices to a hundredth of a pixel: the edge model at every corner, guided by the lattice.

The lattice says which way the lines run, how far the cell reaches, and how the lines bend; the fit says where the
corners are, and so gives a better lattice for a second pass, which also tries the cells that were left empty.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import comb

import cv2
import numpy as np

from rigkit.arrays import BoolArray, FloatArray
from rigkit.corners.edge_fit import BLUR_RANGE, EdgeFit, fit_edges
from rigkit.corners.edge_model import Geometry
from rigkit.corners.lattice import Lattice, Sheet
from rigkit.corners.local_fit import fit_cells
from rigkit.corners.response import FloatImage

__all__ = ["RefinedLattice", "refine"]

FIRST_BLUR = 1.0
"""s that the first pass starts from, px."""

FIRST_PASS = (9.0, 4, 0.02)
LAST_PASS = (18.0, 8, 1e-3)
"""Radius in px, Gauss-Newton steps at most, and the step in px that ends them: the first pass only has to bring the
lattice to a few hundredths of a pixel."""

FEWEST_NEIGHBOURS = 3
"""An empty cell is tried if so many of its eight neighbours are known."""

HOLE_MOVE = 0.12
HOLE_CONTRAST = 0.3
HOLE_RESIDUAL = 2.0
HOLE_SIGMA = 3.0
"""What a corner in an empty cell must show: how far from its prediction (cells); contrast, relative residual and sigma
relative to the corners around it."""

ASTRAY_CELLS = 0.06
ASTRAY_FACTOR = 8.0
"""A corner further than this from where its neighbours say (in cells; and times the board's typical deviation; and
times the standard deviation expected of it) is something else: a finger, a glint, the end of a ruler."""

COVERED = 0.15
COVERED_FACTOR = 3.5
"""A corner whose residual, relative to its contrast, exceeds this and this times the board's typical one, and that lies
off by this times the typical deviation, is covered in part, by the edge of a ruler or of a hand."""

DIFFERENCES = (5, 6)
UNEXPLAINED = 1.25
"""A scatter about the lattice less than this times the expected one is what chance makes of fifty corners."""

MEDIAN_OF_NORMAL = 0.6745
"""Median of the absolute value of a standard normal variable."""


@dataclass(frozen=True, eq=False, slots=True)
class RefinedLattice:
    """A lattice with what the fit says of each corner, (R, C) each and NaN where unknown.

    Attributes
    ----------
    lattice : the corners.
    sigma_px, blur_px, residual : predicted standard deviation, width of the edges, RMS of the fit in grey levels.
    """

    lattice: Lattice
    sigma_px: FloatArray
    blur_px: FloatArray
    residual: FloatArray

    def without(self, drop: BoolArray) -> RefinedLattice:
        """Return this with the corners `drop` (R, C) forgotten."""
        rest = (np.where(drop, np.nan, values) for values in (self.sigma_px, self.blur_px, self.residual))
        return RefinedLattice(self.lattice.without(drop), *rest)

    def cut(self, rows: slice, columns: slice) -> RefinedLattice:
        """Return the part of `rows` and `columns`."""
        rest = (values[rows, columns] for values in (self.sigma_px, self.blur_px, self.residual))
        return RefinedLattice(self.lattice.cut(rows, columns), *rest)


def refine(image: FloatImage, lattices: Sequence[Lattice]) -> list[RefinedLattice]:
    """Return `lattices` with their corners placed by the edge model on the full-resolution grey `image`.

    Corners whose fit fails or that contradict their neighbours are dropped; corners in empty cells that the fit
    confirms are added.
    """
    if not lattices:
        return []
    first = [np.full(item.known.shape, FIRST_BLUR) for item in lattices]
    refined = _pass(image, lattices, first, *FIRST_PASS)
    current = [_with_holes(item) for item in refined]
    second = _pass(image, [item[0] for item in current], [_typical_blur(item) for item in refined], *LAST_PASS)
    return [_checked(_confirmed(item, start, holes)) for item, (start, holes) in zip(second, current, strict=True)]


def _typical_blur(item: RefinedLattice) -> FloatArray:
    known = np.isfinite(item.blur_px)
    typical = float(np.median(item.blur_px[known])) if known.any() else FIRST_BLUR
    blur: FloatArray = np.where(known, np.clip(item.blur_px, 0.7 * typical, 1.4 * typical), typical).clip(*BLUR_RANGE)
    return blur


def _pass(
    image: FloatImage,
    lattices: Sequence[Lattice],
    blurs: Sequence[FloatArray],
    radius_px: float,
    iterations: int,
    converged_px: float,
) -> list[RefinedLattice]:
    """Fit all corners of all lattices in one batch."""
    sheet = Sheet.of(lattices)
    known = sheet.known
    shape = fit_cells(sheet.pixels, known)
    sides = np.stack([shape.along_column, shape.along_row], axis=1)
    geometry = Geometry(sides, shape.curvature(), shape.gaps())
    blur = np.concatenate([values[item.known] for item, values in zip(lattices, blurs, strict=True)])
    pixels, sign = sheet.pixels[known], sheet.signs[known]
    fit = fit_edges(
        image,
        pixels,
        geometry,
        sign,
        blur,
        radius_px=radius_px,
        iterations=iterations,
        converged_px=converged_px,
    )
    ends = np.cumsum([item.count for item in lattices])
    return [_filled(item, fit, slice(end - item.count, end)) for item, end in zip(lattices, ends, strict=True)]


def _filled(lattice: Lattice, fit: EdgeFit, mine: slice) -> RefinedLattice:
    """Return `lattice` with the part `mine` of `fit`, without the corners that failed."""
    known = lattice.known
    good = fit.valid[mine] & (fit.contrast[mine] > 0.0)

    def spread(values: FloatArray) -> FloatArray:
        out = np.full(known.shape + values.shape[1:], np.nan)
        out[known] = np.where(good.reshape(-1, *[1] * (values.ndim - 1)), values[mine], np.nan)
        return out

    refined = Lattice(spread(fit.pixels), spread(fit.contrast), lattice.rising)
    return RefinedLattice(refined, spread(fit.sigma_px), spread(fit.blur), spread(fit.residual))


def _with_holes(item: RefinedLattice) -> tuple[Lattice, BoolArray]:
    """Return the lattice with predictions in the empty cells among known ones, and which cells these are."""
    known = item.lattice.known
    padded = np.pad(known.astype(np.int64), 1)
    rows, columns = known.shape
    around = sum(
        padded[1 + i : 1 + i + rows, 1 + j : 1 + j + columns]
        for i in (-1, 0, 1)
        for j in (-1, 0, 1)
        if (i, j) != (0, 0)
    )
    holes: BoolArray = ~known & (around >= FEWEST_NEIGHBOURS)
    if not holes.any():
        return item.lattice, holes
    shape = fit_cells(item.lattice.pixels, holes, degree=2, ridge=(1e-3, 1.0))
    pixels, contrast = item.lattice.pixels.copy(), item.lattice.contrast.copy()
    pixels[holes] = shape.pixels
    return Lattice(pixels, contrast, item.lattice.rising), holes


def _confirmed(item: RefinedLattice, start: Lattice, holes: BoolArray) -> RefinedLattice:
    """Return `item` without those of the `holes` where the fit saw no proper corner."""
    known = item.lattice.known
    settled = known & ~holes
    if not (holes & known).any() or not settled.any():
        return item.without(holes)
    contrast = item.lattice.contrast
    moved = np.linalg.norm(item.lattice.pixels - start.pixels, axis=2)
    shape = fit_cells(start.pixels, np.ones_like(known), degree=1)
    area = shape.along_column[:, 0] * shape.along_row[:, 1] - shape.along_column[:, 1] * shape.along_row[:, 0]
    cell = np.sqrt(np.maximum(area, 1.0)).reshape(known.shape)
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


def _checked(item: RefinedLattice) -> RefinedLattice:
    """Return `item` without corners that lie where their neighbours say they cannot, and with honest sigmas.

    Where the corners scatter about the lattice by more than the noise in the image explains (JPEG blocks, aliasing,
    wavy paper), the board's sigmas are raised to what is seen.
    """
    known = item.lattice.known
    if known.sum() < 12:
        return item
    shape = fit_cells(item.lattice.pixels, known, leave_out=True)
    off = item.lattice.pixels[known] - shape.pixels
    expected = item.sigma_px[known] * np.hypot(1.0, shape.gain)
    # A prediction from a few corners on one side is no judge of another.
    judged = (shape.support >= 12) & (shape.gain < 1.5)
    if judged.sum() < 9:
        return item
    area = shape.along_column[:, 0] * shape.along_row[:, 1] - shape.along_column[:, 1] * shape.along_row[:, 0]
    distance = np.linalg.norm(off, axis=1)
    cells = distance / np.sqrt(np.maximum(area, 1.0))
    limit = max(ASTRAY_CELLS, ASTRAY_FACTOR * float(np.median(cells[judged])))
    astray = judged & (cells > limit) & (distance > ASTRAY_FACTOR * expected)
    relative = item.residual[known] / item.lattice.contrast[known]
    covered = relative > max(COVERED, COVERED_FACTOR * float(np.median(relative)))
    astray |= judged & covered & (cells > COVERED_FACTOR * float(np.median(cells[judged])))
    drop = np.zeros_like(known)
    drop[known] = astray
    out = item.without(drop)
    scatter = _scatter(out)
    return replace(out, sigma_px=out.sigma_px * scatter) if scatter > UNEXPLAINED else out


def _scatter(item: RefinedLattice) -> float:
    """Return how much more the corners scatter about smooth rows and columns than their sigmas say (1: as they say).

    Judged by the DIFFERENCES along rows and columns, with and without the best perspective taken away first: the one is
    blind to strong perspective, the other to a fisheye's bend, and the calmest of them is right.
    """
    row, column = np.nonzero(item.lattice.known)
    grid = np.stack([column, row], axis=-1).astype(np.float64)
    plane, _ = cv2.findHomography(grid, item.lattice.pixels[row, column], 0)
    flat = np.full(item.lattice.pixels.shape, np.nan)
    if plane is not None:
        flat[row, column] = cv2.perspectiveTransform(grid[None], plane)[0]
    curved = (item.lattice.pixels, item.lattice.pixels - flat)
    ratios = [_roughness(values, item.sigma_px, order) for values in curved for order in DIFFERENCES]
    scatter = float(np.fmin.reduce(ratios))
    return scatter if np.isfinite(scatter) else 1.0


def _roughness(values: FloatArray, sigma: FloatArray, order: int) -> float:
    """Return the typical difference of `order` of `values` (R, C, 2) over the expected one; NaN if there are few."""
    factors = np.array([float(comb(order, k)) for k in range(order + 1)])
    ratios = [np.zeros(0)]
    for axis in (0, 1):
        if sigma.shape[axis] > order:
            windows = np.lib.stride_tricks.sliding_window_view(sigma, order + 1, axis=axis)
            expected = np.sqrt(((windows * factors) ** 2).sum(axis=-1))
            ratio = np.abs(np.diff(values, order, axis=axis)) / expected[..., None]
            ratios.append(ratio[np.isfinite(ratio)])
    every = np.concatenate(ratios)
    return float(np.median(every)) / MEDIAN_OF_NORMAL if len(every) >= 16 else np.nan
