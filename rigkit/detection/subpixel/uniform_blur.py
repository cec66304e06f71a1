"""Images in which a board is blurred alike in all directions, by about as much as its fit is made for.

A camera that moves blurs edges across its way and leaves those along it sharp; one far out of focus blurs by more than
windows reach. Corners are placed by edges of one blur. Where a board's is of another shape, or too wide, the image is
resampled so that it is even: across the motion it is stretched, along it made smaller, and nothing is lost of what blur
has left. To the fit the board is one that is seen aslant.
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

LOOKED_AT_PX = 1.5
"""Boards whose edges are as wide, s, are looked at: below, a motion is less than twice the blur that it is added to."""

UNEVEN_WIDTHS, WIDE_PX = 1.5, 4.0
"""Blur is made even where its s in one direction is so many times that in the other; or so many px: noise that
was there before the blur, and what the print and the codec do, is then alike over more pixels than `correlation` looks
at, and windows begin to end within the edges."""

WINDOW_BLURS = 5.0
"""Windows reach so many s, at least: at three there is the end of an edge."""

SHARPEST_PX, SQUARE_PX = 1.5, 9.0
"""Smallest s that it is made, and the smallest square, as far as that is not smaller in the image itself: as of
`whole_board`."""

MIN_WIDTH_PX, MAX_WIDTH_CELLS = 0.5, 0.3
"""No lens and pixel blur by less; what is measured across a long motion may be anything below. Nor is blur wider than
this, in squares, while these can be told: what is measured of a motion along the squares may be anything above."""


def with_uniform_blur(image: GreyImage, lattice: Lattice, refined: RefinedLattice) -> Resampled | None:
    """Return the part of `image` around a board with its blur made even; None where that is so, or nearly.

    `lattice` : its corners as they were found; `refined` : what the fit with even blur made of them.
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
    # Symmetric: what is upright stays nearly so.
    per_blur = (axes / widths) @ axes.T
    sides = np.linalg.norm(shape.sides @ per_blur.T, axis=2)
    square = float(np.quantile(sides, 0.1))
    even = max(SHARPEST_PX, min(SQUARE_PX / square, float(widths[1])))
    # As large as in the image, where windows there are large enough.
    radius_px = max(even / float(np.sqrt(widths.prod())) * LAST_PASS[0], WINDOW_BLURS * even)
    return resampled(image, lattice, even * per_blur, min(radius_px, LAST_PASS[0]))
