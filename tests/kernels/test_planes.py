"""The kernel that fits planes to nodes of a grid agrees with its definition in numpy, and keeps edges sharp."""

from __future__ import annotations

import numpy as np
import pytest
from kernels.reference import planes as reference

from rigkit.geometry.rotation import unit
from rigkit.kernels.planes import PlaneFits, fitted_planes

REACH, ROUNDS, TURN, STEP = 3, 5, 2.385, 4.0
ROUNDING = 1e-4
"""Both solve badly scaled systems of three unknowns, twice as many digits lost as kept; the loss has several minima."""


def step_edge(rng: np.random.Generator) -> tuple[np.ndarray, ...]:
    """Two planes side by side, seen by a pinhole of 300 px; values, information, frames, and the truth."""
    rows, columns = 20, 30
    v, u = np.mgrid[:rows, :columns] * STEP
    x = np.stack([(u - 60.0) / 300.0, (v - 40.0) / 300.0, np.ones_like(u)], axis=-1)
    rays = unit(x)
    length = np.linalg.norm(x, axis=-1)[..., None]
    across = (np.eye(3) - rays[..., :, None] * rays[..., None, :]) / length[..., None] / 300.0
    frames = np.concatenate([rays[..., None, :], across[..., :2].swapaxes(-1, -2)], axis=-2)
    near = u < 60.0
    truth = np.where(near[..., None], np.array([0.1, 0.0, 1.0]), np.array([0.0, -0.2, 0.7]))
    sigmas = np.array([2e-3, 2e-4, 2e-4])
    values = (frames @ truth[..., None])[..., 0] + sigmas * rng.normal(size=(rows, columns, 3))
    values[rng.random((rows, columns)) < 0.15] = np.nan
    return values, np.broadcast_to(np.diag(sigmas**-2.0), (rows, columns, 3, 3)), frames, truth


def fitted(values: np.ndarray, information: np.ndarray, frames: np.ndarray, reach: int = REACH) -> PlaneFits:
    """Return the planes through values at their nodes, 4 px apart, of windows without extent."""
    shape = values.shape[:2]
    return fitted_planes(
        values,
        information,
        frames,
        offsets=np.zeros((*shape, 2)),
        windows=np.zeros(shape),
        step=STEP,
        reach=reach,
        rounds=ROUNDS,
        turn=TURN,
    )


def test_planes_are_fitted_as_defined(rng: np.random.Generator) -> None:
    values, information, frames, _ = step_edge(rng)
    offsets, windows = rng.uniform(-2.0, 2.0, (*values.shape[:2], 2)), rng.uniform(10.0, 30.0, values.shape[:2])
    ours, theirs = (
        fit(
            values,
            information,
            frames,
            offsets=offsets,
            windows=windows,
            step=STEP,
            reach=REACH,
            rounds=ROUNDS,
            turn=TURN,
        )
        for fit in (fitted_planes, reference.fitted_planes)
    )
    for one, two in zip(ours, theirs, strict=True):
        np.testing.assert_array_equal(np.isfinite(one), np.isfinite(two))
        scale = np.nanmax(np.abs(two))
        assert np.nanmax(np.abs(one - two)) < ROUNDING * scale


def test_an_edge_stays_sharp(rng: np.random.Generator) -> None:
    values, information, frames, truth = step_edge(rng)
    fits = fitted(values, information, frames)
    good, planes = np.isfinite(fits.support), fits.planes
    assert good.sum() > 450
    off = np.abs(np.sum((planes - truth) * frames[..., 0, :], axis=-1))[good]
    # The step is 0.3; noise of 2e-3 averages out.
    assert np.median(off) < 1e-3
    assert off.max() < 0.01
    # The other plane's nodes say nothing of how this one's scatter; the loss leaves three quarters of a variance of 1.
    assert 0.6 < np.median((fits.squares / fits.support)[good]) / 3.0 < 0.9


def test_planes_without_memory_are_an_error(rng: np.random.Generator) -> None:
    """A million nodes to each side of the grid are more than an address space holds."""
    values, information, frames, _ = step_edge(rng)
    with pytest.raises(MemoryError):
        fitted(values, information, frames, reach=1_000_000)
