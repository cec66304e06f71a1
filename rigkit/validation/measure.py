"""Angles and distances of a reconstruction, with their standard deviations.

The corners' own scatter about plane and lattice is observed. The relative pose moves all points together: its
covariance is carried through triangulation by central differences. Both parts are independent, because the residuals
that fix the pose are orthogonal to those that fix the points. The calibrations' uncertainty is the third part, where
they come with their covariances; else intrinsics are taken as exact. What pose and calibrations bend of a plane is
counted with them, not with the scatter.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from rigkit.core.arrays import FloatArray, Points
from rigkit.core.truth import MeasuredDistance
from rigkit.geometry.principal_axes import principal_axes
from rigkit.geometry.triangulation import point_covariances, triangulate_rays
from rigkit.reconstruction.reconstruct import Reconstruction
from rigkit.validation.boards import BoardResult, Placed, measure_board, place_moved, places_on
from rigkit.validation.intrinsics import CalibrationShifts
from rigkit.validation.planes import angle_jacobian, face_angle, normal_errors

ROTATION_STEP_RAD = 1e-5
TRANSLATION_STEP = 1e-5
"""Of the baseline. Central differences are then right to about 1e-9, far below any sigma's own accuracy."""

Boards = dict[str, BoardResult]


@dataclass(frozen=True, eq=False, slots=True)
class Measured:
    """The boards of a reconstruction, and how they move with the relative pose.

    Attributes
    ----------
    boards : by id, in the order of the reconstruction.
    moved : the same boards after a small step forward in each pose parameter (rotation rad, translation mm), after a
        step backward in each, and estimated again: first with the calibrations as they are, then moved along each
        principal axis of their covariance. Without these covariances the steps or the new estimates are left out.
    steps : (6,) of the pose parameters, or empty.
    pose_covariance : (6, 6), or None: then only the scatter counts.
    """

    boards: Boards
    moved: Mapping[str, Placed]
    steps: FloatArray
    pose_covariance: FloatArray | None

    def with_normals(self, reconstruction: Reconstruction) -> Measured:
        """Return the same for a reconstruction that differs in its normals only."""
        cloud = reconstruction.cloud
        of = {board.board_id: cloud.normals[cloud.board_index == n] for n, board in enumerate(reconstruction.boards)}
        boards = {
            name: replace(found, normal_errors=normal_errors(of[name], found.plane.normal))
            for name, found in self.boards.items()
        }
        return replace(self, boards=boards)

    def absent(self, *board_ids: str) -> str:
        """Return in words which of the boards were not reconstructed; empty if all were."""
        lost = [f"'{b}'" for b in dict.fromkeys(board_ids) if b not in self.boards]
        return f"board {' and '.join(lost)} was not reconstructed" if lost else ""

    def count(self, *board_ids: str) -> int:
        """Return how many points lie on these boards."""
        return sum(self.boards[b].plane.count for b in dict.fromkeys(board_ids))

    def angle_deg(self, a: str, b: str) -> tuple[float, float]:
        """Return the angle between two faces and its sigma, degrees."""
        one, two = self.boards[a].plane, self.boards[b].plane
        by_a, by_b = angle_jacobian(one.normal, two.normal)
        scatter = by_a @ one.normal_covariance @ by_a + by_b @ two.normal_covariance @ by_b
        common = self._common_variance(face_angle(self.moved[a].normal, self.moved[b].normal))
        return float(np.rad2deg(face_angle(one.normal, two.normal))), float(np.rad2deg(np.sqrt(scatter + common)))

    def distance_mm(self, distance: MeasuredDistance) -> tuple[float, float]:
        """Return a distance between features and its sigma, mm."""
        scatter = _distance_scatter(self.boards, distance)
        common = self._common_variance(_distance(self.boards, self.moved, distance))
        found = _distance(self.boards, {name: board.placed for name, board in self.boards.items()}, distance)
        return float(found), float(np.sqrt(scatter + common))

    def _common_variance(self, moved: FloatArray) -> float:
        """Return the variance from what moves all points together, pose and calibrations, from values as `moved`."""
        count = len(self.steps)
        ahead, back, shifted = np.split(moved, [count, 2 * count])
        variance = 0.0
        if self.pose_covariance is not None:
            slope = (ahead - back) / (2.0 * self.steps)
            variance += float(slope @ self.pose_covariance @ slope)
        return variance + float(np.sum((shifted[1:] - shifted[:1]) ** 2))


def measure(
    reconstruction: Reconstruction, shifts: CalibrationShifts | None = None, *, weighted: bool = True
) -> Measured:
    """Fit plane and lattice of every board, again for each small step of the pose, and of the calibrations if given.

    Without `weighted` the planes are the principal ones of the points, all alike and none left out.

    Raises DegenerateError where a board has too few points.
    """
    cloud = reconstruction.cloud
    rays1, _ = reconstruction.camera1.unproject(reconstruction.pixels1)
    rays2, _ = reconstruction.camera2.unproject(reconstruction.pixels2)
    # Only the ratios of these covariances count, as weights across the plane: one pixel is as good a sigma as any.
    covariance = point_covariances(
        cloud.points_mm,
        reconstruction.cam2_from_cam1,
        rays1,
        rays2,
        reconstruction.camera1.ray_jacobian(reconstruction.pixels1),
        reconstruction.camera2.ray_jacobian(reconstruction.pixels2),
    )
    usable = weighted and bool(np.isfinite(covariance).all())
    by_pose = () if reconstruction.pose_covariance is None else points_by_pose(reconstruction)
    common = _common_moves(reconstruction, by_pose, shifts)

    ahead, back = ([cloud.points_mm + sign * motion for motion, _ in by_pose] for sign in (1.0, -1.0))
    again = [] if shifts is None else [moved.cloud.points_mm for moved in (shifts.base, *shifts.moved)]
    points = np.array([*ahead, *back, *again]).reshape(-1, len(cloud), 3)
    boards: Boards = {}
    moved: dict[str, Placed] = {}
    for index, board in enumerate(reconstruction.boards):
        on = cloud.board_index == index
        if on.any():
            seen = (cloud.points_mm[on], cloud.normals[on], cloud.grid[on])
            found = measure_board(board, *seen, covariance[on] if usable else None, common[:, on])
            boards[board.board_id] = found
            moved[board.board_id] = place_moved(points[:, on], places_on(board, cloud.grid[on]), found.plane)
    return Measured(boards, moved, np.array([step for _, step in by_pose]), reconstruction.pose_covariance)


def points_by_pose(reconstruction: Reconstruction) -> tuple[tuple[FloatArray, float], ...]:
    """Return for each of the six pose parameters how the points move (N, 3) mm for a small step, and the step.

    Parameters are those of `Reconstruction.pose_covariance`: left rotation perturbation (rad), translation (mm). The
    points are triangulated again from the same corners. A point that has no triangulation moves by NaN.
    """
    camera1, camera2 = reconstruction.camera1, reconstruction.camera2
    rays1, _ = camera1.unproject(reconstruction.pixels1)
    rays2, _ = camera2.unproject(reconstruction.pixels2)
    jacobians = (camera1.ray_jacobian(reconstruction.pixels1), camera2.ray_jacobian(reconstruction.pixels2))
    pose = reconstruction.cam2_from_cam1
    length = float(np.linalg.norm(pose.translation_mm))
    out = []
    for axis in np.eye(6):
        step = ROTATION_STEP_RAD if axis[:3].any() else TRANSLATION_STEP * length

        def points(sign: float, move: FloatArray = axis * step) -> Points:
            shifted = pose.moved(sign * move)
            found, _ = triangulate_rays(rays1, rays2, shifted, jacobians1=jacobians[0], jacobians2=jacobians[1])
            return found

        out.append((0.5 * (points(1.0) - points(-1.0)), step))
    return tuple(out)


def _common_moves(
    reconstruction: Reconstruction, by_pose: Sequence[tuple[FloatArray, float]], shifts: CalibrationShifts | None
) -> FloatArray:
    """Return how the points move (K, N, 3), mm, for one sigma of each independent error that they share."""
    moves = [np.zeros((0, len(reconstruction.cloud), 3))]
    if reconstruction.pose_covariance is not None:
        slopes = np.array([motion / step for motion, step in by_pose])
        moves.append(np.einsum("kp,pni->kni", principal_axes(reconstruction.pose_covariance), slopes))
    if shifts is not None:
        moves.append(shifts.points())
    return np.concatenate(moves)


def _distance(boards: Boards, placed: Mapping[str, Placed], distance: MeasuredDistance) -> FloatArray:
    """Return a distance (...), mm, between features of `boards` that are where `placed` says."""
    a, b = distance.a, distance.b
    if a.is_plane:
        a, b = b, a
    point = placed[a.board_id].at(boards[a.board_id].place(a))
    if b.is_plane:
        return np.abs(placed[b.board_id].distances(point))
    return np.asarray(np.linalg.norm(point - placed[b.board_id].at(boards[b.board_id].place(b)), axis=-1))


def _distance_scatter(boards: Boards, distance: MeasuredDistance) -> float:
    """Return the variance of a distance that comes from the corners' scatter, mm^2."""
    a, b = distance.a, distance.b
    if a.is_plane:
        a, b = b, a
    point, covariance = boards[a.board_id].feature(a)
    if b.is_plane:
        plane = boards[b.board_id].plane
        return float(plane.normal @ covariance @ plane.normal) + plane.variance_at(point)
    other, covariance_other = boards[b.board_id].feature(b)
    if a.board_id == b.board_id:
        lattice, result = boards[a.board_id].lattice, boards[a.board_id]
        difference = np.array([0.0, *(result.place(a) - result.place(b))])
        covariance = lattice.scatter_mm2 * float(difference @ lattice.cofactor @ difference)
        covariance_other = np.zeros((3, 3))
    along = (point - other) / np.linalg.norm(point - other)
    return float(along @ (covariance + covariance_other) @ along)
