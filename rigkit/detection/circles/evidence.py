"""Evidence for and against a lattice of blobs being a grid of circles."""

from __future__ import annotations

from dataclasses import dataclass

UNEXPLAINED, MISSHAPEN, DISPLACED, CORNERED, MAX_IMPLAUSIBILITY = 0.17, 0.08, 0.04, 0.03, 1.4
"""Scales of `GridEvidence`, and the largest sum of squares in these of a grid. Those of two REAL boards reach 0.150
(sharpened), 0.055, 0.029 (motion of 6 px), 0.023 (ink that spreads by 2 px) and a sum of 1.2, in eleven kinds of worse
images. Of 625 pictures without a grid (REAL photographs, RENDERED patterns; sharp, sharpened, blurred, moved) the
nearest, solar panels, cloth and a trellis under motion, have 2.0, 2.4 and 3.1; of 100 photographs (REAL, 400 looks) one
blurred by 2 px has 1.62, in 14 blobs, all others more than 3. The limit is in the middle.
`scripts/measure_thresholds.py --circles` measures both."""


@dataclass(frozen=True, slots=True, kw_only=True)
class GridEvidence:
    """Deviations of a lattice from a grid of circles in a plane; medians over its circles.

    Attributes
    ----------
    unexplained : RMS residual over contrast.
    misshapen : differences of size and slant from the predictions by neighbours, in radii.
    displaced : distance from the place predicted by neighbours, in distances of neighbours.
    corners : amplitude in radii of the edge's harmonics 3 to 6, the mean over all circles: squares have 0.15.
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
