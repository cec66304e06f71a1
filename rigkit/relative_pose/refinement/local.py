"""Many hypotheses against one set of matches: their residuals and qualities, and their improvement in one batch.

The local optimisation is Levenberg-Marquardt on rotation and direction under the marginalised loss, with the sigma of
each Sampson distance held during a step; it is there to choose among hypotheses, the last word has `refine_pose`.
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
"""A shorter step changes no residual by a tenth of its sigma: enough to choose by."""


@dataclass(frozen=True, eq=False, slots=True)
class SampsonRows:
    """The matches, laid out for many hypotheses.

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
        # Of transposed arrays alone numpy makes a transposed one.
        return cls(np.ascontiguousarray(np.concatenate([f1.T, f2.T, *columns])))

    def residuals(self, E21: Mat3) -> FloatArray:
        """Return the signed Sampson distances (H, N) in sigmas of hypotheses (H, 3, 3)."""
        return kernel.residuals(self.packed, E21)

    def quality(self, E21: Mat3, noise: float) -> FloatArray:
        """Return the sums (H,) over the matches of the marginal quality at `noise` of hypotheses (H, 3, 3)."""
        return kernel.qualities(self.packed, E21, noise)

    def quality_ahead(self, E21: Mat3, sigmas: float, *noise: float) -> FloatArray:
        """Return the sums (L, H) at L noise levels over the matches ahead of both cameras, E's best of four poses.

        A match whose parallax is at most so many `sigmas` may be anywhere and is counted always.
        """
        first, second, t = rotations_and_direction(E21)
        R = np.stack([first, second], axis=1)
        return np.stack([kernel.qualities_ahead(self.packed, R, t, level, sigmas) for level in noise])

    def improved(self, E21: Mat3, kind: str, *noise: float) -> Mat3:
        """Return the essential matrices (L, H, 3, 3) that `E21` (H, 3, 3) lead to at L noise levels, one after another.

        `kind` "general" moves all five degrees of freedom, "planar" the two of planar motion; others move none.
        """
        R, t = _split_essential(E21, kind)
        out = np.empty((len(noise), *R.shape))
        for k, level in enumerate(noise):
            R, t = kernel.improve(self.packed, R, t, level, free_directions(kind), MAX_LOCAL_STEPS, LOCAL_SETTLED_RAD)
            out[k] = skew(t) @ R
        return np.asarray(out * np.sqrt(0.5))


def _split_essential(E21: Mat3, kind: str) -> tuple[FloatArray, FloatArray]:
    """Return a rotation (H, 3, 3) and a unit direction (H, 3); for planar motion that about the vertical axis."""
    R, other, t = rotations_and_direction(E21)
    if kind == PoseType.PLANAR:
        R = np.where((other[:, 1, 1] > R[:, 1, 1])[:, None, None], other, R)
    return R, t
