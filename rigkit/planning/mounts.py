"""The information of frames of a rig about the relative pose of two cameras, for known lenses.

A board that cameras a and b see at once has the poses a_from_board and b_from_board, and b_from_a = b_from_board
board_from_a has the errors of both. Frames are independent, so their information adds up.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rigkit.cameras.base import Camera
from rigkit.core.arrays import FloatArray
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3, log_so3, skew
from rigkit.planning.information import BoardPoses, CornerError, pose_information


@dataclass(frozen=True, eq=False, slots=True)
class SharedViews:
    """C boards that cameras `a` and `b` see at once, posed in each camera, and the error of a corner."""

    a: Camera
    b: Camera
    in_a: BoardPoses
    in_b: BoardPoses
    error: CornerError

    def rotations_and_offsets(self) -> tuple[FloatArray, FloatArray]:
        """Return the rotations (C, 3, 3) of b_from_a, and the boards' origins in a rotated by them, (C, 3) mm."""
        turn = self.in_b.rotation @ np.swapaxes(self.in_a.rotation, -1, -2)
        return turn, np.einsum("cij,cj->ci", turn, self.in_a.translation_mm)


def mount_information(shared: SharedViews) -> FloatArray:
    """Return the information of each of C shared boards about b_from_a, (C, 6, 6): about a rotation around the origin
    of b (rad) and a translation (mm)."""
    turn, rotated = shared.rotations_and_offsets()
    by_a, by_b = np.zeros((len(turn), 6, 6)), np.zeros((len(turn), 6, 6))
    # With b_from_a = B A^-1, errors (w, v) of either pose, x -> exp(w) R x + t + v, make w = w_b - R_ba w_a and
    # v = v_b - R_ba v_a - w x (R_ba t_a).
    by_b[:, :3, :3] = by_b[:, 3:, 3:] = np.eye(3)
    by_b[:, 3:, :3] = skew(rotated)
    by_a[:, :3, :3] = by_a[:, 3:, 3:] = -turn
    by_a[:, 3:, :3] = -skew(rotated) @ turn
    covariance = by_a @ _inverse(pose_information(shared.a, shared.in_a, shared.error)) @ np.swapaxes(by_a, -1, -2)
    covariance += by_b @ _inverse(pose_information(shared.b, shared.in_b, shared.error)) @ np.swapaxes(by_b, -1, -2)
    return _inverse(covariance)


def mount_error_px(shared: SharedViews, information: FloatArray) -> FloatArray:
    """Return the rms error (...), px, of the boards' corners predicted in b from their poses in a, with the mount known
    from each of `information` (..., 6, 6)."""
    turn, lever = shared.rotations_and_offsets()
    # A rotation around the origin of b moves the board's origin, too.
    as_pose = np.tile(np.eye(6), (len(turn), 1, 1))
    as_pose[:, 3:, :3] = -skew(lever)
    unit = pose_information(shared.b, shared.in_b, CornerError(1.0))
    weight = np.swapaxes(as_pose, -1, -2) @ unit @ as_pose
    mean = weight.sum(axis=0) / float(shared.in_b.seen.sum())
    return np.asarray(np.sqrt(np.maximum(np.einsum("ij,...ji->...", mean, _inverse(information)), 0.0)))


def median_motion(motions: Sequence[Rigid3]) -> Rigid3:
    """Return the componentwise medians of similar motions: of rotations relative to the first, and of translations."""
    first = motions[0]
    turns = np.array([log_so3(m.rotation @ first.rotation.T) for m in motions])
    shifts = np.array([m.translation_mm for m in motions])
    return Rigid3(exp_so3(np.median(turns, axis=0)) @ first.rotation, np.median(shifts, axis=0))


def _inverse(matrices: FloatArray) -> FloatArray:
    """Return the inverses of matrices (..., 6, 6), scaled first: radians and millimetres differ in magnitude."""
    scale = 1.0 / np.sqrt(np.maximum(np.einsum("...ii->...i", matrices), np.finfo(float).tiny))
    unit = matrices * scale[..., :, None] * scale[..., None, :]
    return np.asarray(np.linalg.pinv(unit, hermitian=True) * scale[..., :, None] * scale[..., None, :])
