"""Levenberg-Marquardt over intrinsics, board shapes and board poses, with the poses eliminated by 6x6 blocks.

One camera, V views padded to C corners. Unknowns are ordered globals (intrinsics, then shape) and, per view, a pose
perturbation (w, dt): R <- exp(w) R, t <- t + dt, so that no rotation is singular. The normal matrix of all views comes
from one batched product; the reduced (Schur) system has the size of the globals only, so the cost is linear in views.

Damping follows Marquardt (scaled by the diagonal) with Nielsen's update. The loss is least squares or Cauchy's
c^2 log(1 + |r|^2 / c^2) of the 2-D residual, as iteratively reweighted least squares.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

from rigkit.calibration.solving.linearise import normal_equations
from rigkit.calibration.solving.normal_equations import NormalEquations, SchurStep
from rigkit.calibration.solving.state import State
from rigkit.calibration.views.observations import Observations
from rigkit.core.arrays import FloatArray
from rigkit.core.errors import DegenerateError, InputError
from rigkit.optim import levenberg_marquardt
from rigkit.optim.damping import Damping, Stop, StopReason
from rigkit.optim.levenberg_marquardt import LinearisedProblem

S = TypeVar("S")

MAX_SOLVER_ITERATIONS = 60
COST_TOLERANCE = 1e-11
"""Stop when the quadratic model promises less than this part of the cost: Gauss-Newton converges quadratically here, so
the optimum is then known to about 1e-10 in cost."""
FROM_OPTIMUM = 1e-6
"""A solve that begins at the optimum of nearly the same problem (all images but some, another lens) stops here: a step
that promises less of the cost changes no digit shown."""
MIN_GAIN_RATIO = 0.5
"""A step that gains little, and less than this share of what it promised, was too far: the next one may gain more."""
SOLVER_DAMPING = Damping(start=1e-13, shrink=0.01, growth=4.0, acceleration=2.0, ceiling=1e12, by_gain=True)
"""Monomials of a polynomial are nearly dependent (eigenvalues down to 1e-12 of the scaled system at degree 6): more
than 1e-13 would hold their combinations back, and with a shrink of 1/3 it would be dozens of steps. A step that goes
too far is refused and the damping grows quickly."""


@dataclass(frozen=True, slots=True)
class Convergence:
    """How the last solve ended.

    Attributes
    ----------
    iterations : steps taken.
    converged, reason : whether it ended where it should, and how in words.
    """

    iterations: int
    converged: bool
    reason: str


@dataclass(frozen=True, eq=False, slots=True)
class Linearised(LinearisedProblem):
    """The problem around a state: the normal equations of the corners, and those with all priors added."""

    data: NormalEquations
    normal: NormalEquations

    @property
    def cost(self) -> float:
        """The cost, priors included."""
        return self.normal.cost

    def step(self, damping: float) -> SchurStep | None:
        """Return the damped step of the normal equations with priors."""
        return self.normal.step(damping)


@dataclass(frozen=True, eq=False, slots=True)
class Solution(Generic[S]):
    """The state found, the normal equations there, of the corners alone and with all priors, and how the solver
    ended."""

    state: S
    data: NormalEquations
    normal: NormalEquations
    convergence: Convergence


def with_priors(data: NormalEquations, state: State, sigma_px: float) -> NormalEquations:
    """Return the normal equations with the priors of camera and shape added; `sigma_px` is the standard deviation of a
    corner."""
    p = state.camera.parameters.size
    shape = slice(p, p + state.unknowns.size)
    return data.with_priors([(slice(0, p), state.camera)], shape, state.shape.sigma, state.unknowns, sigma_px)


def solve(
    observations: Observations,
    start: State,
    *,
    weight: FloatArray | None = None,
    loss_px: float | None = None,
    prior_sigma_px: float = 0.2,
    max_iterations: int = MAX_SOLVER_ITERATIONS,
    cost_tolerance: float = COST_TOLERANCE,
    at_start: NormalEquations | None = None,
) -> Solution[State]:
    """Return the state that minimises the weighted residuals from `start`, and how the solver ended. Never raises for
    lack of data: what is not determined stays where it started.

    Parameters
    ----------
    weight : (V, C) weights of the residuals (not squared), zero for corners to ignore; the observations' own by
        default.
    loss_px : scale of the Cauchy loss; None for least squares.
    prior_sigma_px : standard deviation of a corner, which sets residuals against the priors of shape and camera; zero
        for none.
    at_start : the normal equations at `start`, without priors, where they are known.
    """
    weight = observations.weight if weight is None else weight

    def around(state: State, data: NormalEquations) -> Linearised:
        return Linearised(data, with_priors(data, state, prior_sigma_px))

    def linearise(state: State) -> Linearised:
        return around(state, normal_equations(observations, state, weight, loss_px))

    here = None if at_start is None else around(start, at_start)
    return minimise(start, linearise, State.moved, max_iterations, cost_tolerance, here)


def minimise(
    state: S,
    linearise: Callable[[S], Linearised],
    moved: Callable[[S, SchurStep], S],
    max_iterations: int = MAX_SOLVER_ITERATIONS,
    tolerance: float = COST_TOLERANCE,
    here: Linearised | None = None,
) -> Solution[S]:
    """Return the state of least cost near `state`: Levenberg-Marquardt.

    `linearise` gives cost and normal equations together: nearly every step is taken, so hardly any are in vain.
    `moved` returns the state after a step; where its parameters make no camera it raises, and the step is refused.
    `here` is the problem around the start, where it is known.
    """

    def attempt(state: S, step: SchurStep) -> S | None:
        try:
            return moved(state, step)
        except (InputError, DegenerateError):
            return None

    stop = Stop(steps=max_iterations, gain=tolerance, gain_ratio=MIN_GAIN_RATIO, predicted_gain=tolerance)
    end = levenberg_marquardt.minimise(state, linearise, attempt, SOLVER_DAMPING, stop, here=here)
    stopped = f"stopped after {max_iterations} iterations"
    reason = stopped if end.reason == StopReason.STEPS else str(end.reason)
    return Solution(end.state, end.problem.data, end.problem.normal, Convergence(end.steps, end.converged, reason))
