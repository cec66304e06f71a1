"""The solver: derivatives, optimum, and data that determine few parameters."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.calibration_scenes import REACH_DEG, SIZE, lens, random_views
from scipy.optimize import least_squares

from rigkit.calibration.solving.initialise import initialise
from rigkit.calibration.solving.linearise import normal_equations
from rigkit.calibration.solving.normal_equations import SchurStep
from rigkit.calibration.solving.shape import shape_model
from rigkit.calibration.solving.solver import Linearised, minimise, solve, with_priors
from rigkit.calibration.solving.state import State, evaluate
from rigkit.calibration.views.observations import Observations
from rigkit.cameras.base import RadialCurve
from rigkit.cameras.brown import Brown
from rigkit.cameras.eucm import EUCM
from rigkit.cameras.scaramuzza import Scaramuzza
from rigkit.core.errors import InputError
from rigkit.geometry.rotation import exp_so3

GRADIENT_REL = 1e-5
"""Central differences of a sum of squares of about 1e3 px^2 lose five digits more than those of a residual."""
COST_REL = 1e-8
"""The optimum of another solver from the same start: both stop where the cost no longer changes."""

AT_REST = 1e-4
"""Gradient by an unknown that is at its minimum, in parts of the residuals: the cost is within the square of it."""
FEW_ITERATIONS = 7
"""From the radial start; four or five is usual, whatever the model."""


def scene(name: str, rng: np.random.Generator, count: int = 4) -> tuple[Observations, State]:
    camera = lens(name)
    views, rotation, translation = random_views(camera, count, rng, reach_deg=REACH_DEG[name])
    observations = Observations.from_views(views)
    return observations, State.start(camera, rotation, translation, observations)


def disturbed(state: State, rng: np.random.Generator, size: float) -> State:
    views = len(state.rotation)
    return replace(
        state,
        camera=state.camera.with_parameters(
            state.camera.parameters * (1.0 + size * rng.normal(size=state.camera.parameters.size))
        ),
        rotation=exp_so3(size * rng.normal(size=(views, 3))) @ state.rotation,
        translation_mm=state.translation_mm * (1.0 + size * rng.normal(size=(views, 3))),
    )


@pytest.mark.parametrize("kind", ["flat", "warp", "released"])
@pytest.mark.parametrize("name", ["reg", "fish"])
def test_gradient_of_every_unknown(name: str, kind: str, rng: np.random.Generator) -> None:
    """J^T r against central differences of the cost, for intrinsics, shape and poses at once."""
    observations, state = scene(name, rng)
    shape = shape_model(kind, observations)
    state = replace(disturbed(state, rng, 1e-3), shape=shape, unknowns=0.1 * shape.sigma * rng.normal(size=shape.count))
    weight = observations.weight * rng.uniform(0.5, 1.5, observations.weight.shape)
    normal = normal_equations(observations, state, weight)
    p = state.camera.parameters.size
    analytic = -2.0 * np.concatenate([normal.g, normal.p.ravel()])

    def cost(x: np.ndarray) -> float:
        poses = x[p + shape.count :].reshape(-1, 6)
        moved = replace(
            state,
            camera=state.camera.with_parameters(state.camera.parameters + x[:p]),
            unknowns=state.unknowns + x[p : p + shape.count],
            rotation=exp_so3(poses[:, :3]) @ state.rotation,
            translation_mm=state.translation_mm + poses[:, 3:],
        )
        return float(((evaluate(moved, observations).px ** 2).sum(axis=-1) * weight**2).sum())

    step = np.full(analytic.size, 1e-5)
    step[:p] = 1e-6 * np.maximum(np.abs(state.camera.parameters), 1e-2)
    # All intrinsics and poses, and a dozen of the shape's unknowns.
    chosen = np.concatenate([np.arange(p), np.arange(p + shape.count, analytic.size)])
    chosen = np.concatenate([chosen, p + rng.permutation(shape.count)[:12]])
    numeric = np.array(
        [
            (cost(step[k] * np.eye(1, analytic.size, k)[0]) - cost(-step[k] * np.eye(1, analytic.size, k)[0]))
            / (2 * step[k])
            for k in chosen
        ]
    )
    size = np.sqrt(np.concatenate([np.diag(normal.gg), np.einsum("vii->vi", normal.pp).ravel()]))[chosen]
    # The gradient in units of its own curvature: px, whatever the unknown's unit.
    error = np.abs(analytic[chosen] - numeric) / size
    assert error.max() < GRADIENT_REL * np.abs(analytic[chosen] / size).max()


def test_second_derivative_blocks(rng: np.random.Generator) -> None:
    """The Gauss-Newton step of a released board is the same whichever block is eliminated first."""
    observations, state = scene("fish", rng)
    shape = shape_model("released", observations)
    state = replace(disturbed(state, rng, 1e-3), shape=shape, unknowns=np.zeros(shape.count))
    normal = normal_equations(observations, state, observations.weight)
    normal = with_priors(normal, state, 0.2)
    first, second = normal.step(1e-6), replace(normal, points_from=None).step(1e-6)
    assert first is not None and second is not None
    assert np.abs(first.poses - second.poses).max() < 1e-7 * np.abs(second.poses).max()
    assert first.predicted == pytest.approx(second.predicted, rel=1e-7)


@pytest.mark.parametrize("name", ["reg", "fish"])
def test_optimum_is_that_of_scipy(name: str, rng: np.random.Generator) -> None:
    observations, truth = scene(name, rng)
    start = disturbed(truth, rng, 1e-3)
    solution = solve(observations, start, prior_sigma_px=0.0)
    state = solution.state
    assert solution.convergence.converged
    p = start.camera.parameters.size

    def residuals(x: np.ndarray) -> np.ndarray:
        poses = x[p:].reshape(-1, 6)
        moved = replace(
            start,
            camera=start.camera.with_parameters(start.camera.parameters * (1.0 + 1e-2 * x[:p])),
            rotation=exp_so3(1e-2 * poses[:, :3]) @ start.rotation,
            translation_mm=start.translation_mm + poses[:, 3:],
        )
        return evaluate(moved, observations).px.ravel()

    theirs = least_squares(
        residuals, np.zeros(p + 6 * len(start.rotation)), x_scale="jac", xtol=1e-14, ftol=1e-14, gtol=1e-14
    )
    ours = float((evaluate(state, observations).px ** 2).sum())
    assert ours <= 2.0 * theirs.cost * (1.0 + COST_REL)


def test_cauchy_ignores_outliers(rng: np.random.Generator) -> None:
    observations, truth = scene("fish", rng, count=6)
    clean = solve(observations, truth).state
    pixels = observations.pixels.copy()
    pixels[:, ::17] += 30.0
    spoilt = replace(observations, pixels=pixels)
    plain = solve(spoilt, truth).state
    robust = solve(spoilt, truth, loss_px=0.5).state

    def away(state: State) -> float:
        return float(np.abs(state.camera.parameters[:4] - clean.camera.parameters[:4]).max())

    assert away(robust) < 1.0 < away(plain)


def test_corners_outside_the_field_of_view_do_no_harm(rng: np.random.Generator) -> None:
    """A start that sees the board behind the camera ends without an exception and without losing more corners."""
    observations, truth = scene("reg", rng)
    start = replace(truth, translation_mm=truth.translation_mm * np.array([1.0, 1.0, -1.0]))
    solution = solve(observations, start)
    assert solution.convergence.reason
    assert np.isfinite(solution.state.camera.parameters).all()


def test_scaramuzza_converges_quickly(rng: np.random.Generator) -> None:
    """The monomials are nearly dependent; damping must not hold their combinations back."""
    observations, truth = scene("fish", rng, count=10)
    theta = np.linspace(0.02, 1.62, 80)
    radius = truth.camera.project(np.stack([np.sin(theta), 0 * theta, np.cos(theta)], -1))[0][:, 0] - 808.0
    camera = Scaramuzza.from_radial_curve(
        truth.camera.size_px, RadialCurve(np.array([808.0, 615.0]), theta, 1.05 * radius), order=6
    )
    solution = solve(observations, replace(truth, camera=camera))
    assert solution.convergence.converged
    assert solution.convergence.iterations <= 12
    assert np.sqrt((evaluate(solution.state, observations).px ** 2).mean()) < 0.21


@pytest.mark.parametrize("degree", [6, 8, 10])
def test_polynomials_of_high_degree_are_no_harder(degree: int, rng: np.random.Generator) -> None:
    """Derivatives by the coefficients lie 40 powers of ten apart. Few steps, and at their end a dense least-squares
    solution, of columns scaled to one size, promises nothing more."""
    views, _, _ = random_views(lens("fish"), 12, rng, reach_deg=REACH_DEG["fish"])
    observations = Observations.from_views(views)
    start = next(initialise(observations, SIZE, Scaramuzza, degree))
    found = solve(observations, start, prior_sigma_px=0.0)
    assert found.convergence.converged
    assert found.convergence.iterations <= FEW_ITERATIONS
    state = found.state
    points, lever = state.points_in_cam(observations)
    pixels, _, d_pixels_d_point, by_camera = state.camera.project_with_jacobians(points)
    count = by_camera.shape[-1]
    design = np.zeros((*pixels.shape, count + 6 * len(views)))
    design[..., :count] = by_camera
    for k, own in enumerate(np.split(design[..., count:], len(views), axis=-1)):
        own[k, ..., :3], own[k, ..., 3:] = np.cross(lever[k][:, None], d_pixels_d_point[k]), d_pixels_d_point[k]
    design = design.reshape(-1, design.shape[-1])
    residual = (observations.pixels - pixels).reshape(-1)
    design /= np.linalg.norm(design, axis=0)
    left = residual - design @ np.linalg.lstsq(design, residual, rcond=1e-15)[0]
    assert residual @ residual - left @ left < COST_REL * (residual @ residual)


def test_a_step_that_makes_no_camera_is_refused(rng: np.random.Generator) -> None:
    observations, state = scene("reg", rng, 6)
    start, refused = disturbed(state, rng, 1e-3), list[SchurStep]()

    def linearise(state: State) -> Linearised:
        normal = normal_equations(observations, state)
        return Linearised(normal, normal)

    def moved(state: State, step: SchurStep) -> State:
        if not refused:
            refused.append(step)
            raise InputError("no camera")
        return state.moved(step)

    found = minimise(start, linearise, moved)
    assert found.convergence.converged and len(refused) == 1
    assert found.normal.cost == pytest.approx(minimise(start, linearise, State.moved).normal.cost, rel=1e-9)


@pytest.mark.parametrize("start", [0.6, 0.95, 1.0])
def test_a_best_fit_at_the_end_of_a_range_is_found(start: float, rng: np.random.Generator) -> None:
    """The lens would need alpha > 1: at its end all other unknowns are at their minimum, and alpha would grow."""
    barrel = Brown(SIZE, np.array([900.0, 900.0, 640.0, 480.0, -0.2, 0.03, 0.0, 0.0, 0.0]))
    views, rotation, translation = random_views(barrel, 6, rng, reach_deg=REACH_DEG["reg"])
    observations = Observations.from_views(views)
    camera = EUCM(SIZE, np.array([900.0, 900.0, 640.0, 480.0, start, 0.4 / start]))
    found = solve(observations, State.start(camera, rotation, translation, observations))
    assert found.convergence.converged
    assert found.state.camera.parameters[4] == 1.0
    pull = found.normal.g / np.sqrt(np.diag(found.normal.gg))
    assert pull[4] > 0.0
    assert np.abs(np.delete(pull, 4)).max() < AT_REST * np.sqrt(found.normal.cost)
    # No step at all is left: the others do not follow an alpha that stays.
    step = found.normal.step(0.0)
    assert step is not None
    assert step.globals[4] == 0.0
    assert step.predicted < COST_REL * found.normal.cost


@pytest.mark.parametrize("name", ["reg", "fish"])
def test_pose_blocks_with_the_lens_held_are_the_same(name: str, rng: np.random.Generator) -> None:
    observations, state = scene(name, rng)
    whole, held = normal_equations(observations, state), normal_equations(observations, state, lens_held=True)
    assert held.gg.shape == (0, 0)
    for own, alone in ((whole.pp, held.pp), (whole.p, held.p), (whole.costs, held.costs)):
        assert np.allclose(own, alone, rtol=1e-12)
