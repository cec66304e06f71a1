"""What the calibrations leave open of a cloud of correspondences: cameras moved along each axis of their covariance,
the pose found again from the same correspondences, points and normals from the same pixels and affinities."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rigkit.affine.normal import normals_from_affines
from rigkit.cameras.base import Camera
from rigkit.cameras.uncertain import UncertainCamera
from rigkit.core.arrays import BoolArray, FloatArray
from rigkit.core.matches import Matches
from rigkit.geometry.projection_jacobian import pair_projection_jacobians
from rigkit.geometry.rigid3 import Rigid3
from rigkit.reconstruction.metric import triangulate_matches
from rigkit.reconstruction.moved_cameras import moved_cameras, moved_sights
from rigkit.reconstruction.reconstruct import Reconstruction
from rigkit.relative_pose.refinement.refine import refine_pose


def with_scene_calibrations(
    r: Reconstruction, known1: UncertainCamera, known2: UncertainCamera | None, *, pose_is_known: bool = False
) -> Reconstruction:
    """Return a reconstruction of correspondences with the calibrations' share in the sigmas of its cloud.

    `known2` is None where both images are of one camera. With `pose_is_known` the pose stays as it is. Sigmas of points
    that not all of the moved cameras see are NaN: nobody knows them.
    """
    each = [(r.camera1, r.camera2), *moved_cameras(r.camera1, r.camera2, known1, known2, one=known2 is None)]
    seen = np.logical_and.reduce([a.unproject(r.pixels1)[1] & b.unproject(r.pixels2)[1] for a, b in each])
    found = [_again(r, *cameras, seen, pose_is_known) for cameras in each]
    both = np.logical_and.reduce([valid for _, _, valid in found])
    (points, normals, _), *moved = found
    move = sum((((p - points) ** 2).sum(axis=1) for p, _, _ in moved), np.zeros(len(seen)))
    tilt = sum((((n - normals) ** 2).sum(axis=1) for _, n, _ in moved), np.zeros(len(seen)))
    move[~both], tilt[~both] = np.nan, np.nan
    cloud = replace(
        r.cloud,
        # The largest axis of a sum is no longer than this.
        sigma_mm=np.sqrt(r.cloud.sigma_mm**2 + move),
        normal_sigma_rad=np.sqrt(r.cloud.normal_sigma_rad**2 + tilt),
        calibration_in_sigmas=True,
    )
    return replace(r, cloud=cloud)


def _again(
    r: Reconstruction, camera1: Camera, camera2: Camera, seen: BoolArray, pose_is_known: bool
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Return points and normals (N, 3) with other cameras, and which of those `seen` (N,) have them."""
    m = r.matches.select(seen)
    pixels1, pixels2 = r.pixels1[seen], r.pixels2[seen]
    matches = Matches.from_cameras(
        camera1, camera2, pixels1, pixels2, sigma1_px=m.sigma1_px, sigma2_px=m.sigma2_px, A21=None
    )
    pose = Rigid3(r.cam2_from_cam1.rotation, r.cam2_from_cam1.translation_mm / r.baseline_mm)
    if not pose_is_known:
        pose = refine_pose(matches, pose, r.pose_type, r.level_sigma_rad).cam2_from_cam1
    points, _, valid = triangulate_matches(matches, pose)
    rays1, by1 = moved_sights(camera1, r.camera1, pixels1, m.jacobians1)
    rays2, by2 = moved_sights(camera2, r.camera2, pixels2, m.jacobians2)
    assert m.A21 is not None
    normals = normals_from_affines(*pair_projection_jacobians(points, rays1, by1, rays2, by2, pose), m.A21)[0]
    out = np.zeros((2, len(seen), 3))
    out[:, seen] = r.baseline_mm * points, normals
    known = np.zeros(len(seen), dtype=bool)
    known[seen] = valid
    return out[0], out[1], known
