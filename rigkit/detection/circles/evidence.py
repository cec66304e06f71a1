"""Evidence for and against a lattice of blobs being a grid of circles."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rigkit.detection.circles.fit import CircleFit
from rigkit.detection.saddles.response import GreyImage
from rigkit.optim.robust_scale import MEDIAN_OF_NORMAL

UNEXPLAINED, MISSHAPEN, DISPLACED, CORNERED, MAX_IMPLAUSIBILITY = 0.17, 0.08, 0.04, 0.03, 1.4
"""Scales of `GridEvidence`, and the largest sum of squares in these of a grid. Those of two REAL boards reach 0.150
(sharpened), 0.055, 0.029 (motion of 6 px), 0.023 (ink that spreads by 2 px) and a sum of 1.2, in eleven kinds of worse
images. Of 1267 pictures without a grid (RENDERED patterns, as they are and worse) two out of focus have 1.21 and 1.25,
tiles of a floor and a weave, and pass; all others 2.1 and more, 100 photographs (REAL, worse too) 2.4 and more.
`scripts/measure_thresholds.py --circles` measures both."""

SECOND_LOOK = 2.0
"""Factor of the limit for lattices that are judged again after a fit with the anisotropy of the blur and the
neighbours' light, and by which the limit is then lower, as other patterns fit better, too (cloth out of focus: 1.5 for
1.7). Of a REAL grid in motion of 8 px it finds 336 circles where the first fits left 28, with a sum of 2.1 and then
0.45."""

OCTAGONAL = 3.0
"""Weight of the harmonics 7 and 8 of the edge over those below: of two REAL grids, as they are and in 18 kinds of worse
images, they reach 0.003 radii, those below 0.02; octagons (RENDERED, blurred by 2 px) have 0.025."""

CORE, CORE_BLURS, LAPLACIAN_PX = 0.5, 2.0, 1.5
"""Part of a circle's radius within which noise is measured, if the edge is further away than so many s of its blur and
the reach of the filter, px."""

LAPLACIANS = np.array([[1.0, -2.0, 1.0], [-2.0, 4.0, -2.0], [1.0, -2.0, 1.0]])
"""The difference of two Laplacians, which is 0 in even light and 6 times the noise (Immerkaer 1996)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class GridEvidence:
    """Deviations of a lattice from a grid of circles in a plane; medians over its circles.

    Attributes
    ----------
    unexplained : RMS residual in excess of the noise (`noise_levels`), over contrast.
    misshapen : differences of size and slant from the predictions by neighbours, in radii.
    displaced : distance from the place predicted by neighbours, in distances of neighbours.
    corners : largest amplitude in radii of the edge's harmonics 3 to 8, the means over all circles, 7 and 8 weighted by
        OCTAGONAL: squares have 0.15, octagons 0.08.
    """

    unexplained: float
    misshapen: float
    displaced: float
    corners: float

    @property
    def implausibility(self) -> float:
        """Return the sum of squares of all deviations, in their scales."""
        off = (self.unexplained / UNEXPLAINED, self.misshapen / MISSHAPEN, self.displaced / DISPLACED)
        return sum(part * part for part in (*off, self.corners / CORNERED))

    @property
    def convincing(self) -> bool:
        return self.implausibility < MAX_IMPLAUSIBILITY

    @property
    def may_convince(self) -> bool:
        return self.implausibility < SECOND_LOOK * MAX_IMPLAUSIBILITY

    @property
    def convinces_late(self) -> bool:
        return self.implausibility < MAX_IMPLAUSIBILITY / SECOND_LOOK


def noise_levels(grey: GreyImage, fit: CircleFit) -> float:
    """Return the standard deviation of the noise of pixels inside circles, 0 if these are too small to tell."""
    narrow = np.linalg.svd(fit.maps, compute_uv=False)[:, 1]
    large = (1.0 - CORE) * narrow > CORE_BLURS * fit.blur_px + LAPLACIAN_PX
    if not large.any():
        return 0.0
    inside = CORE * np.stack(np.meshgrid(*2 * [np.linspace(-0.7, 0.7, 5)]), axis=-1).reshape(-1, 2)
    places = fit.pixels[large, None] + inside @ np.swapaxes(fit.maps[large], 1, 2)
    column, row = np.rint(places).astype(np.int64).reshape(-1, 2).T
    height, width = grey.shape
    column, row = column.clip(1, width - 2), row.clip(1, height - 2)
    total = np.zeros(len(row))
    for (down, along), weight in np.ndenumerate(LAPLACIANS):
        total += weight * grey[row + down - 1, column + along - 1]
    return float(np.median(np.abs(total))) / (6.0 * MEDIAN_OF_NORMAL)
