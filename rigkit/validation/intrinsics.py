"""What the uncertainty of the calibrations does to a reconstruction.

A calibration is one error for a whole pair: it tilts planes and stretches baselines without leaving any scatter behind.
So each principal axis of what they leave open is tried: the cameras moved by one standard deviation along it, the
pose, the scale and the points estimated again from the same corners. The axes are independent, so the squares of what
they change in a quantity add up to its variance.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from rigkit.affine.affinities import EpipolarNormals
from rigkit.affine.normal import normals_from_affines
from rigkit.affine.registry import affines_from_directions, needs_epipolar
from rigkit.cameras.base import Camera
from rigkit.cameras.uncertain import UncertainCamera
from rigkit.core.arrays import BoolArray, FloatArray, Normals, RayJacobians, Rays
from rigkit.core.errors import InputError
from rigkit.core.matches import Matches
from rigkit.geometry.projection_jacobian import pair_projection_jacobians
from rigkit.geometry.rigid3 import Rigid3
from rigkit.reconstruction.metric import triangulate_matches
from rigkit.reconstruction.moved_cameras import moved_cameras
from rigkit.reconstruction.reconstruct import Reconstruction
from rigkit.reconstruction.scale import metric_scale
from rigkit.relative_pose.refinement.refine import refine_pose
from rigkit.relative_pose.solvers.pose import essential_from_pose


@dataclass(frozen=True, eq=False)
class CalibrationShifts:
    """A reconstruction estimated again with the calibrations as they are, and moved along each principal axis.

    `known` (N,) are the points that could be triangulated with all of these cameras. The others stay where they were,
    and how well they are known is not known: corners at the rim of the field, and beside the epipoles.
    """

    base: Reconstruction
    moved: tuple[Reconstruction, ...]
    known: BoolArray

    @cached_property
    def rays(self) -> list[list[tuple[Rays, RayJacobians]]]:
        """Rays (N, 3) of the pixels of image 1 and of image 2, and their derivatives by the pixel (N, 3, 2), by the
        cameras as they are and as each move has them."""
        pixels = self.base.pixels1, self.base.pixels2
        each = [(shift.camera1, shift.camera2) for shift in (self.base, *self.moved)]
        return [[(c.unproject(p)[0], c.ray_jacobian(p)) for c, p in zip(both, pixels, strict=True)] for both in each]

    def points(self) -> FloatArray:
        """Return how the points move along each axis (K, N, 3), mm; NaN where that is not known."""
        moves = np.array([moved.cloud.points_mm - self.base.cloud.points_mm for moved in self.moved])
        moves = moves.reshape(-1, len(self.known), 3)
        moves[:, ~self.known] = np.nan
        return moves

    def variance(self, quantity: Callable[[Reconstruction], float]) -> float:
        """Return the variance of a quantity from the calibrations' uncertainty."""
        at_base = quantity(self.base)
        return float(sum((quantity(moved) - at_base) ** 2 for moved in self.moved))


def calibration_shifts(
    reconstruction: Reconstruction,
    known1: UncertainCamera,
    known2: UncertainCamera | None = None,
    *,
    level_sigma_rad: float | None = None,
) -> CalibrationShifts:
    """Return the reconstruction with its cameras moved by one standard deviation along every principal axis.

    Parameters
    ----------
    reconstruction : of one pair.
    known1 : camera 1 as it is known.
    known2 : camera 2, or None where both images are of one camera: then both move together.
    level_sigma_rad : as in the reconstruction.
    """
    camera1, camera2 = reconstruction.camera1, reconstruction.camera2
    cameras = [(camera1, camera2), *moved_cameras(camera1, camera2, known1, known2, one=known2 is None)]
    # A corner at the rim of the field can lie outside a moved camera's: then it says nothing here, of no camera.
    seen = np.logical_and.reduce(
        [
            camera.unproject(pixels)[1]
            for both in cameras
            for camera, pixels in zip(both, (reconstruction.pixels1, reconstruction.pixels2), strict=True)
        ]
    )
    again = [_again(reconstruction, *both, level_sigma_rad, seen) for both in cameras]
    base, *moved = (estimated for estimated, _ in again)
    return CalibrationShifts(base, tuple(moved), np.logical_and.reduce([found for _, found in again]))


def _again(
    reconstruction: Reconstruction, camera1: Camera, camera2: Camera, level_sigma_rad: float | None, seen: BoolArray
) -> tuple[Reconstruction, BoolArray]:
    """Estimate pose, scale and points again from the corners `seen`, and say which points (N,) could be.

    The other points, and all normals, stay.
    """
    known = reconstruction.matches.select(seen)
    matches = Matches.from_cameras(
        camera1,
        camera2,
        reconstruction.pixels1[seen],
        reconstruction.pixels2[seen],
        sigma1_px=known.sigma1_px,
        sigma2_px=known.sigma2_px,
        board_index=known.board_index,
        grid=known.grid,
    )
    pose = reconstruction.cam2_from_cam1
    start = Rigid3(pose.rotation, pose.translation_mm / np.linalg.norm(pose.translation_mm))
    frames = None if reconstruction.geometry is None else reconstruction.geometry.decision.level_frames
    refined = refine_pose(matches, start, reconstruction.pose_type, level_sigma_rad, level_frames=frames)
    points, covariance, valid = triangulate_matches(matches, refined.cam2_from_cam1)
    scale, _ = metric_scale(points, matches.board_index, matches.grid, reconstruction.boards, covariance)
    cloud = reconstruction.cloud
    found = np.zeros(len(seen), dtype=bool)
    found[np.flatnonzero(seen)[valid]] = True
    again = np.array(cloud.points_mm)
    again[found] = scale * points[valid]
    estimated = replace(
        reconstruction,
        camera1=camera1,
        camera2=camera2,
        cam2_from_cam1=Rigid3(refined.cam2_from_cam1.rotation, scale * refined.cam2_from_cam1.translation_mm),
        pose_covariance=None,
        cloud=replace(cloud, points_mm=again),
        baseline_mm=scale,
    )
    return estimated, found


def with_calibrations(reconstruction: Reconstruction, shifts: CalibrationShifts) -> Reconstruction:
    """Return the reconstruction with the share of the calibrations in the sigmas of its cloud's points and normals.

    Along each axis of `shifts` a point moves, and its normal turns: by the moved point, pose and cameras, from the same
    affinity in the image, or where affinities follow from the epipolar geometry from the same directions. Sigmas of
    points that not all of the moved cameras see are NaN: nobody knows them.

    Raises InputError for a reconstruction that is of no boards: its corners' noise is not known any more.
    """
    geometry, kept = reconstruction.geometry, reconstruction.kept
    if geometry is None or kept is None:
        raise InputError(f"pair '{reconstruction.pair_id}': the calibrations' share is for free points of boards")
    cloud, known = reconstruction.cloud, shifts.known
    moves = shifts.points()[:, known]
    covariance = geometry.points.covariance[kept][known] + np.einsum("kni,knj->nij", moves, moves)
    m = reconstruction.matches.select(known)
    # The coordinates of the affinities (rectified, or the captured pixels) move with the pixels as they did.
    by_coordinates = [
        np.linalg.pinv(camera.ray_jacobian(pixels[known])) @ by_coordinate
        for camera, pixels, by_coordinate in (
            (reconstruction.camera1, reconstruction.pixels1, m.jacobians1),
            (reconstruction.camera2, reconstruction.pixels2, m.jacobians2),
        )
    ]
    normals = []
    for shift, sights in zip((shifts.base, *shifts.moved), shifts.rays, strict=True):
        one, two = (
            (rays[known], by_pixel[known] @ by) for (rays, by_pixel), by in zip(sights, by_coordinates, strict=True)
        )
        normals.append(_normals(reconstruction, shift, known, one, two))
    base, *turned = normals
    tilt = sum((np.sum((normals - base) ** 2, axis=1) for normals in turned), np.zeros(int(known.sum())))
    sigma_mm, normal_sigma = np.full(len(cloud), np.nan), np.full(len(cloud), np.nan)
    sigma_mm[known] = np.sqrt(np.linalg.eigvalsh(covariance)[:, -1])
    normal_sigma[known] = np.sqrt(cloud.normal_sigma_rad[known] ** 2 + tilt)
    whole = replace(cloud, sigma_mm=sigma_mm, normal_sigma_rad=normal_sigma, calibration_in_sigmas=True)
    return replace(reconstruction, cloud=whole)


def _normals(
    reconstruction: Reconstruction,
    moved: Reconstruction,
    known: BoolArray,
    one: tuple[Rays, RayJacobians],
    two: tuple[Rays, RayJacobians],
) -> Normals:
    """Return the normals (n, 3) of the `known` points as moved cameras have them: their rays in image `one` and `two`,
    with the derivatives by the coordinates of the affinities."""
    (rays1, by1), (rays2, by2) = one, two
    J1, J2 = pair_projection_jacobians(moved.cloud.points_mm[known], rays1, by1, rays2, by2, moved.cam2_from_cam1)
    A21 = None if reconstruction.matches.A21 is None else reconstruction.matches.A21[known]
    if needs_epipolar(reconstruction.affine_method):
        assert reconstruction.geometry is not None and reconstruction.kept is not None
        E21 = essential_from_pose(moved.cam2_from_cam1)
        seen = EpipolarNormals.from_rays(rays1, by1, rays2, by2, E21)
        chosen = np.flatnonzero(reconstruction.kept)[known]
        n1, n2 = np.full((2, len(reconstruction.kept), 2), np.nan)
        n1[chosen], n2[chosen] = seen.n1, seen.n2
        directions = reconstruction.geometry.pair.directions
        A21 = affines_from_directions(directions, reconstruction.affine_method, epipolar=EpipolarNormals(n1, n2)).A21[
            chosen
        ]
    assert A21 is not None
    return normals_from_affines(J1, J2, A21)[0]
