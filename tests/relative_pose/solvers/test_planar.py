"""The planar optimum against brute force, the batch against the single problem, levelling."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.epipolar_scenes import FISHEYE, pair, pose_errors_deg

from rigkit.core.errors import DegenerateError
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3
from rigkit.relative_pose.refinement.level_frames import LevelFrames
from rigkit.relative_pose.solvers.planar import PlanarSolver, solve_planar_batch
from rigkit.relative_pose.solvers.pose import choose_pose, essential_from_pose

GRID_REL = 1e-9
"""The grid's best cell is polished by a general minimiser, whose own tolerance this is."""


def entries(phi, psi):
    return np.stack([-np.cos(phi), np.cos(psi), -np.sin(psi), np.sin(phi)], axis=-1)


def problems(rng, count, rows, noise):
    theta, phi = rng.uniform(-0.5, 0.5, count), rng.uniform(-np.pi, np.pi, count)
    e = entries(phi, phi - theta)
    r = rng.normal(size=(count, rows, 4)) * rng.uniform(0.1, 3.0, (count, 1, 4))
    r -= 0.5 * np.einsum("bni,bi->bn", r, e)[..., None] * e[:, None]
    r += rng.normal(size=r.shape) * noise
    return np.swapaxes(r, 1, 2) @ r, e


@pytest.mark.parametrize("noise", [0.001, 0.1, 3.0])
@pytest.mark.parametrize("rows", [3, 10, 40])
def test_optimum_is_the_global_one(rng, rows, noise):
    """Whole torus on a grid, the eight best cells polished: never better than ours."""
    from scipy.optimize import minimize

    grams, _ = problems(rng, 12, rows, noise)
    e, cost = solve_planar_batch(grams)
    assert np.allclose(np.hypot(e[:, 0], e[:, 3]), 1.0)
    assert np.allclose(np.hypot(e[:, 1], e[:, 2]), 1.0)
    angle = np.linspace(-np.pi, np.pi, 181)
    # The opposite e costs the same: half of one angle's circle suffices.
    phi, psi = np.meshgrid(angle[: len(angle) // 2 + 1], angle, indexing="ij")
    grid = entries(phi, psi).reshape(-1, 4)
    for gram, ours in zip(grams, cost, strict=True):
        values = np.einsum("ni,ij,nj->n", grid, gram, grid)
        starts = np.argsort(values)[:8]
        at = np.stack([phi.ravel()[starts], psi.ravel()[starts]], axis=1)
        brute = min(minimize(lambda x, g=gram: entries(*x) @ g @ entries(*x), s, tol=1e-12).fun for s in at)
        assert ours <= brute * (1 + GRID_REL) + 1e-12 * np.trace(gram)


def test_kink_of_the_dual_is_handled():
    """A double smallest eigenvalue at the optimum: G = I and other symmetric cases."""
    grams = np.stack(
        [np.eye(4), np.diag([1.0, 2.0, 3.0, 4.0]), np.diag([4.0, 1.0, 1.0, 4.0]), np.diag([0, 1.0, 0, 1.0])]
    )
    e, cost = solve_planar_batch(grams)
    assert np.allclose(cost, [2.0, 3.0, 5.0, 0.0], atol=1e-9)
    assert np.abs(np.sum(e**2 * [1, -1, -1, 1], axis=1)).max() < 1e-12


def test_exact_problems_are_recovered(rng):
    grams, e = problems(rng, 500, 10, 0.0)
    found, _ = solve_planar_batch(grams)
    sign = np.sign(np.sum(found * e, axis=1))[:, None]
    assert np.abs(sign * found - e).max() < 1e-11


def test_one_affine_correspondence_and_a_fisheye_are_enough(rng):
    m, pose, _ = pair(rng, 1, "planar", sigma_A=0.0, camera=FISHEYE)
    estimate = PlanarSolver().solve(m)
    found = choose_pose(estimate.E21, m.rays1, m.rays2, "planar")
    assert max(pose_errors_deg(found, pose)) < 1e-5


def test_cameras_that_are_not_level_are_levelled_first(rng):
    m, pose, _ = pair(rng, 12, "planar", sigma_A=0.0)
    R1, R2 = exp_so3([0.1, 0.02, -0.2]), exp_so3([-0.05, 0.1, 0.15])
    tilted, frames = LevelFrames(R1, R2).matches(m), LevelFrames(R1.T, R2.T)
    true = Rigid3(R2, np.zeros(3)) @ pose @ Rigid3(R1, np.zeros(3)).inverse()
    E21 = R2 @ PlanarSolver().solve(frames.matches(tilted)).E21 @ R1.T
    expected = essential_from_pose(true)
    assert min(np.abs(E21 - expected).max(), np.abs(E21 + expected).max()) < 1e-9
    level = PlanarSolver().solve(tilted).E21
    assert min(np.abs(level - expected).max(), np.abs(level + expected).max()) > 1e-2


def test_points_on_the_horizon_determine_nothing(rng):
    _m, pose, X = pair(rng, 20, "planar")
    from rigkit.cameras.pinhole import Pinhole
    from rigkit.core.matches import Matches

    camera = Pinhole((1624, 1240), np.array([1350.0, 1350.0, 800.0, 620.0]))
    flat = X * [1.0, 0.0, 1.0]
    q1, q2 = camera.project(flat)[0], camera.project(pose.apply(flat))[0]
    level = Matches.from_cameras(camera, camera, q1, q2, sigma1_px=np.full(20, 0.01), sigma2_px=np.full(20, 0.01))
    with pytest.raises(DegenerateError, match="horizon"):
        PlanarSolver().solve(level)
