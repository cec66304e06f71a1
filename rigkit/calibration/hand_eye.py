"""Where a camera sits on a robot's hand (or before the robot), and where the board stands: hand-eye calibration.

    cam_from_board[i] = cam_from_mount @ mount_from_stand[i] @ stand_from_board

The robot tells mount_from_stand of every image. On a hand that carries the camera, the mount is the hand and the stand
the robot's base; where the hand carries the board, the mount is the base and the stand the hand. Start: rotations from
the null space of R_cam R_z^T = R_x R_robot, then translations linearly (M. Shah, "Solving the robot-world/hand-eye
calibration problem using the Kronecker product", J. Mechanisms and Robotics 5, 2013); then least squares over all
corners.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rigkit.calibration.solving.clustered import Clustered, clustered_covariance, effective_freedom, widening
from rigkit.cameras.base import Camera
from rigkit.cameras.board_pose import cam_from_seen_board
from rigkit.core.arrays import FloatArray, IntArray
from rigkit.core.detections import BoardView
from rigkit.core.errors import DegenerateError, InputError
from rigkit.core.printing import brief
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import nearest_rotation, rotation_angle, skew
from rigkit.optim.damping import Damping, Stop
from rigkit.optim.levenberg_marquardt import DenseProblem, DenseStep, minimise

MIN_POSES = 3
MAX_MISMATCH_RAD = np.radians(1.0)
"""Robots and boards tell a rotation to some hundredths of a degree: more is a picture of another pose."""
MAX_SIGMA_OF_DISTANCE = 0.1
"""A place known to no better than this part of the distance of the boards is none: turns about one axis leave it open
along that axis. Turns about a second one, however few, count by how certain they make it."""
OPEN_PART = 1e-12
"""A direction of which the corners know this part of what they know of the best is open: it is rounding."""
HAND_EYE_DAMPING = Damping(start=1e-4, ceiling=1e12)
HAND_EYE_STOP = Stop(steps=60, predicted_gain=1e-14)
UNKNOWNS = 12
INVERSE_FITS_BETTER = 3.0
"""Robot poses taken the other way round are mistaken where they fit so many times better."""


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class HandEye:
    """A hand-eye calibration.

    Attributes
    ----------
    cam_from_mount, stand_from_board : the two unknown poses, mm.
    covariance : (12, 12) of (w, v) of the first, then of the second: R' = exp([w]x) R, t' = t + v, rad and mm. By what
        the images disagree: what the robot does not tell exactly is in it.
    freedom : its degrees of freedom; deviations that are quoted count them in (`widening`).
    rms_px : 2-D RMS of all corners.
    image_rms_px : by image.
    apart_mm, apart_rad : (N,) of the images used, in their order: how far the middle of the board, and its turn, as the
        camera sees the board, are from where the robot has them.
    left_out : by image, by how much (rad) its turns differ from the robot's.
    """

    cam_from_mount: Rigid3
    stand_from_board: Rigid3
    covariance: FloatArray
    freedom: float
    rms_px: float
    image_rms_px: dict[str, float]
    apart_mm: FloatArray
    apart_rad: FloatArray
    left_out: dict[str, float]

    __repr__ = brief

    def sigmas(self) -> tuple[FloatArray, FloatArray]:
        """Return standard deviations (2, 3) of the turns (rad) and of the translations (mm) of both poses: two
        hold 95 % of errors, however few images there are."""
        deviations = widening(self.freedom) * np.sqrt(np.diag(self.covariance)).reshape(2, 2, 3)
        return deviations[:, 0], deviations[:, 1]


def hand_eye(camera: Camera, views: Sequence[BoardView], mount_from_stand: Sequence[Rigid3]) -> HandEye:
    """Return where the camera and the board are, from views of one board and what the robot says at each.

    Raises
    ------
    InputError
        Unlike numbers of views and poses; turns that do not belong together; poses that are the wrong way round.
    DegenerateError
        Fewer than three images, or turns about one axis only: the place along it is open.
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
            f"hand-eye: the camera turned otherwise than the robot from image to image (by {worst:.1f} degrees in the "
            "median); are images and poses in the same order, and angles in the right unit?"
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
    apart_mm, apart_rad = _residuals(*found.state, problem, [seen[i] for i in use])
    return HandEye(
        cam_from_mount=found.state[0],
        stand_from_board=found.state[1],
        covariance=known.covariance,
        # A pose has six numbers: as many images as the unknowns take up say nothing of how images disagree.
        freedom=effective_freedom(min(known.freedom, len(use) - UNKNOWNS / 6), known.overdispersion, UNKNOWNS),
        rms_px=float(np.sqrt(squared.sum(axis=1).mean())),
        image_rms_px=by_image,
        apart_mm=apart_mm,
        apart_rad=apart_rad,
        left_out={views[i].image: float(mismatch[i]) for i in range(len(views)) if i not in use},
    )


class _AllCorners:
    """All corners of all images against both unknown poses."""

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
    """Return how far the boards as they are seen are from where the robot has them, (N,) mm and (N,) rad."""
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
            f"hand-eye: image '{view.image}' has no four corners that the camera sees, not all in line; leave it out"
        ) from error


def _mismatch(seen: Sequence[Rigid3], robot: Sequence[Rigid3]) -> FloatArray:
    """Return for each image by how much its turns against the others differ from the robot's, median, rad: from image
    to image both turn by the same angle, whatever the unknown poses are."""
    angles = []
    for poses in (seen, robot):
        rotation = np.stack([pose.rotation for pose in poses])
        angles.append(rotation_angle(rotation[:, None] @ np.swapaxes(rotation, -1, -2)[None]))
    return np.asarray(np.median(np.abs(angles[0] - angles[1]), axis=1))


def _refuse_open(covariance: FloatArray, seen: Sequence[Rigid3]) -> None:
    """Raise DegenerateError where a place is as good as unknown."""
    distance = float(np.mean([np.linalg.norm(pose.translation_mm) for pose in seen]))
    blocks = [covariance[k : k + 3, k : k + 3] for k in (3, 9)]
    worst = np.inf
    if np.isfinite(covariance).all():
        worst = max(float(np.linalg.eigvalsh(block)[-1]) for block in blocks) ** 0.5
    if not worst <= MAX_SIGMA_OF_DISTANCE * distance:
        predicted = f", known to {worst:.0f} mm only" if np.isfinite(worst) else ""
        raise DegenerateError(
            f"hand-eye: the hand turned about one axis only, which leaves the place along it open{predicted}; turn it "
            f"about "
            "two"
        )


def _linear(seen: Sequence[Rigid3], robot: Sequence[Rigid3]) -> tuple[Rigid3, Rigid3]:
    """Return start poses: R_x^T R_cam = R_robot R_z is linear in both rotations, what is left in both translations."""
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
    """Raise InputError where the robot's poses, taken the other way round, fit far better."""
    other = _AllCorners(problem.camera, problem.views, [pose.inverse() for pose in problem.robot])
    start = _linear(seen, other.robot)
    found = minimise(start, other.at, _moved, HAND_EYE_DAMPING, HAND_EYE_STOP)
    if np.isfinite(found.problem.cost) and found.problem.cost * INVERSE_FITS_BETTER**2 < cost:
        raise InputError(
            "hand-eye: the robot's poses fit far better the other way round; they may be hand_from_base (then say "
            "--inverse), or the board may be on the hand (--board-on-hand)"
        )


def _by_image(problem: DenseProblem, image: IntArray) -> Clustered:
    """Return the covariance (12, 12) of the solution with the image as the unit that is independent: what the robot
    does not tell exactly shifts all corners of an image. Infinite where the corners leave an unknown open."""
    count = int(image.max()) + 1
    rows, residual = problem.jacobian.reshape(-1, 2, UNKNOWNS), problem.residual.reshape(-1, 2)
    information, score = np.zeros((count, UNKNOWNS, UNKNOWNS)), np.zeros((count, UNKNOWNS))
    np.add.at(information, image, np.einsum("nka,nkb->nab", rows, rows))
    np.add.at(score, image, np.einsum("nka,nk->na", rows, residual))
    total = information.sum(axis=0)
    scale = np.sqrt(np.maximum(np.diag(total), np.finfo(float).tiny))
    scaled = total / np.outer(scale, scale)
    if not np.linalg.eigvalsh(scaled)[0] > OPEN_PART:
        return Clustered(np.diag(np.full(UNKNOWNS, np.inf)), 1.0, float("inf"))
    unit = np.linalg.inv(scaled) / np.outer(scale, scale)
    sigma = float(np.sqrt((residual**2).sum() / max(residual.size - UNKNOWNS, 1)))
    return clustered_covariance(unit, information, score, np.zeros_like(total), sigma)
