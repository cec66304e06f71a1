"""Affinities and homographies in both directions; the printed derivative of a homography fails."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.affine_scenes import REGULAR, Corners, see
from helpers.differences import central_difference
from helpers.tolerances import EXACT_REL

from rigkit.affine.homography import (
    affines_from_homography,
    homography_from_affines,
    homography_from_plane,
)
from rigkit.core.errors import DegenerateError, InputError
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3

FINITE_DIFFERENCE = 1e-7
TWO_AFFINITIES = 1e-7
"""Homographies from two neighbouring corners, extrapolated over the board, relative entries."""

POSE = Rigid3(exp_so3(np.array([0.12, -0.35, 0.2])), [-260.0, 60.0, 90.0])
BOARD = Rigid3(exp_so3(np.array([0.5, -0.4, 0.3])), [-100.0, -140.0, 1100.0])


@pytest.fixture(scope="module")
def corners() -> Corners:
    out = see(REGULAR, REGULAR, POSE, [BOARD])
    assert out is not None
    return out


@pytest.fixture(scope="module")
def H21(corners: Corners) -> np.ndarray:
    normal = corners.normals[0]
    return homography_from_plane(REGULAR.K, REGULAR.K, POSE, normal, float(normal @ corners.points[0]))


def test_plane_homography_maps_the_pixels(corners: Corners, H21: np.ndarray) -> None:
    q = np.concatenate([corners.pixels1, np.ones((len(corners), 1))], axis=1) @ H21.T
    np.testing.assert_allclose(q[:, :2] / q[:, 2:], corners.pixels2, atol=1e-8)


def test_affinity_of_a_homography(corners: Corners, H21: np.ndarray) -> None:
    A21, valid = affines_from_homography(-2.7 * H21, corners.pixels1)
    assert valid.all()
    np.testing.assert_allclose(A21, corners.A21, rtol=EXACT_REL)

    def mapped(q: np.ndarray) -> np.ndarray:
        x = q @ H21[:, :2].T + H21[:, 2]
        return x[..., :2] / x[..., 2:]

    np.testing.assert_allclose(A21, central_difference(mapped, corners.pixels1, 1e-2), atol=FINITE_DIFFERENCE)


def test_printed_affinity_of_a_homography_fails(corners: Corners, H21: np.ndarray) -> None:
    """Printed: a2 = (h2 - h8 v2)/s, a3 = (h4 - h7 u2)/s, with u2 and v2 exchanged."""
    s = corners.pixels1 @ H21[2, :2] + H21[2, 2]
    a2 = (H21[0, 1] - H21[2, 1] * corners.pixels2[:, 1]) / s
    a3 = (H21[1, 0] - H21[2, 0] * corners.pixels2[:, 0]) / s
    assert np.median(np.abs(a2 - corners.A21[:, 0, 1])) > 0.01
    assert np.median(np.abs(a3 - corners.A21[:, 1, 0])) > 0.01


def test_at_infinity_is_invalid() -> None:
    H21 = np.array([[1.0, 0, 0], [0, 1, 0], [1, 0, 0]])
    A21, valid = affines_from_homography(H21, np.array([[0.0, 3.0], [1.0, 2.0]]))
    assert valid.tolist() == [False, True]
    assert np.isnan(A21[0]).all()


@pytest.mark.parametrize("which", [[0, 1], [3, 29, 47], list(range(48))])
def test_homography_from_affinities(corners: Corners, H21: np.ndarray, which: list[int]) -> None:
    c = corners.select(np.array(which))
    found = homography_from_affines(c.pixels1, c.pixels2, c.A21)
    scaled = found / np.linalg.norm(found) * np.sign(found[2, 2] * H21[2, 2])
    np.testing.assert_allclose(scaled, H21, atol=TWO_AFFINITIES * np.abs(H21).max())


def test_homography_from_affinities_refuses(corners: Corners) -> None:
    one = corners.select(np.array([0]))
    with pytest.raises(InputError, match="two points or more"):
        homography_from_affines(one.pixels1, one.pixels2, one.A21)
    twice = corners.select(np.array([5, 5]))
    with pytest.raises(DegenerateError):
        homography_from_affines(twice.pixels1, twice.pixels2, twice.A21)


@pytest.mark.parametrize("name", ["pixels1", "pixels2", "A21"])
def test_a_homography_of_unknown_numbers_is_refused(name):
    given = {"pixels1": np.eye(2), "pixels2": np.eye(2), "A21": np.tile(np.eye(2), (2, 1, 1))}
    given[name][1] = np.nan
    with pytest.raises(InputError, match="NaN"):
        homography_from_affines(given["pixels1"], given["pixels2"], given["A21"])


def test_a_homography_of_many_points_needs_little_memory(rng):
    # All left singular vectors of the six rows of each point would take 30 GB.
    H = np.array([[1.1, 0.1, 20.0], [-0.1, 0.9, -30.0], [1e-4, -2e-4, 1.0]])
    q1 = rng.uniform(0.0, 1000.0, (10_000, 2))
    A21, _ = affines_from_homography(H, q1)
    q2 = np.concatenate([q1, np.ones((10_000, 1))], axis=1) @ H.T
    found = homography_from_affines(q1, q2[:, :2] / q2[:, 2:], A21)
    assert found == pytest.approx(H / np.linalg.norm(H), abs=EXACT_REL)
