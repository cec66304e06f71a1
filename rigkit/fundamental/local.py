"""Many hypotheses against one set of matches: their residuals in one product, their improvement in one batch.

The Sampson distance of a match is c / s with c and the four entries of the two pixel gradients linear in vec(E): all
hypotheses of a search are tested by one matrix product. The local optimisation is Levenberg-Marquardt on rotation and
direction under a robust loss, with s held during a step; it is there to choose among hypotheses, the last word has
`refine_pose`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from rigkit.arrays import FloatArray, IntArray, Mat3
from rigkit.fundamental.rows import point_rows
from rigkit.geometry.rotation import cross, exp_so3, skew
from rigkit.matches import Matches
from rigkit.posetype import PoseType

__all__ = ["Loss", "SampsonRows"]

Loss = Callable[[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]
"""From residuals in sigmas (H, N) and noise levels (H, 1) to qualities (H, N), which fall with the size of the residual
r, and weights -q'(r) / r up to a factor."""

MAX_STEPS = 15
SETTLED_RAD = 1e-5
"""A shorter step changes no residual by a tenth of its sigma: enough to choose by."""


@dataclass(frozen=True, eq=False, slots=True)
class SampsonRows:
    """The matches as linear forms of the row-major vec(E).

    Attributes
    ----------
    constraint : (N, 9) c = f2^T E f1.
    gradients : (4 N, 9) the entries of sigma1 n1 and sigma2 n2 (see `epipolar_normals`), entry by entry.
    """

    constraint: FloatArray
    gradients: FloatArray

    @classmethod
    def of(cls, matches: Matches) -> SampsonRows:
        f1, f2, b1, b2 = matches.rays1, matches.rays2, matches.jacobians1, matches.jacobians2
        s1 = np.broadcast_to(matches.sigma1_px, len(matches))[:, None]
        s2 = np.broadcast_to(matches.sigma2_px, len(matches))[:, None]
        by1 = [s1 * point_rows(b1[..., k], f2) for k in (0, 1)]
        by2 = [s2 * point_rows(f1, b2[..., k]) for k in (0, 1)]
        return cls(point_rows(f1, f2), np.concatenate([*by1, *by2]))

    def residuals(self, E21: Mat3) -> FloatArray:
        """Return the signed Sampson distances (H, N) in sigmas of hypotheses (H, 3, 3)."""
        return self._split(E21)[0]

    def _split(self, E21: Mat3) -> tuple[FloatArray, FloatArray]:
        """Return the distances in sigmas and 1 / s, (H, N); both zero at the epipoles, where any partner fits."""
        entries = E21.reshape(-1, 9)
        gradients = entries @ self.gradients.T
        gradients *= gradients
        variance = gradients.reshape(len(entries), 4, -1).sum(axis=1)
        inverse = np.divide(1.0, np.sqrt(variance), out=np.zeros_like(variance), where=variance > 0.0)
        return (entries @ self.constraint.T) * inverse, inverse

    def improved(self, E21: Mat3, kind: str, noise: FloatArray, loss: Loss) -> Mat3:
        """Return the essential matrices (H, 3, 3) that `E21` (H, 3, 3) lead to, at noise levels `noise` (H,).

        `kind` "general" moves all five degrees of freedom, "planar" the two of planar motion; others move none.
        """
        free = _free(kind)
        R, t = _split_essential(E21, kind)
        E21 = skew(t) @ R
        if not len(free):
            return np.asarray(E21 * np.sqrt(0.5))
        level = noise[:, None]
        r, inverse = self._split(E21)
        quality, weights = loss(r, level)
        damping = np.full(len(E21), 1e-4)
        active = np.arange(len(E21))
        for _ in range(MAX_STEPS):
            basis = _bases(t[active])
            by_entry = _derivatives(R[active], t[active], basis)[:, free]
            J = (self.constraint @ np.swapaxes(by_entry, 1, 2)) * inverse[active, :, None]
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
            new_E = skew(new_t) @ new_R
            new_r, new_inverse = self._split(new_E)
            new_quality, new_weights = loss(new_r, level[active])
            better = new_quality.sum(axis=1) >= quality[active].sum(axis=1)
            took = active[better]
            R[took], t[took], E21[took] = new_R[better], new_t[better], new_E[better]
            r[took], inverse[took] = new_r[better], new_inverse[better]
            quality[took], weights[took] = new_quality[better], new_weights[better]
            damping[active] = np.where(better, 0.1 * damping[active], 10.0 * damping[active])
            moving = (np.abs(step).max(axis=1) > SETTLED_RAD) & (damping[active] < 1e8)
            active = active[moving]
            if not len(active):
                break
        return np.asarray(E21 * np.sqrt(0.5))


def _free(kind: str) -> IntArray:
    """Return which of (w, b), the first of b horizontal, the pose type leaves free."""
    return np.array({"general": [0, 1, 2, 3, 4], "planar": [1, 3]}.get(kind, []), dtype=np.int64)


def _split_essential(E21: Mat3, kind: str) -> tuple[FloatArray, FloatArray]:
    """Return a rotation (H, 3, 3) and a unit direction (H, 3) with E = [t]x R up to its sign and size.

    Two rotations do, half a turn about the baseline apart: for planar motion the one about the vertical axis is taken.
    """
    u, _, vt = np.linalg.svd(E21)
    u, vt = u * np.linalg.det(u)[:, None, None], vt * np.linalg.det(vt)[:, None, None]
    quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    R, t = u @ quarter @ vt, np.array(u[:, :, 2])
    if kind == PoseType.PLANAR:
        other = u @ quarter.T @ vt
        R = np.where((other[:, 1, 1] > R[:, 1, 1])[:, None, None], other, R)
    return R, t


def _bases(t: FloatArray) -> FloatArray:
    """Return two unit vectors (H, 2, 3) perpendicular to each of `t` (H, 3), as `translation_basis`."""
    first = np.stack([t[:, 2], np.zeros(len(t)), -t[:, 0]], axis=1)
    size = np.linalg.norm(first, axis=1, keepdims=True)
    first = np.where(size > 1e-9, first / np.maximum(size, 1e-9), [1.0, 0.0, 0.0])
    return np.stack([first, cross(t, first)], axis=1)


def _derivatives(R: FloatArray, t: FloatArray, basis: FloatArray) -> FloatArray:
    """Return the derivatives (H, 5, 9) of vec([t]x R) by R <- exp(w) R and t <- t + b1 T1 + b2 T2."""
    by_rotation = skew(t)[:, None] @ skew(np.eye(3)) @ R[:, None]
    by_direction = skew(basis) @ R[:, None]
    return np.concatenate([by_rotation, by_direction], axis=1).reshape(len(R), 5, 9)
