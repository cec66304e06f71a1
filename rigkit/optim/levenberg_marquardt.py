"""Levenberg-Marquardt for one problem: any state, any way to solve for a step.

A problem linearised around a state gives its cost and damped steps; how it solves for them (dense normal equations,
Schur complement) is its own business. Costs are sums of squares. References: Marquardt, "An algorithm for least-squares
estimation of nonlinear parameters" (1963); Madsen, Nielsen, Tingleff, "Methods for non-linear least squares problems"
(2004), algorithm 3.16.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Generic, Protocol, Self, TypeVar

import numpy as np

from rigkit.core.arrays import FloatArray
from rigkit.optim.damping import Damping, Stop, StopReason


class Step(Protocol):
    """A proposed step."""

    @property
    def predicted(self) -> float:
        """The decrease of the cost that the quadratic model promises."""
        ...


class LinearisedProblem(ABC):
    """A least-squares problem around a state."""

    __slots__ = ()

    @property
    @abstractmethod
    def cost(self) -> float:
        """Sum of squared residuals, infinite or NaN where the state has none."""

    @abstractmethod
    def step(self, damping: float) -> Step | None:
        """Return the damped step, None where the damped system cannot be solved."""

    def decrease(self, there: Self) -> float:
        """Return by how much the cost is less at another state; a step is taken where this is positive."""
        return self.cost - there.cost


S = TypeVar("S")
P = TypeVar("P", bound=LinearisedProblem)


@dataclass(frozen=True, slots=True)
class DenseStep:
    """A step (U,) in the unknowns and the decrease of the cost that the quadratic model promises for it."""

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
    """Where a descent ended: the state, the problem around it, how many steps were tried and why it stopped."""

    state: S
    problem: P
    steps: int
    reason: StopReason

    @property
    def converged(self) -> bool:
        """Whether the state is a minimum, for all that the problem can tell."""
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
    """Return the state of least cost near `state`; a state that nothing improves is returned as it is.

    Parameters
    ----------
    linearise : gives the problem around a state.
    moved : gives the state after one of the problem's steps, None where there is no such state: the step is refused.
    here : the problem around the start, where it is known.
    small : says whether a step is too short to matter: it is the last one, taken or not.
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
    """Return the step (U,) that lessens residuals (M,) with the derivatives (M, U), by the damped normal equations.

    The unknowns are scaled so that the columns have length one: `damping` is the share of the diagonal of J^T J that is
    added to it (Marquardt). What a column of zeros is of does not move. None where the system is singular all the same.
    """
    normal = jacobian.T @ jacobian
    size = np.maximum(np.sqrt(np.diag(normal)), 1e-300)
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
