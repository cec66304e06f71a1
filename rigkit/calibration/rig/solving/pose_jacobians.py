"""Derivatives of each view's pose by the poses of a rig: targets, mounts, and boards on their targets.

Camera c sees board b of the target of frame f at  R = Rc Rf Rb,  t = Rc (Rf tb + tf) + tc. Left perturbations (w, dt)
of the target's pose, (e, ds) of the camera's mount and (b, du) of the board's pose on its target move the board in the
camera by

    w_cam = Rc w + e + Rc Rf b,      dt_cam = Rc dt + (Rc w) x (Rc Rf tb) + ds + e x (t - tc) + Rc Rf du,

so 6x6 matrices transform the derivatives by a view's own pose to those by target, mount and board. For a single camera
(its mount the identity, every board a target) they are the identity.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rigkit.calibration.certainty.covariance import PoseJacobians
from rigkit.calibration.rig.solving.state import RigObservations, RigState
from rigkit.calibration.solving.clustered import summed_by
from rigkit.core.arrays import FloatArray, IntArray, Mat3, Points
from rigkit.geometry.rotation import skew


def pose_jacobians(
    observations: RigObservations, state: RigState, c: int, translation_mm: Points
) -> list[PoseJacobians]:
    """Return the derivatives for the views of camera `c`, with boards at `translation_mm` (V, 3): by targets, by its
    mount and lag if unknown, and by the boards' places on targets, then in one part for each board."""
    parts = pose_jacobians_at_exposure(observations, state, c, translation_mm)
    if state.exposures is None:
        return parts
    frame, lag = observations.frame[c], state.layout(observations).lags.start + c - 1
    rotation_since = state.targets(c, observations)[0] @ np.swapaxes(state.frame_rotation[frame], -1, -2)
    return [state.exposures.at_reference(part, c, rotation_since[part.views], lag) for part in parts]


def board_velocities(observations: RigObservations, state: RigState, c: int, translation_mm: Points) -> FloatArray:
    """Return the velocities of the boards in all views of camera `c` when the images were taken, (V, 6) per unit of
    time."""
    out = np.zeros((len(translation_mm), 6))
    for part in pose_jacobians_at_exposure(observations, state, c, translation_mm):
        if state.exposures is not None:
            out[part.views] = (part.target @ state.exposures.speeds(c, part.poses)[:, :, None])[..., 0]
    return out


def pose_jacobians_at_exposure(
    observations: RigObservations, state: RigState, c: int, translation_mm: Points
) -> list[PoseJacobians]:
    """Return the derivatives for the views of camera `c` by the targets' poses when it took them, mount and places."""
    layout, frame, lever = state.layout(observations), observations.frame[c], translation_mm - state.mount_mm[c]
    turn = state.mount_rotation[c]
    if not observations.tied:
        return [pose_jacobians_of_mount(turn, layout.mounts[c], frame, lever)]
    out, board, rotation = [], observations.cameras[c].board, state.targets(c, observations)[0]
    for b in np.unique(board).tolist():
        views = np.flatnonzero(board == b)
        onto = turn @ rotation[views]
        place = np.zeros((len(views), 6, 6))
        place[:, :3, :3] = place[:, 3:, 3:] = onto
        target = _rotated_lever(onto @ state.board_mm[b]) @ _turned(turn)
        free = _free([(layout.mounts[c], _rotated_lever(lever[views])), (layout.boards[b], place)], len(views))
        out.append(PoseJacobians(views, frame[views], target, *free))
    return out


def pose_jacobians_of_mount(rotation: Mat3, mount: slice | None, poses: IntArray, lever: Points) -> PoseJacobians:
    """Return the derivatives for V boards, each a target, by their `poses` (V,) in the rig and the `mount` of the
    camera (None if held), which has this `rotation`; `lever` (V, 3) is from the rig's origin to the boards, in the
    camera."""
    return PoseJacobians(
        np.arange(len(poses)), poses, _turned(rotation), *_free([(mount, _rotated_lever(lever))], len(poses))
    )


def pose_products(observations: RigObservations, state: RigState, products: Sequence[FloatArray]) -> FloatArray:
    """Return J^T J of every pose, (F, n + 7, n + 7), from the `view_products` of each camera: columns are derivatives
    by the n globals except released corners and by the pose, and the residual."""
    layout = state.layout(observations)
    n = layout.shape.start + observations.shape.basis.shape[-1]
    each = [
        (
            own,
            np.r_[lens.start : lens.stop, layout.shape.start : n],
            pose_jacobians(observations, state, c, state.of_camera(c, observations).translation_mm),
        )
        for c, (own, lens) in enumerate(zip(products, layout.cameras, strict=True))
    ]
    return summed_products(each, len(observations.keys), n)


def summed_products(
    each: Sequence[tuple[FloatArray, IntArray, Sequence[PoseJacobians]]], poses: int, count: int
) -> FloatArray:
    """Return J^T J for so many poses and globals, (F, G + 7, G + 7), from that of the views of each camera
    (V, P + 7, P + 7), the indices of its own P unknowns among the globals, and the derivatives of its views."""
    out = np.zeros((poses, count + 7, count + 7))
    for own, direct, parts in each:
        p = len(direct)
        for part in parts:
            # Derivatives by the camera's own unknowns, by those that move its views, and by the pose; the residual.
            columns = np.concatenate([direct, part.index, np.arange(count, count + 7)])
            follow = np.zeros((len(part.views), p + 7, len(columns)))
            follow[:, np.arange(p), np.arange(p)] = 1.0
            follow[:, p : p + 6, p:-7] = part.globals
            follow[:, p : p + 6, -7:-1] = part.target
            follow[:, -1, -1] = 1.0
            more = summed_by(part.poses, np.swapaxes(follow, -1, -2) @ own[part.views] @ follow)
            out[: len(more), columns[:, None], columns] += more
    return out


def _turned(rotation: Mat3) -> FloatArray:
    """Return the (6, 6) matrix that rotates both parts of (w, dt)."""
    out = np.zeros((6, 6))
    out[:3, :3] = out[3:, 3:] = rotation
    return out


def _rotated_lever(lever: Points) -> FloatArray:
    """Return the matrices (N, 6, 6) from a motion (w, dt) about a point to that at `lever` (N, 3) from it."""
    out = np.zeros((len(lever), 6, 6))
    out[:] = np.eye(6)
    out[:, 3:, :3] = -skew(lever)
    return out


def _free(runs: Sequence[tuple[slice | None, FloatArray]], views: int) -> tuple[IntArray, FloatArray]:
    """Return the indices of the free globals, (K,), and the derivatives of so many views by them, (N, 6, K)."""
    found = [(np.arange(run.start, run.stop), by_run) for run, by_run in runs if run is not None]
    if not found:
        return np.zeros(0, dtype=np.int64), np.zeros((views, 6, 0))
    return np.concatenate([run for run, _ in found]), np.concatenate([by_run for _, by_run in found], axis=-1)
