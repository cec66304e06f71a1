"""Levenberg-Marquardt reaches known minima, reports how it ended, and rejects harmful steps."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np
import pytest

from rigkit.core.arrays import FloatArray
from rigkit.optim.batched import BatchedProblem, minimise_each
from rigkit.optim.damping import Damping, Stop, StopReason
from rigkit.optim.levenberg_marquardt import DenseProblem, DenseStep, damped_step, minimise

TENFOLD = Damping(start=1e-3, ceiling=1e8)
NIELSEN = Damping(start=1e-3, ceiling=1e12, shrink=1.0 / 3.0, growth=2.0, acceleration=2.0, by_gain=True)
AT_MINIMUM = 1e-6
"""Of unknowns near 1, where steps end that gain less than 1e-14 of the cost: its square root, and room."""


def rosenbrock(x: FloatArray) -> DenseProblem:
    """The banana valley as residuals; minimum 0 at (1, 1)."""
    residual = np.array([10.0 * (x[1] - x[0] ** 2), 1.0 - x[0]])
    return DenseProblem(residual, np.array([[-20.0 * x[0], 10.0], [-1.0, 0.0]]))


def moved(x: FloatArray, step: DenseStep) -> FloatArray:
    return x + step.change


@pytest.mark.parametrize("damping", [TENFOLD, NIELSEN])
def test_curved_valley(damping: Damping) -> None:
    stop = Stop(steps=200, gain=1e-14, cost=1e-20)
    end = minimise(np.array([-1.2, 1.0]), rosenbrock, moved, damping, stop)
    assert end.converged and end.reason == StopReason.STATIONARY
    assert np.abs(end.state - 1.0).max() < AT_MINIMUM
    assert end.problem.cost == rosenbrock(end.state).cost


def test_every_taken_step_lowers_the_cost() -> None:
    seen = []

    def linearise(x: FloatArray) -> DenseProblem:
        seen.append(rosenbrock(x))
        return seen[-1]

    costs = []
    for steps in range(1, 30):
        costs.append(minimise(np.array([-1.2, 1.0]), rosenbrock, moved, TENFOLD, Stop(steps=steps)).problem.cost)
    assert (np.diff(costs) <= 0.0).all()
    assert costs[-1] < 0.1 * rosenbrock(np.array([-1.2, 1.0])).cost
    minimise(np.array([-1.2, 1.0]), linearise, moved, TENFOLD, Stop(steps=29))
    assert any(b.cost > a.cost for a, b in itertools.pairwise(seen)), "no step was ever refused: the test shows nothing"


def test_end_is_said() -> None:
    used_up = minimise(np.array([-1.2, 1.0]), rosenbrock, moved, TENFOLD, Stop(steps=2))
    assert used_up.reason == StopReason.STEPS and used_up.steps == 2 and not used_up.converged
    nowhere = minimise(np.array([-1.2, 1.0]), rosenbrock, lambda x, step: None, TENFOLD, Stop(steps=99))
    assert nowhere.reason == StopReason.NO_SMALLER_COST
    assert (nowhere.state == [-1.2, 1.0]).all()
    start = minimise(np.array([1.0, 1.0]), rosenbrock, moved, TENFOLD, Stop(steps=99, predicted_gain=1e-12))
    assert start.reason == StopReason.STATIONARY and start.steps == 1
    broken = DenseProblem(np.ones(2), np.full((2, 2), np.nan))
    lost = minimise(np.zeros(2), lambda x: broken, moved, TENFOLD, Stop(steps=99))
    assert not lost.state.any()


def test_small_step_is_the_last() -> None:
    end = minimise(
        np.array([-1.2, 1.0]), rosenbrock, moved, TENFOLD, Stop(steps=99), small=lambda s: np.abs(s.change).max() < 0.5
    )
    assert end.reason == StopReason.STATIONARY
    assert end.steps < 10


def test_damping_schedules() -> None:
    assert NIELSEN.taken(1.0, 1.0) == pytest.approx(1.0 / 3.0)
    assert NIELSEN.taken(1.0, 0.5) == 1.0
    assert NIELSEN.taken(1.0, 0.25) == pytest.approx(1.125)
    level, growth = NIELSEN.refused(1.0, NIELSEN.growth)
    assert (level, growth) == (2.0, 4.0)
    floored = Damping(start=1.0, ceiling=9.0, floor=0.5, refused_floor=7.0)
    assert floored.taken(1.0, 1.0) == 0.5
    assert floored.refused(0.1, 10.0) == (7.0, 10.0)


def test_damped_step_is_that_of_the_normal_equations(rng: np.random.Generator) -> None:
    """Whatever the units of the unknowns; a column of zeros stays where it is."""
    jacobian, residual = rng.normal(size=(30, 4)) * [1e-3, 1.0, 1e4, 0.0], rng.normal(size=30)
    step = damped_step(jacobian, residual, 0.3)
    assert step is not None
    normal = jacobian.T @ jacobian
    own = np.linalg.solve((normal + 0.3 * np.diag(np.diag(normal)))[:3, :3], -(jacobian.T @ residual)[:3])
    np.testing.assert_allclose(step.change, [*own, 0.0], rtol=1e-9)
    left = residual + jacobian @ step.change
    assert step.predicted == pytest.approx(residual @ residual - left @ left, rel=1e-9)


def exponentials(rng: np.random.Generator, count: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    x = np.linspace(0.0, 3.0, 25)
    truth = np.stack([rng.uniform(0.5, 4.0, count), rng.uniform(0.2, 3.0, count)], axis=1)
    return x, truth, truth[:, :1] * np.exp(-truth[:, 1:] * x)


def batch_of(x: FloatArray, y: FloatArray) -> Callable[[tuple[FloatArray, ...]], BatchedProblem]:
    def linearise(state: tuple[FloatArray, ...]) -> BatchedProblem:
        (a,) = state
        decay = np.exp(-a[:, 1:] * x)
        residual = a[:, :1] * decay - y
        jacobian = np.stack([decay, -x * a[:, :1] * decay], axis=-1)
        turned = np.swapaxes(jacobian, 1, 2)
        return BatchedProblem(turned @ jacobian, -(turned @ residual[..., None])[..., 0], (residual**2).sum(axis=1))

    return linearise


def test_batch_finds_every_minimum(rng: np.random.Generator) -> None:
    x, truth, y = exponentials(rng, 40)
    stop = Stop(steps=100, gain=1e-14, predicted_gain=1e-28)
    (found,), cost = minimise_each((np.full((40, 2), 1.0),), batch_of(x, y), lambda s, d: (s[0] + d,), TENFOLD, stop)
    assert np.abs(found - truth).max() < AT_MINIMUM
    assert (cost < AT_MINIMUM**2).all()


def test_frozen_batch_does_not_depend_on_its_company(rng: np.random.Generator) -> None:
    x, _, y = exponentials(rng, 12)
    y = y + rng.normal(0.0, 0.05, y.shape)

    def solved(which: slice) -> FloatArray:
        start = (np.full((len(y[which]), 2), 1.0),)
        linearise = batch_of(x, y[which])
        return minimise_each(start, linearise, lambda s, d: (s[0] + d,), TENFOLD, Stop(steps=100, gain=1e-6))[0][0]

    together = solved(slice(None))
    alone = np.concatenate([solved(slice(k, k + 1)) for k in range(12)])
    np.testing.assert_allclose(together, alone, rtol=1e-12)
