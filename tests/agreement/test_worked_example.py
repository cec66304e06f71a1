"""One corner worked out by hand to ten digits: rotation, F, affinity, the noisy estimators and their normals."""

from __future__ import annotations

import numpy as np
import pytest

from rigkit.affine.affinities import EpipolarNormals
from rigkit.affine.normal import affines_from_normals, normals_from_affines
from rigkit.affine.registry import affines_from_directions
from rigkit.cameras.pinhole import Pinhole
from rigkit.core.matches import DirectionPairs, Matches
from rigkit.geometry.projection_jacobian import pair_projection_jacobians
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import angle_between, exp_so3, skew, unit

PRINTED = 1.5e-10
"""The example is printed to ten decimals."""

CAMERA = Pinhole((1600, 1240), np.array([1350.0, 1350.0, 800.0, 620.0]))
CAM2_FROM_CAM1 = Rigid3(exp_so3(np.radians(12.0) * unit(np.array([0.2, 1.0, -0.1]))), [-0.3, 0.02, 0.05])
POINT = np.array([[0.1, -0.05, 1.2]])
NORMAL = unit(np.array([0.3, -0.2, -1.0]))
A_TRUE = np.array([[1.0621354319, -0.0287841124], [-0.0361377976, 1.0041710627]])


@pytest.fixture(scope="module")
def matches() -> Matches:
    pixels1, _ = CAMERA.project(POINT)
    pixels2, _ = CAMERA.project(CAM2_FROM_CAM1.apply(POINT))
    return Matches.from_cameras(CAMERA, CAMERA, pixels1, pixels2)


@pytest.fixture(scope="module")
def jacobians(matches: Matches) -> tuple[np.ndarray, np.ndarray]:
    m = matches
    return pair_projection_jacobians(POINT, m.rays1, m.jacobians1, m.rays2, m.jacobians2, CAM2_FROM_CAM1)


@pytest.fixture(scope="module")
def F21() -> np.ndarray:
    K_inv = np.linalg.inv(CAMERA.K)
    F = K_inv.T @ skew(CAM2_FROM_CAM1.translation_mm) @ CAM2_FROM_CAM1.rotation @ K_inv
    return F / np.linalg.norm(F)


@pytest.fixture(scope="module")
def epipolar(F21: np.ndarray, matches: Matches) -> EpipolarNormals:
    return EpipolarNormals.from_F(F21, matches.pixels1, matches.pixels2)


def noisy_directions(A21: np.ndarray) -> DirectionPairs:
    """Edges (1, .2) and (-.1, 1) and their sum, mapped by A; the first is then turned by 2 degrees in image 2."""
    c, s = np.cos(np.radians(2.0)), np.sin(np.radians(2.0))
    d1 = np.array([[1.0, 0.2], [-0.1, 1.0], [0.9, 1.2]])
    d2 = d1 @ A21.T
    d2[0] = np.array([[c, -s], [s, c]]) @ d2[0]
    return DirectionPairs(image1=d1[None], image2=d2[None], valid=np.ones((1, 3), dtype=bool))


def test_geometry(matches: Matches, F21: np.ndarray, epipolar: EpipolarNormals) -> None:
    rotation = [
        [0.9789800731, 0.0244524652, 0.2024847981],
        [-0.0161277417, 0.9989594096, -0.0426613877],
        [-0.2033172704, 0.038499026, 0.9783557188],
    ]
    np.testing.assert_allclose(CAM2_FROM_CAM1.rotation, rotation, atol=PRINTED)
    np.testing.assert_allclose(matches.pixels1[0], [912.5, 563.75], atol=PRINTED)
    np.testing.assert_allclose(matches.pixels2[0], [844.5485684572, 527.0384214423], atol=PRINTED)
    fundamental = [
        [-1.4809152285e-07, -2.2340296093e-06, 2.8343793557e-03],
        [-5.4722686243e-07, 5.8021415204e-07, 1.8698832862e-02],
        [-4.4628495642e-04, -1.6981464564e-02, -9.9967682309e-01],
    ]
    np.testing.assert_allclose(F21, fundamental, rtol=1e-9)
    np.testing.assert_allclose(epipolar.n1[0], [-0.000859765, -0.0185624159], atol=PRINTED)
    np.testing.assert_allclose(epipolar.n2[0], [0.0014398116, 0.0185265841], atol=PRINTED)


def test_affinity_of_the_plane(jacobians: tuple[np.ndarray, np.ndarray]) -> None:
    A21, valid = affines_from_normals(*jacobians, NORMAL)
    assert valid.all()
    np.testing.assert_allclose(A21[0], A_TRUE, atol=PRINTED)


@pytest.mark.parametrize(
    ("method", "expected", "normal", "angle_deg"),
    [
        (
            "F2UDIR",
            [[0.9239686315, -0.0426007924], [-0.0254000292, 1.0052448396]],
            [-0.228091739, -0.248830788, -0.9413062188],
            29.778570456783743,
        ),
        (
            "2SDIR",
            [[1.0558694130e00, -2.9410714299e-02], [-9.1961141885e-05, 1.0077756464e00]],
            [0.25222346, -0.1934496652, -0.9481353033],
            1.7961753074577125,
        ),
    ],
)
def test_noisy_estimators_and_normals(
    method: str,
    expected: list[list[float]],
    normal: list[float],
    angle_deg: float,
    jacobians: tuple[np.ndarray, np.ndarray],
    epipolar: EpipolarNormals,
) -> None:
    J1, J2 = jacobians
    directions = noisy_directions(affines_from_normals(J1, J2, NORMAL)[0][0])
    estimate = affines_from_directions(directions, method, epipolar=epipolar)
    np.testing.assert_allclose(estimate.A21[0], expected, atol=PRINTED)
    normals, valid = normals_from_affines(J1, J2, estimate.A21)
    assert valid.all()
    np.testing.assert_allclose(normals[0], normal, atol=PRINTED)
    assert np.degrees(angle_between(normals[0], NORMAL)) == pytest.approx(angle_deg, abs=1e-9)


def test_correction_of_2sdir(jacobians: tuple[np.ndarray, np.ndarray]) -> None:
    """The affinity of the optimal normal is the nearest one that fulfils the epipolar geometry."""
    directions = noisy_directions(affines_from_normals(*jacobians, NORMAL)[0][0])
    normals, _ = normals_from_affines(*jacobians, affines_from_directions(directions, "2SDIR").A21)
    corrected, _ = affines_from_normals(*jacobians, normals)
    np.testing.assert_allclose(
        corrected[0], [[1.0531225114, -0.0296854045], [-0.0354373497, 1.0042411075]], atol=PRINTED
    )


def test_det3udir(jacobians: tuple[np.ndarray, np.ndarray]) -> None:
    true = affines_from_normals(*jacobians, NORMAL)[0]
    directions = noisy_directions(true[0])
    determinant = np.linalg.det(true)
    assert determinant[0] == pytest.approx(1.0655254709844635, abs=1e-12)
    shaped = affines_from_directions(directions, "DET3UDIR", determinant=determinant)
    expected = [[1.0762621077, -0.0248673065], [0.0075805073, 0.9898489936]]
    np.testing.assert_allclose(shaped.A21[0], expected, atol=PRINTED)
    for scale, value in (("sqmean", 1.0364915348867847), ("area", 1.0640767755119183)):
        estimate = affines_from_directions(directions, "DET3UDIR", scale=scale)
        assert np.linalg.det(estimate.A21[0]) == pytest.approx(value, abs=1e-12)
