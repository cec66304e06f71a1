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
from dataclasses import dataclass, replace

import numpy as np

from rigkit.calibration.robot_noise import (
    UNKNOWNS,
    PosesOfBoards,
    State,
    covariance_by_image,
    with_robot_noise,
    wrong_pose,
)
from rigkit.calibration.solving.clustered import effective_freedom, widening
from rigkit.cameras.base import Camera
from rigkit.cameras.board_pose import cam_from_seen_board
from rigkit.core.arrays import FloatArray
from rigkit.core.detections import BoardView
from rigkit.core.errors import DegenerateError, InputError
from rigkit.core.printing import brief
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import nearest_rotation, rotation_angle, skew

MIN_POSES = 3
MAX_MISMATCH_RAD = np.radians(1.0)
"""Rotations of robots and boards are accurate to some hundredths of a degree: more is an image of another pose."""
MAX_SIGMA_OF_DISTANCE = 0.1
"""Largest standard deviation of a position, as a part of the boards' distance. Rotations about a single axis leave the
position along it undetermined; with a second axis this limit decides."""
INVERSE_FITS_BETTER = 3.0
"""Robot poses are the wrong way round where their inverses fit so many times better."""


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class HandEye:
    """A hand-eye calibration.

    Attributes
    ----------
    cam_from_mount, stand_from_board : the two unknown poses, mm.
    covariance : (12, 12) of (w, v) of the first, then of the second: R' = exp([w]x) R, t' = t + v, rad and mm. It
        includes the errors of the robot's poses.
    robot_turn_rad, robot_move_mm : standard deviations of the robot's poses, of rotations and translations of the hand
        about and along each axis, as the scatter shows them.
    freedom : its degrees of freedom; quoted standard deviations account for them (`widening`).
    rms_px : 2-D RMS of all corners.
    image_rms_px : the same of each image.
    translation_residuals_mm, rotation_residuals_rad : (N,) for the images used, in their order: distance of the board's
        centre, and rotation angle, between the board's pose seen by the camera and that predicted from the robot.
    left_out : for each image left out, by how much (rad) its rotations differ from the robot's.
    contradicting : for each image left out because the others contradict its robot pose, the rotation (rad) and the
        translation (mm) of the hand that would explain it.
    """

    cam_from_mount: Rigid3
    stand_from_board: Rigid3
    covariance: FloatArray
    robot_turn_rad: float
    robot_move_mm: float
    freedom: float
    rms_px: float
    image_rms_px: dict[str, float]
    translation_residuals_mm: FloatArray
    rotation_residuals_rad: FloatArray
    left_out: dict[str, float]
    contradicting: dict[str, tuple[float, float]]

    __repr__ = brief

    def sigmas(self) -> tuple[FloatArray, FloatArray]:
        """Return the standard deviations (2, 3) of the rotations (rad) and of the translations (mm) of both poses,
        widened so that two of them contain 95 % of the errors."""
        deviations = widening(self.freedom) * np.sqrt(np.diag(self.covariance)).reshape(2, 2, 3)
        return deviations[:, 0], deviations[:, 1]


def hand_eye(
    camera: Camera, views: Sequence[BoardView], mount_from_stand: Sequence[Rigid3], *, board_on_hand: bool = False
) -> HandEye:
    """Return the hand-eye calibration from views of one board and the robot's pose at each.

    With `board_on_hand` the stand is the hand, else the mount: the robot's errors turn and move the hand.

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
    names, seen = [view.image for view in views], [_pose(camera, view) for view in views]
    mismatch = _mismatch(seen, mount_from_stand)
    use = np.flatnonzero(mismatch <= MAX_MISMATCH_RAD).tolist()
    fewest = max(MIN_POSES, len(views) // 2 + 1)
    if len(use) < fewest:
        worst = float(np.degrees(np.median(mismatch)))
        raise InputError(
            f"hand-eye: rotations of camera and robot between images differ (by {worst:.1f} degrees, median); check "
            "that images and poses are in the same order, and the unit of the angles"
        )
    views, seen, robot = [views[i] for i in use], [seen[i] for i in use], [mount_from_stand[i] for i in use]
    problem = PosesOfBoards(seen, robot, _covariances_seen(camera, views, seen), board_on_hand)
    state, problem = with_robot_noise(_linear(seen, robot), problem)
    _refuse_inverse(problem, state)
    contradicting = dict[str, tuple[float, float]]()
    while len(views) > fewest and (wrong := wrong_pose(problem, state)) is not None:
        worst, off, state, problem = wrong
        contradicting[views.pop(worst).image] = off
    left_out = {name: float(mismatch[i]) for i, name in enumerate(names) if i not in use}
    return replace(_result(camera, views, problem, state), left_out=left_out, contradicting=contradicting)


def _result(camera: Camera, views: Sequence[BoardView], problem: PosesOfBoards, state: State) -> HandEye:
    """Return the calibration with these views; raises DegenerateError if they do not determine it."""
    known = covariance_by_image(problem, state)
    _refuse_open(known.covariance, problem.seen)
    predicted = [state[0] @ arm @ state[1] for arm in problem.robot]
    squares = [
        ((camera.project(pose.apply(view.points()))[0] - view.pixels) ** 2).sum(axis=1)
        for view, pose in zip(views, predicted, strict=True)
    ]
    off_mm, turned_rad = _residuals(views, problem.seen, predicted)
    return HandEye(
        cam_from_mount=state[0],
        stand_from_board=state[1],
        covariance=known.covariance,
        robot_turn_rad=float(np.sqrt(problem.variances[0])),
        robot_move_mm=float(np.sqrt(problem.variances[1])),
        # Each image measures six numbers: UNKNOWNS / 6 images determine the unknowns and say nothing about scatter.
        freedom=min(
            effective_freedom(min(known.freedom, len(views) - UNKNOWNS / 6), known.overdispersion, UNKNOWNS),
            problem.freedom,
        ),
        rms_px=float(np.sqrt(np.concatenate(squares).mean())),
        image_rms_px={view.image: float(np.sqrt(own.mean())) for view, own in zip(views, squares, strict=True)},
        translation_residuals_mm=off_mm,
        rotation_residuals_rad=turned_rad,
        left_out={},
        contradicting={},
    )


def _covariances_seen(camera: Camera, views: Sequence[BoardView], seen: Sequence[Rigid3]) -> FloatArray:
    """Return the covariances (N, 6, 6) of the boards' poses from the noise of their corners, which all residuals about
    these poses scale."""
    information, total, freedom = [], 0.0, 0
    for view, pose in zip(views, seen, strict=True):
        turned = view.points() @ pose.rotation.T
        pixels, valid, by_point, _ = camera.project_with_jacobians(turned + pose.translation_mm)
        scale = np.where(valid, 1.0 / view.sigma_px, 0.0)[:, None]
        rows = scale[..., None] * np.concatenate([by_point @ -skew(turned), by_point], axis=-1)
        rows, residual = np.where(valid[:, None, None], rows, 0.0), np.where(valid[:, None], pixels - view.pixels, 0.0)
        information.append(np.einsum("nka,nkb->ab", rows, rows))
        total += float(((scale * residual) ** 2).sum())
        freedom += 2 * int(valid.sum()) - 6
    return np.asarray(np.linalg.inv(information)) * (total / freedom if freedom > 0 and total > 0.0 else 1.0)


def _residuals(
    views: Sequence[BoardView], seen: Sequence[Rigid3], predicted: Sequence[Rigid3]
) -> tuple[FloatArray, FloatArray]:
    """Return distance (N,) mm and angle (N,) rad between the boards' poses seen and those predicted from the robot."""
    off_mm, turned = [], []
    for view, one, other in zip(views, seen, predicted, strict=True):
        middle = view.points().mean(axis=0)
        off_mm.append(np.linalg.norm(one.apply(middle) - other.apply(middle)))
        turned.append(one.rotation @ other.rotation.T)
    return np.array(off_mm), rotation_angle(np.array(turned))


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


def _refuse_inverse(problem: PosesOfBoards, state: State) -> None:
    """Raise InputError where the inverses of the robot's poses fit far better."""
    other = replace(problem, robot=[pose.inverse() for pose in problem.robot])
    found, cost = other.at(other.refined(_linear(other.seen, other.robot))).cost, problem.at(state).cost
    if np.isfinite(found) and found * INVERSE_FITS_BETTER**2 < cost:
        raise InputError(
            "hand-eye: the inverse robot poses fit far better: either --inverse (the poses are hand_from_base) or "
            "--board-on-hand must change: give it, or leave it out if it is given"
        )
