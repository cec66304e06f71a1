"""The observations of a rig's cameras, and its unknowns: cameras, mounts, targets, boards on targets.

A target is a rigid body that moves in front of the cameras: a single board, or several boards mounted to each other,
whose frame is that of the first of them. Camera c sees board b of the target of frame f at

    cam_from_board = cam_from_rig[c] rig_from_target[f] target_from_board[b].

Without a common trigger, rig_from_target is the pose when the first camera took its image, and each camera sees the
target where it was at its own time (`rigkit.calibration.rig.solving.exposure_times`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from rigkit.calibration.rig.solving.exposure_times import ExposureTimes
from rigkit.calibration.rig.solving.layout import Layout
from rigkit.calibration.solving.normal_equations import SchurStep
from rigkit.calibration.solving.shape import ShapeModel
from rigkit.calibration.solving.state import State
from rigkit.calibration.views.observations import Observations
from rigkit.cameras.base import Camera
from rigkit.core.arrays import BoolArray, FloatArray, IntArray, Mat3, Points
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3

Key = tuple[str, str]
"""(frame, target): views with the same key share one pose of the target."""


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class RigObservations:
    """The observations of every camera.

    Attributes
    ----------
    cameras : observations of each camera; all have the same table of boards.
    weights : (V_c, C) of each camera, zero for corners to ignore: weighted residuals are in px of a corner of median
        quality.
    shape : model of the boards' shape.
    frame : (V_c,) int of each camera, index of each view's key in `keys`.
    keys : (frame, target) of every pose.
    places : (B,) whether a board has an unknown pose on its target (the first one of a target defines its frame).
    held : prior mean (P,) and information (P, P) px^2 of each camera's parameters; empty without priors.
    held_mounts : prior mean and information (6, 6) px^2 per rad and mm of each camera's mount, None without a prior;
        empty without any.
    """

    cameras: tuple[Observations, ...]
    weights: tuple[FloatArray, ...]
    shape: ShapeModel
    frame: tuple[IntArray, ...]
    keys: tuple[Key, ...]
    places: tuple[bool, ...]
    held: tuple[tuple[FloatArray, FloatArray], ...] = ()
    held_mounts: tuple[tuple[Rigid3, FloatArray] | None, ...] = ()

    @property
    def tied(self) -> bool:
        """Whether any target has several boards."""
        return any(self.places)

    @property
    def corner_count(self) -> int:
        """Number of corners used."""
        return int(sum(int((w > 0.0).sum()) for w in self.weights))

    def subset(self, poses: BoolArray) -> RigObservations:
        """Return the views of the poses chosen (F,); `keys` still has all poses."""
        chosen = [np.flatnonzero(poses[f]) for f in self.frame]
        return replace(
            self,
            cameras=tuple(own.subset(c) for own, c in zip(self.cameras, chosen, strict=True)),
            weights=tuple(w[c] for w, c in zip(self.weights, chosen, strict=True)),
            frame=tuple(f[c] for f, c in zip(self.frame, chosen, strict=True)),
        )


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class RigState:
    """The unknowns of a rig.

    Attributes
    ----------
    cameras : the cameras.
    mount_rotation, mount_mm : (n, 3, 3) and (n, 3), cam_from_rig of each; the first is the identity.
    frame_rotation, frame_mm : (F, 3, 3) and (F, 3), rig_from_target of every key.
    board_rotation, board_mm : (B, 3, 3) and (B, 3), target_from_board of every board.
    unknowns : of the boards' shape.
    exposures : times of the images, if cameras have no common trigger.
    """

    cameras: tuple[Camera, ...]
    mount_rotation: Mat3
    mount_mm: Points
    frame_rotation: Mat3
    frame_mm: Points
    board_rotation: Mat3
    board_mm: Points
    unknowns: FloatArray
    exposures: ExposureTimes | None = None

    def layout(self, observations: RigObservations) -> Layout:
        """Return the order of the unknowns."""
        lags = 0 if self.exposures is None else len(self.cameras) - 1
        sizes = [c.parameters.size for c in self.cameras]
        return Layout.of(sizes, observations.places, observations.shape.count, lags)

    def targets(self, c: int, observations: RigObservations) -> tuple[Mat3, Points]:
        """Return rig_from_target of every view of camera `c` at the time of its image, (V, 3, 3) and (V, 3)."""
        f = observations.frame[c]
        poses = self.frame_rotation[f], self.frame_mm[f]
        return poses if self.exposures is None else self.exposures.targets(c, f, poses)

    def of_camera(self, c: int, observations: RigObservations) -> State:
        """Return the state of camera `c` alone, with the pose of every view in that camera."""
        rotation, place = self.targets(c, observations)
        if observations.tied:
            b = observations.cameras[c].board
            place = place + np.einsum("vij,vj->vi", rotation, self.board_mm[b])
            rotation = rotation @ self.board_rotation[b]
        rotation = self.mount_rotation[c] @ rotation
        translation = place @ self.mount_rotation[c].T + self.mount_mm[c]
        return State(self.cameras[c], rotation, translation, observations.shape, self.unknowns)

    def moved(self, step: SchurStep, layout: Layout) -> RigState:
        """Return the state after a step; raises InputError or DegenerateError where the parameters are invalid."""
        lenses = zip(self.cameras, layout.cameras, strict=True)
        mounts, boards = _steps(step.globals, layout.mounts), _steps(step.globals, layout.boards)
        return RigState(
            cameras=tuple(c.stepped(step.globals[own]) for c, own in lenses),
            mount_rotation=exp_so3(mounts[:, :3]) @ self.mount_rotation,
            mount_mm=self.mount_mm + mounts[:, 3:],
            frame_rotation=exp_so3(step.poses[:, :3]) @ self.frame_rotation,
            frame_mm=self.frame_mm + step.poses[:, 3:],
            board_rotation=exp_so3(boards[:, :3]) @ self.board_rotation,
            board_mm=self.board_mm + boards[:, 3:],
            unknowns=self.unknowns + step.globals[layout.shape],
            exposures=None if self.exposures is None else self.exposures.moved(step.globals[layout.lags]),
        )

    def with_frames(self, other: RigState) -> RigState:
        """Return this state with the targets' poses of another one."""
        return replace(self, frame_rotation=other.frame_rotation, frame_mm=other.frame_mm)


def _steps(step: FloatArray, runs: Sequence[slice | None]) -> FloatArray:
    return np.array([np.zeros(6) if run is None else step[run] for run in runs]).reshape(-1, 6)
