"""What pycolmap found of a pair, as a reconstruction in millimetres that can be measured like ours."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rigkit.core.arrays import FloatArray, IntArray, Points
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.triangulation import point_covariances
from rigkit.interop.colmap import ColmapPair, ColmapResult
from rigkit.reconstruction.reconstruct import Reconstruction
from rigkit.reconstruction.scale import scale_and_gradient
from rigkit.validation.measure import points_by_pose

BEST_CORNER_PX = 1e-3
"""No corner is known better than this, however well a few of them happen to fit."""
PER_POINT = ("normals", "colours", "board_index", "grid", "sigma_mm", "normal_sigma_rad")


def colmap_reconstruction(reconstruction: Reconstruction, pair: ColmapPair, result: ColmapResult) -> Reconstruction:
    """Return COLMAP's adjusted pose and points as a reconstruction in mm, scaled by the squares."""
    which = np.flatnonzero(pair.used)
    seen = np.isfinite(result.points).all(axis=1)
    which, unit_points = which[seen], result.points[seen]
    cloud = reconstruction.cloud
    known = (cloud.board_index[which], cloud.grid[which], reconstruction.boards)
    # COLMAP's covariance is for corners of 1 px; 4N residuals fix 3N + 5 unknowns.
    variance = max(result.rms_px**2 * 2.0 * len(which) / max(len(which) - 5, 1), BEST_CORNER_PX**2)
    spread = variance * _spread(reconstruction, which, unit_points, result.adjusted)
    scale, scale_sigma, d_scale_d_points = scale_and_gradient(unit_points, *known, spread)
    picked = {name: getattr(cloud, name)[which] for name in PER_POINT}
    metric = replace(
        reconstruction,
        matches=reconstruction.matches.select(which),
        pixels1=reconstruction.pixels1[which],
        pixels2=reconstruction.pixels2[which],
        cam2_from_cam1=Rigid3(result.adjusted.rotation, scale * result.adjusted.translation_mm),
        cloud=replace(cloud, **picked, points_mm=scale * unit_points),
        baseline_mm=scale,
        pose_covariance=None,
    )
    if not np.isfinite(result.adjusted_covariance).all():
        return metric
    # t = s u: its direction moves with the pose, its length with the scale that this pose gives to the squares.
    across = np.diag([1.0] * 3 + [scale] * 3) @ result.adjusted_covariance @ np.diag([1.0] * 3 + [scale] * 3)
    # A point without a triangulation takes no part.
    moves = [(np.nan_to_num(motion), step) for motion, step in points_by_pose(metric)]
    slope = np.array([np.sum(d_scale_d_points * motion) / (scale * step) for motion, step in moves])
    along = np.eye(6)
    along[3:] += np.outer(result.adjusted.translation_mm, slope)
    covariance = along @ across @ along.T * variance
    covariance[3:, 3:] += scale_sigma**2 * np.outer(result.adjusted.translation_mm, result.adjusted.translation_mm)
    return replace(metric, pose_covariance=covariance)


def _spread(reconstruction: Reconstruction, which: IntArray, points: Points, pose: Rigid3) -> FloatArray:
    """Return the covariances of triangulated points for corners of 1 px: what weighs them in the scale."""
    camera1, camera2 = reconstruction.camera1, reconstruction.camera2
    pixels1, pixels2 = reconstruction.pixels1[which], reconstruction.pixels2[which]
    rays = (camera1.unproject(pixels1)[0], camera2.unproject(pixels2)[0])
    return point_covariances(points, pose, *rays, camera1.ray_jacobian(pixels1), camera2.ray_jacobian(pixels2))
