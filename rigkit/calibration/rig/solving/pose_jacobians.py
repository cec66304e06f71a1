"""How views follow from a rig: what a camera's own normal equations say of a view's pose, carried over to the rig's.

A camera sees board b of the target of frame f at  R = Rc Rf Rb,  t = Rc (Rf tb + tf) + tc. Perturbations from the left,
(w, dt) of the target's pose, (e, ds) of the camera's mount and (b, du) of the board's place on its target, move the
board in the camera by

    w_cam = Rc w + e + Rc Rf b,      dt_cam = Rc dt + (Rc w) x (Rc Rf tb) + ds + e x (t - tc) + Rc Rf du,

so the six columns of each view's own pose are carried over to target, mount and place by 6x6 matrices. Of a camera
alone (its mount the identity, every board a target) they are the identity, and nothing is carried anywhere.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rigkit.calibration.certainty.covariance import PoseJacobians
from rigkit.calibration.rig.solving.state import RigObservations, RigState
from rigkit.core.arrays import FloatArray, IntArray, Mat3, Points
from rigkit.geometry.rotation import skew


def pose_jacobians(
    observations: RigObservations, state: RigState, c: int, translation_mm: Points
) -> list[PoseJacobians]:
    """Return how the views of camera `c`, at `translation_mm` (V, 3) from it, follow from targets, its mount where that
    is free, (board by board, where boards have places on a target) from these, and from its lag where cameras lag."""
    parts = at_own_moment(observations, state, c, translation_mm)
    if state.moments is None:
        return parts
    frame, lag = observations.frame[c], state.layout(observations).lags.start + c - 1
    meanwhile = state.targets(c, observations)[0] @ np.swapaxes(state.frame_rotation[frame], -1, -2)
    return [state.moments.at_reference(part, c, meanwhile[part.views], lag) for part in parts]


def gone_in_cam(observations: RigObservations, state: RigState, c: int, translation_mm: Points) -> FloatArray:
    """Return by how much the boards of all views of camera `c` go on at their moments, (V, 6) a unit of time."""
    out = np.zeros((len(translation_mm), 6))
    for part in at_own_moment(observations, state, c, translation_mm):
        if state.moments is not None:
            out[part.views] = (part.target @ state.moments.speeds(c, part.poses)[:, :, None])[..., 0]
    return out


def at_own_moment(
    observations: RigObservations, state: RigState, c: int, translation_mm: Points
) -> list[PoseJacobians]:
    """Return how the views of camera `c` follow from the targets where it has seen them, mount and places."""
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
    """Return how V boards, targets all, follow their `poses` (V,) in the rig and the `mount` of a camera, None where
    that is not free: it has this `rotation`, and the boards lie at `lever` (V, 3) from where it has the rig."""
    return PoseJacobians(
        np.arange(len(poses)), poses, _turned(rotation), *_free([(mount, _rotated_lever(lever))], len(poses))
    )


def pose_products(observations: RigObservations, state: RigState, products: Sequence[FloatArray]) -> FloatArray:
    """Return of every pose the sums of the products of its rows, (F, n + 7, n + 7), from those of every view of each
    camera (`view_products`): derivatives by the n globals but for released corners, by the pose, and the residual."""
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
    """Return the products of so many poses and globals, (F, G + 7, G + 7): of each camera given are those of its views
    (V, P + 7, P + 7), where its own P unknowns stand among the globals, and how the views follow."""
    out = np.zeros((poses, count + 7, count + 7))
    for own, direct, parts in each:
        p = len(direct)
        for part in parts:
            follow = np.zeros((len(part.views), p + 7, count + 7))
            follow[:, np.arange(p), direct] = 1.0
            follow[:, p : p + 6, part.index] = part.globals
            follow[:, p : p + 6, count : count + 6] = part.target
            follow[:, -1, -1] = 1.0
            np.add.at(out, part.poses, np.swapaxes(follow, -1, -2) @ own[part.views] @ follow)
    return out


def _turned(rotation: Mat3) -> FloatArray:
    """Return how a pose (w, dt) is turned, (6, 6)."""
    out = np.zeros((6, 6))
    out[:3, :3] = out[3:, 3:] = rotation
    return out


def _rotated_lever(lever: Points) -> FloatArray:
    """Return how a turn about a point, and a shift, move what is at `lever` (N, 3) from it, (N, 6, 6)."""
    out = np.zeros((len(lever), 6, 6))
    out[:] = np.eye(6)
    out[:, 3:, :3] = -skew(lever)
    return out


def _free(runs: Sequence[tuple[slice | None, FloatArray]], views: int) -> tuple[IntArray, FloatArray]:
    """Return the globals that are free, (K,), and how so many views follow them, (N, 6, K)."""
    found = [(np.arange(run.start, run.stop), how) for run, how in runs if run is not None]
    if not found:
        return np.zeros(0, dtype=np.int64), np.zeros((views, 6, 0))
    return np.concatenate([run for run, _ in found]), np.concatenate([how for _, how in found], axis=-1)
