"""Rotations and rigid motions: exponential map, composition, inverse, refusals."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.tolerances import ROUNDING
from scipy.spatial.transform import Rotation

from rigkit.core.errors import InputError
from rigkit.geometry.rigid3 import Rigid3, cam_from_world_look_at
from rigkit.geometry.rotation import (
    angle_between,
    exp_so3,
    left_jacobian,
    log_so3,
    nearest_rotation,
    rotation_angle,
    skew,
)

POLE_TOL = 1e-7
"""Near pi the logarithm recovers the axis from a symmetric matrix: half the digits."""


def random_motion(rng: np.random.Generator) -> Rigid3:
    return Rigid3(exp_so3(rng.normal(size=3)), rng.normal(size=3) * 100.0)


def test_exp_and_log_agree_with_scipy(rng: np.random.Generator) -> None:
    vectors = rng.normal(size=(200, 3)) * rng.choice([1e-9, 1e-3, 0.5], size=(200, 1))
    rotations = exp_so3(vectors)
    assert np.abs(rotations - Rotation.from_rotvec(vectors).as_matrix()).max() < ROUNDING
    assert np.abs(log_so3(rotations) - vectors).max() < ROUNDING
    assert np.abs(rotation_angle(rotations) - np.linalg.norm(vectors, axis=1)).max() < ROUNDING


@pytest.mark.parametrize("angle", [0.0, 0.05, 0.1001, 2.0])
def test_a_changed_rotation_vector_turns_by_the_left_jacobian(angle: float) -> None:
    vector, step = angle * np.array([2.0, -1.0, 2.0]) / 3.0, 1e-5 * np.array([1.0, 2.0, -1.0])
    turn = 0.5 * log_so3(exp_so3(vector + step) @ exp_so3(vector - step).T)
    assert turn == pytest.approx(left_jacobian(vector) @ step, abs=1e-13)


def test_log_near_and_at_pi(rng: np.random.Generator) -> None:
    axes = rng.normal(size=(100, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    angle = np.pi - rng.choice([0.0, 1e-9, 1e-4], size=(100, 1))
    rotations = exp_so3(axes * angle)
    assert np.abs(exp_so3(log_so3(rotations)) - rotations).max() < POLE_TOL


def test_skew_is_the_cross_product(rng: np.random.Generator) -> None:
    a, b = rng.normal(size=(2, 50, 3))
    assert np.abs((skew(a) @ b[..., None])[..., 0] - np.cross(a, b)).max() < ROUNDING


def test_nearest_rotation_never_reflects(rng: np.random.Generator) -> None:
    assert np.linalg.det(nearest_rotation(rng.normal(size=(100, 3, 3)))) == pytest.approx(1.0)


def test_angle_between_is_exact_for_tiny_angles() -> None:
    a = np.array([1.0, 0.0, 0.0])
    assert float(angle_between(a, np.array([1.0, 1e-9, 0.0]))) == pytest.approx(1e-9, rel=1e-6)


def test_group_axioms(rng: np.random.Generator) -> None:
    for _ in range(50):
        c_from_b, b_from_a = random_motion(rng), random_motion(rng)
        x_in_a = rng.normal(size=(4, 5, 3))
        composed = (c_from_b @ b_from_a).apply(x_in_a)
        assert np.abs(composed - c_from_b.apply(b_from_a.apply(x_in_a))).max() < 1e-10
        assert (b_from_a.inverse() @ b_from_a).allclose(Rigid3.identity(), translation_tol_mm=1e-10)
        assert Rigid3.from_matrix(b_from_a.matrix()).allclose(b_from_a)


def test_results_are_locked_and_inputs_untouched(rng: np.random.Generator) -> None:
    rotation, translation = exp_so3(rng.normal(size=3)), rng.normal(size=3)
    motion = Rigid3(rotation, translation)
    translation[0] = 99.0
    assert motion.translation_mm[0] != 99.0
    with pytest.raises(ValueError, match="read-only"):
        motion.translation_mm[0] = 1.0


@pytest.mark.parametrize("bad", [np.eye(3) * 1.01, -np.eye(3), np.eye(4), np.full((3, 3), np.nan)])
def test_refuses_what_is_no_rotation(bad: np.ndarray) -> None:
    with pytest.raises(InputError):
        Rigid3(bad, np.zeros(3))


def test_look_at() -> None:
    cam_from_world = cam_from_world_look_at([100.0, -50.0, 0.0], [100.0, -50.0, 800.0])
    seen = cam_from_world.apply(np.array([100.0, -50.0, 800.0]))
    assert np.abs(seen - [0.0, 0.0, 800.0]).max() < 1e-10
    below = cam_from_world.apply(np.array([100.0, 0.0, 800.0]))
    assert below[1] > 0.0
    with pytest.raises(InputError):
        cam_from_world_look_at([0, 0, 0], [0, 0, 0])


def test_a_step_leads_from_one_motion_to_another(rng: np.random.Generator) -> None:
    one, other = random_motion(rng), random_motion(rng)
    assert one.moved(other.step_from(one)).allclose(other, translation_tol_mm=1e-12)
    assert not one.moved(one.step_from(other)).allclose(other)


def test_a_matrix_that_was_rounded_is_made_a_rotation_again(rng: np.random.Generator) -> None:
    motion = random_motion(rng)
    matrix = np.round(motion.matrix(), 5)
    found = Rigid3.from_matrix(matrix)
    assert np.abs(found.rotation.T @ found.rotation - np.eye(3)).max() < ROUNDING
    assert np.abs(found.rotation - motion.rotation).max() < 1e-5
