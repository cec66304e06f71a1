"""The unknowns of the calibration of one camera, and the residuals."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from rigkit.calibration.solving.normal_equations import Residuals, SchurStep
from rigkit.calibration.solving.shape import ShapeModel, shape_model
from rigkit.calibration.views.observations import Observations
from rigkit.cameras.base import Camera
from rigkit.core.arrays import FloatArray, IntArray, Mat3, Points
from rigkit.geometry.rotation import exp_so3


@dataclass(frozen=True, eq=False, slots=True)
class State:
    """Camera, poses (V, 3, 3) and (V, 3) mm, shape model and its unknowns."""

    camera: Camera
    rotation: Mat3
    translation_mm: Points
    shape: ShapeModel
    unknowns: FloatArray

    @classmethod
    def start(cls, camera: Camera, rotation: Mat3, translation_mm: Points, observations: Observations) -> State:
        """Return the state with flat boards."""
        return cls(camera, rotation, translation_mm, shape_model("flat", observations), np.zeros(0))

    def subset(self, chosen: IntArray) -> State:
        """Return the state of the views `chosen`."""
        return replace(self, rotation=self.rotation[chosen], translation_mm=self.translation_mm[chosen])

    def moved(self, step: SchurStep) -> State:
        """Return the state after a step; raises InputError or DegenerateError where the parameters are invalid."""
        p = self.camera.parameters.size
        return replace(
            self,
            camera=self.camera.stepped(step.globals[:p]),
            rotation=exp_so3(step.poses[:, :3]) @ self.rotation,
            translation_mm=self.translation_mm + step.poses[:, 3:],
            unknowns=self.unknowns + step.globals[p:],
        )

    def with_boards_held(self) -> State:
        """Return the state with the boards' shapes held."""
        return replace(self, shape=self.shape.held(self.unknowns), unknowns=np.zeros(0))

    def with_corners_held(self) -> State:
        """Return the state with released corners held, and only the boards' warps unknown."""
        count = self.shape.basis.shape[-1]
        if not count:
            return self.with_boards_held()
        return replace(self, shape=self.shape.with_corners_held(self.unknowns), unknowns=self.unknowns[:count])

    def points_in_cam(self, observations: Observations) -> tuple[Points, Points]:
        """Return the corners in the camera frame and their lever arms R X, both (V, C, 3) mm, coordinates first in
        memory."""
        board = np.take(self.shape.points(self.unknowns).T, observations.corner, axis=1)
        lever = np.empty_like(board)
        np.matmul(self.rotation, np.swapaxes(board, 0, 1), out=np.swapaxes(lever, 0, 1))
        points = lever + self.translation_mm.T[:, :, None]
        return np.moveaxis(points, 0, -1), np.moveaxis(lever, 0, -1)


def evaluate(state: State, observations: Observations) -> Residuals:
    """Return the residuals of `state`; where a corner does not project, the diagonal of the image."""
    points, _ = state.points_in_cam(observations)
    pixels, valid = state.camera.project(points)
    residuals = observations.pixels - pixels
    return Residuals(residuals if valid.all() else np.where(valid[..., None], residuals, lost_px(state.camera)), valid)


def weighted_squares(state: State, observations: Observations, weight: FloatArray) -> FloatArray:
    """Return the weighted sum of squares of each view (V,), px^2, for weights (V, C) of the residuals."""
    return np.asarray((weight**2 * (evaluate(state, observations).px ** 2).sum(axis=-1)).sum(axis=-1))


def lost_px(camera: Camera) -> float:
    """Return the residual per coordinate of a corner outside the model's field of view: the diagonal of the image."""
    return math.hypot(*camera.size_px)
