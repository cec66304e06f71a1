"""The minimisation of `refine_pose`: Levenberg-Marquardt on the pose with iteratively reweighted matches."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from rigkit.core.arrays import TINY, FloatArray, IntArray, as_array
from rigkit.core.errors import InputError
from rigkit.core.matches import Matches
from rigkit.core.posetype import PoseType
from rigkit.geometry.rotation import exp_so3, unit
from rigkit.kernels import pose as kernel
from rigkit.optim.damping import Damping, Stop
from rigkit.optim.levenberg_marquardt import DenseStep, LinearisedProblem, minimise
from rigkit.relative_pose.refinement.local import MarginalLoss, SampsonRows
from rigkit.relative_pose.refinement.residuals import affinity_terms, level_terms, point_terms, whitened_affinities
from rigkit.relative_pose.solvers.pose import free_directions, translation_basis

MAX_REFINEMENTS = 60
STEP_TOLERANCE = 1e-10
DAMPING_OF_POSE = Damping(start=1e-6, ceiling=1e8, floor=1e-12)
ROUNDING_OF_COST = 1e-14
CAUCHY_SCALE = 2.385
"""Scale of the Cauchy loss in standard deviations: 95 % efficient for Gaussian noise."""

RobustWeights = Callable[[FloatArray], FloatArray]
"""Maps residuals in sigmas (N,) to the weights of their squares (N,)."""


def cauchy_weights(residuals: FloatArray) -> FloatArray:
    """Return the weights 1 / (1 + (r / c)^2) of the Cauchy loss."""
    return np.asarray(1.0 / (1.0 + (residuals / CAUCHY_SCALE) ** 2))


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class PoseMinimum:
    """Result of the minimisation.

    Attributes
    ----------
    R, t : rotation (3, 3) and unit translation (3,) of cam2_from_cam1.
    residuals, jacobian, weights : (M,), (M, 5), (M,): of the points, two of each affinity, `priors` of the level.
        Residuals (in sigmas) and Jacobian (by (w, b)) are not multiplied by the weights of the squared residuals.
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
class _WeightedRows(LinearisedProblem):
    """Residuals (M,) at a pose, their Jacobian (M, 5), weights (M,) and matches (M,), and the free parameters."""

    residuals: FloatArray
    jacobian: FloatArray
    weights: FloatArray
    of: IntArray
    free: IntArray

    @property
    def cost(self) -> float:
        """Weighted sum of squared residuals."""
        return float(np.sum(self.weights * self.residuals**2))

    def step(self, damping: float) -> DenseStep | None:
        """Return the damped step (5,), zero in fixed parameters; None if the system is singular."""
        J, w = self.jacobian[:, self.free], self.weights
        gram, gradient = (J.T * w) @ J, (J.T * w) @ self.residuals
        scale = np.diag(gram) + 1e-12 * np.trace(gram) + TINY
        try:
            move = np.linalg.solve(gram + damping * np.diag(scale), -gradient)
        except np.linalg.LinAlgError:
            return None
        change = np.zeros(5)
        change[self.free] = move
        return DenseStep(change, float(move @ (damping * scale * move - gradient)))

    def decrease(self, there: _WeightedRows) -> float:
        """Return the decrease of the cost under the present weights; equal costs within rounding are a decrease.

        A step that lowers this sum also lowers the robust loss.
        """
        return self.cost * (1.0 + ROUNDING_OF_COST) - float(np.sum(self.weights * there.residuals**2))


def _moved(state: tuple[FloatArray, FloatArray], step: DenseStep) -> tuple[FloatArray, FloatArray]:
    R, t = state
    return exp_so3(step.change[:3]) @ R, unit(t + step.change[3:] @ translation_basis(t))


def _small(step: DenseStep) -> bool:
    return bool(np.abs(step.change).max() < STEP_TOLERANCE)


@dataclass(frozen=True, eq=False, slots=True)
class PoseProblem:
    """The arguments of `refine_pose`, as a least squares problem."""

    matches: Matches
    kind: str
    level_sigma_rad: float | None
    robust: RobustWeights | None
    point_weights: FloatArray | None

    def free(self) -> IntArray:
        """Return the indices of the free parameters among (w, b)."""
        return free_directions(PoseType.GENERAL if self.level_sigma_rad is not None else self.kind)

    def minimum(self, R: FloatArray, t: FloatArray) -> PoseMinimum:
        """Return the minimum near a pose; raises InputError if there are fewer residuals than degrees of freedom."""
        loss = self._loss()
        if self.level_sigma_rad is None and loss is not None:
            affine, which = whitened_affinities(self.matches)
            self._require(len(self.matches) + 2 * len(which))
            packed, limits = SampsonRows.of(self.matches).packed, (MAX_REFINEMENTS, STEP_TOLERANCE)
            given = (packed, affine, which, self._own_weights())
            turned, moved, r, jacobian, w, count, settled = kernel.minimise(*given, loss, self.free(), R, t, *limits)
            return PoseMinimum(
                R=turned,
                t=moved,
                residuals=r,
                jacobian=jacobian,
                weights=w,
                priors=0,
                iterations=count,
                converged=settled,
            )
        return self._descend(R, t)

    def _descend(self, R: FloatArray, t: FloatArray) -> PoseMinimum:
        """Return the minimum near a pose for a level prior or another loss, which the kernel does not support."""
        start = self._linearise((R, t))
        self._require(len(start.residuals))
        iterations, converged, state, here = 0, True, (R, t), start
        if len(self.free()):
            stop = Stop(steps=MAX_REFINEMENTS)
            end = minimise((R, t), self._linearise, _moved, DAMPING_OF_POSE, stop, here=start, small=_small)
            iterations, converged, state, here = end.steps, end.converged, end.state, end.problem
        return PoseMinimum(
            R=state[0],
            t=state[1],
            residuals=here.residuals,
            jacobian=here.jacobian,
            weights=here.weights,
            priors=int(np.sum(here.of < 0)),
            iterations=iterations,
            converged=converged,
        )

    def _linearise(self, state: tuple[FloatArray, FloatArray]) -> _WeightedRows:
        residuals, jacobian, of = self._residuals(*state)
        return _WeightedRows(residuals, jacobian, self._weights(residuals, of), of, self.free())

    def _require(self, count: int) -> None:
        if count < len(self.free()):
            raise InputError(
                f"pose refinement: {count} residuals for {len(self.free())} degrees of freedom; add matches"
            )

    def _loss(self) -> tuple[int, float] | None:
        """Return the kernel's number of the loss, and its scale; None if the kernel does not support it."""
        if self.robust is None:
            return 0, 1.0
        if self.robust is cauchy_weights:
            return 1, CAUCHY_SCALE
        return (2, self.robust.max_noise) if isinstance(self.robust, MarginalLoss) else None

    def _residuals(self, R: FloatArray, t: FloatArray) -> tuple[FloatArray, FloatArray, IntArray]:
        """Return unweighted residuals (M,), Jacobian (M, 5) and the match of each residual (M,), -1 for the prior."""
        basis = translation_basis(t)
        r, jacobian = point_terms(self.matches, R, t, basis)
        ra, ja, which = affinity_terms(self.matches, R, t, basis)
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
            # An affinity's weight is the product of that of its point and its own, from residuals per component.
            by_point = self.robust(r[:n])
            pair = r[n : data.sum()].reshape(-1, 2)
            by_affinity = self.robust(np.sqrt(0.5 * np.sum(pair**2, axis=1)))
            out[:n] *= by_point
            out[n : data.sum()] *= np.repeat(by_affinity, 2) * by_point[of[n : data.sum()]]
        return out
