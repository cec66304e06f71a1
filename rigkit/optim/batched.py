"""Levenberg-Marquardt for many small problems at once, each with its own damping."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray
from rigkit.optim.damping import Damping, Stop

Values = tuple[FloatArray, ...]
"""Arrays whose first axis is over the problems."""


class BatchedProblem(NamedTuple):
    """K linearised problems.

    Attributes
    ----------
    normal, descent : (K, U, U) and (K, U), J^T J and -J^T r.
    cost : (K,) sums of squared residuals.
    """

    normal: FloatArray
    descent: FloatArray
    cost: FloatArray


def minimise_each(
    state: Values,
    linearise: Callable[[Values], BatchedProblem],
    moved: Callable[[Values, FloatArray], Values],
    damping: Damping,
    stop: Stop,
) -> tuple[Values, FloatArray]:
    """Return the states, each at its own minimum, and their costs (K,). A result does not depend on the other problems.

    Parameters
    ----------
    moved : returns the states after steps (K, U).
    damping : `by_gain`, `acceleration` and `refused_floor` are ignored.
    stop : `gain_ratio` and `cost` are ignored.
    """
    here = linearise(state)
    level = np.full(len(here.cost), damping.start)
    active = here.cost > 0.0
    for _ in range(stop.steps):
        if not active.any():
            break
        diagonal = np.diagonal(here.normal, axis1=1, axis2=2)
        added = level[:, None] * np.where(diagonal > 0.0, diagonal, 1.0)
        damped = here.normal.copy()
        damped.reshape(len(damped), -1)[:, :: damped.shape[1] + 1] += added
        step: FloatArray = np.asarray(np.linalg.solve(damped, here.descent[..., None])[..., 0], dtype=np.float64)
        predicted = (step * (added * step + here.descent)).sum(axis=-1)
        trial = moved(state, step)
        there = linearise(trial)
        better = (there.cost < here.cost) & active
        gain = np.where(better, here.cost - there.cost, 0.0)
        done = np.where(better, gain <= stop.gain * here.cost, level > damping.ceiling)
        done |= predicted <= stop.predicted_gain * here.cost
        if better.all():
            state, here = trial, there
        else:
            state = tuple(_chosen(better, new, old) for new, old in zip(trial, state, strict=True))
            here = BatchedProblem(*(_chosen(better, new, old) for new, old in zip(there, here, strict=True)))
        level = np.where(better, np.maximum(damping.shrink * level, damping.floor), damping.growth * level)
        active &= ~done
    return state, here.cost


def _chosen(which: BoolArray, new: FloatArray, old: FloatArray) -> FloatArray:
    """Return rows of `new` where `which`, of `old` elsewhere."""
    return np.where(which.reshape(-1, *[1] * (new.ndim - 1)), new, old)
