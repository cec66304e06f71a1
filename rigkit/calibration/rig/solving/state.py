"""What a rig's cameras saw, and everything that is solved for: cameras, mounts, targets and their places.

A target is what keeps its shape while it moves before the cameras: a single board, or several boards mounted to each
other, whose frame is that of the first of them. The camera c sees board b of the target of frame f at

    cam_from_board = cam_from_rig[c] rig_from_target[f] target_from_board[b].

Where cameras lag, rig_from_target is that of the first camera's moment, and each sees the target where it has gone
meanwhile (`rigkit.calibration.rig.solving.moments`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from rigkit.calibration.rig.solving.layout import Layout
from rigkit.calibration.rig.solving.moments import Moments
from rigkit.calibration.solving.normal_equations import SchurStep
from rigkit.calibration.solving.shape import ShapeModel
from rigkit.calibration.solving.state import State
from rigkit.calibration.views.observations import Observations
from rigkit.cameras.base import Camera
from rigkit.core.arrays import BoolArray, FloatArray, IntArray, Mat3, Points
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3

Key = tuple[str, str]
"""(frame, target): views that have a key in common see the same target in the same place."""


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class RigObservations:
    """What every camera saw.

    Attributes
    ----------
    cameras : observations of each camera; all have the same table of boards.
    weights : (V_c, C) of each camera, zero for corners to ignore: weighted residuals are in px of a corner of median
        quality.
    shape : how the boards' points depend on the shape's unknowns.
    frame : (V_c,) int of each camera, row of each view's key in `keys`.
    keys : (frame, target) of every pose.
    places : (B,) whether a board has a place to find on its target (the first one of a target is its frame).
    held : near which parameters (P,) the lens of each camera is held, and by which information (P, P) px^2; empty where
        none is.
    held_mounts : near which mount each camera is held, and by which information (6, 6) px^2 per rad and mm; None or
        empty where none is.
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
        """Return the views of the poses chosen (F,); all poses stay in the table."""
        chosen = [np.flatnonzero(poses[f]) for f in self.frame]
        return replace(
            self,
            cameras=tuple(own.subset(c) for own, c in zip(self.cameras, chosen, strict=True)),
            weights=tuple(w[c] for w, c in zip(self.weights, chosen, strict=True)),
            frame=tuple(f[c] for f, c in zip(self.frame, chosen, strict=True)),
        )


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class RigState:
    """Cameras, their mounts cam_from_rig (n, 3, 3), (n, 3) mm, the first the identity, rig_from_target of every key
    (F, 3, 3), (F, 3) mm, target_from_board of every board (B, 3, 3), (B, 3) mm, the shape's unknowns, and where cameras
    have no common trigger the moments of their pictures."""

    cameras: tuple[Camera, ...]
    mount_rotation: Mat3
    mount_mm: Points
    frame_rotation: Mat3
    frame_mm: Points
    board_rotation: Mat3
    board_mm: Points
    unknowns: FloatArray
    moments: Moments | None = None

    def layout(self, observations: RigObservations) -> Layout:
        """Return where the unknowns stand."""
        lags = 0 if self.moments is None else len(self.cameras) - 1
        sizes = [c.parameters.size for c in self.cameras]
        return Layout.of(sizes, observations.places, observations.shape.count, lags)

    def targets(self, c: int, observations: RigObservations) -> tuple[Mat3, Points]:
        """Return rig_from_target of every view of camera `c` when it was taken, (V, 3, 3) and (V, 3)."""
        f = observations.frame[c]
        poses = self.frame_rotation[f], self.frame_mm[f]
        return poses if self.moments is None else self.moments.targets(c, f, poses)

    def of_camera(self, c: int, observations: RigObservations) -> State:
        """Return the state of camera `c` alone, every view with its pose in that camera."""
        rotation, place = self.targets(c, observations)
        if observations.tied:
            b = observations.cameras[c].board
            place = place + np.einsum("vij,vj->vi", rotation, self.board_mm[b])
            rotation = rotation @ self.board_rotation[b]
        rotation = self.mount_rotation[c] @ rotation
        translation = place @ self.mount_rotation[c].T + self.mount_mm[c]
        return State(self.cameras[c], rotation, translation, observations.shape, self.unknowns)

    def moved(self, step: SchurStep, layout: Layout) -> RigState:
        """Return the state after a step; raises InputError or DegenerateError where the parameters make no camera."""
        lenses = zip(self.cameras, layout.cameras, strict=True)
        mounts, boards = _steps(step.globals, layout.mounts), _steps(step.globals, layout.boards)
        return RigState(
            cameras=tuple(c.with_parameters(c.parameters + step.globals[own]) for c, own in lenses),
            mount_rotation=exp_so3(mounts[:, :3]) @ self.mount_rotation,
            mount_mm=self.mount_mm + mounts[:, 3:],
            frame_rotation=exp_so3(step.poses[:, :3]) @ self.frame_rotation,
            frame_mm=self.frame_mm + step.poses[:, 3:],
            board_rotation=exp_so3(boards[:, :3]) @ self.board_rotation,
            board_mm=self.board_mm + boards[:, 3:],
            unknowns=self.unknowns + step.globals[layout.shape],
            moments=None if self.moments is None else self.moments.moved(step.globals[layout.lags]),
        )

    def with_frames(self, other: RigState) -> RigState:
        """Return this state with the poses of the targets of another."""
        return replace(self, frame_rotation=other.frame_rotation, frame_mm=other.frame_mm)


def _steps(step: FloatArray, runs: Sequence[slice | None]) -> FloatArray:
    return np.array([np.zeros(6) if run is None else step[run] for run in runs]).reshape(-1, 6)
