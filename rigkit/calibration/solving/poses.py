"""Poses of boards for a fixed camera: one small problem for each view, all solved in one batch."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from rigkit.calibration.solving.linearise import normal_equations
from rigkit.calibration.solving.normal_equations import NormalEquations
from rigkit.calibration.solving.radial_alignment import align
from rigkit.calibration.solving.state import State
from rigkit.calibration.views.observations import Observations
from rigkit.core.arrays import FloatArray, Mat3, Points
from rigkit.geometry.board_pose import after_pose_step
from rigkit.geometry.rotation import log_so3, nearest_rotation
from rigkit.optim.batched import BatchedProblem, minimise_each
from rigkit.optim.damping import Damping, Stop

MAX_POSE_ITERATIONS = 40
VIEW_TOLERANCE = 1e-10
"""Relative predicted decrease of a view's cost at which it stops."""
START_TOLERANCE = 1e-5
"""The same for initial poses: with a robust loss the last digits take dozens of steps."""
VIEW_DAMPING = Damping(start=1e-6, floor=1e-12, ceiling=1e10)
"""The floor keeps the system regular for a view with too few projected corners to determine its pose."""


def refine_poses(
    observations: Observations,
    state: State,
    weight: FloatArray,
    loss_px: float | None = None,
    tolerance: float = VIEW_TOLERANCE,
) -> tuple[State, FloatArray]:
    """Return the state with each view's pose at its own minimum, and each view's cost (V,) in px^2. `loss_px` is the
    scale of the Cauchy loss, `tolerance` the relative predicted decrease of the cost at which a view stops."""

    held = state.with_boards_held()

    def linearise(rotation: Mat3, translation_mm: Points) -> NormalEquations:
        moved = replace(held, rotation=rotation, translation_mm=translation_mm)
        return normal_equations(observations, moved, weight, loss_px, lens_held=True)

    rotation, translation_mm, cost = refine_each(state.rotation, state.translation_mm, linearise, tolerance)
    return replace(state, rotation=rotation, translation_mm=translation_mm), cost


def refine_each(
    rotation: Mat3,
    translation_mm: Points,
    linearise: Callable[[Mat3, Points], NormalEquations],
    tolerance: float = VIEW_TOLERANCE,
) -> tuple[Mat3, Points, FloatArray]:
    """Return poses (N, 3, 3), (N, 3), each at its own minimum, and their costs (N,), by Levenberg-Marquardt with a
    separate damping for each. `linearise` returns the normal equations at given poses."""

    def around(poses: tuple[FloatArray, ...]) -> BatchedProblem:
        normal = linearise(*poses)
        return BatchedProblem(normal.pp, normal.p, normal.costs)

    stop = Stop(steps=MAX_POSE_ITERATIONS, predicted_gain=tolerance)
    found, cost = minimise_each((rotation, translation_mm), around, after_pose_step, VIEW_DAMPING, stop)
    return found[0], found[1], cost


def steps_between(before: tuple[Mat3, Points], after: tuple[Mat3, Points]) -> FloatArray:
    """Return the steps (N, 6) from poses `before` to poses `after`, (N, 3, 3) and (N, 3) each: the inverse of
    `after_pose_step`."""
    return np.concatenate([log_so3(after[0] @ np.swapaxes(before[0], -1, -2)), after[1] - before[1]], axis=1)


def find_poses(observations: Observations, state: State, weight: FloatArray, loss_px: float | None) -> State:
    """Return the state with every pose estimated again: the solution of least cost of three, from radial alignment with
    both signs of the tilt and from the pose in `state`."""
    board = np.swapaxes(observations.table()[observations.corner][..., :2], 1, 2)
    alignment = align(np.swapaxes(observations.pixels - state.camera.axis_px, 1, 2), board, weight)
    rays, seen = state.camera.unproject(observations.pixels)
    s = np.linalg.norm(alignment.camera_xy(board), axis=1)
    across = np.maximum(np.linalg.norm(rays[..., :2], axis=-1), 1e-9)
    z = np.where(seen, s * rays[..., 2] / across, 0.0)
    share = np.where(seen, alignment.weight * across**2, 0.0)
    total = np.maximum(share.sum(axis=1), 1e-12)
    best, cost = refine_poses(observations, state, weight, loss_px, START_TOLERANCE)
    for sign in (1.0, -1.0):
        tilt = sign * alignment.tilt
        t3 = (share * (z - (tilt[:, None] @ board)[:, 0])).sum(axis=1) / total
        columns = np.concatenate([alignment.rows[..., :2], tilt[:, None, :]], axis=1)
        third = np.cross(columns[..., 0], columns[..., 1])
        start = replace(
            state,
            rotation=nearest_rotation(np.concatenate([columns, third[..., None]], axis=-1)),
            translation_mm=np.concatenate([alignment.rows[..., 2], t3[:, None]], axis=-1),
        )
        found, found_cost = refine_poses(observations, start, weight, loss_px, START_TOLERANCE)
        wins = found_cost < cost
        best = replace(
            best,
            rotation=np.where(wins[:, None, None], found.rotation, best.rotation),
            translation_mm=np.where(wins[:, None], found.translation_mm, best.translation_mm),
        )
        cost = np.where(wins, found_cost, cost)
    return best
