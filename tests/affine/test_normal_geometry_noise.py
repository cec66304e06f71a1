"""Errors of normals from corner noise and pose noise alone (directions exact): prediction against Monte Carlo."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.affine_scenes import FISHEYE, REGULAR, Corners, angles_deg, see

from rigkit.affine.affinities import EpipolarNormals
from rigkit.affine.normal import estimate_normals, geometry_covariance, normals_from_affines
from rigkit.affine.registry import affines_from_directions
from rigkit.cameras.base import Camera
from rigkit.core.matches import Matches
from rigkit.geometry.projection_jacobian import pair_projection_jacobians
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3, skew
from rigkit.geometry.triangulation import triangulate_rays

PREDICTED = 0.12
"""Root mean square over 48 corners x 150 trials; a corner beside the epipole weighs heavily."""
UNIMPORTANT = 0.25
"""To the side the share is under 0.02 degrees, and what is left out of it (the lens's magnification) is of its size."""
TRIALS = 150
SIGMA_PX = 0.1

FORWARD = Rigid3(exp_so3(np.array([0.01, -0.02, 0.0])), [15.0, -10.0, -200.0])
SIDE = Rigid3(exp_so3(np.array([0.1, -0.3, 0.15])), [-260.0, 60.0, 90.0])
BOARD = Rigid3(exp_so3(np.array([0.3, -0.4, 0.3])), [60.0, -140.0, 900.0])


def normals_of(
    c: Corners, camera: Camera, pose: Rigid3, method: str, pixels1: np.ndarray, pixels2: np.ndarray
) -> tuple[np.ndarray, Matches, np.ndarray]:
    """The pipeline's steps at these pixels with this pose."""
    m = Matches.from_cameras(camera, camera, pixels1, pixels2)
    E21 = skew(pose.translation_mm) @ pose.rotation
    e = EpipolarNormals.of_matches(m, E21)
    A21 = affines_from_directions(c.directions(), method, epipolar=e, min_conditioning=0.0).A21
    points, _ = triangulate_rays(m.rays1, m.rays2, pose, jacobians1=m.jacobians1, jacobians2=m.jacobians2)
    J1, J2 = pair_projection_jacobians(points, m.rays1, m.jacobians1, m.rays2, m.jacobians2, pose)
    return normals_from_affines(J1, J2, A21)[0], m, A21


@pytest.mark.parametrize("method", ["F3UDIR", "2SDIR"])
@pytest.mark.parametrize(
    ("camera", "pose", "limit"),
    [(REGULAR, FORWARD, PREDICTED), (REGULAR, SIDE, UNIMPORTANT), (FISHEYE, FORWARD, PREDICTED)],
    ids=["forward", "side", "fisheye"],
)
def test_corner_errors(camera: Camera, pose: Rigid3, limit: float, method: str, rng: np.random.Generator) -> None:
    c = see(camera, camera, pose, [BOARD])
    assert c is not None
    _, m, A21 = normals_of(c, camera, pose, method, c.pixels1, c.pixels2)

    def follow(e: EpipolarNormals) -> np.ndarray:
        return affines_from_directions(c.directions(), method, epipolar=e, min_conditioning=0.0).A21

    sigma = np.full(len(c), SIGMA_PX)
    seen = replace(m, sigma1_px=sigma, sigma2_px=sigma)
    share = geometry_covariance(seen, pose, follow if method == "F3UDIR" else A21)
    square = np.zeros(len(c))
    for _ in range(TRIALS):
        noisy = [q + SIGMA_PX * rng.normal(size=q.shape) for q in (c.pixels1, c.pixels2)]
        normals, _, _ = normals_of(c, camera, pose, method, *noisy)
        square += np.radians(angles_deg(normals, c.normals)) ** 2 / TRIALS
    predicted = np.trace(share, axis1=1, axis2=2)
    assert np.sqrt(square.mean() / predicted.mean()) == pytest.approx(1.0, abs=limit)
    assert np.median(np.sqrt(square / predicted)) == pytest.approx(1.0, abs=limit)
    if pose is SIDE:
        assert np.degrees(np.sqrt(predicted.mean())) < 0.02


def test_pose_errors(rng: np.random.Generator) -> None:
    c = see(REGULAR, REGULAR, SIDE, [BOARD])
    assert c is not None
    _, m, A21 = normals_of(c, REGULAR, SIDE, "2SDIR", c.pixels1, c.pixels2)
    half = np.diag([2e-4, 3e-4, 1e-4, 0.3, 0.2, 0.4]) @ (np.eye(6) + 0.3 * np.tri(6, k=-1))
    still = replace(m, sigma1_px=np.zeros(len(c)), sigma2_px=np.zeros(len(c)))
    share = geometry_covariance(still, SIDE, A21, half @ half.T)
    square = np.zeros(len(c))
    for _ in range(600):
        change = half @ rng.normal(size=6)
        pose = Rigid3(exp_so3(change[:3]) @ SIDE.rotation, SIDE.translation_mm + change[3:])
        normals, _, _ = normals_of(c, REGULAR, pose, "2SDIR", c.pixels1, c.pixels2)
        square += np.radians(angles_deg(normals, c.normals)) ** 2 / 600
    ratio = np.sqrt(square / np.trace(share, axis1=1, axis2=2))
    assert np.abs(ratio - 1.0).max() < PREDICTED


def test_is_added_to_the_estimate() -> None:
    c = see(REGULAR, REGULAR, SIDE, [BOARD])
    assert c is not None
    share = np.broadcast_to(np.diag([1e-4, 2e-4, 1e-4]), (len(c), 3, 3))
    of_A21 = np.tile(1e-6 * np.eye(4), (len(c), 1, 1))
    without = estimate_normals(c.J1, c.J2, c.A21, covariance=of_A21)
    with_it = estimate_normals(c.J1, c.J2, c.A21, covariance=of_A21, geometry=share)
    np.testing.assert_allclose(with_it.sigma_rad**2 - without.sigma_rad**2, 4e-4, rtol=1e-9)
