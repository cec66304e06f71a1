"""Boards of known lattice in two views, and the minimum of their residuals: the problem behind `lattice_planes`."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from rigkit.cameras.base import Camera
from rigkit.core.arrays import BoolArray, FloatArray, IntArray, Pixels, Points
from rigkit.identification.joint_pose import BoardCorners, joint_residuals, moved_poses
from rigkit.optim.levenberg_marquardt import DenseProblem
from rigkit.reconstruction.board_planes import MIN_CORNERS_OF_BOARD, OUTLIER_ROUNDS, likeliest, near_the_rest

PlacedLattices: TypeAlias = tuple[FloatArray, FloatArray, FloatArray]
"""cam2_from_cam1 (4, 4), the boards' poses in camera 1 (K, 4, 4), and the logarithms (K,) of their sizes over the
declared ones."""


@dataclass(frozen=True, eq=False, slots=True)
class LatticeProblem:
    """Corners of K boards in two images.

    Attributes
    ----------
    pixels, images : of either image, the corners.
    size_sigma : (K,) standard deviation of the logarithm of a board's size; 0: the size is exact.
    """

    pixels: tuple[Pixels, Pixels]
    images: tuple[BoardCorners, BoardCorners]
    size_sigma: FloatArray

    @property
    def count(self) -> int:
        """How many corners there are."""
        return sum(len(pixels) for pixels in self.pixels)

    @property
    def free(self) -> BoolArray:
        """Which parameters are unknown: a board's size only where a sigma of it is stated."""
        return np.concatenate([np.ones(6 * (len(self.size_sigma) + 1), dtype=bool), self.size_sigma > 0.0])

    def through(self, cameras: tuple[Camera, Camera]) -> LatticeProblem:
        """Return the same corners as other cameras see them."""
        first, second = (
            seen_corners(camera, pixels, c.sigma_px, c.points, c.board)
            for camera, pixels, c in zip(cameras, self.pixels, self.images, strict=True)
        )
        return replace(self, images=(first, second))

    def residuals(self, state: PlacedLattices) -> FloatArray:
        """Return the residuals (2 N,) of the corners in sigmas."""
        return joint_residuals(self.images, *state)[0]

    def linearise(self, state: PlacedLattices) -> DenseProblem:
        """Return all residuals in sigmas, those of the sizes' prior last, and their derivatives by what is unknown."""
        residual, jacobian = joint_residuals(self.images, *state)
        stated = self.size_sigma > 0.0
        sigma = self.size_sigma[stated]
        prior = np.zeros((len(sigma), jacobian.shape[1]))
        prior[:, -len(stated) :] = np.eye(len(stated))[stated] / sigma[:, None]
        rows = np.concatenate([jacobian, prior])
        return DenseProblem(np.concatenate([residual, state[2][stated] / sigma]), rows[:, self.free])

    def minimum(self, state: PlacedLattices) -> PlacedLattices:
        """Return the state of maximum likelihood near `state`."""
        return likeliest(state, self.linearise, _moved, self.free)

    def without_outliers(self, state: PlacedLattices) -> tuple[LatticeProblem, PlacedLattices]:
        """Return the problem without gross outliers, and its minimum."""
        problem = self
        for _ in range(OUTLIER_ROUNDS):
            state = problem.minimum(state)
            near = near_the_rest(np.linalg.norm(problem.residuals(state).reshape(-1, 2), axis=1))
            each = np.split(near, [len(problem.pixels[0])])
            seen = zip(problem.images, each, strict=True)
            left = [np.bincount(c.board[kept], minlength=len(state[1])) for c, kept in seen]
            if near.all() or np.min(left) < MIN_CORNERS_OF_BOARD:
                return problem, state
            problem = problem._select(each)
        return problem, problem.minimum(state)

    def _select(self, each: list[BoolArray]) -> LatticeProblem:
        pixels, images = [], []
        for at, c, kept in zip(self.pixels, self.images, each, strict=True):
            pixels.append(at[kept])
            images.append(BoardCorners(c.rays[kept], c.bases[kept], c.points[kept], c.board[kept], c.sigma_px[kept]))
        return replace(self, pixels=(pixels[0], pixels[1]), images=(images[0], images[1]))


def seen_corners(camera: Camera, pixels: Pixels, sigma_px: FloatArray, points: Points, board: IntArray) -> BoardCorners:
    """Return corners as a camera sees them."""
    bases = np.linalg.pinv(camera.ray_jacobian(pixels)) / sigma_px[:, None, None]
    return BoardCorners(camera.unproject(pixels)[0], np.asarray(bases), points, board, sigma_px)


def _moved(state: PlacedLattices, step: FloatArray) -> PlacedLattices:
    motion, boards, log_sizes = state
    by_pose = step[: -len(boards)].reshape(-1, 6)
    return moved_poses(motion, by_pose[0]), moved_poses(boards, by_pose[1:]), log_sizes + step[-len(boards) :]
