"""Planes of boards fitted to both images: normals, angles and baseline, with their uncertainty."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import TypeVar

import numpy as np

from rigkit.core.arrays import TINY, BoolArray, FloatArray, Mat3, Points
from rigkit.core.boards import Board
from rigkit.core.errors import DegenerateError
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import angle_between, skew
from rigkit.optim.damping import Damping, Stop
from rigkit.optim.levenberg_marquardt import DenseProblem, DenseStep, minimise
from rigkit.optim.robust_scale import MEDIAN_OF_RAYLEIGH
from rigkit.relative_pose.refinement.refine import variance_factor

MIN_CORNERS_OF_BOARD = 8
"""Fewer corners in a view do not determine the board's pose well enough."""
GROSS = 8.0
"""Residual, in standard deviations, from which a corner is an outlier: something hides it."""
OUTLIER_ROUNDS = 3
DAMPING_OF_PLANES = Damping(start=1e-6, ceiling=1e8, floor=1e-12)
STOP_OF_PLANES = Stop(steps=60, predicted_gain=1e-14, gain=1e-14)

State = TypeVar("State")


@dataclass(frozen=True, eq=False, kw_only=True)
class BoardPlanes(ABC):
    """Maximum-likelihood relative pose and planes of boards.

    Attributes
    ----------
    board_ids : in the order of the parameters.
    cam2_from_cam1 : relative pose, mm.
    covariance : (P, P) of the parameters, from the corners' noise: (rotation rad, translation mm) of the relative pose,
        then of every board, each as a left perturbation; then those that only one kind of fit has.
    calibration_moves : (A, P) change of the parameters by one standard deviation along each principal axis of the
        calibrations' covariance; A = 0 if that is not known.
    variance_factor : observed over stated variance of the corners, as used in `covariance`.
    count, gross : number of corners used, and of outliers.
    """

    board_ids: tuple[str, ...]
    cam2_from_cam1: Rigid3
    covariance: FloatArray
    calibration_moves: FloatArray
    variance_factor: float
    count: int
    gross: int

    @abstractmethod
    def normal(self, board_id: str) -> FloatArray:
        """Return the unit normal (3,) of a board, facing camera 1."""

    @abstractmethod
    def has_points(self, board: Board, grid: FloatArray) -> BoolArray:
        """Return a mask (N,) of the corners `grid` (N, 2) of a board that `points` can be asked for."""

    @abstractmethod
    def points(self, board: Board, grid: FloatArray) -> tuple[Points, FloatArray]:
        """Return a board's corners `grid` (N, 2) in camera 1, mm, and their covariances (N, 3, 3)."""

    @cached_property
    def full_covariance(self) -> FloatArray:
        """Covariance (P, P) of the parameters, from the corners' noise and the calibrations' uncertainty."""
        return np.asarray(self.covariance + self.calibration_moves.T @ self.calibration_moves)

    def normal_covariance(self, board_id: str) -> Mat3:
        """Return the covariance (3, 3) of a board's normal, rad^2, including the calibrations' uncertainty."""
        by_turn = np.zeros((3, len(self.covariance)))
        by_turn[:, self.rotation_of(board_id)] = -skew(self.normal(board_id))
        return np.asarray(by_turn @ self.full_covariance @ by_turn.T)

    def angle_deg(self, a: str, b: str) -> tuple[float, float]:
        """Return the angle between two boards' faces (180 when coplanar) and its standard deviation, degrees."""
        one, two = self.normal(a), self.normal(b)
        sine = float(np.linalg.norm(np.cross(one, two)))
        # d angle / d rotation of a: along the axis perpendicular to both normals; parallel faces have none.
        axis = np.cross(one, two) / sine if sine > 1e-12 else np.zeros(3)
        row = np.zeros(len(self.covariance))
        row[self.rotation_of(a)], row[self.rotation_of(b)] = axis, -axis
        sigma = float(np.sqrt(row @ self.full_covariance @ row))
        return 180.0 - float(np.rad2deg(angle_between(one, two))), float(np.rad2deg(sigma))

    def baseline_mm(self) -> tuple[float, float]:
        """Return the length of the baseline and its sigma, mm."""
        t = self.cam2_from_cam1.translation_mm
        length = float(np.linalg.norm(t))
        row = np.zeros(len(self.covariance))
        row[3:6] = t / length
        return length, float(np.sqrt(row @ self.full_covariance @ row))

    def rotation_of(self, board_id: str) -> slice:
        """Return the slice of a board's rotation among the parameters."""
        start = 6 * (1 + self.board_ids.index(board_id))
        return slice(start, start + 3)


def maximum_likelihood(
    state: State,
    linearise: Callable[[State], DenseProblem],
    moved: Callable[[State, FloatArray], State],
    free: BoolArray,
) -> State:
    """Return the state of maximum likelihood near `state`; only the parameters `free` (P,) change."""

    def after_step(at: State, step: DenseStep) -> State:
        change = np.zeros(len(free))
        change[free] = step.change
        return moved(at, change)

    return minimise(state, linearise, after_step, DAMPING_OF_PLANES, STOP_OF_PLANES).state


def inliers_by_median(lengths: FloatArray) -> BoolArray:
    """Return a mask (N,) of the inliers, from the lengths (N,) of the corners' residuals and their median."""
    return np.asarray(lengths <= GROSS * max(float(np.median(lengths)) / MEDIAN_OF_RAYLEIGH, 1e-9))


def variance_and_covariance(
    problem: DenseProblem, corners: int, unknowns: int, pair_id: str
) -> tuple[float, FloatArray]:
    """Return observed over stated variance of the corners, and the covariance (F, F) of the parameters at a minimum.

    The first 2 `corners` residuals are those of the corners, to which `unknowns` parameters are fitted. The others are
    priors, whose stated variance is kept. Raises DegenerateError if the corners do not determine the parameters.
    """
    data = problem.residual[: 2 * corners]
    factor = variance_factor(float(data @ data), 2 * corners - unknowns)
    variance = np.where(np.arange(len(problem.residual)) < len(data), factor, 1.0)
    information = (problem.jacobian.T / variance) @ problem.jacobian
    scale = np.sqrt(np.maximum(np.diag(information), TINY))
    values, vectors = np.linalg.eigh(information / np.outer(scale, scale))
    if not values[0] > 1e-14:
        raise DegenerateError(f"pair '{pair_id}': the corners leave the boards' poses open; more of them must be seen")
    return factor, np.asarray((vectors / values) @ vectors.T / np.outer(scale, scale))
