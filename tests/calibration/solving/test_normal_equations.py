"""Costs and gradients of priors, and the standard deviation that a fit leaves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.calibration_scenes import REACH_DEG, lens, random_views

from rigkit.calibration.solving.camera_prior import camera_prior
from rigkit.calibration.solving.fit import _sigma
from rigkit.calibration.solving.linearise import normal_equations
from rigkit.calibration.solving.shape import shape_model
from rigkit.calibration.solving.solver import with_priors
from rigkit.calibration.solving.state import State
from rigkit.calibration.views.observations import Observations
from rigkit.core.errors import DegenerateError

SIGMA_PX = 0.2


def scene(rng: np.random.Generator, kind: str = "flat") -> tuple[Observations, State]:
    camera = lens("reg")
    views, rotation, translation = random_views(camera, 4, rng, reach_deg=REACH_DEG["reg"])
    observations = Observations.from_views(views)
    shape = shape_model(kind, observations)
    start = State.start(camera, rotation, translation, observations)
    return observations, replace(start, shape=shape, unknowns=0.1 * shape.sigma * rng.normal(size=shape.count))


def test_costs_are_sums_of_squares_and_their_gradients_follow(rng: np.random.Generator) -> None:
    observations, state = scene(rng, "warp")
    normal = normal_equations(observations, state, observations.weight)
    px = normal.residuals[0].px
    length = np.hypot(px[..., 0], px[..., 1]) * observations.weight
    np.testing.assert_allclose(normal.residuals[0].weighted(observations), length, rtol=1e-12)
    assert normal.cost == pytest.approx(float((length**2).sum()), rel=1e-9)

    def priors(parameters: np.ndarray, unknowns: np.ndarray) -> float:
        _, deviation = camera_prior(state.camera.with_parameters(parameters))
        return float(SIGMA_PX**2 * ((deviation**2).sum() + ((unknowns / state.shape.sigma) ** 2).sum()))

    here = np.concatenate([state.camera.parameters, state.unknowns])
    p = state.camera.parameters.size
    known = with_priors(normal, state, SIGMA_PX)
    assert known.cost - normal.cost == pytest.approx(priors(here[:p], here[p:]), rel=1e-9)
    step = 1e-4 * np.maximum(np.abs(here), 1e-2)
    slopes = [
        (priors((here + s)[:p], (here + s)[p:]) - priors((here - s)[:p], (here - s)[p:])) / (2.0 * s.sum())
        for s in np.diag(step)
    ]
    # The ratio of the focal lengths changes its own scale with them.
    np.testing.assert_allclose(-2.0 * (known.g - normal.g), slopes, rtol=0.02, atol=1e-4 * np.abs(slopes).max())
    off, root = rng.normal(size=3), rng.normal(size=(3, 3))
    quadratic = known.with_quadratic(slice(2, 5), off, root @ root.T)
    assert quadratic.cost - known.cost == pytest.approx(((off @ root) ** 2).sum(), rel=1e-6)
    np.testing.assert_allclose(quadratic.g[2:5] - known.g[2:5], -root @ root.T @ off, rtol=1e-9)
    np.testing.assert_allclose(quadratic.gg[2:5, 2:5] - known.gg[2:5, 2:5], root @ root.T, rtol=1e-6)


def test_the_standard_deviation_is_of_coordinates_less_unknowns(rng: np.random.Generator) -> None:
    observations, state = scene(rng)
    kept = observations.present.copy()
    kept[0] = False
    unknowns = state.camera.parameters.size + 6 * 3
    assert _sigma(state, 7.0, kept) == pytest.approx(np.sqrt(7.0 / (2 * kept.sum() - unknowns)))
    few = np.zeros_like(kept)
    few[1:, : unknowns // 6] = True
    assert 2 * few.sum() <= unknowns
    with pytest.raises(DegenerateError, match="at least as many unknowns"):
        _sigma(state, 7.0, few)
