"""Corners near shadow edges: they are fitted again in corrected light, and missed ones are added."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray, upper_median
from rigkit.core.boards import Board
from rigkit.core.detections import BoardDetection
from rigkit.core.patterns.charuco import Charuco
from rigkit.detection.guided.board_guide import CROSS
from rigkit.detection.guided.corner_fit import RADIUS_PX, fit_corners, gap_to_markers
from rigkit.detection.guided.guided import MAX_SIGMA_CELLS
from rigkit.detection.lattice.local_fit import FLEXIBLE, MIN_PREDICTORS, LocalFit, fit_cells
from rigkit.detection.saddles.response import GreyImage
from rigkit.detection.subpixel.refined import RefinedLattice
from rigkit.detection.subpixel.shadows import beside_shadows, in_even_light, light_steps
from rigkit.detection.subpixel.subpixel import FIRST_BLUR

MIN_EVEN, MAX_EVEN = 9, 32
"""Smallest and largest number of evenly lit corners that give the typical values of the board."""

MIN_SHADED = 3
"""Smallest number of corners near a shadow edge that crosses a board; one or two are due to dirt or the board's
border."""

TYPICAL_WITHIN_CELLS = 3
"""Largest distance, in cells, of evenly lit corners that give typical values."""

MAX_RELIT_GAIN = 3.0
"""Largest standard deviation of a prediction from corners of standard deviation 1."""

MIN_SHADED_CELL_PX = 10.0
"""Smallest cell with enough pixels to distinguish a step of the light from a corner."""

MOVED_SIGMAS = 5.0
"""Largest distance of a corner from its prediction by evenly lit corners, in standard deviations."""

TIMES_BETTER, MAX_RELIT_RESIDUAL = 1.5, 2.0
"""Smallest ratio of the residual over contrast before the correction of the light to that after it, and to the typical
one; and largest ratio of the residual after the correction to the typical one."""


@dataclass(frozen=True, eq=False, slots=True)
class _Typical:
    """Typical values of evenly lit corners.

    Attributes
    ----------
    signs : (R, C)
    blur : s, px.
    relative : residual over contrast.
    factor : factor of the sigmas of the fits by the detector.
    off_px : distance from predictions by the others, for predictions of gain 1.
    """

    signs: FloatArray
    blur: float
    relative: float
    factor: float
    off_px: float


def relit(
    image: GreyImage, found: BoardDetection, refined: RefinedLattice, board: Board | None = None
) -> BoardDetection:
    """Return `found` with corners near shadow edges fitted in corrected light, and with those missed for it added.

    `refined` : the fits of the corners, on the same grid. `board` : the board, if it is a ChArUco board.
    """
    as_sure = TIMES_BETTER * upper_median(found.sigma_px)
    if found.complete and np.count_nonzero(found.sigma_px >= as_sure) < MIN_SHADED:
        return found
    pixels, relative = found.lattice(), refined.relative_residual
    known = np.isfinite(pixels[..., 0])
    own = np.full(known.shape, np.nan)
    own[found.grid[:, 1], found.grid[:, 0]] = found.sigma_px
    # A shadow edge increases sigma and residual: corners with typical values of either are not affected.
    plain = own < as_sure
    plain |= relative < TIMES_BETTER * upper_median(relative[np.isfinite(relative)])
    doubtful = ~plain & ((cv2.dilate(known.astype(np.uint8), CROSS) > 0) | known)
    if np.count_nonzero(doubtful) < MIN_SHADED:
        return found
    suspect = _lit_unevenly(image, board, pixels, doubtful)
    even = known & ~suspect
    if np.count_nonzero(suspect) < MIN_SHADED or np.count_nonzero(even) < MIN_EVEN:
        return found
    assumed = board or Board("found", found.columns, found.rows, 1.0, 1.0)
    fits = refined if board is None else _fitted_with_markers(image, board, found, refined, _near(even, suspect))
    reference = _near(even & np.isfinite(fits.blur_px), suspect)
    if np.count_nonzero(reference) < MIN_EVEN:
        return found
    typical = _typical(pixels, fits, reference)
    shape = fit_cells(np.where(even[..., None], pixels, np.nan), suspect, **FLEXIBLE._asdict())
    was = _relative_residuals(image, assumed, suspect, shape, fits.relative_residual, typical)
    tried = (shape.support >= MIN_PREDICTORS) & (shape.gain < MAX_RELIT_GAIN) & (was > TIMES_BETTER * typical.relative)
    tried &= np.linalg.norm(shape.sides, axis=2).min(axis=1) > MIN_SHADED_CELL_PX
    if np.count_nonzero(tried) < MIN_SHADED:
        return found
    suspect[suspect] = tried
    placed, sigma, good = _in_even_light(image, assumed, suspect, shape.of(tried), was[tried], typical)
    suspect[suspect] = good
    pixels[suspect], own[suspect] = placed[good], sigma[good]
    row, column = np.nonzero(np.isfinite(pixels[..., 0]))
    grid = np.stack([column, row], axis=-1)
    return replace(found, grid=grid, pixels=pixels[row, column], sigma_px=own[row, column])


def _relative_residuals(
    image: GreyImage, board: Board, cells: BoolArray, shape: LocalFit, relative: FloatArray, typical: _Typical
) -> FloatArray:
    """Return the residuals over contrast (M,) of the corners at `cells`: `relative` (R, C) where known, else those of
    fits at the predictions `shape`."""
    left, missed = relative[cells], cells & ~np.isfinite(relative)
    unknown = missed[cells]
    if unknown.any():
        part = shape.of(unknown)
        fit = fit_corners(image, board, missed, part, part.pixels, typical.signs[missed], typical.blur)
        left[unknown] = fit.residual / np.maximum(fit.contrast, 1e-6)
    return left


def _in_even_light(
    image: GreyImage, board: Board, cells: BoolArray, shape: LocalFit, was: FloatArray, typical: _Typical
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Return pixels (M, 2) and sigmas (M,) of the corners at `cells` of `shape` in corrected light, and which are good.

    `was` (M,) is the residual over contrast before the correction.
    """
    side, signs = np.linalg.norm(shape.sides, axis=2).min(axis=1), typical.signs[cells]
    lateral = _uniform_distance(board, shape.sides)
    steps, seen = light_steps(image, shape.pixels, shape.sides, shape.curvature(), typical.blur, lateral)
    picture, moved = in_even_light(image, steps)
    start = np.where(np.abs(steps.pixels - shape.pixels) < 1.0, steps.pixels, shape.pixels)
    fit = fit_corners(picture, board, cells, shape, start + moved, signs, typical.blur, paper=False)
    pixels, sigma = fit.pixels - moved, np.hypot(typical.factor * fit.sigma_px, steps.sigma_px)
    relative = fit.residual / np.maximum(fit.contrast, 1e-6)
    good = seen & fit.valid & (fit.contrast > 0.0) & (sigma < MAX_SIGMA_CELLS * side)
    allowed = MOVED_SIGMAS * np.hypot(sigma, typical.off_px * np.maximum(shape.gain, 1.0))
    good &= np.linalg.norm(pixels - shape.pixels, axis=1) < allowed
    good &= (relative < MAX_RELIT_RESIDUAL * typical.relative) & (was > TIMES_BETTER * relative)
    return pixels, sigma, np.asarray(good)


def _lit_unevenly(image: GreyImage, board: Board | None, pixels: FloatArray, cells: BoolArray) -> BoolArray:
    """Return which of the `cells` (R, C) of a board with corners `pixels` (R, C, 2) are lit unevenly."""
    shape = fit_cells(pixels, cells)
    ends = np.ones_like(cells)
    ends[1:-1, 1:-1] = False
    at = np.where(np.isfinite(pixels[cells]), pixels[cells], shape.pixels)
    out = cells.copy()
    out[cells] = beside_shadows(image, at, shape.sides, _uniform_distance(board, shape.sides), ends[cells])
    return out


def _uniform_distance(board: Board | None, sides: FloatArray) -> FloatArray:
    """Return the distance from the lines of a board within which its squares are uniform (N,), px."""
    if board is None or not isinstance(board.pattern, Charuco):
        return np.full(len(sides), RADIUS_PX)
    return 0.5 * gap_to_markers(board, sides)


def _near(even: BoolArray, suspect: BoolArray) -> BoolArray:
    """Return those of the cells `even` (R, C) that are near the `suspect` ones, or all if there are few."""
    reach = np.ones((2 * TYPICAL_WITHIN_CELLS + 1, 2 * TYPICAL_WITHIN_CELLS + 1), np.uint8)
    near = even & (cv2.dilate(suspect.astype(np.uint8), reach) > 0)
    return near if np.count_nonzero(near) >= MIN_EVEN else even


def _fitted_with_markers(
    image: GreyImage, board: Board, found: BoardDetection, refined: RefinedLattice, cells: BoolArray
) -> RefinedLattice:
    """Return `refined` with fits of about MAX_EVEN of the `cells` (R, C) in the image with markers, and of no others.

    Residuals of fits in an image with erased markers are not comparable with those of windows that show markers.
    """
    row, column = np.nonzero(cells)
    every = max(1, len(row) // MAX_EVEN)
    row, column = row[::every], column[::every]
    chosen = np.zeros_like(cells)
    chosen[row, column] = True
    pixels, signs = found.lattice(), refined.lattice.signs()
    shape, blur = fit_cells(pixels, chosen), FIRST_BLUR
    # The width of the windows depends on the initial blur.
    for _ in range(2):
        fit = fit_corners(image, board, chosen, shape, pixels[chosen], signs[chosen], blur)
        blur = upper_median(fit.blur)
    good = fit.valid & (fit.contrast > 0.0)
    row, column = row[good], column[good]
    sigma, blurs, residual, contrast = np.full((4, *cells.shape), np.nan)
    sigma[found.grid[:, 1], found.grid[:, 0]] = found.sigma_px
    factor = upper_median(sigma[row, column] / fit.sigma_px[good]) if good.any() else 1.0
    for values, seen in ((blurs, fit.blur), (residual, fit.residual), (contrast, fit.contrast)):
        values[row, column] = seen[good]
    lattice = replace(refined.lattice, contrast=contrast)
    part = replace(refined, lattice=lattice, blur_px=blurs, residual=residual)
    return replace(part, scatter=max(factor, 1.0), correlated=1.0)


def _typical(pixels: FloatArray, refined: RefinedLattice, even: BoolArray) -> _Typical:
    """Return the typical values of the corners `even` (R, C) of `pixels` (R, C, 2)."""
    blur, relative = upper_median(refined.blur_px[even]), upper_median(refined.relative_residual[even])
    ahead = fit_cells(pixels, even, **FLEXIBLE._asdict(), leave_out=True)
    off = np.linalg.norm(pixels[even] - ahead.pixels, axis=1) / np.hypot(1.0, ahead.gain)
    factor = refined.scatter * refined.correlated
    return _Typical(refined.lattice.signs(), blur, relative, factor, upper_median(off))
