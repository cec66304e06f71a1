"""The linear equations, in rays, pixels and transformed coordinates."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.epipolar_scenes import FISHEYE, REGULAR, affinities, pair
from helpers.tolerances import EXACT_REL

from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3, skew
from rigkit.relative_pose.refinement.level_frames import LevelFrames
from rigkit.relative_pose.solvers.pose import essential_from_pose
from rigkit.relative_pose.solvers.rows import (
    PLANAR_ENTRIES,
    affinity_rows,
    essential_from_planar,
    point_rows,
    right_singular,
)


@pytest.mark.parametrize("camera", [REGULAR, FISHEYE], ids=["pinhole", "fisheye"])
def test_rows_vanish_on_the_true_essential_matrix(rng, camera):
    m, pose, _ = pair(rng, 200, sigma_A=0.0, camera=camera)
    e = essential_from_pose(pose).ravel()
    assert np.abs(point_rows(m.rays1, m.rays2) @ e).max() < 1e-12
    rows = affinity_rows(m.rays1, m.rays2, m.jacobians1, m.jacobians2, affinities(m))
    assert np.abs(rows @ e).max() < EXACT_REL * np.abs(rows).max()
    wrong = affinity_rows(m.rays1, m.rays2, m.jacobians1, m.jacobians2, np.swapaxes(affinities(m), 1, 2))
    assert np.abs(wrong @ e).max() > 1e-3 * np.abs(rows).max()


def test_rows_on_pixels_are_those_of_the_literature(rng):
    """[u2 + a1 u1, a1 v1, a1, v2 + a3 u1, a3 v1, a3, 1, 0, 0] and its companion."""
    m, _, _ = pair(rng, 5, sigma_A=0.0)
    (u1, v1), (u2, v2) = m.pixels1.T, m.pixels2.T
    (a1, a2), (a3, a4) = affinities(m).transpose(1, 2, 0)
    o, z = np.ones(5), np.zeros(5)
    h1, h2 = (np.concatenate([q, np.ones((5, 1))], axis=1) for q in (m.pixels1, m.pixels2))
    plane = np.broadcast_to(np.eye(3)[:, :2], (5, 3, 2))
    rows = affinity_rows(h1, h2, plane, plane, affinities(m))
    assert np.allclose(rows[:, 0].T, [u2 + a1 * u1, a1 * v1, a1, v2 + a3 * u1, a3 * v1, a3, o, z, z], rtol=1e-14)
    assert np.allclose(rows[:, 1].T, [a2 * u1, u2 + a2 * v1, a2, a4 * u1, v2 + a4 * v1, a4, z, o, z], rtol=1e-14)
    assert np.allclose(point_rows(h1, h2).T, [u2 * u1, u2 * v1, u2, v2 * u1, v2 * v1, v2, u1, v1, o], rtol=1e-14)


def test_an_affine_change_of_pixels_changes_the_affinity_by_its_linear_parts(rng):
    """A' = (scale2 / scale1) A under Hartley's transformations, and F' = T2^-T F T1^-1."""
    m, pose, _ = pair(rng, 20, sigma_A=0.0)
    T1, T2 = (np.array([[s, 0, a], [0, s, b], [0, 0, 1.0]]) for s, a, b in rng.uniform(0.5, 2.0, (2, 3)))
    h1, h2 = (np.concatenate([q, np.ones((20, 1))], axis=1) for q in (m.pixels1, m.pixels2))
    plane = np.broadcast_to(np.eye(3)[:, :2], (20, 3, 2))
    assert m.K1 is not None and m.K2 is not None
    inverse1, inverse2 = np.linalg.inv(m.K1), np.linalg.inv(m.K2)
    F = inverse2.T @ essential_from_pose(pose) @ inverse1
    moved = np.linalg.inv(T2).T @ F @ np.linalg.inv(T1)
    rows = affinity_rows(h1 @ T1.T, h2 @ T2.T, plane, plane, T2[0, 0] / T1[0, 0] * affinities(m))
    residual = rows @ moved.ravel()
    assert np.abs(residual).max() < EXACT_REL * np.abs(rows * moved.ravel()).max()


def test_planar_entries(rng):
    for _ in range(20):
        theta, phi = rng.uniform(-1.0, 1.0), rng.uniform(-np.pi, np.pi)
        R, t = exp_so3([0, theta, 0]), np.array([np.sin(phi), 0.0, np.cos(phi)])
        E = skew(t) @ R
        e = E.ravel()[list(PLANAR_ENTRIES)]
        expected = [-np.cos(phi), np.cos(phi - theta), -np.sin(phi - theta), np.sin(phi)]
        assert np.allclose(e, expected, atol=1e-14)
        assert np.allclose(essential_from_planar(e), E, atol=1e-14)


def test_turned_matches_obey_the_turned_geometry(rng):
    """Levelling rotations of cameras that are not level: rows, affinities included, stay exact."""
    m, pose, _ = pair(rng, 20, sigma_A=0.0)
    R1, R2 = exp_so3(rng.normal(size=3) * 0.3), exp_so3(rng.normal(size=3) * 0.3)
    turned = LevelFrames(R1, R2).matches(m)
    level = Rigid3(R2, np.zeros(3)) @ pose @ Rigid3(R1, np.zeros(3)).inverse()
    e = essential_from_pose(level).ravel()
    rows = affinity_rows(turned.rays1, turned.rays2, turned.jacobians1, turned.jacobians2, affinities(turned))
    assert np.abs(rows @ e).max() < EXACT_REL * np.abs(rows).max()
    assert np.abs(point_rows(turned.rays1, turned.rays2) @ e).max() < 1e-12


def test_null_vector_exists_with_fewer_rows_than_columns(rng):
    rows = rng.normal(size=(8, 9))
    s, vt = right_singular(rows)
    assert s[8] == 0.0
    assert np.abs(rows @ vt[8]).max() < 1e-12
    many = rng.normal(size=(500, 9))
    assert np.allclose(right_singular(many)[0], np.linalg.svd(many, compute_uv=False))
