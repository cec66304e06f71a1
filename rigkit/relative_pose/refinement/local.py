"""Residuals, qualities and local optimisation of many pose hypotheses for one set of matches.

The local optimisation is Levenberg-Marquardt on rotation and direction under the marginalised loss, with the sigma of
each Sampson distance fixed during a step. It serves to choose among hypotheses; `refine_pose` follows.

The loss is marginalised over an unknown noise level, without an inlier threshold: the quality of a residual r, in
sigmas, is the mean of max(0, 1 - (r / (k s))^2) over the noise levels s between 1 and `max_noise`, with k the 99 %
quantile. Reference: Barath, Noskova, Matas ("MAGSAC++").
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rigkit.core.arrays import FloatArray, Mat3
from rigkit.core.matches import Matches
from rigkit.core.posetype import PoseType
from rigkit.geometry.rotation import skew
from rigkit.kernels import pose as kernel
from rigkit.relative_pose.solvers.pose import free_directions, rotations_and_direction

MAX_LOCAL_STEPS = 15
LOCAL_SETTLED_RAD = 1e-5
"""The optimisation ends at a shorter step, which changes no residual by a tenth of its sigma."""
QUANTILE = 2.576
"""99 % quantile of |r| for a standard normal r. As in kernels/pose.c."""


@dataclass(frozen=True, eq=False, slots=True)
class SampsonRows:
    """The matches in the memory layout of the kernels.

    Attributes
    ----------
    packed : (18, N), C-contiguous: the rays f1 and f2, then by pixel coordinate the columns of sigma1 B1 and of
        sigma2 B2.
    """

    packed: FloatArray

    @classmethod
    def of(cls, matches: Matches) -> SampsonRows:
        f1, f2, b1, b2 = matches.rays1, matches.rays2, matches.jacobians1, matches.jacobians2
        s1, s2 = (np.broadcast_to(s, len(matches)) for s in (matches.sigma1_px, matches.sigma2_px))
        columns = [(s * b.T).reshape(6, -1) for s, b in ((s1, b1), (s2, b2))]
        # The concatenation of transposed arrays is not C-contiguous.
        return cls(np.ascontiguousarray(np.concatenate([f1.T, f2.T, *columns])))

    def residuals(self, E21: Mat3) -> FloatArray:
        """Return the signed Sampson distances (H, N) in sigmas under hypotheses (H, 3, 3)."""
        return kernel.residuals(self.packed, E21)

    def quality(self, E21: Mat3, noise: float) -> FloatArray:
        """Return the sum over the matches of the marginal quality (H,) of hypotheses (H, 3, 3) at `noise`."""
        return kernel.qualities(self.packed, E21, noise)

    def quality_ahead(self, E21: Mat3, sigmas: float, *noise: float) -> FloatArray:
        """Return the qualities (L, H) at L noise levels of the best of the four poses of each E, by cheirality.

        Matches behind a camera do not count, unless their parallax is at most `sigmas` standard deviations.
        """
        first, second, t = rotations_and_direction(E21)
        R = np.stack([first, second], axis=1)
        return np.stack([kernel.qualities_ahead(self.packed, R, t, level, sigmas) for level in noise])

    def improved(self, E21: Mat3, kind: str, *noise: float) -> Mat3:
        """Return the local optima (L, H, 3, 3) from `E21` (H, 3, 3) at L noise levels, each starting at the one before.

        `kind` "general" optimises five degrees of freedom, "planar" two, other pose types none.
        """
        R, t = _split_essential(E21, kind)
        out = np.empty((len(noise), *R.shape))
        for k, level in enumerate(noise):
            R, t = kernel.improve(self.packed, R, t, level, free_directions(kind), MAX_LOCAL_STEPS, LOCAL_SETTLED_RAD)
            out[k] = skew(t) @ R
        return np.asarray(out * np.sqrt(0.5))


def _split_essential(E21: Mat3, kind: str) -> tuple[FloatArray, FloatArray]:
    """Return a rotation (H, 3, 3), for planar motion the one about the vertical axis, and a unit direction (H, 3)."""
    R, other, t = rotations_and_direction(E21)
    if kind == PoseType.PLANAR:
        R = np.where((other[:, 1, 1] > R[:, 1, 1])[:, None, None], other, R)
    return R, t


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
