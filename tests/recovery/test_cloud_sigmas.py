"""Sigmas of free points and normals against truth, with cameras calibrated anew from noisy corners for each cloud."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.board_scenes import noisy_pair
from helpers.calibration_scenes import REACH_DEG, lens
from helpers.recalibrations import SIGMA_PX, random_scene, recalibration
from helpers.reconstructions import BOARDS
from scipy.spatial import cKDTree

from rigkit.cameras.uncertain import UncertainCamera
from rigkit.core.posetype import PoseType
from rigkit.reconstruction.calibration_shifts import calibration_shifts, with_calibrations
from rigkit.reconstruction.reconstruct import Reconstruction, reconstruct_pair
from rigkit.synthetic.pairs import StereoScene

DRAWS, SCENES = 12, 3
POINTS = (0.85, 1.85)
"""Root mean square of |error| over sigma: 1 where all errors are along one axis, 1.73 where they are alike along three;
12 calibrations know it to a tenth."""
NORMALS = (0.75, 1.25)


def errors(reconstruction: Reconstruction, scene: StereoScene) -> tuple[np.ndarray, np.ndarray]:
    """Return how far points (N,), mm, and normals (N,), rad, are off the truth; boards that look alike may change
    names, so the truth is that of the nearest corners."""
    cloud = reconstruction.cloud
    trees = [cKDTree(points.reshape(-1, 3)) for points in scene.points_in_cam1()]
    off_mm, off_rad = np.empty(len(cloud)), np.empty(len(cloud))
    for k in range(len(reconstruction.boards)):
        on = cloud.board_index == k
        off = [tree.query(cloud.points_mm[on])[0] for tree in trees]
        nearest = int(np.argmin([np.median(o) for o in off]))
        off_mm[on] = off[nearest]
        off_rad[on] = np.arccos(np.clip(cloud.normals[on] @ scene.normals_in_cam1()[nearest], -1.0, 1.0))
    return off_mm, off_rad


def ratio(off: list[np.ndarray], sigma: list[np.ndarray]) -> float:
    return float(np.sqrt(np.mean((np.concatenate(off) / np.concatenate(sigma)) ** 2)))


@pytest.mark.parametrize(("name", "method"), [("reg", "3SDIR"), ("fish", "F3UDIR")])
def test_sigmas_of_free_clouds_include_the_calibration(rng: np.random.Generator, name: str, method: str) -> None:
    camera = lens(name)
    calibrate = recalibration(camera, REACH_DEG[name], rng)
    scenes = [random_scene(camera, PoseType.GENERAL, rng) for _ in range(SCENES)]
    off_mm, off_rad, sigma_mm, sigma_rad, exact_mm = [], [], [], [], []
    for k in range(DRAWS):
        scene = scenes[k % SCENES]
        calibrated, covariance = calibrate()
        matched = noisy_pair(scene, BOARDS, rng, SIGMA_PX, known_as=calibrated)
        given = reconstruct_pair(matched, pose_type=scene.pose_type, affine_method=method)
        known = UncertainCamera(calibrated, covariance)
        whole = with_calibrations(given, calibration_shifts(given, known))
        assert whole.cloud.calibration_in_sigmas and np.isfinite(whole.cloud.sigma_mm).all()
        off = errors(whole, scene)
        off_mm.append(off[0])
        off_rad.append(off[1])
        sigma_mm.append(whole.cloud.sigma_mm)
        sigma_rad.append(whole.cloud.normal_sigma_rad)
        exact_mm.append(given.cloud.sigma_mm)
    assert POINTS[0] < ratio(off_mm, sigma_mm) < POINTS[1] < ratio(off_mm, exact_mm)
    assert NORMALS[0] < ratio(off_rad, sigma_rad) < NORMALS[1]
