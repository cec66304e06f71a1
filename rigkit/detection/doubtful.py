"""A message on grids that no finder reads, or that are rejected as too doubtful, for images without a board."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rigkit.core.arrays import upper_median
from rigkit.detection.checks.evidence import MIN_EXPECTED_CORNERS, Evidence
from rigkit.detection.circles.evidence import DISPLACED, MISSHAPEN
from rigkit.detection.circles.search import CircleSearch
from rigkit.detection.fields import of_one_moment
from rigkit.detection.lattices import candidate_lattices
from rigkit.detection.saddles.bad_pixels import without_bad_pixels
from rigkit.detection.saddles.mosaic import without_mosaic
from rigkit.detection.saddles.response import GreyImage, grey_image
from rigkit.detection.searched_image import SearchedImage
from rigkit.detection.subpixel.refined import RefinedLattice
from rigkit.detection.subpixel.subpixel import refine

MIN_DOUBTFUL_SCORE = -7.0
"""Smallest evidence score of a grid that is reported. Boards with squares of under 6 px have scores down to -6.5."""

DOUBTFUL_SIGMA, DOUBTFUL_RESIDUAL, BLURRED_CELLS = 0.02, 0.15, 0.1
"""Sigma in squares and residual over contrast that few boards exceed, and the blur, in squares, that explains such a
sigma: they decide which cause is reported."""

SQUARES_CORNERS = 0.12, 0.18
"""Range of `GridEvidence.corners` of separate squares, whose harmonic of order 4 is 0.152 radii (RENDERED, slanted:
0.152 to 0.153); of patterns without a board whose lattices are as regular, panels have 0.09 to 0.10."""


def doubtful_grid(image: NDArray[np.generic]) -> str | None:
    """Return a message on the largest rejected grid of `image` that may be a board, or on a grid of separate squares;
    None if there is none."""
    grey = without_bad_pixels(of_one_moment(without_mosaic(grey_image(image))))
    fitted = refine(grey, candidate_lattices(SearchedImage.of(grey), MIN_EXPECTED_CORNERS, lambda *_: True))
    large = (item for item in fitted if item.lattice.count >= MIN_EXPECTED_CORNERS)
    seen = [item for item in large if Evidence.of(item).score > MIN_DOUBTFUL_SCORE]
    if not seen:
        return _separate_squares(grey)
    largest = max(seen, key=lambda item: item.lattice.count)
    columns, rows = largest.lattice.size
    sigma_px = upper_median(largest.worst_sigma_px[largest.lattice.known])
    return f"a {columns}x{rows} grid is seen, corners uncertain by {sigma_px:.1g} px: {_cause(largest, sigma_px)}"


def _separate_squares(grey: GreyImage) -> str | None:
    """Return a message on a whole grid of squares that do not meet; None if there is none."""
    least, most = SQUARES_CORNERS
    for grid in CircleSearch(grey).seen(coarse=True, whole=True):
        rows, columns = sorted((np.ptp(grid.label, axis=0) + 1).tolist())
        evidence = grid.evidence
        regular = evidence.misshapen < MISSHAPEN and evidence.displaced < DISPLACED
        if regular and least < evidence.corners < most and len(grid) == rows * columns and not grid.hexagonal:
            what = f"a grid of {columns} x {rows} separate squares is seen"
            return f"{what}, which is no target of rigkit: print one with 'rigkit board', such as a chessboard"
    return None


def _cause(item: RefinedLattice, sigma_px: float) -> str:
    evidence = Evidence.of(item)
    blur_px = upper_median(item.blur_px[item.lattice.known])
    cell_px = sigma_px / max(evidence.sigma_cells * item.scatter, 1e-9)
    if evidence.sigma_cells > DOUBTFUL_SIGMA or blur_px > BLURRED_CELLS * cell_px:
        return "blurred" if blur_px > BLURRED_CELLS * cell_px else "small or noisy"
    if evidence.excess_residual > DOUBTFUL_RESIDUAL:
        return "its edges are not those of squares"
    return "its corners do not lie in smooth rows"
