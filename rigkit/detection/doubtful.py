"""A message on grids that `rigkit.detection.checks.evidence` rejects, for images without a detected board."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rigkit.core.arrays import upper_median
from rigkit.detection.checks.evidence import MIN_EXPECTED_CORNERS, Evidence
from rigkit.detection.fields import of_one_moment
from rigkit.detection.lattices import candidate_lattices
from rigkit.detection.saddles.bad_pixels import without_bad_pixels
from rigkit.detection.saddles.mosaic import without_mosaic
from rigkit.detection.saddles.response import grey_image
from rigkit.detection.searched_image import SearchedImage
from rigkit.detection.subpixel.refined import RefinedLattice
from rigkit.detection.subpixel.subpixel import refine

MIN_DOUBTFUL_SCORE = -7.0
"""Smallest evidence score of a grid that is reported. Boards with squares of under 6 px have scores down to -6.5."""

DOUBTFUL_SIGMA, DOUBTFUL_RESIDUAL, BLURRED_CELLS = 0.02, 0.15, 0.1
"""Sigma in squares and residual over contrast that few boards exceed, and the blur, in squares, that explains such a
sigma: they decide which cause is reported."""


def doubtful_grid(image: NDArray[np.generic]) -> str | None:
    """Return a message on the largest rejected grid of `image` that may be a board; None if there is none."""
    grey = without_bad_pixels(of_one_moment(without_mosaic(grey_image(image))))
    fitted = refine(grey, candidate_lattices(SearchedImage.of(grey), MIN_EXPECTED_CORNERS, lambda *_: True))
    large = (item for item in fitted if item.lattice.count >= MIN_EXPECTED_CORNERS)
    seen = [item for item in large if Evidence.of(item).score > MIN_DOUBTFUL_SCORE]
    if not seen:
        return None
    largest = max(seen, key=lambda item: item.lattice.count)
    columns, rows = largest.lattice.size
    sigma_px = upper_median(largest.worst_sigma_px[largest.lattice.known])
    return f"a {columns}x{rows} grid is seen, corners uncertain by {sigma_px:.1g} px: {_cause(largest, sigma_px)}"


def _cause(item: RefinedLattice, sigma_px: float) -> str:
    evidence = Evidence.of(item)
    blur_px = upper_median(item.blur_px[item.lattice.known])
    cell_px = sigma_px / max(evidence.sigma_cells * item.scatter, 1e-9)
    if evidence.sigma_cells > DOUBTFUL_SIGMA or blur_px > BLURRED_CELLS * cell_px:
        return "blurred" if blur_px > BLURRED_CELLS * cell_px else "small or noisy"
    if evidence.excess_residual > DOUBTFUL_RESIDUAL:
        return "its edges are not those of squares"
    return "its corners do not lie in smooth rows"
