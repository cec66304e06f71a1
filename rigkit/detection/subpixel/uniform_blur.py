"""Resampling of an image so that a board has isotropic blur, of a width that suits the edge model.

Motion blurs edges across its direction only; strong defocus blurs by more than the size of the windows. The edge model
assumes isotropic blur. A board with anisotropic or wide blur is therefore resampled: stretched across the motion and
shrunk along it, without loss of information. For the fit it is then a board in an oblique view.
"""

from __future__ import annotations

import numpy as np

from rigkit.core.arrays import known_median
from rigkit.detection.lattice.lattice import Lattice
from rigkit.detection.lattice.local_fit import fit_cells
from rigkit.detection.saddles.response import GreyImage
from rigkit.detection.subpixel.blur_shape import blur_covariance
from rigkit.detection.subpixel.refined import RefinedLattice
from rigkit.detection.subpixel.resampled import Resampled, resampled
from rigkit.detection.subpixel.subpixel import LAST_PASS
from rigkit.detection.subpixel.whole_board import MIN_BLUR_OF_BOARD, MIN_SQUARE

LOOKED_AT_PX = 1.5
"""Smallest s of boards that are examined: below, motion is less than twice the other blur."""

UNEVEN_WIDTHS, WIDE_PX = 1.5, 4.0
"""Boards are resampled if the ratio of the largest to the smallest s exceeds UNEVEN_WIDTHS, or the largest s WIDE_PX.
For wide blur, noise from before the blur, print and codec is correlated over more pixels than `correlation` considers,
and edges extend beyond the windows."""

WINDOW_BLURS = 5.0
"""Smallest radius of the windows in s; edges extend to three s."""

MIN_WIDTH_PX, MAX_WIDTH_CELLS = 0.5, 0.3
"""Bounds of s: lens and pixels cause a larger one, which is not measurable across a long motion; and s is at most this
many squares as long as these are visible, which is not measurable for motion along the squares."""


def with_uniform_blur(image: GreyImage, lattice: Lattice, refined: RefinedLattice) -> Resampled | None:
    """Return the part of `image` around a board, resampled for isotropic blur; None if the blur is nearly isotropic.

    `lattice` : its corners before the fit; `refined` : their fit in the image.
    """
    blur = known_median(refined.blur_px) if refined.lattice.count else 0.0
    if not blur > LOOKED_AT_PX:
        return None
    variances, axes = np.linalg.eigh(blur_covariance(image, lattice, blur))
    shape = fit_cells(lattice.pixels, lattice.known)
    widths = np.sqrt(variances).clip(
        MIN_WIDTH_PX, max(MAX_WIDTH_CELLS * float(np.median(shape.cell_px())), MIN_WIDTH_PX)
    )
    if widths[1] < UNEVEN_WIDTHS * widths[0] and widths[1] < WIDE_PX:
        return None
    # A symmetric matrix, which hardly rotates the board.
    per_blur = (axes / widths) @ axes.T
    sides = np.linalg.norm(shape.sides @ per_blur.T, axis=2)
    square = float(np.quantile(sides, 0.1))
    # Unless squares are smaller in the image.
    even = max(MIN_BLUR_OF_BOARD, min(MIN_SQUARE / square, float(widths[1])))
    # Windows of the same area as in the image, if these are large enough.
    radius_px = max(even / float(np.sqrt(widths.prod())) * LAST_PASS[0], WINDOW_BLURS * even)
    return resampled(image, lattice, even * per_blur, min(radius_px, LAST_PASS[0]))
