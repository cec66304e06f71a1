"""COLMAP's bundle adjustment of a pair against our refinement of the same corners."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.epipolar_scenes import REGULAR, pair, pose_errors_deg

from rigkit.geometry.rotation import log_so3
from rigkit.interop.colmap import colmap_pair, solve_pair
from rigkit.relative_pose.refinement.refine import refine_pose

NOISE_PX = 0.3


def test_the_adjusted_pose_and_its_covariance_are_those_of_our_refinement(rng: np.random.Generator) -> None:
    m, pose, _ = pair(rng, 80, "general", noise_px=NOISE_PX)
    m = replace(m, A21=None, sigma_A=None)
    found = solve_pair(colmap_pair(REGULAR, REGULAR, m.pixels1, m.pixels2))
    ours = refine_pose(m, pose)
    assert found.inliers == 80
    sigma = np.sqrt(np.diag(ours.covariance).max())
    turn = log_so3(found.adjusted.rotation @ ours.cam2_from_cam1.rotation.T)
    shift = found.adjusted.translation_mm - ours.cam2_from_cam1.translation_mm / np.linalg.norm(
        ours.cam2_from_cam1.translation_mm
    )
    # Both minimise the distances of the corners, ours to first order.
    assert max(np.abs(turn).max(), np.abs(shift).max()) < 0.05 * sigma
    assert max(pose_errors_deg(found.adjusted, pose)) < 1.0
    theirs = found.adjusted_covariance * m.sigma1_px[0] ** 2
    np.testing.assert_allclose(theirs, ours.covariance, atol=0.1 * np.abs(ours.covariance).max())
    # The sum of squares of the best points is that of our distances.
    assert found.rms_px == pytest.approx(m.sigma1_px[0] * np.sqrt(ours.cost / 160.0), rel=1e-3)
    across = found.points / found.points[:, 2:]
    seen = REGULAR.project(across)[0]
    assert np.abs(seen - m.pixels1).max() < 5.0 * NOISE_PX
    again, valid = REGULAR.project(found.adjusted.apply(found.points))
    assert valid.all() and np.abs(again - m.pixels2).max() < 5.0 * NOISE_PX
