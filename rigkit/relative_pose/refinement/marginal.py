"""Quality and weight of a residual marginalised over an unknown noise level, without an inlier threshold.

The quality of a residual r, in sigmas, is the mean of max(0, 1 - (r / (k s))^2) over the noise levels s between 1 and
`max_noise`, with k the 99 % quantile. Reference: Barath, Noskova, Matas ("MAGSAC++").
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rigkit.core.arrays import FloatArray

QUANTILE = 2.576
"""99 % quantile of |r| for a standard normal r. As in kernels/pose.c."""


def marginal_quality(r: FloatArray, max_noise: FloatArray | float) -> FloatArray:
    """Return the quality (0 to 1) of residuals in sigmas; `max_noise` > 1 may be an array that broadcasts with `r`."""
    rho = np.abs(r) / QUANTILE
    far = (max_noise - np.minimum(rho, max_noise)) ** 2 / (max_noise * (max_noise - 1.0))
    return np.asarray(np.where(rho <= 1.0, 1.0 - rho**2 / max_noise, far))


def marginal_weights(r: FloatArray, max_noise: FloatArray | float) -> FloatArray:
    """Return the weights -q'(r) / r up to a factor: 1 for small residuals, 0 beyond the highest noise level."""
    low = np.clip(np.abs(r) / QUANTILE, 1.0, max_noise)
    return np.asarray((max_noise - low) / ((max_noise - 1.0) * low))


@dataclass(frozen=True, slots=True)
class MarginalLoss:
    """The marginal weights at one noise level, for `refine_pose`."""

    max_noise: float

    def __call__(self, r: FloatArray) -> FloatArray:
        """Return the weights of residuals in sigmas."""
        return marginal_weights(r, self.max_noise)
