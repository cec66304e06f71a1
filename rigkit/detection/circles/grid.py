"""A grid of circles as it is seen in an image."""

from __future__ import annotations

from dataclasses import dataclass

from rigkit.core.arrays import FloatArray, IntArray
from rigkit.detection.circles.evidence import GridEvidence


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class CircleGrid:
    """Circles of one lattice, sorted by label.

    Attributes
    ----------
    label : (N, 2) places in the lattice (`lattices.LabelledBlobs`), from (0, 0).
    pixels, sigma_px : (N, 2) and (N,) images of the centres.
    maps : (N, 2, 2) px per radius.
    hexagonal : whether the second direction is at 60 degrees to the first, not at 90.
    bright : whether the circles are brighter than the sheet.
    radius : of the printed circles, in distances of neighbours.
    blur_px, contrast, share : typical blur of an edge, contrast in grey levels, and contrast relative to the brighter
        of circle and sheet.
    uneven_px2 : (2,) anisotropy of the blur (`fit_circles`).
    empty : (K, 2) places beside these circles that are visible in the image, without a circle.
    evidence : how well the lattice agrees with a grid.
    """

    label: IntArray
    pixels: FloatArray
    sigma_px: FloatArray
    maps: FloatArray
    hexagonal: bool
    bright: bool
    radius: float
    blur_px: float
    contrast: float
    share: float
    uneven_px2: FloatArray
    empty: IntArray
    evidence: GridEvidence

    def __len__(self) -> int:
        return len(self.label)
