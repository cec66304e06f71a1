"""Affinities of surfaces: against finite differences in perspective and fisheye pairs; the printed formulas fail."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.affine_scenes import FISHEYE, REGULAR, Corners, see
from helpers.tolerances import EXACT_REL, ROUNDING

from rigkit.affine.affinities import EpipolarNormals
from rigkit.affine.normal import affines_from_normals, linear_gauge
from rigkit.cameras.base import Camera
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3, unit

FINITE_DIFFERENCE = 1e-7
"""Central differences over 1e-3 mm on a surface a metre away; the affinity's entries are of order 1."""
PRINTED_ERROR = 0.01
"""What a wrong formula misses by at least, in the median."""
STEP_MM = 1e-3

POSE = Rigid3(exp_so3(np.array([0.12, -0.35, 0.2])), [-260.0, 60.0, 90.0])
SIDEWAYS = Rigid3(exp_so3(np.array([0.0, 0.0, 0.0])), [-250.0, 40.0, 30.0])


def slanted(pose: Rigid3, distance: float, turn: tuple[float, float, float]) -> Rigid3:
    """A board at `distance` along the axis of `pose`, turned."""
    return pose @ Rigid3(exp_so3(np.array(turn)), [-100.0, -140.0, distance])


def scene(camera: Camera) -> Corners:
    if camera is REGULAR:
        boards = [slanted(Rigid3.identity(), 1100.0, (0.5, -0.4, 0.3))]
        out = see(camera, camera, POSE, boards)
    else:
        # Boards at about 25 and at about 95 degrees off the axis of both cameras.
        far = Rigid3(exp_so3(np.array([0.0, np.radians(105.0), 0.0])), np.zeros(3))
        near = Rigid3(exp_so3(np.array([0.2, 0.3, 0.0])), np.zeros(3))
        boards = [slanted(near, 700.0, (0.4, 0.3, 0.2)), slanted(far, 900.0, (-0.3, 0.4, 0.8))]
        out = see(camera, camera, SIDEWAYS, boards)
    assert out is not None
    return out


CAMERAS = pytest.mark.parametrize("camera", [REGULAR, FISHEYE], ids=["pinhole", "fisheye"])


def finite_difference(camera: Camera, pose: Rigid3, c: Corners) -> np.ndarray:
    """A from how the two pixels move when the point moves on its plane."""
    helper = np.where(np.abs(c.normals[:, :1]) < 0.9, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    e1 = unit(np.cross(c.normals, helper))
    tangents = (e1, np.cross(c.normals, e1))

    def moved(project: object) -> np.ndarray:
        steps = [project(c.points + STEP_MM * t) - project(c.points - STEP_MM * t) for t in tangents]  # type: ignore[operator]
        return np.stack(steps, axis=-1) / (2.0 * STEP_MM)

    by1 = moved(lambda x: camera.project(x)[0])
    by2 = moved(lambda x: camera.project(pose.apply(x))[0])
    return by2 @ np.linalg.inv(by1)


@CAMERAS
def test_against_finite_differences(camera: Camera) -> None:
    c = scene(camera)
    numeric = finite_difference(camera, POSE if camera is REGULAR else SIDEWAYS, c)
    np.testing.assert_allclose(c.A21, numeric, atol=FINITE_DIFFERENCE)


def test_the_fisheye_scene_goes_beyond_90_degrees() -> None:
    c = scene(FISHEYE)
    off_axis = np.degrees(np.arccos(unit(c.points)[:, 2]))
    assert (off_axis > 90.0).sum() > 20
    assert (off_axis < 45.0).sum() > 20


def affines_from_normals_by_minors(J1: np.ndarray, J2: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Return A21 as `affines_from_normals`, by the 2x2 minors of Molnar and Chetverikov.

    Notes
    -----
    A = [n.w1, n.w2; n.w3, n.w4] / n.w5. Erratum: the paper prints w1 = grad v1 x grad u1, the same as w5; it is
    w1 = grad v1 x grad u2.
    """
    u1, v1, u2, v2 = J1[..., 0, :], J1[..., 1, :], J2[..., 0, :], J2[..., 1, :]
    minors = np.stack(
        [np.cross(v1, u2), np.cross(u2, u1), np.cross(v1, v2), np.cross(v2, u1), np.cross(v1, u1)], axis=-2
    )
    products = np.einsum("...ki,...i->...k", minors, normals)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray((products[..., :4] / products[..., 4:]).reshape(*products.shape[:-1], 2, 2))


@CAMERAS
def test_minors_and_gauge_agree(camera: Camera) -> None:
    c = scene(camera)
    np.testing.assert_allclose(affines_from_normals_by_minors(c.J1, c.J2, -3.0 * c.normals), c.A21, rtol=EXACT_REL)


def epipolar_residuals(A21: np.ndarray, epipolar: EpipolarNormals) -> np.ndarray:
    """Return (A21^T n2 + n1) / |n2|, (N, 2)."""
    raw = np.einsum("nij,ni->nj", A21, epipolar.n2) + epipolar.n1
    return np.asarray(raw / np.linalg.norm(epipolar.n2, axis=-1, keepdims=True))


@CAMERAS
def test_fulfils_the_epipolar_equations_with_this_sign(camera: Camera) -> None:
    c = scene(camera)
    assert np.abs(epipolar_residuals(c.A21, c.epipolar)).max() < ROUNDING
    assert np.abs(epipolar_residuals(-c.A21, c.epipolar)).min(axis=0).max() > 0.1


@CAMERAS
def test_h_lies_along_the_epipolar_line(camera: Camera) -> None:
    c = scene(camera)
    h = linear_gauge(c.J1, c.J2).h
    assert np.abs(np.sum(unit(h) * unit(c.n2), axis=1)).max() < ROUNDING * 10


def test_printed_w1_fails() -> None:
    """The paper's w1 = grad v1 x grad u1 equals w5 and would make a1 = 1 everywhere."""
    c = scene(REGULAR)
    u1, v1 = c.J1[:, 0], c.J1[:, 1]
    printed = np.cross(v1, u1)
    a1 = np.sum(c.normals * printed, axis=1) / np.sum(c.normals * np.cross(v1, u1), axis=1)
    assert np.median(np.abs(a1 - c.A21[:, 0, 0])) > PRINTED_ERROR


def test_printed_pinhole_derivatives_fail() -> None:
    """(p1 + u p9) / s is printed; with the correct minus this is J, which the finite differences have confirmed."""
    c = scene(REGULAR)
    s = c.points[:, 2:]
    minus = (REGULAR.K[0] - c.pixels1[:, :1] * REGULAR.K[2]) / s
    plus = (REGULAR.K[0] + c.pixels1[:, :1] * REGULAR.K[2]) / s
    np.testing.assert_allclose(minus, c.J1[:, 0], atol=EXACT_REL)
    assert np.median(np.abs(plus - c.J1[:, 0]).max(axis=1) / np.abs(c.J1[:, 0]).max(axis=1)) > PRINTED_ERROR


def test_edge_on_is_invalid() -> None:
    c = scene(REGULAR)
    across = np.cross(c.points, [0.0, 1.0, 0.0])
    across[0] = [0.0, 0.0, 0.0]
    A21, valid = affines_from_normals(c.J1, c.J2, across)
    assert not valid[0]
    assert np.isnan(A21[0]).all()
