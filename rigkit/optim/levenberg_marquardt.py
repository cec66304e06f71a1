"""Levenberg-Marquardt for one problem with any type of state and any linear solver.

A problem linearised at a state has a cost (a sum of squares) and computes damped steps, by dense normal equations or a
Schur complement. References: Marquardt, "An algorithm for least-squares estimation of nonlinear parameters" (1963);
Madsen, Nielsen, Tingleff, "Methods for non-linear least squares problems" (2004), algorithm 3.16.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Generic, Protocol, Self, TypeVar

import numpy as np

from rigkit.core.arrays import TINY, FloatArray
from rigkit.optim.damping import Damping, Stop, StopReason


class Step(Protocol):
    """A proposed step."""

    @property
    def predicted(self) -> float:
        """The decrease of the cost that the quadratic model predicts."""
        ...


class LinearisedProblem(ABC):
    """A least-squares problem linearised at a state."""

    __slots__ = ()

    @property
    @abstractmethod
    def cost(self) -> float:
        """Sum of squared residuals, infinite or NaN where the state is invalid."""

    @abstractmethod
    def step(self, damping: float) -> Step | None:
        """Return the damped step, None where the damped system cannot be solved."""

    def decrease(self, there: Self) -> float:
        """Return the decrease of the cost to another state; a step is accepted if it is positive."""
        return self.cost - there.cost


S = TypeVar("S")
P = TypeVar("P", bound=LinearisedProblem)


@dataclass(frozen=True, slots=True)
class DenseStep:
    """A step (U,) in the unknowns and the decrease of the cost that the quadratic model predicts."""

    change: FloatArray
    predicted: float


@dataclass(frozen=True, eq=False, slots=True)
class DenseProblem(LinearisedProblem):
    """Residuals (M,) and their derivatives (M, U)."""

    residual: FloatArray
    jacobian: FloatArray

    @property
    def cost(self) -> float:
        """Sum of squared residuals."""
        return float(self.residual @ self.residual)

    def step(self, damping: float) -> DenseStep | None:
        """Return the step of `damped_step`."""
        return damped_step(self.jacobian, self.residual, damping)


@dataclass(frozen=True, eq=False, slots=True)
class Minimum(Generic[S, P]):
    """The result: the state, the problem linearised there, the number of steps tried and why the iteration stopped."""

    state: S
    problem: P
    steps: int
    reason: StopReason

    @property
    def converged(self) -> bool:
        """Whether the iteration converged."""
        return self.reason in (StopReason.STATIONARY, StopReason.NO_SMALLER_COST)


def minimise(
    state: S,
    linearise: Callable[[S], P],
    moved: Callable[[S, Any], S | None],
    damping: Damping,
    stop: Stop,
    *,
    here: P | None = None,
    small: Callable[[Any], bool] | None = None,
) -> Minimum[S, P]:
    """Return the local minimum near `state`; `state` itself if no step lowers the cost.

    Parameters
    ----------
    linearise : returns the problem linearised at a state.
    moved : returns the state after a step; None for an invalid one: the step is rejected.
    here : the problem linearised at `state`, if known.
    small : returns whether a step is negligible: it is the last one, accepted or not.
    """
    here = linearise(state) if here is None else here
    level, growth = damping.start, damping.growth
    for count in range(1, stop.steps + 1):
        step = here.step(level)
        if step is None:
            level, growth = damping.refused(level, growth)
            if level > damping.ceiling:
                return Minimum(state, here, count, StopReason.SINGULAR)
            continue
        if step.predicted <= stop.predicted_gain * here.cost:
            return Minimum(state, here, count, StopReason.STATIONARY)
        trial = moved(state, step)
        there = None if trial is None else linearise(trial)
        gain = -np.inf if there is None else here.decrease(there)
        last = small is not None and small(step)
        if trial is not None and there is not None and gain > 0.0:
            ratio = gain / step.predicted
            last |= gain <= stop.gain * here.cost and ratio > stop.gain_ratio
            state, here = trial, there
            level, growth = damping.taken(level, ratio), damping.growth
            if last or here.cost < stop.cost:
                return Minimum(state, here, count, StopReason.STATIONARY)
        else:
            level, growth = damping.refused(level, growth)
            if last or level > damping.ceiling:
                return Minimum(state, here, count, StopReason.STATIONARY if last else StopReason.NO_SMALLER_COST)
    return Minimum(state, here, stop.steps, StopReason.STEPS)


def damped_step(jacobian: FloatArray, residual: FloatArray, damping: float) -> DenseStep | None:
    """Return the step (U,) for residuals (M,) with derivatives (M, U), by the damped normal equations.

    The unknowns are scaled to columns of unit length: `damping` is the part of the diagonal of J^T J that is added to
    it (Marquardt). Unknowns with a zero column do not change. None where the system is singular.
    """
    normal = jacobian.T @ jacobian
    size = np.maximum(np.sqrt(np.diag(normal)), TINY)
    normal = normal / size / size[:, None]
    normal.flat[:: len(size) + 1] += damping
    gradient = (jacobian.T @ residual) / size
    try:
        change = np.linalg.solve(normal, -gradient)
    except np.linalg.LinAlgError:
        return None
    # Decrease of the undamped model |r + J h|^2 for the damped step: h^T (mu h - J^T r).
    predicted = float(change @ (damping * change - gradient))
    return DenseStep(np.asarray(change / size), predicted)
