"""The minimisation behind `refine_pose`: Levenberg-Marquardt on the pose, matches weighted anew after every step."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from rigkit.core.arrays import FloatArray, IntArray, as_array
from rigkit.core.errors import InputError
from rigkit.core.matches import Matches
from rigkit.core.posetype import PoseType
from rigkit.geometry.rotation import exp_so3, unit
from rigkit.kernels import pose as kernel
from rigkit.relative_pose.refinement.local import SampsonRows
from rigkit.relative_pose.refinement.marginal import MarginalLoss
from rigkit.relative_pose.refinement.residuals import affinity_terms, level_terms, point_terms, whitened_affinities
from rigkit.relative_pose.solvers.pose import free_directions, translation_basis

__all__ = ["Minimum", "PoseProblem", "RobustWeights", "cauchy_weights"]

MAX_ITERATIONS = 60
STEP_TOLERANCE = 1e-10
CAUCHY_SCALE = 2.385
"""In standard deviations: 95 % efficient for Gaussian noise."""

RobustWeights = Callable[[FloatArray], FloatArray]
"""From residuals in sigmas (N,) to factors of their squares (N,)."""


def cauchy_weights(residuals: FloatArray) -> FloatArray:
    """Return the weights 1 / (1 + (r / c)^2) of the Cauchy loss."""
    return np.asarray(1.0 / (1.0 + (residuals / CAUCHY_SCALE) ** 2))


@dataclass(frozen=True, eq=False, slots=True)
class Minimum:
    """Where the minimisation ended.

    Attributes
    ----------
    R, t : rotation (3, 3) and unit translation (3,) of cam2_from_cam1.
    residuals, jacobian, weights : (M,), (M, 5), (M,): points, then two for each affinity, then `priors` of the level.
        Residuals are in sigmas and, like the Jacobian by (w, b), without the weights of their squares.
    iterations : of the minimisation; `converged` says whether its last step was small.
    """

    R: FloatArray
    t: FloatArray
    residuals: FloatArray
    jacobian: FloatArray
    weights: FloatArray
    priors: int
    iterations: int
    converged: bool


@dataclass(frozen=True, eq=False, slots=True)
class PoseProblem:
    """What a pose is refined on; the attributes are the arguments of `refine_pose`."""

    matches: Matches
    kind: str
    level_sigma_rad: float | None
    covariance_A: FloatArray | None
    robust: RobustWeights | None
    point_weights: FloatArray | None

    def free(self) -> IntArray:
        """Return which of (w, b), the first of b horizontal, may move."""
        return free_directions(PoseType.GENERAL if self.level_sigma_rad is not None else self.kind)

    def minimum(self, R: FloatArray, t: FloatArray) -> Minimum:
        """Return the minimum near a pose; raises InputError where the residuals are too few."""
        loss = self._loss()
        plain = self.level_sigma_rad is None and self.covariance_A is None
        if plain and loss is not None:
            affine, which = whitened_affinities(self.matches)
            self._require(len(self.matches) + 2 * len(which))
            packed, limits = SampsonRows.of(self.matches).packed, (MAX_ITERATIONS, STEP_TOLERANCE)
            given = (packed, affine, which, self._own_weights())
            end = kernel.minimise(*given, loss, self.free(), R, t, *limits)
            return Minimum(*end[:5], 0, *end[5:])
        return self._minimum(R, t)

    def _minimum(self, R: FloatArray, t: FloatArray) -> Minimum:
        free = self.free()
        r, jacobian, of = self._residuals(R, t)
        self._require(len(r))
        w = self._weights(r, of)
        damping, converged, iterations = 1e-6, not len(free), 0
        while not converged and iterations < MAX_ITERATIONS:
            iterations += 1
            J = jacobian[:, free]
            gram, gradient = (J.T * w) @ J, (J.T * w) @ r
            scale = np.diag(gram) + 1e-12 * np.trace(gram) + 1e-300
            step = np.zeros(5)
            step[free] = np.linalg.solve(gram + damping * np.diag(scale), -gradient)
            new_R, new_t = exp_so3(step[:3]) @ R, unit(t + step[3:] @ translation_basis(t))
            new_r, new_jacobian, _ = self._residuals(new_R, new_t)
            converged = bool(np.abs(step).max() < STEP_TOLERANCE)
            # Both poses under the old weights: a step that lowers this sum lowers the robust loss as well.
            if np.sum(w * new_r**2) <= np.sum(w * r**2) * (1.0 + 1e-14):
                R, t, r, jacobian = new_R, new_t, new_r, new_jacobian
                w = self._weights(r, of)
                damping = max(damping * 0.1, 1e-12)
            else:
                converged = converged or damping > 1e8
                damping *= 10.0
        return Minimum(R, t, r, jacobian, w, int(np.sum(of < 0)), iterations, converged)

    def _require(self, count: int) -> None:
        if count < len(self.free()):
            raise InputError(
                f"pose refinement: {count} residuals for {len(self.free())} degrees of freedom; add matches"
            )

    def _loss(self) -> tuple[int, float] | None:
        """Return what the kernel calls the loss, and its scale; None if it does not know it."""
        if self.robust is None:
            return 0, 1.0
        if self.robust is cauchy_weights:
            return 1, CAUCHY_SCALE
        return (2, self.robust.max_noise) if isinstance(self.robust, MarginalLoss) else None

    def _residuals(self, R: FloatArray, t: FloatArray) -> tuple[FloatArray, FloatArray, IntArray]:
        """Return residuals (M,), Jacobian (M, 5) and the match of each (M,), -1 for the prior; no weights yet."""
        basis = translation_basis(t)
        r, jacobian = point_terms(self.matches, R, t, basis)
        ra, ja, which = affinity_terms(self.matches, R, t, basis, self.covariance_A)
        rows, by, of = [r, ra.reshape(-1)], [jacobian, ja.reshape(-1, 5)], [np.arange(len(r)), np.repeat(which, 2)]
        if self.level_sigma_rad is not None:
            deviation, by_pose = level_terms(self.kind, R, t, basis)
            rows.append(deviation / self.level_sigma_rad)
            by.append(by_pose / self.level_sigma_rad)
            of.append(np.full(len(deviation), -1))
        return np.concatenate(rows), np.concatenate(by), np.concatenate(of)

    def _own_weights(self) -> FloatArray:
        """Return the fixed factors (N,) of the matches."""
        n = len(self.matches)
        return np.ones(n) if self.point_weights is None else as_array(self.point_weights, (n,), "point weights")

    def _weights(self, r: FloatArray, of: IntArray) -> FloatArray:
        """Return the factors (M,) of the squared residuals."""
        n, data = len(self.matches), of >= 0
        out = np.where(data, self._own_weights()[np.maximum(of, 0)], 1.0)
        if self.robust is not None:
            # A match is doubted by its point and by its affinity, each per degree of freedom.
            doubt = self.robust(r[:n])
            pair = r[n : n + 2 * int((data.sum() - n) // 2)].reshape(-1, 2)
            of_pair = self.robust(np.sqrt(0.5 * np.sum(pair**2, axis=1)))
            out[:n] *= doubt
            out[n : n + pair.size] *= np.repeat(of_pair, 2) * doubt[of[n : n + pair.size]]
        return out
