"""Many hypotheses against one set of matches: their residuals and qualities, and their improvement in one batch.

The local optimisation is Levenberg-Marquardt on rotation and direction under the marginalised loss, with the sigma of
each Sampson distance held during a step; it is there to choose among hypotheses, the last word has `refine_pose`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rigkit.core.arrays import FloatArray, IntArray, Mat3
from rigkit.core.matches import Matches
from rigkit.core.posetype import PoseType
from rigkit.geometry.rotation import cross, exp_so3, skew
from rigkit.kernels import pose as native
from rigkit.relative_pose.refinement.marginal import marginal_quality, marginal_weights
from rigkit.relative_pose.solvers.pose import free_directions, rotations_and_direction, translation_basis

__all__ = ["SampsonRows"]

MAX_STEPS = 15
SETTLED_RAD = 1e-5
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
        if (library := native.loaded()) is not None:
            return native.residuals(library, self.packed, E21)
        return self._split(E21)[0]

    def quality(self, E21: Mat3, noise: float) -> FloatArray:
        """Return the sums (H,) over the matches of the marginal quality at `noise` of hypotheses (H, 3, 3)."""
        if (library := native.loaded()) is not None:
            return native.qualities(library, self.packed, E21, noise)
        return np.asarray(marginal_quality(self._split(E21)[0], noise).sum(axis=1))

    def quality_ahead(self, E21: Mat3, sigmas: float, *noise: float) -> FloatArray:
        """Return the sums (L, H) at L noise levels over the matches ahead of both cameras, E's best of four poses.

        A match whose parallax is at most so many `sigmas` may be anywhere and is counted always.
        """
        first, second, t = rotations_and_direction(E21)
        R = np.stack([first, second], axis=1)
        if (library := native.loaded()) is not None:
            return np.stack([native.qualities_ahead(library, self.packed, R, t, level, sigmas) for level in noise])
        f1, f2 = self.packed[:3].T, self.packed[3:6].T
        r, a, t = self._split(skew(t) @ first)[0], f1 @ np.swapaxes(R, 2, 3), t[:, None, None]
        across = cross(f2, a)
        range1, range2 = (np.sum(cross(t, f) * across, axis=-1) for f in (f2, a))
        far = np.sum(across**2, axis=-1) <= sigmas**2 * 0.5 * np.sum(self.packed[6:] ** 2, axis=0)
        ahead = np.stack([far | ((sign * range1 >= 0.0) & (sign * range2 >= 0.0)) for sign in (1.0, -1.0)])
        sums = [np.sum(marginal_quality(r, level)[:, None] * ahead, axis=3) for level in noise]
        return np.asarray(np.max(sums, axis=(1, 3)))

    def _split(self, E21: Mat3) -> tuple[FloatArray, FloatArray]:
        """Return the distances in sigmas and 1 / s, (H, N); both zero at the epipoles, where any partner fits."""
        f1, f2, b1, b2 = np.split(self.packed, [3, 6, 12])
        line2, line1 = E21 @ f1, np.swapaxes(E21, 1, 2) @ f2
        variance = np.zeros((len(E21), self.packed.shape[1]))
        for line, b in ((line1, b1), (line2, b2)):
            for column in (b[:3], b[3:]):
                variance += np.sum(line * column, axis=1) ** 2
        inverse = np.divide(1.0, np.sqrt(variance), out=np.zeros_like(variance), where=variance > 0.0)
        return np.sum(line2 * f2, axis=1) * inverse, inverse

    def improved(self, E21: Mat3, kind: str, *noise: float) -> Mat3:
        """Return the essential matrices (L, H, 3, 3) that `E21` (H, 3, 3) lead to at L noise levels, one after another.

        `kind` "general" moves all five degrees of freedom, "planar" the two of planar motion; others move none.
        """
        R, t = _split_essential(E21, kind)
        out = np.empty((len(noise), *R.shape))
        for k, level in enumerate(noise):
            if (library := native.loaded()) is not None:
                free = free_directions(kind)
                R, t = native.improve(library, self.packed, R, t, level, free, MAX_STEPS, SETTLED_RAD)
            else:
                self._improve(R, t, level, free_directions(kind))
            out[k] = skew(t) @ R
        return np.asarray(out * np.sqrt(0.5))

    def _improve(self, R: FloatArray, t: FloatArray, level: float, free: IntArray) -> None:
        """Move rotations (H, 3, 3) and unit directions (H, 3), in place, to the best quality at noise `level`."""
        r, inverse = self._split(skew(t) @ R)
        quality, weights = marginal_quality(r, level), marginal_weights(r, level)
        damping = np.full(len(R), 1e-4)
        active = np.arange(len(R))
        for _ in range(MAX_STEPS):
            basis = translation_basis(t[active])
            J = self._derivatives(R[active], t[active], basis)[:, :, free] * inverse[active, :, None]
            JtW = np.swapaxes(J, 1, 2) * weights[active, None]
            gram, gradient = JtW @ J, JtW @ r[active, :, None]
            diagonal = np.einsum("hii->hi", gram)
            diagonal *= 1.0 + damping[active, None]
            diagonal += 1e-12 * diagonal.sum(axis=1, keepdims=True) + 1e-300
            step = np.zeros((len(active), 5))
            step[:, free] = -np.linalg.solve(gram, gradient)[..., 0]
            new_R = exp_so3(step[:, :3]) @ R[active]
            new_t = t[active] + np.sum(step[:, 3:, None] * basis, axis=1)
            new_t /= np.linalg.norm(new_t, axis=1, keepdims=True)
            new_r, new_inverse = self._split(skew(new_t) @ new_R)
            new_quality = marginal_quality(new_r, level)
            better = new_quality.sum(axis=1) >= quality[active].sum(axis=1)
            took = active[better]
            R[took], t[took], r[took], inverse[took] = new_R[better], new_t[better], new_r[better], new_inverse[better]
            quality[took], weights[took] = new_quality[better], marginal_weights(new_r[better], level)
            damping[active] = np.where(better, 0.1 * damping[active], 10.0 * damping[active])
            moving = (np.abs(step).max(axis=1) > SETTLED_RAD) & (damping[active] < 1e8)
            active = active[moving]
            if not len(active):
                return

    def _derivatives(self, R: FloatArray, t: FloatArray, basis: FloatArray) -> FloatArray:
        """Return the derivatives (H, N, 5) of f2^T [t]x R f1 by R <- exp(w) R and t <- t + b1 T1 + b2 T2."""
        f1, f2 = self.packed[:3].T, self.packed[3:6].T
        turned = f1 @ np.swapaxes(R, 1, 2)
        by_rotation = cross(turned, cross(f2, t[:, None]))
        by_direction = cross(turned, f2) @ np.swapaxes(basis, 1, 2)
        return np.concatenate([by_rotation, by_direction], axis=2)


def _split_essential(E21: Mat3, kind: str) -> tuple[FloatArray, FloatArray]:
    """Return a rotation (H, 3, 3) and a unit direction (H, 3); for planar motion that about the vertical axis."""
    R, other, t = rotations_and_direction(E21)
    if kind == PoseType.PLANAR:
        R = np.where((other[:, 1, 1] > R[:, 1, 1])[:, None, None], other, R)
    return R, t
