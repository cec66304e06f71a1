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

from rigkit.calibration.covariance import Carried
from rigkit.calibration.rig.state import RigObservations, RigState
from rigkit.core.arrays import FloatArray, IntArray, Points
from rigkit.geometry.rotation import skew


def carried(observations: RigObservations, state: RigState, c: int, translation_mm: Points) -> list[Carried]:
    """Return how the views of camera `c`, at `translation_mm` (V, 3) from it, follow from targets, its mount where that
    is free, and (board by board, where boards have places on a target) from these."""
    layout, frame, board = state.layout(observations), observations.frame[c], observations.cameras[c].board
    turn = state.mount_rotation[c]
    target = np.kron(np.eye(2), turn)
    if not observations.tied:
        free = [(layout.mounts[c], _swung(translation_mm - state.mount_mm[c]))]
        return [Carried(np.arange(len(frame)), frame, target, *_free(free, len(frame)))]
    out = []
    for b in np.unique(board).tolist():
        views = np.flatnonzero(board == b)
        onto = turn @ state.frame_rotation[frame[views]]
        place = np.zeros((len(views), 6, 6))
        place[:, :3, :3] = place[:, 3:, 3:] = onto
        free = [
            (layout.mounts[c], _swung(translation_mm[views] - state.mount_mm[c])),
            (layout.boards[b], place),
        ]
        by_target = _swung(onto @ state.board_mm[b]) @ target
        out.append(Carried(views, frame[views], by_target, *_free(free, len(views))))
    return out


def pose_products(observations: RigObservations, state: RigState, products: Sequence[FloatArray]) -> FloatArray:
    """Return of every pose the sums of the products of its rows, (F, n + 7, n + 7), from those of every view of each
    camera (`view_products`): derivatives by the n globals but for released corners, by the pose, and the residual."""
    layout, warps = state.layout(observations), observations.shape.basis.shape[-1]
    n = layout.shape.start + warps
    out = np.zeros((len(observations.keys), n + 7, n + 7))
    for c, own in enumerate(products):
        lens = layout.cameras[c]
        direct = np.r_[lens.start : lens.stop, layout.shape.start : n]
        p = len(direct)
        for part in carried(observations, state, c, state.of_camera(c, observations).translation_mm):
            index = np.concatenate([direct, part.index, np.arange(n, n + 7)])
            follow = np.zeros((len(part.views), p + 7, len(index)))
            follow[:, :p, :p] = np.eye(p)
            follow[:, p : p + 6, p:-7] = part.globals
            follow[:, p : p + 6, -7:-1] = part.target
            follow[:, -1, -1] = 1.0
            both = np.swapaxes(follow, -1, -2) @ own[part.views] @ follow
            out[part.poses[:, None, None], index[:, None], index] += both
    return out


def _swung(lever: Points) -> FloatArray:
    """Return how a turn about a point, and a shift, move what is at `lever` (N, 3) from it, (N, 6, 6)."""
    out = np.zeros((len(lever), 6, 6))
    out[:] = np.eye(6)
    out[:, 3:, :3] = -skew(lever)
    return out


def _free(runs: Sequence[tuple[slice | None, FloatArray]], views: int) -> tuple[IntArray, FloatArray]:
    """Return the globals that are free, (K,), and how so many views follow them, (N, 6, K)."""
    found = [(np.arange(run.start, run.stop), how) for run, how in runs if run is not None]
    index = np.concatenate([np.zeros(0, dtype=np.int64), *(run for run, _ in found)])
    return index, np.concatenate([np.zeros((views, 6, 0)), *(how for _, how in found)], axis=-1)
