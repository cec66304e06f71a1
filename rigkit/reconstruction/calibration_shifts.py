"""Propagate the uncertainty of the calibrations to a reconstruction.

A calibration error is the same for a whole pair: it tilts planes and stretches baselines but does not scatter points.
So the cameras are moved by one standard deviation along each principal axis of their covariance, and pose, scale and
points are estimated again from the same corners or correspondences. The axes are independent: the variance of a
quantity is the sum of its squared changes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from rigkit.affine.affinities import EpipolarNormals
from rigkit.affine.normal import normals_from_affines
from rigkit.affine.registry import affines_from_directions, needs_epipolar
from rigkit.cameras.uncertain import PosedPair, UncertainCamera, UncertainPair
from rigkit.core.arrays import BoolArray, FloatArray, Normals, RayJacobians, Rays
from rigkit.core.errors import InputError
from rigkit.geometry.projection_jacobian import pair_projection_jacobians
from rigkit.geometry.rigid3 import Rigid3
from rigkit.reconstruction.metric import triangulate_matches
from rigkit.reconstruction.moved_cameras import Known, moved_pairs, moved_pixels, visible_in_all
from rigkit.reconstruction.reconstruct import Reconstruction
from rigkit.reconstruction.scale import metric_scale
from rigkit.relative_pose.refinement.refine import refine_pose
from rigkit.relative_pose.solvers.pose import essential_from_pose


@dataclass(frozen=True, eq=False)
class CalibrationShifts:
    """A reconstruction estimated again with the calibrated cameras (`base`), and with each of the `moved` ones.

    `known` (N,) is the mask of the points that could be triangulated with all of these cameras. The others, at the rim
    of the field of view and close to the epipoles, keep their place, and their uncertainty is unknown.
    """

    base: Reconstruction
    moved: tuple[Reconstruction, ...]
    known: BoolArray

    @cached_property
    def rays(self) -> list[list[tuple[Rays, RayJacobians]]]:
        """Rays (N, 3) of the corners in image 1 and in image 2 with their Jacobians (N, 3, 2) by the pixel, for the
        calibrated cameras and each of the moved ones."""
        each = [((r.camera1, r.pixels1), (r.camera2, r.pixels2)) for r in (self.base, *self.moved)]
        return [[camera.rays_and_jacobians(p)[::2] for camera, p in both] for both in each]

    def points(self) -> FloatArray:
        """Return the change of the points by each axis (K, N, 3), mm; NaN if unknown."""
        moves = np.array([moved.cloud.points_mm - self.base.cloud.points_mm for moved in self.moved])
        moves = moves.reshape(-1, len(self.known), 3)
        moves[:, ~self.known] = np.nan
        return moves

    def variance(self, quantity: Callable[[Reconstruction], float]) -> float:
        """Return the variance of a quantity that comes from the calibrations' uncertainty."""
        at_base = quantity(self.base)
        return float(sum((quantity(moved) - at_base) ** 2 for moved in self.moved))


def calibration_shifts(
    reconstruction: Reconstruction,
    known1: UncertainCamera | UncertainPair,
    known2: UncertainCamera | None = None,
    *,
    pose_is_known: bool = False,
) -> CalibrationShifts:
    """Return the reconstruction with its cameras moved by one standard deviation along every principal axis.

    Parameters
    ----------
    reconstruction : of one pair, with boards or of any scene.
    known1 : camera 1 with its covariance, or both cameras of a rig with that of their pose.
    known2 : camera 2, or None if both images are of one camera; then both move together.
    pose_is_known : do not estimate the pose again: a rig's pose moves with its cameras, a measured one is kept.
    """
    r = reconstruction
    there = PosedPair(r.camera1, r.camera2, r.cam2_from_cam1)
    calibrations = known1 if isinstance(known1, UncertainPair) else (known1, known2)
    moves = [there, *moved_pairs(there, calibrations)]
    known = (known1, known2 or known1) if isinstance(known1, UncertainCamera) else (None, None)
    # A corner outside the field of view of any moved camera is left out for all.
    seen = visible_in_all([(move.camera1, move.camera2) for move in moves], r.pixels1, r.pixels2)
    again = [_reestimated(_with_moved_pixels(r, known, move), move, seen, pose_is_known) for move in moves]
    base, *moved = (estimated for estimated, _ in again)
    return CalibrationShifts(base, tuple(moved), np.logical_and.reduce([found for _, found in again]))


def _with_moved_pixels(r: Reconstruction, known: Known, there: PosedPair) -> Reconstruction:
    """Return the reconstruction with its pixels corrected for moved cameras, see `moved_pixels`."""
    points = r.cloud.points_mm, r.cam2_from_cam1.apply(r.cloud.points_mm)
    pixels1, pixels2 = moved_pixels((r.pixels1, r.pixels2), points, known, (there.camera1, there.camera2))
    return replace(r, pixels1=pixels1, pixels2=pixels2)


def _reestimated(
    r: Reconstruction, there: PosedPair, seen: BoolArray, pose_is_known: bool
) -> tuple[Reconstruction, BoolArray]:
    """Estimate pose, scale and points again from the corners `seen`; return also a mask (N,) of the new points.

    The other points, and all normals, are kept. Without boards the baseline keeps its length.
    """
    camera1, camera2, given = there
    captured = replace(r.matches.select(seen), pixels1=r.pixels1[seen], pixels2=r.pixels2[seen])
    matches = captured.with_cameras(camera1, camera2)
    scale = float(np.linalg.norm(given.translation_mm))
    pose = Rigid3(given.rotation, given.translation_mm / scale)
    if not pose_is_known:
        frames = None if r.geometry is None else r.geometry.decision.level_frames
        pose = refine_pose(matches, pose, r.pose_type, r.level_sigma_rad, level_frames=frames).cam2_from_cam1
    points, covariance, valid = triangulate_matches(matches, pose)
    if r.boards:
        scale, _, _ = metric_scale(points, matches.board_index, matches.grid, r.boards, covariance)
    found = np.zeros(len(seen), dtype=bool)
    found[np.flatnonzero(seen)[valid]] = True
    again = np.array(r.cloud.points_mm)
    again[found] = scale * points[valid]
    estimated = replace(
        r,
        camera1=camera1,
        camera2=camera2,
        cam2_from_cam1=Rigid3(pose.rotation, scale * pose.translation_mm),
        pose_covariance=None,
        cloud=replace(r.cloud, points_mm=again),
        baseline_mm=scale,
    )
    return estimated, found


def with_calibrations(r: Reconstruction, shifts: CalibrationShifts | None) -> Reconstruction:
    """Return the reconstruction with the calibrations' uncertainty added to the sigmas of its points and normals.

    Without `shifts` it is returned unchanged. Each axis of `shifts` moves a point and rotates its normal. The normal is
    computed again from the moved point, pose and cameras, and the same affinity; if the estimator uses the epipolar
    geometry, from the same directions. Sigmas of points that some moved camera does not see are NaN.

    Raises InputError for points on fitted planes, whose sigmas already include it.
    """
    if shifts is None:
        return r
    if r.boards and r.kept is None:
        raise InputError(f"pair '{r.pair_id}': the calibrations' share is for free points of boards")
    cloud, known = r.cloud, shifts.known
    moves = shifts.points()[:, known]
    if r.geometry is not None and r.kept is not None:
        covariance = r.geometry.points.covariance[r.kept][known] + np.einsum("kni,knj->nij", moves, moves)
        spread = np.sqrt(np.linalg.eigvalsh(covariance)[:, -1])
    else:
        # Upper bound of the largest eigenvalue of the sum.
        spread = np.sqrt(cloud.sigma_mm[known] ** 2 + np.sum(moves**2, axis=(0, 2)))
    m = r.matches.select(known)
    # The map from captured pixels to the affinities' coordinates (rectified or captured) is held fixed.
    by_coordinates = [
        np.linalg.pinv(camera.ray_jacobian(pixels[known])) @ by_coordinate
        for camera, pixels, by_coordinate in (
            (r.camera1, r.pixels1, m.jacobians1),
            (r.camera2, r.pixels2, m.jacobians2),
        )
    ]
    normals = []
    for shift, sights in zip((shifts.base, *shifts.moved), shifts.rays, strict=True):
        one, two = (
            (rays[known], by_pixel[known] @ by) for (rays, by_pixel), by in zip(sights, by_coordinates, strict=True)
        )
        normals.append(_normals(r, shift, known, one, two))
    base, *turned = normals
    tilt = sum((np.sum((normals - base) ** 2, axis=1) for normals in turned), np.zeros(int(known.sum())))
    sigma_mm, normal_sigma = np.full(len(cloud), np.nan), np.full(len(cloud), np.nan)
    sigma_mm[known] = spread
    normal_sigma[known] = np.sqrt(cloud.normal_sigma_rad[known] ** 2 + tilt)
    whole = replace(cloud, sigma_mm=sigma_mm, normal_sigma_rad=normal_sigma, calibration_in_sigmas=True)
    return replace(r, cloud=whole)


def _normals(
    r: Reconstruction,
    moved: Reconstruction,
    known: BoolArray,
    one: tuple[Rays, RayJacobians],
    two: tuple[Rays, RayJacobians],
) -> Normals:
    """Return the normals (n, 3) of the `known` points for moved cameras, from the rays in image `one` and `two` and
    their Jacobians by the affinities' coordinates."""
    (rays1, by1), (rays2, by2) = one, two
    J1, J2 = pair_projection_jacobians(moved.cloud.points_mm[known], rays1, by1, rays2, by2, moved.cam2_from_cam1)
    assert r.matches.A21 is not None
    A21 = r.matches.A21[known]
    if r.geometry is not None and r.kept is not None and needs_epipolar(r.affine_method):
        seen = EpipolarNormals.from_rays(rays1, by1, rays2, by2, essential_from_pose(moved.cam2_from_cam1))
        chosen = np.flatnonzero(r.kept)[known]
        n1, n2 = np.full((2, len(r.kept), 2), np.nan)
        n1[chosen], n2[chosen] = seen.n1, seen.n2
        directions = r.geometry.pair.directions
        found = affines_from_directions(directions, r.affine_method, epipolar=EpipolarNormals(n1, n2))
        A21 = found.A21[chosen]
    return normals_from_affines(J1, J2, A21)[0]
