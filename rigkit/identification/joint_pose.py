"""Bundle adjustment of the poses of two cameras and of the boards that both see."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rigkit.cameras.base import Camera
from rigkit.core.arrays import FloatArray, IntArray, Pixels, Points, Rays
from rigkit.core.errors import InputError
from rigkit.geometry.board_pose import point_residuals
from rigkit.geometry.rotation import exp_so3, skew
from rigkit.optim.damping import Damping, Stop
from rigkit.optim.levenberg_marquardt import DenseProblem, DenseStep, minimise

MAX_JOINT_STEPS = 30
JOINT_DAMPING = Damping(start=1e-6, floor=1e-9, refused_floor=1e-4, ceiling=1e4)


@dataclass(frozen=True, eq=False, slots=True)
class BoardObservation:
    """Corners of one board in one image, as rays.

    Attributes
    ----------
    rays : (N, 3) unit.
    bases : (N, 2, 3) pseudo-inverse of d ray / d pixel, which maps an offset of the ray to one of the pixel.
    sigma_px : (N,)
    """

    rays: Rays
    bases: FloatArray
    sigma_px: FloatArray

    @classmethod
    def of(cls, camera: Camera, pixels: Pixels, sigma_px: FloatArray, where: str) -> BoardObservation:
        """Build from pixels; raises InputError, with `where` in its message, if a pixel has no ray."""
        rays, seen = camera.unproject(pixels)
        if not seen.all():
            lost = int((~seen).sum())
            raise InputError(f"{where}: {lost} corners lie outside the camera's field of view; check the calibration")
        return cls(rays, np.asarray(np.linalg.pinv(camera.ray_jacobian(pixels)), dtype=np.float64), sigma_px)


@dataclass(frozen=True, eq=False, slots=True)
class JointPose:
    """Result of `refine_joint`.

    Attributes
    ----------
    cam2_from_cam1 : (4, 4)
    cam1_from_board : (B, 4, 4)
    squared_px : (B, 2) sum of the corners' squared residuals, px^2, per board in image 1 and 2.
    chi2 : (B, 2) the same over the corners' variances.
    """

    cam2_from_cam1: FloatArray
    cam1_from_board: FloatArray
    squared_px: FloatArray
    chi2: FloatArray


@dataclass(frozen=True, eq=False, slots=True)
class BoardCorners:
    """All corners of one image.

    Attributes
    ----------
    rays : (N, 3) unit.
    bases : (N, 2, 3) rows perpendicular to the rays, scaled for residuals in sigmas.
    points, board : (N, 3) mm in the frame of the board, and (N,) index of the board.
    sigma_px : (N,)
    """

    rays: Rays
    bases: FloatArray
    points: Points
    board: IntArray
    sigma_px: FloatArray

    @classmethod
    def stack(cls, observations: Sequence[BoardObservation], points: Sequence[Points]) -> BoardCorners:
        """Concatenate the corners of the boards of one image."""
        sigma = np.concatenate([s.sigma_px for s in observations])
        bases = np.concatenate([s.bases for s in observations]) / sigma[:, None, None]
        board = np.repeat(np.arange(len(observations)), [len(p) for p in points])
        return cls(np.concatenate([s.rays for s in observations]), bases, np.concatenate(points), board, sigma)


def refine_joint(
    cam2_from_cam1: FloatArray,
    cam1_from_board: FloatArray,
    images: tuple[BoardCorners, BoardCorners],
    *,
    tolerance: float = 1e-9,
) -> JointPose:
    """Return relative pose and board poses that minimise the whitened residuals of all corners in both images.

    Parameters
    ----------
    cam2_from_cam1, cam1_from_board : (4, 4) and (B, 4, 4) initial poses.
    images : corners of the B boards in image 1 and 2, which may show different ones.
    tolerance : relative decrease of the cost below which the minimisation stops.
    """

    def linearise(poses: tuple[FloatArray, FloatArray]) -> DenseProblem:
        return DenseProblem(*joint_residuals(images, *poses))

    def moved(poses: tuple[FloatArray, FloatArray], step: DenseStep) -> tuple[FloatArray, FloatArray]:
        change = step.change.reshape(-1, 6)
        return moved_poses(poses[0], change[0]), moved_poses(poses[1], change[1:])

    start = cam2_from_cam1.copy(), cam1_from_board.copy()
    end = minimise(start, linearise, moved, JOINT_DAMPING, Stop(steps=MAX_JOINT_STEPS, gain=tolerance))
    motion, boards = end.state
    residual = end.problem.residual
    split = np.split(residual.reshape(-1, 2), [len(images[0].rays)])
    chi2, squared = np.zeros((len(boards), 2)), np.zeros((len(boards), 2))
    for k, (image, part) in enumerate(zip(images, split, strict=True)):
        each = (part**2).sum(axis=1)
        chi2[:, k] = np.bincount(image.board, each, len(boards))
        squared[:, k] = np.bincount(image.board, each * image.sigma_px**2, len(boards))
    return JointPose(motion, boards, squared, chi2)


def moved_poses(pose: FloatArray, step: FloatArray) -> FloatArray:
    """Return poses (..., 4, 4) updated by (w, v): R' = exp([w]x) R, t' = t + v."""
    out = pose.copy()
    out[..., :3, :3] = exp_so3(step[..., :3]) @ pose[..., :3, :3]
    out[..., :3, 3] += step[..., 3:]
    return out


def joint_residuals(
    images: tuple[BoardCorners, BoardCorners],
    motion: FloatArray,
    boards: FloatArray,
    log_sizes: FloatArray | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Return whitened residuals of image 1 and 2, (2N,), and their derivatives by the motion and the board poses.

    With `log_sizes` (K,), logarithms of the boards' true over declared sizes, the derivatives by these follow.
    """
    count, residuals, jacobians = len(boards), [], []
    for k, image in enumerate(images):
        pose = boards[image.board]
        turned = (pose[:, :3, :3] @ image.points[..., None])[..., 0]
        if log_sizes is not None:
            turned *= np.exp(log_sizes[image.board])[:, None]
        x = turned + pose[:, :3, 3]
        n = len(x)
        jacobian = np.zeros((n, 2, 1 + count, 6))
        if k == 0:
            residual, by_x = point_residuals(image.rays, image.bases, x)
        else:
            rotated = x @ motion[:3, :3].T
            residual, by_y = point_residuals(image.rays, image.bases, rotated + motion[:3, 3])
            jacobian[:, :, 0] = np.concatenate([-by_y @ skew(rotated), by_y], axis=-1)
            by_x = by_y @ motion[:3, :3]
        jacobian[np.arange(n), :, 1 + image.board] = np.concatenate([-by_x @ skew(turned), by_x], axis=-1)
        columns = [jacobian.reshape(2 * n, -1)]
        if log_sizes is not None:
            by_size = np.zeros((n, 2, count))
            by_size[np.arange(n), :, image.board] = (by_x @ turned[..., None])[..., 0]
            columns.append(by_size.reshape(2 * n, -1))
        residuals.append(residual.reshape(-1))
        jacobians.append(np.concatenate(columns, axis=1))
    return np.concatenate(residuals), np.concatenate(jacobians)
