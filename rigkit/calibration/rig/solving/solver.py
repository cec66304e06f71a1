"""The joint least squares of a rig, on top of the normal equations of single cameras (`pose_jacobians`)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rigkit.calibration.rig.solving.exposure_times import without_own_times
from rigkit.calibration.rig.solving.pose_jacobians import board_velocities, pose_jacobians
from rigkit.calibration.rig.solving.state import RigObservations, RigState
from rigkit.calibration.solving.linearise import normal_equations
from rigkit.calibration.solving.normal_equations import NormalEquations
from rigkit.calibration.solving.poses import refine_each
from rigkit.calibration.solving.solver import COST_TOLERANCE, Linearised, Solution, minimise
from rigkit.core.arrays import Mat3, Points
from rigkit.geometry.rotation import log_so3


def rig_normal(observations: RigObservations, state: RigState, sigma_px: float = 0.0) -> NormalEquations:
    """Return the normal equations with all priors; `sigma_px`, the standard deviation of a corner, scales residuals
    against the priors of cameras and shape; zero for none of these."""
    return with_rig_priors(rig_data(observations, state), observations, state, sigma_px)


def rig_data(observations: RigObservations, state: RigState) -> NormalEquations:
    """Return the normal equations of the corners over the globals (`RigState.layout`) and the targets' poses."""
    layout = state.layout(observations)
    count, poses = layout.count, len(observations.keys)
    gg, g = np.zeros((count, count)), np.zeros(count)
    gp, pp, p = np.zeros((poses, count, 6)), np.zeros((poses, 6, 6)), np.zeros((poses, 6))
    costs = np.zeros(poses)
    each: list[NormalEquations] = []
    for c, own in enumerate(observations.cameras):
        alone = state.of_camera(c, observations)
        n = normal_equations(own, alone, observations.weights[c])
        if (exposures := state.exposures) is not None:
            f, velocity = observations.frame[c], board_velocities(observations, state, c, alone.translation_mm)
            n = without_own_times(n, velocity, exposures.own[c, f], exposures.information[c, f])
        each.append(n)
        size = alone.camera.parameters.size
        # Slices of the camera's own unknowns in the rig, and in the camera's equations.
        parts = [(layout.cameras[c], slice(0, size))]
        if observations.shape.count:
            parts.append((layout.shape, slice(size, None)))
        for there, here in parts:
            g[there] += n.g[here]
            for also, too in parts:
                gg[there, also] += n.gg[here, too]
        for part in pose_jacobians(observations, state, c, alone.translation_mm):
            f, views, index = part.poses, part.views, part.index
            by_target, by_globals = np.swapaxes(part.target, -1, -2), np.swapaxes(part.globals, -1, -2)
            own_pp, own_p = n.pp[views], n.p[views, :, None]
            pp[f] += by_target @ own_pp @ part.target
            p[f] += (by_target @ own_p)[..., 0]
            costs[f] += n.costs[views]
            for there, here in parts:
                gp[f, there] += n.gp[views, here] @ part.target
            if not index.size:
                continue
            moved = by_globals @ own_pp
            gp[f[:, None], index] += moved @ part.target
            gg[index[:, None], index] += (moved @ part.globals).sum(axis=0)
            g[index] += (by_globals @ own_p).sum(axis=0)[:, 0]
            for there, here in parts:
                both = (n.gp[views, here] @ part.globals).sum(axis=0)
                gg[there, index] += both
                gg[index, there] += both.T
    released = None
    # The times of images couple the points that they show.
    if observations.shape.kind == "released" and state.exposures is None:
        released = layout.shape.start + observations.shape.basis.shape[-1]
    return replace(_joined(each), gg=gg, gp=gp, pp=pp, g=g, p=p, costs=costs, points_from=released)


def _joined(each: Sequence[NormalEquations]) -> NormalEquations:
    """Return the first with the residuals and products of all."""
    residuals = tuple(own for normal in each for own in normal.residuals)
    return replace(each[0], residuals=residuals, products=tuple(own for normal in each for own in normal.products))


def with_rig_priors(
    normal: NormalEquations, observations: RigObservations, state: RigState, sigma_px: float
) -> NormalEquations:
    """Add the priors of cameras and shape, and those of held lenses and mounts."""
    layout = state.layout(observations)
    cameras = list(zip(layout.cameras, state.cameras, strict=True))
    normal = normal.with_priors(cameras, layout.shape, observations.shape.sigma, state.unknowns, sigma_px)
    for (where, camera), (near, information) in zip(cameras, observations.held, strict=False):
        normal = normal.with_quadratic(where, camera.parameters - near, information)
    for c, held in enumerate(observations.held_mounts):
        run = layout.mounts[c]
        if held is not None and run is not None:
            turned = log_so3(state.mount_rotation[c] @ held[0].rotation.T)
            off = np.concatenate([turned, state.mount_mm[c] - held[0].translation_mm])
            normal = normal.with_quadratic(run, off, held[1])
    return normal


def solve_rig(
    observations: RigObservations, start: RigState, sigma_px: float, tolerance: float = COST_TOLERANCE
) -> Solution[RigState]:
    """Return the state that minimises the weighted residuals, from the initial state `start`.

    `sigma_px` as for `rig_normal`; `tolerance` is the relative predicted decrease of the cost at which it stops.
    """
    layout = start.layout(observations)

    def linearise(state: RigState) -> Linearised:
        data = rig_data(observations, state)
        return Linearised(data, with_rig_priors(data, observations, state, sigma_px))

    return minimise(start, linearise, lambda state, step: state.moved(step, layout), tolerance=tolerance)


def refine_frames(observations: RigObservations, state: RigState) -> RigState:
    """Return the state with the pose of every target at its own minimum, and all else held."""
    seen = replace(observations, shape=observations.shape.held(state.unknowns))
    held = replace(state, unknowns=np.zeros(0))

    def linearise(rotation: Mat3, translation_mm: Points) -> NormalEquations:
        return rig_normal(seen, replace(held, frame_rotation=rotation, frame_mm=translation_mm))

    rotation, translation_mm, _ = refine_each(state.frame_rotation, state.frame_mm, linearise)
    return replace(state, frame_rotation=rotation, frame_mm=translation_mm)
