"""Whether a fitted lattice is a chessboard: one judgement of all that the fit says for and against it.

No single measure tells boards from what resembles them: a webcam that sharpens leaves residuals as large as dots do, a
small or blurred board is as uncertain as a weave, and a strong lens spaces corners as unevenly as the stripes of a
tartan. Their product does. The score is the log odds of a logistic regression (Hosmer and Lemeshow 2000, chapter 1) on
the logarithms of six measures, each of which falls for boards; `scripts/measure_thresholds.py` fits it again on
rendered and real images and prints how far boards and other patterns lie from 0.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from rigkit.core.arrays import upper_median
from rigkit.detection.lattice.local_fit import fit_cells
from rigkit.detection.lattice.spacing import spacing_changes
from rigkit.detection.subpixel.refined import RefinedLattice

MIN_EXCESS_RESIDUAL, MIN_SPACING_CHANGE, MIN_BLUR = 0.03, 0.03, 0.03
"""Smaller values are those of any sharp board seen straight on, and speak no further for it."""

SCORE = {
    "sigma_cells": -3.2,
    "scatter": -1.9,
    "excess_residual": -2.7,
    "spacing_change": -0.25,
    "raggedness": -4.0,
    "blur_cells": -3.2,
}
OFFSET = -30.2
"""Weights of the logarithms, and what is added to them: the most probable ones if each is known beforehand to be 0,
with a standard deviation of 70 over the root of the number of lattices, of measures of standard deviation 1; never
positive, and that of raggedness not beyond -4, so that a hand may cover a third of a board.

From 1545 lattices of boards of 27 real sets, four fifths of them blurred, noisy, compressed, sharpened, faint, shrunk,
covered or cut, and 276 of other patterns. As taken, boards score 0.7 and more and all but one of the others -1.9 and
less: a page of 1304 discs of 7 px that nearly touch, every second row moved by half a step, -0.6. With what was done to
the images 10 boards are refused, smeared and shrunk ones, and no other pattern is taken for one."""

OF_EXPECTED_SIZE, MIN_EXPECTED_CORNERS = 4.0, 20
"""What the score grows by where a lattice of so many corners has the rows and columns of a board that may be there: the
logarithm of how much rarer that is among other patterns. Of 75 lattices of these 1 or none has the size of a board in
use (9 x 6, 7 x 10), 3 have 6 x 4 corners; smaller ones chance makes in any size."""


class Evidence(NamedTuple):
    """What the fit says of a lattice; (upper) medians over its corners.

    Attributes
    ----------
    sigma_cells : standard deviation of a corner if all that the fit leaves were noise, in sides of a cell, before it is
        raised for the scatter about the lattice.
    scatter : the factor by which it is raised.
    excess_residual : RMS of what the fit leaves beyond the noise, and so on both sides of the corner alike, relative to
    the
        contrast.
    spacing_change : difference of neighbouring steps along rows or columns, whichever is larger, relative to the
        shorter step; 0 where no three corners follow each other.
    raggedness : places in the rows and columns over corners that are there, at least 1: boards are rectangles, and
        patterns that go on for ever are found in patches.
    blur_cells : width of the edges, in sides of a cell: the wider, the less there is to tell squares from dots by.
    """

    sigma_cells: float
    scatter: float
    excess_residual: float
    spacing_change: float
    raggedness: float = 1.0
    blur_cells: float = MIN_BLUR

    @classmethod
    def of(cls, refined: RefinedLattice) -> Evidence:
        """Return the evidence of a lattice with at least one corner."""
        lattice = refined.lattice
        known = lattice.known
        contrast = lattice.contrast[known]
        beyond_noise = (refined.residual[known] ** 2 - refined.noise[known] ** 2) / contrast**2
        cell_px = np.sqrt(np.maximum(fit_cells(lattice.pixels, known, degree=1).areas(), 1e-6))
        sigma_cells = refined.worst_sigma_px[known] / (refined.scatter * cell_px)
        changes = [change.every for change in spacing_changes(lattice.pixels) if np.isfinite(change.every)]
        excess_residual = float(np.sqrt(max(upper_median(beyond_noise), 0.0)))
        return cls(
            upper_median(sigma_cells),
            refined.scatter,
            excess_residual,
            max(changes, default=0.0),
            known.size / lattice.count,
            upper_median(refined.blur_px[known] / cell_px),
        )

    @property
    def score(self) -> float:
        """Log odds for a board: positive where the evidence speaks for one."""
        measures = {
            "sigma_cells": max(self.sigma_cells, 1e-9),
            "scatter": self.scatter,
            "excess_residual": max(self.excess_residual, MIN_EXCESS_RESIDUAL),
            "spacing_change": max(self.spacing_change, MIN_SPACING_CHANGE),
            "raggedness": self.raggedness,
            "blur_cells": max(self.blur_cells, MIN_BLUR),
        }
        return OFFSET + sum(weight * math.log(measures[name]) for name, weight in SCORE.items())
