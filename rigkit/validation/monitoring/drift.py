"""The dependence of a monitored amount on temperature, over months."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rigkit.core.arrays import FloatArray

MIN_ENTRIES = 3
"""Two points always lie on a line, whatever their errors."""
MIN_RANGE_C = 1.0
"""Temperatures within a smaller range are constant: those of one room."""


@dataclass(frozen=True, slots=True)
class HeatDrift:
    """The straight line amount = `at_mean` + `per_degree` (T - `mean_c`), with the standard deviation `sigma` of its
    slope, and the p-value `chance` of the slope."""

    mean_c: float
    at_mean: float
    per_degree: float
    sigma: float
    chance: float

    def at(self, temperature_c: FloatArray) -> FloatArray:
        """Return the amounts on the line."""
        return np.asarray(self.at_mean + self.per_degree * (temperature_c - self.mean_c))


def heat_drift(temperature_c: FloatArray, value: FloatArray, sigma: FloatArray) -> HeatDrift | None:
    """Return the weighted least-squares line through amounts (N,) with their standard deviations; None for fewer than
    three or for temperatures within a degree. Residuals larger than the standard deviations state inflate the standard
    deviation of the slope."""
    if len(value) < MIN_ENTRIES or np.ptp(temperature_c) < MIN_RANGE_C or not (sigma > 0.0).all():
        return None
    # Imported here: registers without temperatures are shown without it.
    from scipy.special import stdtr

    weight = sigma**-2.0
    mean, middle = (float((weight * x).sum() / weight.sum()) for x in (temperature_c, value))
    deviation_c = temperature_c - mean
    spread = float((weight * deviation_c**2).sum())
    slope = float((weight * deviation_c * value).sum()) / spread
    freedom = len(value) - 2
    excess = float((weight * (value - middle - slope * deviation_c) ** 2).sum()) / freedom
    own = float(np.sqrt(max(excess, 1.0) / spread))
    return HeatDrift(mean, middle, slope, own, float(2.0 * stdtr(freedom, -abs(slope) / own)))
