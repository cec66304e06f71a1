"""Times at which cameras without a common trigger took their images, and the targets' poses at these times.

Each camera has a constant lag behind the first, and each of its images a small deviation from it. Meanwhile a target
moves along a polynomial in time through its poses in the frames before and after: at time t after key f its pose has
changed by the step  s(t) = sum_k trajectories[f, k] t^(k + 1).  The unit of time is that between two frames.

The deviation of each image is eliminated from its view before the solution, with u the derivative of the pose by it:
the products M of the columns of a view become  M - (M u) (M u)^T / (u^T M u + information).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from rigkit.calibration.certainty.covariance import PoseJacobians
from rigkit.calibration.solving.normal_equations import NormalEquations
from rigkit.calibration.solving.poses import steps_between
from rigkit.core.arrays import FloatArray, IntArray, Mat3, Points
from rigkit.geometry.board_pose import after_pose_step

POINTS, MIN_POINTS = 5, 3
"""Poses that a trajectory passes through, the frame's own included. For swings of 1.5 s at six frames a second, a
fifth order's speeds are 1 % off in the middle and 5 % at the ends, a third order's 8 and 16 %."""
MAX_TIME_OF_TRAJECTORY = 4.0
"""Largest time between a frame and those through which its trajectory passes."""


@dataclass(frozen=True, slots=True)
class Lag:
    """The time by which a camera lags behind the first of its rig, its standard deviation, and the standard deviation
    of the lags of single images. In units of the median time between two frames."""

    frames: float
    sigma: float
    scatter: float


@dataclass(frozen=True, eq=False, slots=True)
class ExposureTimes:
    """The times of images.

    Attributes
    ----------
    lags : (n,) of the cameras, the first zero.
    trajectories : (F, K, 6) coefficients of the targets' trajectories, in the rig.
    own : (n, F) deviation from the camera's lag in the frame of a key.
    information : (n, F) px^2 per squared unit, prior of `own` around zero; infinite where `own` is fixed at zero.
    readouts : (n,) readout times of the cameras (`shutters`).
    """

    lags: FloatArray
    trajectories: FloatArray
    own: FloatArray
    information: FloatArray
    readouts: FloatArray

    def moved(self, step: FloatArray) -> ExposureTimes:
        """Return the exposure times after a step (n - 1,) of the lags."""
        return replace(self, lags=self.lags + np.append(0.0, step))

    def turned(self, turn: Mat3) -> ExposureTimes:
        """Return the same in a rig rotated by `turn` (3, 3)."""
        return replace(self, trajectories=(self.trajectories.reshape(-1, 3) @ turn.T).reshape(self.trajectories.shape))

    def targets(self, c: int, key: IntArray, poses: tuple[Mat3, Points]) -> tuple[Mat3, Points]:
        """Return rig_from_target of views (V,) of camera `c` at their own times, from the `poses` of their keys."""
        powers = self._times(c, key) ** np.arange(1.0, self.trajectories.shape[1] + 1.0)
        rotation, place = after_pose_step(poses, np.einsum("vks,vk->vs", self.trajectories[key], powers))
        return rotation, place

    def speeds(self, c: int, key: IntArray) -> FloatArray:
        """Return the speeds of the targets of views of camera `c` at their times, (V, 6) per unit of time."""
        order = np.arange(float(self.trajectories.shape[1]))
        speeds: FloatArray = np.einsum(
            "vks,vk->vs", self.trajectories[key], (order + 1.0) * self._times(c, key) ** order
        )
        return speeds

    def all_speeds(self) -> FloatArray:
        """Return the speeds of all targets at the times of all cameras, (n, F, 6)."""
        keys = np.arange(len(self.trajectories))
        return np.array([self.speeds(c, keys) for c in range(len(self.lags))])

    def _times(self, c: int, key: IntArray) -> FloatArray:
        times: FloatArray = self.lags[c] + self.own[c, key]
        return times[:, None]

    def at_reference(self, part: PoseJacobians, c: int, rotation_since: Mat3, lag: int) -> PoseJacobians:
        """Return the derivatives of views of camera `c` by the targets at the first camera's time, and by the `lag`
        among the globals, from those by the targets at their own times, rotated by `rotation_since` (V, 3, 3)."""
        speed, since = self.speeds(c, part.poses)[:, :, None], np.zeros((len(part.views), 6, 6))
        since[:, :3, :3], since[:, 3:, 3:] = rotation_since, np.eye(3)
        index, follow = part.index, part.globals
        if c:
            index, follow = np.append(index, lag), np.concatenate([follow, part.target @ speed], axis=-1)
        return replace(part, target=part.target @ since, index=index, globals=follow)


def without_own_times(
    normal: NormalEquations, velocity: FloatArray, own: FloatArray, information: FloatArray
) -> NormalEquations:
    """Return the normal equations of a camera's views with the images' own times `own` (V,) eliminated. These have the
    prior `information` (V,) and move the poses of the views with the `velocity` (V, 6) per unit of time."""
    (products,), free = normal.products, np.isfinite(information)
    own, information, velocity = (np.where(free, own, 0.0), np.where(free, information, 1.0), velocity * free[:, None])
    pose = slice(-7, -1)
    by_time = np.einsum("vij,vj->vi", products[:, :, pose], velocity)
    known = np.einsum("vi,vi->v", by_time[:, pose], velocity) + information
    by_time[:, -1] -= information * own
    left = products - by_time[:, :, None] * (by_time / known[:, None])[:, None]
    left[:, -1, -1] += information * own**2
    by_globals = np.einsum("vgi,vi->vg", normal.gp, velocity)
    part = by_globals / known[:, None]
    return replace(
        normal,
        gg=normal.gg - by_globals.T @ part,
        gp=normal.gp - part[:, :, None] * by_time[:, None, pose],
        pp=left[:, pose, pose],
        g=normal.g - part.T @ by_time[:, -1],
        p=left[:, pose, -1],
        costs=normal.costs + information * own**2 - by_time[:, -1] ** 2 / known,
        products=(left,),
    )


def trajectories_through(
    rotation: Mat3, place: Points, targets: Sequence[str], times: FloatArray, points: int = POINTS
) -> FloatArray:
    """Return the trajectories (F, POINTS - 1, 6) through the poses (F, 3, 3) and (F, 3) of `targets`, at `times` (F,),
    each through so many `points`: zeros where times are unknown, or where fewer than MIN_POINTS poses are within
    MAX_TIME_OF_TRAJECTORY."""
    trajectories = np.zeros((len(times), POINTS - 1, 6))
    for target in dict.fromkeys(targets):
        own = np.array([f for f, t in enumerate(targets) if t == target and np.isfinite(times[f])], dtype=np.int64)
        own = own[np.argsort(times[own])]
        for i, f in enumerate(own):
            first = min(max(i - points // 2, 0), max(len(own) - points, 0))
            near = np.array(
                [
                    k
                    for k in own[first : first + points]
                    if k != f and abs(times[k] - times[f]) <= MAX_TIME_OF_TRAJECTORY
                ]
            )
            if len(near) + 1 < MIN_POINTS:
                continue
            here = (np.repeat(rotation[f : f + 1], len(near), 0), np.repeat(place[f : f + 1], len(near), 0))
            powers = (times[near] - times[f])[:, None] ** np.arange(1.0, len(near) + 1.0)
            trajectories[f, : len(near)] = np.linalg.solve(powers, steps_between(here, (rotation[near], place[near])))
    return trajectories
