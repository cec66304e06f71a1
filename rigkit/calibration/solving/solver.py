"""Levenberg-Marquardt over intrinsics, board shapes and board poses, with the poses eliminated by 6x6 blocks.

One camera, V views padded to C corners. Unknowns are the globals (intrinsics, then shape) and, for each view, a pose
perturbation (w, dt): R <- exp(w) R, t <- t + dt, so that no rotation is singular. The normal matrix of all views is one
batched product. The reduced (Schur) system has the size of the globals only, so the cost is linear in views.

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
"""Relative predicted decrease of the cost at which the solver stops: Gauss-Newton converges quadratically here, so the
cost is then within about 1e-10 of its minimum."""
FROM_OPTIMUM = 1e-6
"""The same for a solve that starts at the optimum of nearly the same problem (some images less, another lens): smaller
steps change no digit that is shown."""
MIN_GAIN_RATIO = 0.5
"""A step with a small gain is the last one only if its gain ratio is above this: a step that was too long is no sign of
convergence."""
SOLVER_DAMPING = Damping(start=1e-13, shrink=0.01, growth=4.0, acceleration=2.0, ceiling=1e12, by_gain=True)
"""Monomials of a polynomial are nearly dependent (eigenvalues down to 1e-12 of the scaled system at degree 6). A larger
damping would suppress their combinations, and a shrink of 1/3 would take dozens of steps. A step that is too long is
refused, and the damping grows quickly."""


@dataclass(frozen=True, slots=True)
class Convergence:
    """How the last solve ended.

    Attributes
    ----------
    iterations : number of steps tried.
    converged, reason : whether it converged, and why it stopped, in words.
    """

    iterations: int
    converged: bool
    reason: str


@dataclass(frozen=True, eq=False, slots=True)
class Linearised(LinearisedProblem):
    """The problem linearised at a state: normal equations of the corners, and with all priors added."""

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
    """The solution, its normal equations, of the corners alone and with all priors, and how the solver ended."""

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
    """Return the state that minimises the weighted residuals, from the initial state `start`. Never raises for lack of
    data: undetermined unknowns keep their initial values.

    Parameters
    ----------
    weight : (V, C) weights of the residuals (not squared), zero for corners to ignore; the observations' own by
        default.
    loss_px : scale of the Cauchy loss; None for least squares.
    prior_sigma_px : standard deviation of a corner, which scales residuals against the priors of shape and camera; zero
        for no priors.
    at_start : the normal equations at `start`, without priors, if known.
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
    """Return the local minimum near `state`, by Levenberg-Marquardt.

    `linearise` returns cost and normal equations together, as nearly every step is taken. `moved` returns the state
    after a step; where the parameters are invalid for the model it raises, and the step is refused. `here` is the
    problem linearised at `state`, if known.
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
