"""The noise of a robot's poses, estimated with the two poses of a hand-eye calibration.

Every pose of the board, as seen, differs from that predicted from the robot by errors of the image's corners, whose
covariance is known, and by rotations and translations of the robot's hand of unknown variance. The poses weighted by
both, and the variances by the scatter at the optimum, are estimated in turns: each variance is multiplied by the root
of the scatter that it explains over that expected, which approaches the restricted maximum of likelihood (H. Zhou,
L. Hu, J. Zhou, K. Lange, "MM algorithms for variance components models", J. Computational and Graphical Statistics 28,
2019).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from rigkit.calibration.solving.clustered import Clustered, clustered_covariance
from rigkit.core.arrays import FloatArray, root_diagonal, scaled_pinv
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import log_so3, skew
from rigkit.optim.damping import Damping, Stop
from rigkit.optim.levenberg_marquardt import DenseProblem, DenseStep, minimise

OPEN_PART = 1e-12
"""Relative eigenvalue of the information matrix up to which a direction is undetermined: rounding."""
HAND_EYE_DAMPING = Damping(start=1e-4, ceiling=1e12)
HAND_EYE_STOP = Stop(steps=60, predicted_gain=1e-14)
UNKNOWNS = 12
VARIANCE_ROUNDS = 60
"""Estimates of the robot's noise, each with the poses at their optimum; variances that are zero only approach it."""
VARIANCES_SETTLED = 1e-3
"""Change of the variances, as a part of these or of those of poses as seen, that ends the estimates: a twentieth of
what a thousand images would leave unknown."""
LEAST_VARIANCE = 1e-9
"""Robot noise of this part of the noise of boards' poses, as seen, is none, and stays above zero for rounding."""
MAX_CHANCE_OF_WRONG = 1e-3
"""Largest chance, of all images together, of a robot pose this far from where the others have it that is called wrong:
one in a thousand calibrations loses an image."""

State = tuple[Rigid3, Rigid3]


@dataclass(frozen=True, eq=False, slots=True)
class PosesOfBoards:
    """The least-squares problem of the N poses of the boards in the two unknown poses.

    Attributes
    ----------
    seen, robot : poses of the board in the camera, and mount_from_stand.
    covariance : (N, 6, 6) of `seen`.
    board_on_hand : whether the stand is the robot's hand.
    variances : (2,) of the robot's rotations, rad^2, and translations, mm^2.
    """

    seen: Sequence[Rigid3]
    robot: Sequence[Rigid3]
    covariance: FloatArray
    board_on_hand: bool
    variances: FloatArray = field(default_factory=lambda: np.zeros(2))

    @property
    def freedom(self) -> float:
        """Degrees of freedom of each variance: three an image show it, except in images that determine the unknowns."""
        return 3.0 * (len(self.seen) - UNKNOWNS / 6)

    def of(self, chosen: Sequence[int]) -> PosesOfBoards:
        """Return the problem of these images only."""
        seen, robot = [self.seen[i] for i in chosen], [self.robot[i] for i in chosen]
        return replace(self, seen=seen, robot=robot, covariance=self.covariance[list(chosen)])

    def linearised(self, state: State) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the steps (N, 6) from the poses seen to those predicted, and their derivatives (N, 6, 12) by the
        state, and (N, 6, 6) by a rotation and translation of the hand in its own frame."""
        (cam_from_mount, stand_from_board), count = state, len(self.seen)
        seen_turn, seen_move = _stacked(self.seen)
        turn, move = _stacked(self.robot)
        cam_from_stand = cam_from_mount.rotation @ turn
        in_stand = cam_from_stand @ stand_from_board.translation_mm
        in_mount = in_stand + move @ cam_from_mount.rotation.T
        off = np.empty((count, 6))
        off[:, :3] = log_so3(cam_from_stand @ stand_from_board.rotation @ np.swapaxes(seen_turn, 1, 2))
        off[:, 3:] = in_mount + cam_from_mount.translation_mm - seen_move
        by_state, by_hand = np.zeros((count, 6, UNKNOWNS)), np.zeros((count, 6, 6))
        by_state[:, :3, :3] = by_state[:, 3:, 3:6] = np.eye(3)
        by_state[:, 3:, :3] = -skew(in_mount)
        # A step turns the board in the stand about its own origin.
        by_state[:, :3, 6:9] = by_state[:, 3:, 9:] = cam_from_stand
        frame, lever = (cam_from_stand, in_stand) if self.board_on_hand else (cam_from_mount.rotation, in_mount)
        by_hand[:, :3, :3] = by_hand[:, 3:, 3:] = frame
        by_hand[:, 3:, :3] = -skew(lever) @ frame
        return off, by_state, by_hand

    def whitening(self, by_hand: FloatArray) -> FloatArray:
        """Return W (N, 6, 6) with W V W^T = 1 of the covariances V of the steps."""
        robot = by_hand * np.repeat(self.variances, 3)
        return np.asarray(np.linalg.inv(np.linalg.cholesky(self.covariance + robot @ np.swapaxes(by_hand, 1, 2))))

    def at(self, state: State) -> DenseProblem:
        """Return residuals in sigmas and their derivatives by (w, v) of either pose."""
        off, by_state, by_hand = self.linearised(state)
        white = self.whitening(by_hand)
        return DenseProblem((white @ off[..., None]).ravel(), (white @ by_state).reshape(-1, UNKNOWNS))

    def refined(self, start: State) -> State:
        """Return the poses at the least cost."""
        return minimise(start, self.at, _moved, HAND_EYE_DAMPING, HAND_EYE_STOP).state

    def with_variances_from(self, state: State) -> PosesOfBoards:
        """Return the problem with better variances, by the scatter at its optimum."""
        off, by_state, by_hand = self.linearised(state)
        white = self.whitening(by_hand)
        rows, residual, shown = white @ by_state, (white @ off[..., None])[..., 0], white @ by_hand
        inverse = scaled_pinv(np.einsum("nka,nkb->ab", rows, rows), OPEN_PART)
        variances = []
        for part, before in zip((shown[..., :3], shown[..., 3:]), self.variances, strict=True):
            scatter = float((np.einsum("nka,nk->na", part, residual) ** 2).sum())
            used = np.einsum("nka,nkb->ab", rows, part @ np.einsum("nka,nkb->nab", part, rows))
            expected = float((part**2).sum() - np.trace(inverse @ used))
            variances.append(before * np.sqrt(scatter / max(expected, np.finfo(float).tiny)))
        return replace(self, variances=np.maximum(variances, LEAST_VARIANCE * self.scale()))

    def scale(self) -> FloatArray:
        """Return the mean variances (2,) of rotations and translations of the poses seen."""
        each = np.einsum("nii->ni", self.covariance)
        return np.array([each[:, :3].mean(), each[:, 3:].mean()])


def _stacked(poses: Sequence[Rigid3]) -> tuple[FloatArray, FloatArray]:
    return np.stack([pose.rotation for pose in poses]), np.stack([pose.translation_mm for pose in poses])


def with_robot_noise(start: State, problem: PosesOfBoards) -> tuple[State, PosesOfBoards]:
    """Return the refined poses, and the problem with the robot's noise."""
    off = problem.linearised(start)[0]
    problem = replace(problem, variances=np.array([np.mean(off[:, :3] ** 2), np.mean(off[:, 3:] ** 2)]))
    problem = replace(problem, variances=np.maximum(problem.variances, problem.scale()))
    state = start
    for _ in range(VARIANCE_ROUNDS):
        state = problem.refined(state)
        before, problem = problem.variances, problem.with_variances_from(state)
        if np.all(
            np.abs(problem.variances - before) <= VARIANCES_SETTLED * np.maximum(problem.variances, problem.scale())
        ):
            break
    return state, problem


def wrong_pose(problem: PosesOfBoards, state: State) -> tuple[int, tuple[float, float], State, PosesOfBoards] | None:
    """Return the image that all others contradict, the rotation and translation of the hand that would explain it, and
    the poses and the problem without it; None if there is none.

    It is the one without which the cost decreases most. By the noise of the others, the square of its distance from
    where they have it is distributed as F, with which the sum of two such with variances of their own is exceeded less.
    """
    # Imported here: scipy is slow to import.
    from scipy.special import fdtrc

    here, count = problem.at(state), len(problem.seen)
    rows, residual = here.jacobian.reshape(-1, 6, UNKNOWNS), here.residual.reshape(-1, 6, 1)
    hat = rows @ scaled_pinv(here.jacobian.T @ here.jacobian, OPEN_PART) @ np.swapaxes(rows, 1, 2)
    gains = np.swapaxes(residual, 1, 2) @ np.linalg.pinv(np.eye(6) - hat, OPEN_PART, hermitian=True) @ residual
    worst = int(np.argmax(gains))
    others, fewer = with_robot_noise(state, problem.of([i for i in range(count) if i != worst]))
    known = covariance_by_image(fewer, others).covariance
    if not np.isfinite(known).all():
        return None
    one = replace(problem.of([worst]), variances=fewer.variances)
    off, by_state, by_hand = (each[0] for each in one.linearised(others))
    covariance = one.covariance[0] + (by_hand * np.repeat(one.variances, 3)) @ by_hand.T + by_state @ known @ by_state.T
    square = float(off @ np.linalg.solve(covariance, off)) / len(off)
    if not count * fdtrc(len(off), fewer.freedom, square) <= MAX_CHANCE_OF_WRONG:
        return None
    turn, move = np.linalg.solve(by_hand, off).reshape(2, 3)
    return worst, (float(np.linalg.norm(turn)), float(np.linalg.norm(move))), others, fewer


def _moved(state: State, step: DenseStep) -> State:
    return state[0].moved(step.change[:6]), state[1].moved(step.change[6:])


def covariance_by_image(problem: PosesOfBoards, state: State) -> Clustered:
    """Return the covariance (12, 12) of the solution with images as independent units. Infinite where an unknown is
    undetermined."""
    here = problem.at(state)
    rows, residual = here.jacobian.reshape(-1, 6, UNKNOWNS), here.residual.reshape(-1, 6)
    information, score = np.einsum("nka,nkb->nab", rows, rows), np.einsum("nka,nk->na", rows, residual)
    total = information.sum(axis=0)
    scale = root_diagonal(total)
    scaled = total / np.outer(scale, scale)
    if not np.linalg.eigvalsh(scaled)[0] > OPEN_PART:
        return Clustered(np.diag(np.full(UNKNOWNS, np.inf)), 1.0, float("inf"))
    unit = np.linalg.inv(scaled) / np.outer(scale, scale)
    return clustered_covariance(unit, information, score, np.zeros_like(total), 1.0)
