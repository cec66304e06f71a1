"""Whether a fitted lattice is a chessboard: one judgement of all that the fit says for and against it.

No single measure tells boards from what resembles them: a webcam that sharpens leaves residuals as large as dots do, a
small or blurred board is as uncertain as a weave, and a strong lens spaces corners as unevenly as the stripes of a
tartan. Their product does. The score is the log odds of a logistic regression (Hosmer and Lemeshow 2000, chapter 1) on
the logarithms of five measures, each of which falls for boards; `scripts/measure_thresholds.py` fits it again on
rendered and real images and prints how far boards and other patterns lie from 0.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rigkit.core.arrays import upper_median
from rigkit.detection.lattice.local_fit import fit_cells
from rigkit.detection.lattice.spacing import spacing_changes
from rigkit.detection.subpixel.subpixel import RefinedLattice

__all__ = ["Evidence"]

EXPLAINED_NOISE = 10.0
"""Residuals of so many grey levels may be noise of the camera and speak against no board."""

MIN_UNEXPLAINED, MIN_SPACING_CHANGE = 0.03, 0.03
"""Smaller values are those of any sharp board seen straight on, and speak no further for it."""

SCORE = {"sigma_cells": -3.4, "scatter": -1.0, "unexplained": -1.44, "spacing_change": -0.89, "raggedness": -2.0}
OFFSET = -23.1
"""Weights of the logarithms, and what is added to them. Of 196 boards with squares of 6 px and more, blurred, small,
sharpened and in strong lenses, the one seen worst scores 0.1. All of 26 with smaller squares, in the background of
images of another board, score -6.5 to -0.6, as dots do, and are refused.
Of 33 other patterns the highest scores -2.8; of 120 pages of discs of 7 px that nearly touch, every second row moved by
half a step, the worst scored -0.4, the usual ones -1.9."""


class Evidence(NamedTuple):
    """What the fit says of a lattice; (upper) medians over its corners.

    Attributes
    ----------
    sigma_cells : standard deviation of a corner if all that the fit leaves were noise, in sides of a cell, before it is
        raised for the scatter about the lattice.
    scatter : the factor by which it is raised.
    unexplained : RMS of the residual beyond EXPLAINED_NOISE, relative to the contrast.
    spacing_change : difference of neighbouring steps along rows or columns, whichever is larger, relative to the
        shorter step; 0 where no three corners follow each other.
    raggedness : places in the rows and columns over corners that are there, at least 1: boards are rectangles, and
        patterns that go on for ever are found in patches.
    """

    sigma_cells: float
    scatter: float
    unexplained: float
    spacing_change: float
    raggedness: float = 1.0

    @classmethod
    def of(cls, refined: RefinedLattice) -> Evidence:
        """Return the evidence of a lattice with at least one corner."""
        lattice = refined.lattice
        known = lattice.known
        contrast = lattice.contrast[known]
        beyond_noise = (refined.residual[known] ** 2 - EXPLAINED_NOISE**2) / contrast**2
        cell_px = np.sqrt(np.maximum(fit_cells(lattice.pixels, known, degree=1).areas(), 1e-6))
        sigma_cells = refined.worst_sigma_px[known] / (refined.scatter * cell_px)
        changes = [change.every for change in spacing_changes(lattice.pixels) if np.isfinite(change.every)]
        unexplained = float(np.sqrt(max(upper_median(beyond_noise), 0.0)))
        return cls(
            upper_median(sigma_cells),
            refined.scatter,
            unexplained,
            max(changes, default=0.0),
            known.size / lattice.count,
        )

    @property
    def score(self) -> float:
        """Log odds for a board: positive where the evidence speaks for one."""
        measures = {
            "sigma_cells": max(self.sigma_cells, 1e-9),
            "scatter": self.scatter,
            "unexplained": max(self.unexplained, MIN_UNEXPLAINED),
            "spacing_change": max(self.spacing_change, MIN_SPACING_CHANGE),
            "raggedness": self.raggedness,
        }
        return OFFSET + sum(weight * float(np.log(measures[name])) for name, weight in SCORE.items())
