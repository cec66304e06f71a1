"""Test whether the cameras of a rig, or boards on one mount, moved against each other between two calibrations.

A shift of the principal point is equivalent to a rotation of the camera, which the mount absorbs. So mounts are
compared with respect to the axes of the first rig's lenses. With W_k the rotation that compensates a change dk_k of the
lens k best (first order: W_k = G_k dk_k), the mount's perturbation (w, dt) at (R, t) becomes

    w' = w - W_k + R W_0,      dt' = dt - W_k x t,

whose covariance is that of intrinsics and mounts together.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from rigkit.calibration.certainty.uncertainty import projection_design
from rigkit.calibration.compare import SAME_CHANCE
from rigkit.calibration.rig.board_rig import BoardRig
from rigkit.calibration.rig.mounted import MountedCameras
from rigkit.calibration.solving.clustered import drawn_errors
from rigkit.cameras.compare import compare_cameras, grid_pixels
from rigkit.core.arrays import FloatArray, scaled_pinv
from rigkit.core.errors import InputError
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import skew

LENS_GRID = (24, 18)
"""Pixels (columns, rows) at which the lenses are compared."""
SCALE_ROUNDS, SCALE_STEP = 8, 1e-4
"""Newton steps for the scale between two rigs, and the relative step of its derivative."""
MAX_SCALE = 100.0
"""Largest ratio of the lengths of two rigs: metres for centimetres."""
WEIGHT_FLOOR_PX = 1e-6
"""Smallest standard deviation of a projection: weights stay finite without noise."""


@dataclass(frozen=True, slots=True)
class MountDifference:
    """Difference of one camera's, or board's, pose between two calibrations: degrees, mm, and the probability of a
    difference this large without a movement; None where a rig has no covariance."""

    name: str
    rotation_deg: float
    shift_mm: float
    chance: float | None


@dataclass(frozen=True, slots=True)
class RigDifference:
    """Differences of every camera (or board) but the first, and the probability of all of them together without a
    movement; `scale` is the ratio of lengths, second rig over first, if that alone explains the difference."""

    mounts: tuple[MountDifference, ...]
    chance: float | None
    scale: float | None = None

    @property
    def same(self) -> bool | None:
        return None if self.chance is None else self.chance >= SAME_CHANCE


def compare_mounts(a: MountedCameras, b: MountedCameras) -> RigDifference:
    """Compare the mounts of two rigs after the rotations between their lenses; a single camera has no mount.

    The error of the squares' size is not included: two rigs with the same boards have it in common. Mounts are
    correlated with the departures of the lenses from their models.

    Raises InputError where the rigs have different cameras or image sizes; DegenerateError where the fields of view of
    two cameras do not overlap.
    """
    if list(a.cameras) != list(b.cameras):
        raise InputError(
            f"rigs of other cameras: {', '.join(a.cameras)} and {', '.join(b.cameras)}; "
            "compare rigs of the same cameras"
        )
    a, b = a.with_departures, b.with_departures
    turns = []
    weights = [_weights(a, k) * _weights(b, k) for k in range(len(a.cameras))]
    for (first, _), (second, _), weight in zip(a.cameras.values(), b.cameras.values(), weights, strict=True):
        turns.append(compare_cameras(first, second, grid=LENS_GRID, weights=weight).b_from_a)
    mounts, others = ([mount for _, mount in rig.cameras.values()] for rig in (a, b))

    def off(scale: float) -> FloatArray:
        out = [np.zeros(0)]
        for turn, here, there in list(zip(turns, mounts, others, strict=True))[1:]:
            # With respect to the axes of the first rig's lenses.
            moved = Rigid3(turn.T @ there.rotation @ turns[0], turn.T @ there.translation_mm / scale)
            out.append(here.step_from(moved))
        return np.concatenate(out)

    known = None
    if a.covariance is not None and b.covariance is not None:
        parts = _moved(a, a.covariance, weights), _moved(b, b.covariance, weights)
        known = _known(parts, (a.freedom, b.freedom))
    found = _difference(list(a.cameras)[1:], off(1.0), known)
    return replace(found, scale=_scale(off, known)) if known is not None and found.same is False else found


def _scale(off: Callable[[float], FloatArray], known: Known) -> float | None:
    """Return the ratio of lengths that explains the difference; None if none does."""
    scale, weight = 1.0, scaled_pinv(known[0])
    for _ in range(SCALE_ROUNDS):
        here = off(scale)
        slope = (off(scale * (1.0 + SCALE_STEP)) - here) / (scale * SCALE_STEP)
        scale -= float(slope @ weight @ here / max(float(slope @ weight @ slope), np.finfo(float).tiny))
        if not 1.0 / MAX_SCALE < scale < MAX_SCALE:
            return None
    return scale if _chance(off(scale), *known) >= SAME_CHANCE else None


def compare_board_rigs(a: BoardRig, b: BoardRig, *, seed: int = 0) -> RigDifference:
    """Compare the poses of boards on one mount, in the frame of the first of them; the error of the squares' size is
    common to both.

    Raises InputError where the boards are different ones.
    """
    if a.names != b.names:
        raise InputError(
            f"other boards: {', '.join(a.names)} and {', '.join(b.names)}; compare mounts of the same boards"
        )
    off = [p.target_from_board.step_from(q.target_from_board) for p, q in zip(a.boards[1:], b.boards[1:], strict=True)]
    known = _known((a.covariance, b.covariance), (a.freedom, b.freedom), seed)
    return _difference(a.names[1:], np.concatenate([np.zeros(0), *off]), known)


Known = tuple[FloatArray, FloatArray]
"""Covariance (n, n) of a difference, and differences (n, N) drawn from the distributions of both parts."""


def _known(parts: Sequence[FloatArray], freedom: Sequence[float], seed: int = 0) -> Known:
    rng = np.random.default_rng(seed)
    first, second = (drawn_errors(part, degrees, rng) for part, degrees in zip(parts, freedom, strict=True))
    return parts[0] + parts[1], first - second


def _difference(names: Sequence[str], steps: FloatArray, known: Known | None) -> RigDifference:
    """Return the difference from the perturbations `steps` (6 n,) of the poses with these names."""
    mounts = []
    for k, name in enumerate(names):
        own = slice(6 * k, 6 * k + 6)
        angle, shift = np.degrees(np.linalg.norm(steps[own][:3])), np.linalg.norm(steps[own][3:])
        chance = None if known is None else _chance(steps[own], known[0][own, own], known[1][own])
        mounts.append(MountDifference(name, float(angle), float(shift), chance))
    return RigDifference(tuple(mounts), None if known is None else _chance(steps, *known))


def _weights(rig: MountedCameras, k: int) -> FloatArray:
    """Return weights (rows, columns) of pixels of camera `k`, inverse to the projection's standard deviation there."""
    camera = list(rig.cameras.values())[k][0]
    pixels = grid_pixels(camera.size_px, LENS_GRID)
    if rig.covariance is None:
        return np.ones(pixels.shape[:2])
    out = np.zeros(pixels.shape[:2])
    rays, valid = camera.unproject(pixels)
    p = camera.parameters.size
    design = projection_design(camera, rays[valid])[:, :p]
    own = rig.layout.cameras[k]
    variance = np.einsum("ipm,pq,iqm->m", design, rig.covariance[own, own], design)
    out[valid] = 1.0 / np.maximum(np.sqrt(np.maximum(variance, 0.0)), WEIGHT_FLOOR_PX)
    return np.asarray(out / out.max())


def _moved(rig: MountedCameras, covariance: FloatArray, weights: Sequence[FloatArray]) -> FloatArray:
    """Return the covariance (6 (n - 1), 6 (n - 1)) of the mounts with respect to the axes of the lenses."""
    design = _design(rig, weights)
    return design @ covariance @ design.T


def _design(rig: MountedCameras, weights: Sequence[FloatArray]) -> FloatArray:
    """Return d (w', dt') of all mounts / d (intrinsics, mounts), (6 (n - 1), K)."""
    turns = []
    for (camera, _), weight in zip(rig.cameras.values(), weights, strict=True):
        rays, valid = camera.unproject(grid_pixels(camera.size_px, LENS_GRID))
        p = camera.parameters.size
        both = projection_design(camera, rays[valid]) * np.sqrt(weight[valid])
        rows = both.transpose(1, 0, 2).reshape(p + 3, -1)
        turns.append(-np.linalg.lstsq(rows[p:].T, rows[:p].T, rcond=None)[0])
    layout = rig.layout
    out = np.zeros((layout.count, layout.count))
    for k, (_, mount) in list(enumerate(rig.cameras.values()))[1:]:
        own, lens = layout.mount(k), layout.cameras[k]
        turn, shift = out[own][:3], out[own][3:]
        turn[:, layout.cameras[0]] += mount.rotation @ turns[0]
        turn[:, lens] -= turns[k]
        shift[:, lens] += skew(mount.translation_mm) @ turns[k]
        out[own, own] = np.eye(6)
    return out[layout.cameras[-1].stop :]


def _chance(off: FloatArray, covariance: FloatArray, errors: FloatArray) -> float:
    """Return the p-value of a difference `off` (n,): the part of the drawn `errors` (n, N) with at least its
    Mahalanobis distance."""
    if not len(off):
        return 1.0
    inverse = scaled_pinv(covariance)
    null = np.einsum("in,in->n", errors, inverse @ errors)
    return float((1 + np.count_nonzero(null >= off @ inverse @ off)) / (len(null) + 1))
