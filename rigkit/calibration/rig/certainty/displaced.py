"""Model inadequacy of the lenses of a rig, and the error of all unknowns with it.

As for a single camera (`certainty.displaced`), but all cameras share the boards' poses, so that mounts change with the
displacements of a lens: by the rig's normal equations, with the boards' shape held.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rigkit.calibration.certainty.displaced import LensModes, significant_modes
from rigkit.calibration.certainty.uncertainty import FarProjection
from rigkit.calibration.rig.solving.pose_jacobians import board_velocities, pose_jacobians
from rigkit.calibration.rig.solving.state import RigObservations, RigState
from rigkit.calibration.solving.normal_equations import NormalEquations
from rigkit.calibration.solving.solver import Solution
from rigkit.calibration.solving.state import State
from rigkit.calibration.views.observations import Observations
from rigkit.core.arrays import FloatArray, IntArray
from rigkit.geometry.rotation import skew
from rigkit.kernels.departures import displacements


def lens_modes(
    observations: RigObservations, solution: Solution[RigState], far: Sequence[FarProjection], reported: IntArray
) -> tuple[LensModes, ...]:
    """Return the model inadequacy of each lens, with the error of the globals `reported` (G,), intrinsics and mounts;
    `far` are the uncertainties of the cameras' projections in the rig."""
    n, normal = solution.state.layout(observations).shape.start, solution.normal
    if n < len(normal.g):
        normal = replace(normal, gg=normal.gg[:n, :n], gp=normal.gp[:, :n], points_from=None)
    each = (significant_modes(one) for one in far)
    return tuple(_of_camera(observations, solution.state, normal, c, modes, reported) for c, modes in enumerate(each))


def _of_camera(
    observations: RigObservations,
    state: RigState,
    normal: NormalEquations,
    c: int,
    modes: FloatArray,
    reported: IntArray,
) -> LensModes:
    """Return the modes (J, M) of the lens of camera `c` with the error of the globals `reported`; `normal` are the
    rig's normal equations without the boards' shape."""
    if not modes.size:
        return LensModes(modes, np.zeros((len(reported), 0)))
    layout = state.layout(observations)
    alone, own = state.of_camera(c, observations), observations.cameras[c]
    n = layout.shape.start
    by_globals = np.zeros((n, modes.shape[1]))
    motion = None
    if state.exposures is not None:
        information = state.exposures.information[c, observations.frame[c]]
        motion = board_velocities(observations, state, c, alone.translation_mm), information
    by_globals[layout.cameras[c]], by_own = _products(alone, own, observations.weights[c], modes, motion)
    by_pose = np.zeros((len(observations.keys), 6, modes.shape[1]))
    for part in pose_jacobians(observations, state, c, alone.translation_mm):
        shown = by_own[part.views]
        by_globals[part.index] += (np.swapaxes(part.globals, -1, -2) @ shown).sum(axis=0)
        by_pose[part.poses] += np.swapaxes(part.target, -1, -2) @ shown
    inverse, back, _ = normal.covariance
    moves = -inverse @ (by_globals - np.tensordot(back, by_pose, axes=((0, 1), (0, 1))))
    return LensModes(modes, moves[reported])


def _products(
    alone: State,
    own: Observations,
    weight: FloatArray,
    modes: FloatArray,
    motion: tuple[FloatArray, FloatArray] | None,
) -> tuple[FloatArray, FloatArray]:
    """Return the weighted products of the modes with the derivatives by the parameters (P, M) and by the pose of each
    view (V, 6, M); `motion` are the velocity of each view's pose (V, 6) and the information on its own time."""
    points, lever = alone.points_in_cam(own)
    pixels, valid, d_pixels_d_point, d_pixels_d_parameters = alone.camera.project_with_jacobians(points)
    used = valid & (weight > 0.0)
    moved = np.zeros((*used.shape, 2, modes.shape[1]))
    moved[used] = (displacements(pixels[used], alone.camera.size_px).transpose(2, 0, 1) @ modes) * (
        weight[used, None, None] ** 2
    )
    d_pixels_d_point, d_pixels_d_parameters = (
        np.where(used[..., None, None], by, 0.0) for by in (d_pixels_d_point, d_pixels_d_parameters)
    )
    by_view = np.concatenate([-d_pixels_d_point @ skew(lever), d_pixels_d_point], axis=-1)
    views, count = len(weight), modes.shape[1]
    if motion is not None:
        # The images' own times absorb a part.
        by_time = np.einsum("vcxi,vi->vcx", by_view, motion[0])
        weighted = by_time * np.where(used, weight, 0.0)[..., None] ** 2
        known = np.einsum("vcx,vcx->v", weighted, by_time) + motion[1]
        taken = np.einsum("vcx,vcxm->vm", by_time, moved) / known[:, None]
        moved -= weighted[..., None] * taken[:, None, None]
    of_views = np.swapaxes(by_view.reshape(views, -1, 6), 1, 2) @ moved.reshape(views, -1, count)
    return d_pixels_d_parameters.reshape(-1, d_pixels_d_parameters.shape[-1]).T @ moved.reshape(-1, count), of_views
