"""Rolling shutters: a camera reads its image row by row, while boards move.

A corner at some part of the image's height below its middle is exposed this part of the camera's `readout` time after
the image's time, when its board has moved on (`exposure_times`). A readout is observable in residuals that no pose of
the view explains. Corners are then corrected to their positions at the image's time.

References: C. Geyer, M. Meingast, S. Sastry, "Geometric models of rolling-shutter cameras", OMNIVIS 2005. L. Oth,
P. Furgale, L. Kneip, R. Siegwart, "Rolling shutter camera calibration", CVPR 2013.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from rigkit.calibration.rig.solving.pose_jacobians import board_velocities
from rigkit.calibration.rig.solving.state import RigObservations, RigState
from rigkit.core.arrays import FloatArray
from rigkit.geometry.rotation import skew

POSE_RIDGE = 1e-9
"""As a part of the largest information: regularises the pose of a view with few corners."""


@dataclass(frozen=True, slots=True)
class Readout:
    """The time between the first and the last row of an image, and its standard deviation, in units of the median time
    between two frames."""

    frames: float
    sigma: float


def with_longer_readouts(observations: RigObservations, state: RigState, steps: FloatArray) -> RigObservations:
    """Return the observations with the corners corrected for readouts of the n cameras that are longer by `steps`
    (n,)."""
    moved = [
        replace(own, pixels=own.pixels - step * _readout_displacements(observations, state, c)[0])
        for c, (own, step) in enumerate(zip(observations.cameras, steps.tolist(), strict=True))
    ]
    return replace(observations, cameras=tuple(moved))


def readout_steps(observations: RigObservations, state: RigState) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the corrections of the readouts of the n cameras, their standard deviations, clustered by view, with all
    but the views' poses held, and the degrees of freedom of these, (n,) each; zeros where hardly more than one view has
    information."""
    found = [_step(*_readout_information(observations, state, c)) for c in range(len(state.cameras))]
    step, sigma, freedom = np.array(found).T
    return step, sigma, freedom


def readouts_of(names: Sequence[str], state: RigState, sigmas: FloatArray) -> dict[str, Readout]:
    """Return the readouts of the cameras by their `names`, where they were solved for, with their `sigmas` (n,)."""
    if state.exposures is None or not state.exposures.readouts.any():
        return {}
    found = zip(state.exposures.readouts.tolist(), sigmas.tolist(), strict=True)
    return {name: Readout(*own) for name, own in zip(names, found, strict=True)}


def _step(score: FloatArray, information: FloatArray) -> tuple[float, float, float]:
    total = float(information.sum())
    share = information / total if total > 0.0 else np.ones(1)
    # Views with high leverage count for several, and have pulled the readout towards themselves (as in `clustered`).
    freedom = 1.0 / float((share**2).sum()) - 1.0
    if freedom < 1.0:
        return 0.0, 0.0, freedom
    step = float(score.sum()) / total
    return step, float(np.linalg.norm((score - step * information) / (1.0 - share))) / total, freedom


def readout_errors_of_speeds(observations: RigObservations, state: RigState, coarser: RigState) -> FloatArray:
    """Return the standard deviations (n,) of the readouts due to errors of the boards' speeds. These are as large as
    the difference to a `coarser` state, with fewer poses in each trajectory, and independent between views."""
    assert state.exposures is not None
    out = np.zeros(len(state.cameras))
    for c, readout in enumerate(state.exposures.readouts.tolist()):
        other, own = (_readout_displacements(observations, of, c)[0] for of in (coarser, state))
        score, information = _readout_information(observations, state, c, readout * (other - own))
        out[c] = np.linalg.norm(score) / max(float(information.sum()), np.finfo(float).tiny)
    return out


def _readout_information(
    observations: RigObservations, state: RigState, c: int, residuals: FloatArray | None = None
) -> tuple[FloatArray, FloatArray]:
    """Return score and information (V,) of every view of camera `c` on its readout, the view's pose eliminated, for
    `residuals` (V, C, 2) other than those of the state if given."""
    motion, by_pose, own_residuals = _readout_displacements(observations, state, c)
    residuals = own_residuals if residuals is None else residuals
    weight = observations.weights[c][:, :, None]
    views = len(weight)
    motion, residuals = ((weight * part).reshape(views, -1) for part in (motion, residuals))
    by_pose = (weight[..., None] * by_pose).reshape(views, -1, 6)
    back = np.swapaxes(by_pose, -1, -2)
    pose = back @ by_pose
    largest = np.maximum(np.einsum("vii->vi", pose).max(axis=1), 1.0)
    own = np.linalg.solve(pose + POSE_RIDGE * largest[:, None, None] * np.eye(6), back @ motion[..., None])
    motion = motion - (by_pose @ own)[..., 0]
    return (motion * residuals).sum(axis=1), (motion**2).sum(axis=1)


def _readout_displacements(
    observations: RigObservations, state: RigState, c: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the displacement of the corners of camera `c` until they are read, px per unit of readout (V, C, 2), their
    derivatives by the pose of the view (V, C, 2, 6), and residuals (V, C, 2); zero for corners that are not used."""
    own, alone = observations.cameras[c], state.of_camera(c, observations)
    points, lever = alone.points_in_cam(own)
    pixels, valid, d_pixels_d_point, _ = alone.camera.project_with_jacobians(points)
    used = (valid & (observations.weights[c] > 0.0))[..., None]
    by_pose = np.concatenate([d_pixels_d_point @ -skew(lever), d_pixels_d_point], axis=-1)
    by_pose = np.where(used[..., None], by_pose, 0.0)
    speed = np.einsum("vcij,vj->vci", by_pose, board_velocities(observations, state, c, alone.translation_mm))
    height = alone.camera.size_px[1]
    below = (own.pixels[..., 1:] - 0.5 * (height - 1.0)) / height
    return speed * below, by_pose, np.where(used, own.pixels - pixels, 0.0)
