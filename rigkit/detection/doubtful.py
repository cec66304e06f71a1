"""What is seen but not trusted: grids that the judgement of `rigkit.detection.checks.evidence` refuses, in words."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rigkit.core.arrays import FloatArray, upper_median
from rigkit.detection.checks.evidence import Evidence
from rigkit.detection.lattices import Seen, candidates
from rigkit.detection.saddles.bad_pixels import without_bad_pixels
from rigkit.detection.saddles.mosaic import without_mosaic
from rigkit.detection.saddles.response import grey_image
from rigkit.detection.subpixel.refined import RefinedLattice
from rigkit.detection.subpixel.subpixel import refine

MIN_DOUBTFUL_CORNERS = 20
"""Chance makes smaller grids out of anything."""

MIN_DOUBTFUL_SCORE = -7.0
"""Boards in the background with squares of under 6 px have scores down to -6.5; so have grids of dots, which are only
said to be seen."""

DOUBTFUL_SIGMA, DOUBTFUL_RESIDUAL, BLURRED_CELLS = 0.02, 0.15, 0.1
"""What is named as the cause: a sigma, in squares, and a residual, relative to the contrast, that few boards exceed;
the first comes from blur where that is as wide as this, in squares."""


def doubtful_grid(image: NDArray[np.generic]) -> str | None:
    """Return what is said of the largest grid of `image` that may be a board but is not taken for one; None without.

    For images in which no board was found.
    """
    grey = without_bad_pixels(without_mosaic(grey_image(image)))
    seen = [
        item for item in refine(grey, candidates(Seen.of(grey), MIN_DOUBTFUL_CORNERS, lambda *_: True)) if _worth(item)
    ]
    if not seen:
        return None
    largest = max(seen, key=lambda item: item.lattice.count)
    columns, rows = largest.lattice.size
    sigma_px = upper_median(_known(largest, largest.worst_sigma_px))
    return f"a {columns}x{rows} grid is seen, corners uncertain by {sigma_px:.1g} px: {_cause(largest)}"


def _worth(item: RefinedLattice) -> bool:
    return item.lattice.count >= MIN_DOUBTFUL_CORNERS and Evidence.of(item).score > MIN_DOUBTFUL_SCORE


def _cause(item: RefinedLattice) -> str:
    evidence = Evidence.of(item)
    blur_px = upper_median(_known(item, item.blur_px))
    cell_px = upper_median(_known(item, item.worst_sigma_px)) / max(evidence.sigma_cells * item.scatter, 1e-9)
    if evidence.sigma_cells > DOUBTFUL_SIGMA or blur_px > BLURRED_CELLS * cell_px:
        return "blurred" if blur_px > BLURRED_CELLS * cell_px else "small or noisy"
    if evidence.excess_residual > DOUBTFUL_RESIDUAL:
        return "its edges are not those of squares"
    return "its corners do not lie in smooth rows"


def _known(item: RefinedLattice, values: FloatArray) -> FloatArray:
    return values[item.lattice.known]
