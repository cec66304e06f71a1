"""Convert pycolmap's result for a pair to a reconstruction in mm."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.triangulation import point_uncertainty
from rigkit.interop.colmap import ColmapPair, ColmapResult
from rigkit.reconstruction.metric import covariance_in_mm
from rigkit.reconstruction.reconstruct import Reconstruction
from rigkit.reconstruction.scale import metric_scale

BEST_CORNER_PX = 1e-3
"""Floor of the corners' standard deviation: a few corners can fit better by chance."""
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
    observed = (each[which] for each in reconstruction.measured_rays())
    spread, by_pose = point_uncertainty(unit_points, result.adjusted, *observed)
    scale, scale_sigma, d_scale_d_points = metric_scale(unit_points, *known, variance * spread)
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
    # Points that could not be triangulated have a zero gradient.
    slope = np.einsum("ni,nip->p", d_scale_d_points, np.nan_to_num(by_pose))
    of_pose = variance * result.adjusted_covariance
    covariance = covariance_in_mm(result.adjusted.translation_mm, of_pose, scale, scale_sigma, slope)
    return replace(metric, pose_covariance=covariance)
