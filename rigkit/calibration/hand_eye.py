"""Robot-world / hand-eye calibration: the pose of a camera on a robot's hand (or before the robot), and of the board.

    cam_from_board[i] = cam_from_mount @ mount_from_stand[i] @ stand_from_board

The robot gives mount_from_stand for every image. If the hand carries the camera, the mount is the hand and the stand
the robot's base; if it carries the board, the mount is the base and the stand the hand. Initial rotations come from the
null space of R_cam R_z^T = R_x R_robot, initial translations linearly (M. Shah, "Solving the robot-world/hand-eye
calibration problem using the Kronecker product", J. Mechanisms and Robotics 5, 2013); both poses are then refined by
least squares over all corners.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rigkit.calibration.solving.clustered import Clustered, clustered_covariance, effective_freedom, widening
from rigkit.cameras.base import Camera
from rigkit.cameras.board_pose import cam_from_seen_board
from rigkit.core.arrays import FloatArray, IntArray, root_diagonal
from rigkit.core.detections import BoardView
from rigkit.core.errors import DegenerateError, InputError
from rigkit.core.printing import brief
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import nearest_rotation, rotation_angle, skew
from rigkit.optim.damping import Damping, Stop
from rigkit.optim.levenberg_marquardt import DenseProblem, DenseStep, minimise

MIN_POSES = 3
MAX_MISMATCH_RAD = np.radians(1.0)
"""Rotations of robots and boards are accurate to some hundredths of a degree: more is an image of another pose."""
MAX_SIGMA_OF_DISTANCE = 0.1
"""Largest standard deviation of a position, as a part of the boards' distance. Rotations about a single axis leave the
position along it undetermined; with a second axis this limit decides."""
OPEN_PART = 1e-12
"""Relative eigenvalue of the information matrix up to which a direction is undetermined: rounding."""
HAND_EYE_DAMPING = Damping(start=1e-4, ceiling=1e12)
HAND_EYE_STOP = Stop(steps=60, predicted_gain=1e-14)
UNKNOWNS = 12
INVERSE_FITS_BETTER = 3.0
"""Robot poses are the wrong way round where their inverses fit so many times better."""


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class HandEye:
    """A hand-eye calibration.

    Attributes
    ----------
    cam_from_mount, stand_from_board : the two unknown poses, mm.
    covariance : (12, 12) of (w, v) of the first, then of the second: R' = exp([w]x) R, t' = t + v, rad and mm. It is
        estimated from the scatter between images and so includes the errors of the robot's poses.
    freedom : its degrees of freedom; quoted standard deviations account for them (`widening`).
    rms_px : 2-D RMS of all corners.
    image_rms_px : the same of each image.
    translation_residuals_mm, rotation_residuals_rad : (N,) for the images used, in their order: distance of the board's
        centre, and rotation angle, between the board's pose seen by the camera and that predicted from the robot.
    left_out : for each image left out, by how much (rad) its rotations differ from the robot's.
    """

    cam_from_mount: Rigid3
    stand_from_board: Rigid3
    covariance: FloatArray
    freedom: float
    rms_px: float
    image_rms_px: dict[str, float]
    translation_residuals_mm: FloatArray
    rotation_residuals_rad: FloatArray
    left_out: dict[str, float]

    __repr__ = brief

    def sigmas(self) -> tuple[FloatArray, FloatArray]:
        """Return the standard deviations (2, 3) of the rotations (rad) and of the translations (mm) of both poses,
        widened so that two of them contain 95 % of the errors."""
        deviations = widening(self.freedom) * np.sqrt(np.diag(self.covariance)).reshape(2, 2, 3)
        return deviations[:, 0], deviations[:, 1]


def hand_eye(camera: Camera, views: Sequence[BoardView], mount_from_stand: Sequence[Rigid3]) -> HandEye:
    """Return the hand-eye calibration from views of one board and the robot's pose at each.

    Raises
    ------
    InputError
        Different numbers of views and poses; rotations of camera and robot that disagree; inverted robot poses.
    DegenerateError
        Fewer than three images, or rotations about one axis only, which leave the position along it undetermined.
    """
    if len(views) != len(mount_from_stand):
        raise InputError(f"hand-eye: {len(views)} views, but {len(mount_from_stand)} poses of the robot")
    if len(views) < MIN_POSES:
        raise DegenerateError(f"hand-eye: {len(views)} images with the board; at least {MIN_POSES} are needed")
    seen = [_pose(camera, view) for view in views]
    mismatch = _mismatch(seen, mount_from_stand)
    use = np.flatnonzero(mismatch <= MAX_MISMATCH_RAD).tolist()
    if len(use) < max(MIN_POSES, len(views) // 2 + 1):
        worst = float(np.degrees(np.median(mismatch)))
        raise InputError(
            f"hand-eye: rotations of camera and robot between images differ (by {worst:.1f} degrees, median); check "
            "that images and poses are in the same order, and the unit of the angles"
        )
    problem = _AllCorners(camera, [views[i] for i in use], [mount_from_stand[i] for i in use])
    start = _linear([seen[i] for i in use], problem.robot)
    found = minimise(start, problem.at, _moved, HAND_EYE_DAMPING, HAND_EYE_STOP)
    _refuse_inverse(problem, [seen[i] for i in use], found.problem.cost)
    known = _by_image(found.problem, problem.image)
    _refuse_open(known.covariance, [seen[i] for i in use])
    squared = found.problem.residual.reshape(-1, 2) ** 2 * problem.sigma[:, None] ** 2
    by_image = {
        problem.views[i].image: float(np.sqrt(squared[problem.image == i].sum(axis=1).mean()))
        for i in range(len(problem.views))
    }
    off_mm, turned_rad = _residuals(*found.state, problem, [seen[i] for i in use])
    return HandEye(
        cam_from_mount=found.state[0],
        stand_from_board=found.state[1],
        covariance=known.covariance,
        # Each image measures six numbers: UNKNOWNS / 6 images determine the unknowns and say nothing about scatter.
        freedom=effective_freedom(min(known.freedom, len(use) - UNKNOWNS / 6), known.overdispersion, UNKNOWNS),
        rms_px=float(np.sqrt(squared.sum(axis=1).mean())),
        image_rms_px=by_image,
        translation_residuals_mm=off_mm,
        rotation_residuals_rad=turned_rad,
        left_out={views[i].image: float(mismatch[i]) for i in range(len(views)) if i not in use},
    )


class _AllCorners:
    """The least-squares problem of all corners of all images in the two unknown poses."""

    def __init__(self, camera: Camera, views: Sequence[BoardView], robot: Sequence[Rigid3]) -> None:
        self.camera, self.views, self.robot = camera, list(views), list(robot)
        self.image: IntArray = np.repeat(np.arange(len(views)), [len(view.grid) for view in views])
        self.points = np.concatenate([view.points() for view in views])
        self.pixels = np.concatenate([view.pixels for view in views])
        self.sigma = np.concatenate([view.sigma_px for view in views])
        self.rotation = np.stack([pose.rotation for pose in robot])[self.image]
        self.translation = np.stack([pose.translation_mm for pose in robot])[self.image]

    def at(self, state: tuple[Rigid3, Rigid3]) -> DenseProblem:
        """Return residuals in sigmas and their derivatives by (w, v) of either pose."""
        cam_from_mount, stand_from_board = state
        turned = self.points @ stand_from_board.rotation.T
        in_stand = turned + stand_from_board.translation_mm
        in_mount = np.einsum("nij,nj->ni", self.rotation, in_stand) + self.translation
        far = in_mount @ cam_from_mount.rotation.T
        pixels, valid, d_pixels_d_point, _ = self.camera.project_with_jacobians(far + cam_from_mount.translation_mm)
        to_cam = d_pixels_d_point @ (cam_from_mount.rotation @ self.rotation)
        jacobian = np.concatenate(
            [d_pixels_d_point @ -skew(far), d_pixels_d_point, to_cam @ -skew(turned), to_cam], axis=-1
        )
        scale = 1.0 / self.sigma[:, None]
        residual = np.where(valid[:, None], (pixels - self.pixels) * scale, np.inf)
        jacobian = np.where(valid[:, None, None], jacobian * scale[..., None], 0.0)
        return DenseProblem(residual.reshape(-1), jacobian.reshape(-1, UNKNOWNS))


def _residuals(
    cam_from_mount: Rigid3, stand_from_board: Rigid3, problem: _AllCorners, seen: Sequence[Rigid3]
) -> tuple[FloatArray, FloatArray]:
    """Return distance (N,) mm and angle (N,) rad between the boards' poses seen and those predicted from the robot."""
    off_mm, turned = [], []
    for view, arm, cam_from_board in zip(problem.views, problem.robot, seen, strict=True):
        predicted = cam_from_mount @ arm @ stand_from_board
        middle = view.points().mean(axis=0)
        off_mm.append(np.linalg.norm(cam_from_board.apply(middle) - predicted.apply(middle)))
        turned.append(cam_from_board.rotation @ predicted.rotation.T)
    return np.array(off_mm), rotation_angle(np.array(turned))


def _moved(state: tuple[Rigid3, Rigid3], step: DenseStep) -> tuple[Rigid3, Rigid3]:
    return state[0].moved(step.change[:6]), state[1].moved(step.change[6:])


def _pose(camera: Camera, view: BoardView) -> Rigid3:
    try:
        return cam_from_seen_board(camera, view.pixels, view.points())
    except DegenerateError as error:
        raise InputError(
            f"hand-eye: image '{view.image}' has fewer than four non-collinear corners in the camera's field of "
            "view; leave it out"
        ) from error


def _mismatch(seen: Sequence[Rigid3], robot: Sequence[Rigid3]) -> FloatArray:
    """Return for each image the median difference (N,) rad between the camera's and the robot's rotation angles to the
    other images: the angles are equal whatever the unknown poses are."""
    angles = []
    for poses in (seen, robot):
        rotation = np.stack([pose.rotation for pose in poses])
        angles.append(rotation_angle(rotation[:, None] @ np.swapaxes(rotation, -1, -2)[None]))
    return np.asarray(np.median(np.abs(angles[0] - angles[1]), axis=1))


def _refuse_open(covariance: FloatArray, seen: Sequence[Rigid3]) -> None:
    """Raise DegenerateError where a position is undetermined."""
    distance = float(np.mean([np.linalg.norm(pose.translation_mm) for pose in seen]))
    blocks = [covariance[k : k + 3, k : k + 3] for k in (3, 9)]
    worst = np.inf
    if np.isfinite(covariance).all():
        worst = max(float(np.linalg.eigvalsh(block)[-1]) for block in blocks) ** 0.5
    if not worst <= MAX_SIGMA_OF_DISTANCE * distance:
        known = f", known to {worst:.0f} mm only" if np.isfinite(worst) else ""
        raise DegenerateError(
            "hand-eye: the hand rotated about one axis only, which does not determine the translation along it"
            f"{known}; rotate it about two axes"
        )


def _linear(seen: Sequence[Rigid3], robot: Sequence[Rigid3]) -> tuple[Rigid3, Rigid3]:
    """Return initial poses: R_x^T R_cam = R_robot R_z is linear in both rotations, the rest in both translations."""
    rows = [
        np.hstack([np.kron(np.eye(3), cam.rotation.T), -np.kron(arm.rotation, np.eye(3))])
        for cam, arm in zip(seen, robot, strict=True)
    ]
    # Row by row: vec(R_x^T R_cam) = (I kron R_cam^T) vec(R_x^T), vec(R_robot R_z) = (R_robot kron I) vec(R_z).
    solution = np.linalg.svd(np.concatenate(rows), full_matrices=False)[2][-1]
    first, second = solution[:9].reshape(3, 3), solution[9:].reshape(3, 3)
    sign = np.sign(np.linalg.det(first))
    Rx, Rz = nearest_rotation(sign * first).T, nearest_rotation(sign * second)
    # t_cam = R_x (R_robot t_z + t_robot) + t_x
    design = np.concatenate([np.hstack([np.eye(3), Rx @ arm.rotation]) for arm in robot])
    target = np.concatenate(
        [cam.translation_mm - Rx @ arm.translation_mm for cam, arm in zip(seen, robot, strict=True)]
    )
    translations = np.linalg.lstsq(design, target, rcond=None)[0]
    return Rigid3(Rx, translations[:3]), Rigid3(Rz, translations[3:])


def _refuse_inverse(problem: _AllCorners, seen: Sequence[Rigid3], cost: float) -> None:
    """Raise InputError where the inverses of the robot's poses fit far better."""
    other = _AllCorners(problem.camera, problem.views, [pose.inverse() for pose in problem.robot])
    start = _linear(seen, other.robot)
    found = minimise(start, other.at, _moved, HAND_EYE_DAMPING, HAND_EYE_STOP)
    if np.isfinite(found.problem.cost) and found.problem.cost * INVERSE_FITS_BETTER**2 < cost:
        raise InputError(
            "hand-eye: the inverse robot poses fit far better: either --inverse (the poses are hand_from_base) or "
            "--board-on-hand must change: give it, or leave it out if it is given"
        )


def _by_image(problem: DenseProblem, image: IntArray) -> Clustered:
    """Return the covariance (12, 12) of the solution with images as independent units: an error of the robot's pose
    shifts all corners of an image. Infinite where an unknown is undetermined."""
    count = int(image.max()) + 1
    rows, residual = problem.jacobian.reshape(-1, 2, UNKNOWNS), problem.residual.reshape(-1, 2)
    information, score = np.zeros((count, UNKNOWNS, UNKNOWNS)), np.zeros((count, UNKNOWNS))
    np.add.at(information, image, np.einsum("nka,nkb->nab", rows, rows))
    np.add.at(score, image, np.einsum("nka,nk->na", rows, residual))
    total = information.sum(axis=0)
    scale = root_diagonal(total)
    scaled = total / np.outer(scale, scale)
    if not np.linalg.eigvalsh(scaled)[0] > OPEN_PART:
        return Clustered(np.diag(np.full(UNKNOWNS, np.inf)), 1.0, float("inf"))
    unit = np.linalg.inv(scaled) / np.outer(scale, scale)
    sigma = float(np.sqrt((residual**2).sum() / max(residual.size - UNKNOWNS, 1)))
    return clustered_covariance(unit, information, score, np.zeros_like(total), sigma)
