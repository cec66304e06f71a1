"""Displacements of two cameras along the principal axes of a rig's covariance."""

from __future__ import annotations

import numpy as np
import pytest

from rigkit.cameras.eucm import EUCM
from rigkit.cameras.pinhole import Pinhole
from rigkit.cameras.uncertain import PosedPair, UncertainCamera, UncertainPair, UncertainRig
from rigkit.core.arrays import FloatArray
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3, log_so3

CAMERAS = [Pinhole((300, 225), np.array([262.5 + k, 262.5, 149.5, 112.0])) for k in range(3)]
POSES = [
    Rigid3.identity(),
    Rigid3(exp_so3(np.array([0.1, -0.4, 0.2])), np.array([-300.0, 40.0, 60.0])),
    Rigid3(exp_so3(np.array([-0.3, 0.2, 0.7])), np.array([150.0, -90.0, 500.0])),
]
SIZES = [4, 4, 4, 6, 6]
MOVE = 1e-6


@pytest.mark.parametrize(("first", "second"), [(0, 1), (1, 0), (1, 2), (2, 1), (2, 0)])
def test_a_pair_moves_as_the_rig_does(first: int, second: int) -> None:
    """The rig is sure but along one axis: its pair is moved along one axis, to where the moved rig has it."""
    # One number at a time, then all at once: their changes belong together.
    for step in MOVE * np.vstack([np.eye(sum(SIZES)), 0.1 * np.ones(sum(SIZES))]):
        assert_a_pair_moves_as_the_rig_does(first, second, step)


def assert_a_pair_moves_as_the_rig_does(first: int, second: int, step: FloatArray) -> None:
    rig = UncertainRig(cameras=CAMERAS, cam_from_rig=POSES, covariance=np.outer(step, step))
    own = np.split(step, np.cumsum(SIZES)[:-1])
    cameras = [camera.with_parameters(camera.parameters + by) for camera, by in zip(CAMERAS, own[:3], strict=True)]
    poses = [POSES[0]] + [
        Rigid3(exp_so3(by[:3]) @ pose.rotation, pose.translation_mm + by[3:])
        for pose, by in zip(POSES[1:], own[3:], strict=True)
    ]
    here, there = POSES[second] @ POSES[first].inverse(), poses[second] @ poses[first].inverse()
    change = np.concatenate(
        [
            cameras[first].parameters - CAMERAS[first].parameters,
            cameras[second].parameters - CAMERAS[second].parameters,
            log_so3(there.rotation @ here.rotation.T),
            there.translation_mm - here.translation_mm,
        ]
    )
    pair = rig.pair(first, second)
    # Second order: a rotation of 1e-6 at 600 mm.
    np.testing.assert_allclose(pair.covariance, np.outer(change, change), atol=1e-6 * MOVE**2 * 600.0**2)
    for moved in pair.moved():
        by = np.concatenate(
            [
                moved.camera1.parameters - CAMERAS[first].parameters,
                moved.camera2.parameters - CAMERAS[second].parameters,
                log_so3(moved.cam2_from_cam1.rotation @ here.rotation.T),
                moved.cam2_from_cam1.translation_mm - here.translation_mm,
            ]
        )
        sign = np.sign(by @ change)
        np.testing.assert_allclose(by, sign * change, atol=1e-4 * MOVE * 600.0)


def test_the_scale_uncertainty_is_in_the_baseline() -> None:
    rig = UncertainRig(cameras=CAMERAS, cam_from_rig=POSES, covariance=np.zeros((24, 24)), scale_sigma=1e-3)
    (moved,) = rig.pair(1, 2).moved()
    here = POSES[2] @ POSES[1].inverse()
    np.testing.assert_allclose(moved.cam2_from_cam1.rotation, here.rotation, atol=1e-12)
    longer = np.linalg.norm(moved.cam2_from_cam1.translation_mm) / np.linalg.norm(here.translation_mm)
    assert abs(longer - 1.0) == pytest.approx(1e-3)


def test_a_parameter_near_the_end_of_its_range_moves_the_other_way() -> None:
    """One sigma more than alpha = 0.98 would be no camera."""
    lens = EUCM((300, 225), np.array([262.5, 262.5, 149.5, 112.0, 0.98, 0.8]))
    known = UncertainCamera(lens, np.diag([0.0, 0.0, 0.0, 0.0, 0.05, 0.0]) ** 2)
    (moved,) = known.moved()
    assert np.abs(moved.parameters - lens.parameters)[4] == pytest.approx(0.05)
    both = np.zeros((18, 18))
    both[:6, :6] = known.covariance
    (pair,) = UncertainPair(PosedPair(lens, lens, POSES[1]), both).moved()
    assert np.abs(pair.camera1.parameters - lens.parameters)[4] == pytest.approx(0.05)


def test_a_parameter_uncertain_by_more_than_its_range_moves_by_parts() -> None:
    """One sigma either way from alpha = 0.5 would be no camera; few images leave such a lens, well known in pixels."""
    lens = EUCM((300, 225), np.array([262.5, 262.5, 149.5, 112.0, 0.5, 0.8]))
    known = UncertainCamera(lens, np.diag([0.0, 0.0, 0.0, 0.0, 0.6, 0.0]) ** 2)
    changes = np.array([moved.parameters - lens.parameters for moved in known.moved()])
    assert np.sum(changes[:, 4] ** 2) == pytest.approx(0.36)
