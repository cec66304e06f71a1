"""Measure angles and distances of a reconstruction, with their standard deviations.

The noise of the corners is their observed scatter about plane and lattice. Errors of the relative pose move all points
together; so do those of the calibrations if their covariances are known (else intrinsics are exact). The points are
moved by one standard deviation of each of these independent errors, and the squared changes of a quantity add up to its
variance. Scatter and pose are independent, because the residuals that determine the pose are orthogonal to those that
determine the points. Bending of a plane by pose and calibrations counts as their error, not as scatter.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from rigkit.core.arrays import FloatArray, principal_axes
from rigkit.core.truth import Feature, MeasuredDistance
from rigkit.geometry.triangulation import point_uncertainty
from rigkit.reconstruction.calibration_shifts import CalibrationShifts
from rigkit.reconstruction.reconstruct import Reconstruction
from rigkit.validation.boards import BoardPlace, BoardResult, measure_board, place_perturbed, places_on
from rigkit.validation.planes import angle_jacobian, face_angle, normal_errors

Boards = dict[str, BoardResult]


@dataclass(frozen=True, eq=False, slots=True)
class Measured:
    """The boards of a reconstruction, and their displacement by the errors common to all points.

    Attributes
    ----------
    boards : by id, in the order of the reconstruction.
    moved : the boards unperturbed, and then moved by one standard deviation of each independent error of the relative
        pose and of the calibrations, if known.
    """

    boards: Boards
    moved: Mapping[str, BoardPlace]

    def with_normals(self, reconstruction: Reconstruction) -> Measured:
        """Return the same boards with the normal errors of a reconstruction that differs only in its normals."""
        cloud = reconstruction.cloud
        boards = {
            name: replace(found, normal_errors=normal_errors(cloud.normals[cloud.on_board(name)], found.plane.normal))
            for name, found in self.boards.items()
        }
        return replace(self, boards=boards)

    def absent(self, *board_ids: str) -> str:
        """Return a message about the boards that were not reconstructed; empty if all were."""
        lost = [f"'{b}'" for b in dict.fromkeys(board_ids) if b not in self.boards]
        return f"board {' and '.join(lost)} was not reconstructed" if lost else ""

    def count(self, *board_ids: str) -> int:
        """Return the number of points on these boards."""
        return sum(self.boards[b].plane.count for b in dict.fromkeys(board_ids))

    def angle_deg(self, a: str, b: str) -> tuple[float, float]:
        """Return the angle between two faces and its sigma, degrees."""
        one, two = self.boards[a].plane, self.boards[b].plane
        by_a, by_b = angle_jacobian(one.normal, two.normal)
        scatter = by_a @ one.normal_covariance @ by_a + by_b @ two.normal_covariance @ by_b
        common = _common_variance(face_angle(self.moved[a].normal, self.moved[b].normal))
        return float(np.rad2deg(face_angle(one.normal, two.normal))), float(np.rad2deg(np.sqrt(scatter + common)))

    def distance_mm(self, distance: MeasuredDistance) -> tuple[float, float]:
        """Return a distance between features and its sigma, mm."""
        a, b = (distance.b, distance.a) if distance.a.is_plane else (distance.a, distance.b)
        common = _common_variance(_distance(self.boards, self.moved, a, b))
        found = _distance(self.boards, {name: board.placed for name, board in self.boards.items()}, a, b)
        return float(found), float(np.sqrt(_distance_scatter(self.boards, a, b) + common))


def _common_variance(moved: FloatArray) -> float:
    """Return the variance of a quantity by the common errors, from its values (1 + K,) for the boards `moved`."""
    return float(np.sum((moved[1:] - moved[0]) ** 2))


def measure(
    reconstruction: Reconstruction, shifts: CalibrationShifts | None = None, *, weighted: bool = True
) -> Measured:
    """Fit plane and lattice of every board, and again for each error of the pose, and of the calibrations if given.

    Without `weighted` planes are fitted by PCA to all points with equal weights.

    Raises DegenerateError if a board has too few points.
    """
    cloud = reconstruction.cloud
    # Only the ratios of these covariances are used, as weights: any sigma will do, here one pixel.
    covariance, by_pose = point_uncertainty(
        cloud.points_mm, reconstruction.cam2_from_cam1, *reconstruction.measured_rays()
    )
    usable = weighted and bool(np.isfinite(covariance).all())
    moves = [np.zeros((0, len(cloud), 3))]
    if reconstruction.pose_covariance is not None:
        moves.append(np.einsum("kp,nip->kni", principal_axes(reconstruction.pose_covariance), by_pose))
    if shifts is not None:
        moves.append(shifts.points())
    common = np.concatenate(moves)
    points = cloud.points_mm + np.concatenate([np.zeros((1, len(cloud), 3)), common])
    boards: Boards = {}
    moved: dict[str, BoardPlace] = {}
    for index, board in enumerate(reconstruction.boards):
        on = cloud.board_index == index
        if on.any():
            seen = (cloud.points_mm[on], cloud.normals[on], cloud.grid[on])
            found = measure_board(board, *seen, covariance[on] if usable else None, common[:, on])
            boards[board.board_id] = found
            moved[board.board_id] = place_perturbed(points[:, on], places_on(board, cloud.grid[on]), found.plane)
    return Measured(boards, moved)


def _distance(boards: Boards, placed: Mapping[str, BoardPlace], a: Feature, b: Feature) -> FloatArray:
    """Return the distance (...), mm, of a point `a` to a point or plane `b`, for planes and lattices `placed`."""
    point = placed[a.board_id].at(boards[a.board_id].place(a))
    if b.is_plane:
        return np.abs(placed[b.board_id].distances(point))
    return np.asarray(np.linalg.norm(point - placed[b.board_id].at(boards[b.board_id].place(b)), axis=-1))


def _distance_scatter(boards: Boards, a: Feature, b: Feature) -> float:
    """Return the variance of such a distance by the corners' scatter, mm^2."""
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
