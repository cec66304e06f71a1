"""The joint least squares of a rig, on top of the normal equations of single cameras.

A camera sees a board of frame f at  R = Rc Rf,  t = Rc tf + tc. A perturbation (w, dt) of the frame's pose and (e, ds)
of the camera's mount, both from the left, move the board in the camera by

    w_cam = Rc w + e,      dt_cam = Rc dt + e x (Rc tf) + ds,

so the six columns of each view's own pose are carried over to frame and mount by two 6x6 matrices.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from rigkit.arrays import FloatArray, IntArray, Mat3, Points
from rigkit.calibration.normal import Normal, Residuals, Step, normal_equations
from rigkit.calibration.observations import Observations
from rigkit.calibration.result import Convergence
from rigkit.calibration.shape import ShapeModel
from rigkit.calibration.solver import Linearised, State, minimise
from rigkit.cameras.base import Camera
from rigkit.detections import BoardView
from rigkit.errors import RigkitError
from rigkit.geometry.rotation import exp_so3, skew

__all__ = ["RigObservations", "RigState", "rig_normal", "solve_rig"]


@dataclass(frozen=True, eq=False, slots=True)
class RigObservations:
    """What every camera saw.

    Attributes
    ----------
    cameras : observations of each camera.
    weights : (V_c, C_c) of each camera, zero for corners to ignore.
    shapes : points of the boards in the order of each camera's table, as shapes without unknowns.
    frame : (V_c,) int of each camera, row of each view's (frame, board) in `keys`.
    keys : (frame, board) of every pose.
    """

    cameras: tuple[Observations, ...]
    weights: tuple[FloatArray, ...]
    shapes: tuple[ShapeModel, ...]
    frame: tuple[IntArray, ...]
    keys: tuple[tuple[str, str], ...]

    @classmethod
    def from_views(
        cls,
        views: Sequence[Sequence[tuple[tuple[str, str], BoardView]]],
        kept: Sequence[Sequence[np.ndarray]],
        points: dict[str, Points],
    ) -> RigObservations:
        """Build from ((frame, board), view) of each camera, the corners kept of each, and the boards' points."""
        keys = {key: i for i, key in enumerate(dict.fromkeys(key for own in views for key, _ in own))}
        cameras, weights, shapes, frame = [], [], [], []
        for own, masks in zip(views, kept, strict=True):
            observations = Observations.from_views([view for _, view in own])
            mask = np.zeros(observations.present.shape, dtype=bool)
            for i, m in enumerate(masks):
                mask[i, : len(m)] = m
            cameras.append(observations)
            weights.append(np.where(mask, observations.weight, 0.0))
            table = np.concatenate([points[b.board_id] for b in observations.boards])
            shapes.append(ShapeModel("flat", table, np.zeros((len(table), 3, 0)), np.zeros(0)))
            frame.append(np.array([keys[key] for key, _ in own], dtype=np.int64))
        return cls(tuple(cameras), tuple(weights), tuple(shapes), tuple(frame), tuple(keys))


@dataclass(frozen=True, eq=False, slots=True)
class RigState:
    """Cameras, their mounts cam_from_rig (n, 3, 3), (n, 3) mm, the first the identity, and rig_from_board of every
    (frame, board): (F, 3, 3), (F, 3) mm."""

    cameras: tuple[Camera, ...]
    mount_rotation: Mat3
    mount_mm: Points
    frame_rotation: Mat3
    frame_mm: Points

    def of_camera(self, c: int, observations: RigObservations) -> State:
        """Return the state of camera `c` alone, every view with its pose in that camera."""
        f = observations.frame[c]
        rotation = self.mount_rotation[c] @ self.frame_rotation[f]
        translation = self.frame_mm[f] @ self.mount_rotation[c].T + self.mount_mm[c]
        return State(self.cameras[c], rotation, translation, observations.shapes[c], np.zeros(0))


def rig_normal(observations: RigObservations, state: RigState) -> Normal:
    """Return the normal equations: globals are all intrinsics, then the mounts of all cameras but the first."""
    sizes = [c.parameters.size for c in state.cameras]
    first = np.concatenate([[0], np.cumsum(sizes)])
    count = int(first[-1]) + 6 * (len(sizes) - 1)
    frames = len(observations.keys)
    gg, g = np.zeros((count, count)), np.zeros(count)
    gp, pp, p = np.zeros((frames, count, 6)), np.zeros((frames, 6, 6)), np.zeros((frames, 6))
    costs = np.zeros(frames)
    residuals: tuple[Residuals, ...] = ()
    for c, own in enumerate(observations.cameras):
        alone = state.of_camera(c, observations)
        n = normal_equations(
            alone.camera,
            alone.rotation,
            alone.translation_mm,
            alone.shape,
            alone.unknowns,
            own,
            observations.weights[c],
            None,
        )
        f = observations.frame[c]
        k = slice(int(first[c]), int(first[c + 1]))
        by_frame = np.zeros((6, 6))
        by_frame[:3, :3] = by_frame[3:, 3:] = state.mount_rotation[c]
        gg[k, k] += n.gg
        g[k] += n.g
        gp[f, k] += n.gp @ by_frame
        pp[f] += by_frame.T @ n.pp @ by_frame
        p[f] += n.p @ by_frame
        costs[f] += n.costs
        residuals += n.residuals
        if c > 0:
            m = slice(int(first[-1]) + 6 * (c - 1), int(first[-1]) + 6 * c)
            by_mount = np.zeros((len(f), 6, 6))
            by_mount[:] = np.eye(6)
            by_mount[:, 3:, :3] = -skew(alone.translation_mm - state.mount_mm[c])
            turned = np.swapaxes(by_mount, -1, -2)
            gg[k, m] += (n.gp @ by_mount).sum(axis=0)
            gg[m, k] = gg[k, m].T
            gg[m, m] += (turned @ n.pp @ by_mount).sum(axis=0)
            g[m] += (turned @ n.p[..., None]).sum(axis=0)[:, 0]
            gp[f, m] += turned @ n.pp @ by_frame
    return Normal(gg, gp, pp, g, p, costs, residuals)


def solve_rig(observations: RigObservations, start: RigState) -> tuple[RigState, Normal, Convergence]:
    """Return the state of least weighted squares from `start`, its normal equations, and how the solver ended."""

    def linearise(state: RigState) -> Linearised:
        normal = rig_normal(observations, state)
        return Linearised(normal, normal)

    state, last, convergence = minimise(start, linearise, _moved)
    return state, last.normal, convergence


def _moved(state: RigState, step: Step) -> RigState | None:
    cameras, at = [], 0
    for camera in state.cameras:
        size = camera.parameters.size
        try:
            cameras.append(camera.with_parameters(camera.parameters + step.globals[at : at + size]))
        except RigkitError:
            return None
        at += size
    mounts = np.concatenate([np.zeros((1, 6)), step.globals[at:].reshape(-1, 6)])
    return replace(
        state,
        cameras=tuple(cameras),
        mount_rotation=exp_so3(mounts[:, :3]) @ state.mount_rotation,
        mount_mm=state.mount_mm + mounts[:, 3:],
        frame_rotation=exp_so3(step.poses[:, :3]) @ state.frame_rotation,
        frame_mm=state.frame_mm + step.poses[:, 3:],
    )
