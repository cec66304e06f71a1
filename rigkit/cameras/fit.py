"""Fit of a camera's parameters to given pixels of given points, by Levenberg-Marquardt."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np

from rigkit.cameras.base import Camera
from rigkit.core.arrays import FloatArray, Pixels, Points
from rigkit.core.errors import InputError
from rigkit.optim.damping import Damping, Stop
from rigkit.optim.levenberg_marquardt import DenseStep, LinearisedProblem, damped_step, minimise

FIT_DAMPING = Damping(start=1e-6, ceiling=1e6)
STEP_HALVINGS = 8
"""Maximal number of halvings of a step that leads to invalid parameters."""

C = TypeVar("C", bound=Camera)


@dataclass(frozen=True, eq=False, slots=True)
class _Projection(LinearisedProblem, Generic[C]):
    """The fit of a camera to pixels (N, 2) of points (N, 3), weighted (N,), in the columns of `free` (P, F)."""

    camera: C
    points: Points
    pixels: Pixels
    weight: FloatArray
    free: FloatArray
    sum_of_squares: float

    @property
    def cost(self) -> float:
        """Sum of squared errors, infinite where a point is outside the field of view."""
        return self.sum_of_squares

    def step(self, damping: float) -> DenseStep | None:
        projected, _, _, d_pixels_d_parameters = self.camera.project_with_jacobians(self.points)
        # Long rows in memory: two large products, not thousands of small ones.
        by_axis = np.moveaxis(d_pixels_d_parameters, (-2, -1), (0, 1))
        jacobian = np.empty((self.free.shape[1], 2, len(self.points)))
        for axis in (0, 1):
            np.multiply(self.free.T @ by_axis[axis], self.weight, out=jacobian[:, axis])
        residuals = self.weight * (projected - self.pixels).T
        return damped_step(jacobian.reshape(len(jacobian), -1).T, residuals.reshape(-1), damping)


def nearest_camera(
    start: C, points: Points, pixels: Pixels, free: FloatArray, stop: Stop, weight: FloatArray | None = None
) -> tuple[C, float]:
    """Return the camera near `start` that projects points (N, 3) closest to pixels (N, 2), and the sum of squares.

    Columns of `free` (P, F) are the directions in which its parameters may change, `weight` (N,) is that of each error.
    The sum is infinite where not all points are in the field of view of `start`.
    """
    weight = np.ones(len(points)) if weight is None else weight

    def linearise(camera: C) -> _Projection[C]:
        projected, valid = camera.project(points)
        cost = float(np.sum((weight[:, None] * (projected - pixels)) ** 2)) if valid.all() else float("inf")
        return _Projection(camera, points, pixels, weight, free, cost)

    def moved(camera: C, step: DenseStep) -> C | None:
        change = free @ step.change
        for _ in range(STEP_HALVINGS):
            try:
                return camera.with_parameters(camera.parameters + change)
            except InputError:
                change = 0.5 * change
        return None

    end = minimise(start, linearise, moved, FIT_DAMPING, stop)
    return end.state, end.problem.cost
