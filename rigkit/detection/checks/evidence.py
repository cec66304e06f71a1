"""Classification of fitted lattices as chessboards or other patterns, by logistic regression.

No single measure separates boards from other patterns: a sharpening webcam gives residuals as large as those of dots, a
small or blurred board is as uncertain as a weave, and a strong lens spaces corners as unevenly as the stripes of a
tartan. Their combination does. The score is the log odds of a logistic regression (Hosmer and Lemeshow 2000, chapter 1)
on the logarithms of seven measures, each of which is smaller for boards. `scripts/measure_thresholds.py` repeats the
regression on rendered and real images and prints the scores of boards and other patterns.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from rigkit.core.arrays import upper_median
from rigkit.detection.lattice.local_fit import fit_cells
from rigkit.detection.lattice.spacing import spacing_changes
from rigkit.detection.subpixel.refined import RefinedLattice

MIN_MEASURE = 0.03
"""Lower bound of the excess residual, the change of spacing and the blur: smaller values are common to all sharp
frontal boards and are no further evidence."""

MIN_CONTRAST_CHANGE = 0.1
"""Lower bound of the change of contrast: light, noise and blur cause less on 99 % of 1174 boards."""

OF_NOISE = 0.1
"""Excess residuals below this share of the noise are not measurable: from some hundred pixels at each of fifty corners
the variance of the noise is known to a hundredth."""

SCORE = {
    "sigma_cells": -3.2,
    "scatter": -1.9,
    "excess_residual": -2.7,
    "spacing_change": -0.25,
    "contrast_change": -3.6,
    "raggedness": -4.0,
    "blur_cells": -3.2,
}
OFFSET = -38.5
"""Weights of the logarithms, and the intercept: maximum a posteriori for a zero-mean Gaussian prior on the weights of
standardised measures, of standard deviation 70 over the root of the number of lattices. Weights are not positive, and
that of raggedness is at least -4, so that a hand may cover a third of a board.

The data are 1545 lattices of boards of 27 REAL sets, four fifths of them blurred, noisy, compressed, sharpened, faint,
shrunk, covered or cut, and 276 lattices of other patterns. The weight of the change of contrast is that of another fit,
to 1174 lattices of boards and 1303 of other patterns found on any level of the pyramid; the intercept is such that
lattices without such a change score as before. Of these no other pattern is accepted (in original images they score at
most -1.8), and three boards are rejected, in degraded images (in original ones they score at least 0.9)."""

OF_EXPECTED_SIZE, MIN_EXPECTED_CORNERS = 4.0, 20
"""Increase of the score of a lattice of at least MIN_EXPECTED_CORNERS corners with the size of a listed board: the log
ratio of the frequencies of that size among boards and other patterns. Of 75 lattices of other patterns at most 1 has
the size of a common board (9 x 6, 7 x 10), and 3 have 6 x 4 corners; smaller ones have any size."""

OF_WHOLE = 3.0
"""Further increase if such a lattice lacks no corner, of which raggedness counts a part. Of 935 lattices of other
patterns with 20 corners or more (RENDERED, and REAL photographs, sharp, blurred and moved) 5 are whole, of 612 with 30
or more none. Small boards in motion or of interlaced lines, which need it, mostly are."""


class Evidence(NamedTuple):
    """The measures of a lattice; (upper) medians over its corners.

    Attributes
    ----------
    sigma_cells : standard deviation of a corner if all residuals were noise, in sides of a cell, before it is raised
        by `scatter`.
    scatter : the factor by which sigmas are raised for the scatter about the lattice.
    excess_residual : rms residual in excess of the noise, or OF_NOISE of it, relative to the contrast. Where there is
        no corner, the fit finds one of little contrast, and noise that explains all residuals.
    spacing_change : difference of successive steps along rows or columns, whichever is larger, relative to the shorter
        step; 0 without three successive corners.
    contrast_change : difference of the logarithms of the contrasts of neighbouring corners, 0 without neighbours: ink
        and light of a board are nearly the same at both, and where there is no corner any contrast is found.
    raggedness : rows times columns over the number of corners, at least 1: boards are rectangles, and periodic patterns
        are found in patches.
    blur_cells : s of the edges in sides of a cell: with more blur squares and dots look more alike.
    """

    sigma_cells: float
    scatter: float
    excess_residual: float
    spacing_change: float
    contrast_change: float = MIN_CONTRAST_CHANGE
    raggedness: float = 1.0
    blur_cells: float = MIN_MEASURE

    @classmethod
    def of(cls, refined: RefinedLattice) -> Evidence:
        """Return the evidence of a lattice with at least one corner."""
        lattice = refined.lattice
        at = lattice.known.reshape(-1).nonzero()[0]
        every = (lattice.contrast, refined.residual, refined.noise, refined.worst_sigma_px, refined.blur_px)
        # values[known] takes five times as long.
        contrast, residual, noise, sigma_px, blur_px = (values.reshape(-1)[at] for values in every)
        beyond_noise = (residual**2 - (1.0 - OF_NOISE**2) * noise**2) / contrast**2
        cell_px = np.sqrt(np.maximum(fit_cells(lattice.pixels, lattice.known, degree=1).areas(), 1e-6))
        changes = [change.every for change in spacing_changes(lattice.pixels) if np.isfinite(change.every)]
        logs = np.log(lattice.contrast)
        steps = np.abs(np.concatenate([(logs[1:] - logs[:-1]).reshape(-1), (logs[:, 1:] - logs[:, :-1]).reshape(-1)]))
        steps = steps[np.isfinite(steps)]
        return cls(
            upper_median(sigma_px / (refined.scatter * cell_px)),
            refined.scatter,
            math.sqrt(max(upper_median(beyond_noise), 0.0)),
            max(changes, default=0.0),
            upper_median(steps) if len(steps) else 0.0,
            lattice.known.size / lattice.count,
            upper_median(blur_px / cell_px),
        )

    def logarithms(self) -> list[float]:
        """Return the logarithms of the measures, not below their lower bounds, in the order of SCORE."""
        lowest = [1e-9, 1.0, MIN_MEASURE, MIN_MEASURE, MIN_CONTRAST_CHANGE, 1.0, MIN_MEASURE]
        return [math.log(max(pair)) for pair in zip(self, lowest, strict=True)]

    @property
    def score(self) -> float:
        """Log odds of a board against another pattern."""
        return OFFSET + sum(weight * part for weight, part in zip(SCORE.values(), self.logarithms(), strict=True))
