"""Our epipolar geometry, pose and points against OpenCV's and COLMAP's."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from helpers.epipolar_scenes import REGULAR, pair, pixel_fundamental, pose_errors_deg, same_up_to_sign

from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.triangulation import triangulate_pixels
from rigkit.relative_pose.refinement.refine import estimate_pose
from rigkit.relative_pose.robust import robust_pose
from rigkit.relative_pose.solvers.pose import choose_pose, decompose_essential
from rigkit.relative_pose.solvers.registry import fundamental_for


def test_eight_point_is_opencvs_on_exact_points(rng):
    m, _, _ = pair(rng, 30)
    theirs, _ = cv2.findFundamentalMat(m.pixels1, m.pixels2, cv2.FM_8POINT)
    ours = pixel_fundamental(fundamental_for("general").solve(m))
    assert same_up_to_sign(ours, theirs / np.linalg.norm(theirs)) < 1e-7


def test_eight_point_is_no_worse_than_opencvs_on_noisy_points(rng):
    ours: list[tuple[float, float]] = []
    theirs: list[tuple[float, float]] = []
    for _ in range(40):
        m, pose, _ = pair(rng, 30, noise_px=0.5)
        F, _ = cv2.findFundamentalMat(m.pixels1, m.pixels2, cv2.FM_8POINT)
        assert m.K1 is not None and m.K2 is not None
        for found, E in ((ours, fundamental_for("general").solve(m).E21), (theirs, m.K2.T @ F @ m.K1)):
            found.append(pose_errors_deg(choose_pose(E, m.rays1, m.rays2), pose))
    assert np.all(np.median(ours, axis=0) < 1.05 * np.median(theirs, axis=0))


def test_decomposition_is_opencvs(rng):
    m, _, _ = pair(rng, 30)
    E = fundamental_for("general").solve(m).E21
    R1, R2, t = cv2.decomposeEssentialMat(E)
    ours = decompose_essential(E)
    for R in (R1, R2):
        assert min(np.abs(p.rotation - R).max() for p in ours) < 1e-9
    assert same_up_to_sign(ours[0].translation_mm, t[:, 0]) < 1e-9


def test_pose_and_points_agree_with_opencv(rng):
    m, pose, X = pair(rng, 60, noise_px=0.3)
    E = fundamental_for("general").solve(m).E21
    _, R, t, _ = cv2.recoverPose(E, m.pixels1, m.pixels2, REGULAR.K)
    assert max(pose_errors_deg(choose_pose(E, m.rays1, m.rays2), Rigid3(R, t[:, 0]))) < 1e-6
    points, valid = triangulate_pixels(m.pixels1, m.pixels2, REGULAR.K, REGULAR.K, pose)
    P1, P2 = REGULAR.K @ np.eye(3, 4), REGULAR.K @ pose.matrix()[:3]
    h = cv2.triangulatePoints(P1, P2, m.pixels1.T, m.pixels2.T)
    theirs = (h[:3] / h[3]).T
    assert valid.all()
    error, of_them = (np.linalg.norm(p - X, axis=1) for p in (points, theirs))
    assert np.median(error) < 1.05 * np.median(of_them)
    assert np.median(np.linalg.norm(points - theirs, axis=1)) < np.median(error)


def test_refined_pose_is_better_than_opencvs_essential(rng):
    ours: list[tuple[float, float]] = []
    theirs: list[tuple[float, float]] = []
    for _ in range(30):
        m, pose, _ = pair(rng, 60, noise_px=0.5)
        E, _ = cv2.findEssentialMat(m.pixels1, m.pixels2, REGULAR.K, method=cv2.RANSAC, prob=0.999, threshold=2.0)
        _, R, t, _ = cv2.recoverPose(E, m.pixels1, m.pixels2, REGULAR.K)
        ours.append(pose_errors_deg(estimate_pose(m).cam2_from_cam1, pose))
        theirs.append(pose_errors_deg(Rigid3(R, t[:, 0]), pose))
    assert np.all(np.median(ours, axis=0) < np.median(theirs, axis=0))


def test_robust_pose_is_no_worse_than_colmaps(rng):
    pycolmap = pytest.importorskip("pycolmap", reason="pycolmap is not installed")
    fx, fy, cx, cy = REGULAR.parameters
    # COLMAP puts (0.5, 0.5) at the centre of the first pixel.
    camera = pycolmap.Camera(model="PINHOLE", width=1624, height=1240, params=[fx, fy, cx + 0.5, cy + 0.5])
    options = pycolmap.TwoViewGeometryOptions()
    options.compute_relative_pose = True
    options.ransac.random_seed = 0
    ours: list[tuple[float, float]] = []
    theirs: list[tuple[float, float]] = []
    for _ in range(40):
        m, pose, _ = pair(rng, 150, noise_px=0.5)
        q2 = np.array(m.pixels2)
        q2[:50] = rng.uniform([0, 0], [1624, 1240], (50, 2))
        from rigkit.core.matches import Matches

        wild = Matches.from_cameras(REGULAR, REGULAR, m.pixels1, q2, sigma1_px=m.sigma1_px, sigma2_px=m.sigma2_px)
        index = np.repeat(np.arange(150, dtype=np.uint32)[:, None], 2, axis=1)
        geometry = pycolmap.estimate_calibrated_two_view_geometry(
            camera, m.pixels1 + 0.5, camera, q2 + 0.5, index, options
        )
        theirs.append(pose_errors_deg(Rigid3.from_matrix(geometry.cam2_from_cam1.matrix()), pose))
        ours.append(pose_errors_deg(robust_pose(wild, rng).refined.cam2_from_cam1, pose))
    assert np.all(np.median(ours, axis=0) < 1.1 * np.median(theirs, axis=0))
