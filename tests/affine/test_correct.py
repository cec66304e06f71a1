"""Affinities made consistent with epipolar geometry, in two views and in many."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.affine_scenes import FISHEYE, REGULAR, Corners, angles_deg, see
from tolerances import EXACT_REL, ROUNDING

from rigkit.affine.affinities import EpipolarNormals
from rigkit.affine.correct import correct_affines, correct_frames, epipolar_residuals
from rigkit.affine.normal import normals_from_affines
from rigkit.affine.surface import affines_from_normals
from rigkit.cameras.base import Camera
from rigkit.core.errors import InputError
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3, unit

POSE = Rigid3(exp_so3(np.array([0.1, -0.3, 0.15])), [-260.0, 60.0, 90.0])
BOARD = Rigid3(exp_so3(np.array([0.5, -0.4, 0.3])), [-100.0, -140.0, 900.0])
SAME_NORMAL_DEG = 1e-9


@pytest.fixture(params=[REGULAR, FISHEYE], ids=["pinhole", "fisheye"])
def corners(request: pytest.FixtureRequest) -> Corners:
    camera: Camera = request.param
    out = see(camera, camera, POSE, [BOARD])
    assert out is not None
    return out


def test_corrected_affinities_fulfil_the_equations(corners: Corners, rng: np.random.Generator) -> None:
    noisy = corners.A21 + 0.1 * rng.normal(size=corners.A21.shape)
    corrected, valid = correct_affines(noisy, corners.epipolar)
    assert valid.all()
    assert np.abs(epipolar_residuals(noisy, corners.epipolar)).max() > 0.05
    assert np.abs(epipolar_residuals(corrected, corners.epipolar)).max() < ROUNDING
    np.testing.assert_allclose(correct_affines(corners.A21, corners.epipolar)[0], corners.A21, atol=ROUNDING)


def test_correction_is_the_smallest(corners: Corners, rng: np.random.Generator) -> None:
    """It is the affinity of the optimal normal, and no other affinity of a surface is nearer."""
    noisy = corners.A21 + 0.1 * rng.normal(size=corners.A21.shape)
    corrected, _ = correct_affines(noisy, corners.epipolar)
    best = np.linalg.norm(corrected - noisy, axis=(1, 2))
    for _ in range(50):
        normals = unit(corners.normals + 0.3 * rng.normal(size=corners.normals.shape))
        other, _ = affines_from_normals(corners.J1, corners.J2, normals)
        assert (np.linalg.norm(other - noisy, axis=(1, 2)) >= best * (1.0 - EXACT_REL)).all()


def test_optimal_normal_is_that_of_the_corrected_affinity(corners: Corners, rng: np.random.Generator) -> None:
    noisy = corners.A21 + 0.05 * rng.normal(size=corners.A21.shape)
    corrected, _ = correct_affines(noisy, corners.epipolar)
    direct, valid1 = normals_from_affines(corners.J1, corners.J2, noisy)
    after, valid2 = normals_from_affines(corners.J1, corners.J2, corrected)
    assert valid1.all()
    assert valid2.all()
    assert angles_deg(direct, after).max() < SAME_NORMAL_DEG
    np.testing.assert_allclose(affines_from_normals(corners.J1, corners.J2, direct)[0], corrected, atol=EXACT_REL)


def test_epipole_is_invalid(corners: Corners) -> None:
    n2 = corners.n2.copy()
    n2[3] = 0.0
    corrected, valid = correct_affines(corners.A21, EpipolarNormals(corners.n1, n2))
    assert not valid[3]
    assert valid.sum() == len(corners) - 1
    assert np.isnan(corrected[3]).all()


def three_views() -> tuple[np.ndarray, list[EpipolarNormals]]:
    """Exact frames (N, 3, 2, 2) of a board in three views and the epipolar normals of all pairs."""
    second = Rigid3(exp_so3(np.array([-0.2, 0.1, 0.0])), [100.0, -220.0, 40.0])
    pairs = [
        see(REGULAR, REGULAR, POSE, [BOARD]),
        see(REGULAR, REGULAR, second, [BOARD]),
        see(REGULAR, REGULAR, second @ POSE.inverse(), [POSE @ BOARD]),
    ]
    assert all(p is not None for p in pairs)
    first, other, _ = pairs
    frames = np.stack([first.exact1[:, :2], first.exact2[:, :2], other.exact2[:, :2]], axis=1)  # type: ignore[union-attr]
    return np.swapaxes(frames, -1, -2), [p.epipolar for p in pairs]  # type: ignore[union-attr]


def test_frames_of_three_views(rng: np.random.Generator) -> None:
    frames, epipolars = three_views()
    pairs = [(0, 1), (0, 2), (1, 2)]
    exact, valid = correct_frames(frames, pairs, epipolars)
    assert valid.all()
    np.testing.assert_allclose(exact, frames, atol=1e-8 * np.abs(frames).max())
    noisy = frames + 2.0 * rng.normal(size=frames.shape)
    corrected, _ = correct_frames(noisy, pairs, epipolars)
    for (i, j), epipolar in zip(pairs, epipolars, strict=True):
        A = corrected[:, j] @ np.linalg.inv(corrected[:, i])
        assert np.abs(epipolar_residuals(A, epipolar)).max() < 1e-8
    # A projection on the truth's subspace brings every frame nearer to the truth, and moves it no further than needed.
    n = len(frames)
    before, after = (np.linalg.norm((f - frames).reshape(n, -1), axis=1) for f in (noisy, corrected))
    assert (after < before).all()
    moved = np.linalg.norm((noisy - corrected).reshape(n, -1), axis=1)
    np.testing.assert_allclose(before**2, after**2 + moved**2, rtol=1e-6)


def test_two_view_frames_agree_with_the_equations(corners: Corners, rng: np.random.Generator) -> None:
    frames = np.swapaxes(np.stack([corners.exact1[:, :2], corners.exact2[:, :2]], axis=1), -1, -2)
    corrected, _ = correct_frames(frames + rng.normal(size=frames.shape), [(0, 1)], [corners.epipolar])
    A = corrected[:, 1] @ np.linalg.inv(corrected[:, 0])
    assert np.abs(epipolar_residuals(A, corners.epipolar)).max() < ROUNDING * 100


def test_frames_refuse_wrong_pairs(corners: Corners) -> None:
    with pytest.raises(InputError, match="view numbers"):
        correct_frames(np.zeros((len(corners), 2, 2, 2)), [(0, 2)], [corners.epipolar])
