"""Uncertainty of a rig by solving it again: with other models (`choosing.between_models` for several cameras), and with
other readout times.

The rig is solved again with each rival model, for all cameras that have it at once: like cameras have one model. An
entrance pupil that may move is such a rival.

The uncertainty of the cameras' readout times is found in the same way: for each camera the rig is solved again with its
readout one standard deviation longer. `readout_steps` holds all but the poses of views; the rest of the rig follows and
explains a part of the residuals, which lowers the information on this readout, and changes what the other cameras say
of theirs. So readouts are correlated, and their covariance is the inverse of the information on all of them. Speeds of
boards, from poses in some frames, have an error that no scatter of residuals shows; it is estimated from speeds with
one pose less.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rigkit.calibration.certainty.uncertainty import step_to_lens
from rigkit.calibration.choosing.between_models import same_model, spread_rays
from rigkit.calibration.result import Rival
from rigkit.calibration.rig.joint import JointRig
from rigkit.calibration.rig.solving.exposure_times import POINTS
from rigkit.calibration.rig.solving.lags import with_trajectories
from rigkit.calibration.rig.solving.layout import Layout
from rigkit.calibration.rig.solving.shutters import readout_errors_of_speeds, readout_steps, with_longer_readouts
from rigkit.calibration.rig.solving.solver import solve_rig
from rigkit.calibration.rig.solving.state import RigState
from rigkit.calibration.solving.clustered import widening
from rigkit.calibration.solving.poses import steps_between
from rigkit.calibration.solving.solver import FROM_OPTIMUM
from rigkit.calibration.with_pupil import MOVING
from rigkit.cameras.base import Camera
from rigkit.cameras.moving_pupil import NearCamera, far_camera, with_pupil_of
from rigkit.core.arrays import FloatArray, Mat3
from rigkit.core.errors import DegenerateError, InputError

MIN_LEFT = 0.05
"""Least part of the information on readouts that remains, in any direction: less is rounding error."""


def between_rig_models(joint: JointRig, sigmas: FloatArray) -> FloatArray:
    """Return the rivals' contribution to the covariance (G, G) of all globals; `sigmas` (G,) are the standard
    deviations without it. Zero where lenses are held: their own covariances include it. Rivals of another board shape
    do not count, as the cameras choose that together."""
    here, layout = joint.solution.state, joint.solution.state.layout(joint.observations)
    out = np.zeros((layout.count, layout.count))
    if joint.observations.held or joint.known is not None:
        return out
    single, rays = joint.views.single, []
    for c, weight in enumerate(joint.observations.weights):
        points, _ = here.of_camera(c, joint.observations).points_in_cam(joint.observations.cameras[c])
        rays.append(spread_rays(points[weight > 0.0]))

    def fitted_to(there: RigState) -> tuple[list[FloatArray], list[Mat3]]:
        """Return the change of each camera's parameters that fits it to that of another state, and the rotations
        there_from_here of the rays."""
        both = zip(here.cameras, there.cameras, rays, layout.cameras, strict=True)
        found = [step_to_lens(camera, other, own, sigmas[run]) for camera, other, own, run in both]
        return [step for step, _ in found], [turn for _, turn in found]

    others = [
        rival.name
        for one in single
        for rival in one.rivals
        if rival.name == MOVING or not same_model(rival.camera, one.camera)
    ]
    for name in dict.fromkeys(others):
        own = [next((r for r in calibration.rivals if r.name == name), None) for calibration in single]
        start = replace(
            here,
            cameras=tuple(c if r is None else _lens_of(r, c) for c, r in zip(here.cameras, own, strict=True)),
        )
        try:
            start = _turned(start, fitted_to(start)[1])
            there = _as_central(solve_rig(joint.observations, start, joint.sigma_px, FROM_OPTIMUM).state, here)
            steps, turns = fitted_to(there)
        except (InputError, DegenerateError):
            continue
        global_step = globals_between(layout, here, _turned(there, [turn.T for turn in turns]))
        for lens, step in zip(layout.cameras, steps, strict=True):
            global_step[lens] = step
        likely = [r.likely for r in own if r is not None]
        out += np.mean(likely) * np.outer(global_step, global_step)
    return out


def _lens_of(rival: Rival, camera: Camera) -> Camera:
    """Return the lens of a rival from which to solve, in place of `camera`."""
    return NearCamera.of(rival.camera) if rival.name == MOVING else with_pupil_of(rival.camera, camera)


def _as_central(there: RigState, here: RigState) -> RigState:
    """Return the state without the pupils of the cameras that are central `here`."""
    both = zip(there.cameras, here.cameras, strict=True)
    return replace(there, cameras=tuple(c if isinstance(own, NearCamera) else far_camera(c) for c, own in both))


def _turned(state: RigState, turns: Sequence[Mat3]) -> RigState:
    """Return the state with camera c rotated by `turns[c]`, the rig with the first."""
    turn, first = np.array(turns), turns[0]
    return replace(
        state,
        mount_rotation=turn @ state.mount_rotation @ first.T,
        mount_mm=np.einsum("cij,cj->ci", turn, state.mount_mm),
        frame_rotation=first @ state.frame_rotation,
        frame_mm=state.frame_mm @ first.T,
        exposures=None if state.exposures is None else state.exposures.turned(first),
    )


def globals_between(layout: Layout, here: RigState, there: RigState) -> FloatArray:
    """Return the change of the globals (G,) from the state `here` to `there`; zero for lenses of another model."""
    global_step = np.zeros(layout.count)
    for lens, camera, other in zip(layout.cameras, here.cameras, there.cameras, strict=True):
        if camera.parameters.size == other.parameters.size:
            global_step[lens] = other.parameters - camera.parameters
    for runs, before, after in (
        (layout.mounts, (here.mount_rotation, here.mount_mm), (there.mount_rotation, there.mount_mm)),
        (layout.boards, (here.board_rotation, here.board_mm), (there.board_rotation, there.board_mm)),
    ):
        moved = steps_between(before, after)
        for k, run in enumerate(runs):
            if run is not None:
                global_step[run] = moved[k]
    if here.exposures is not None and there.exposures is not None:
        global_step[layout.lags] = (there.exposures.lags - here.exposures.lags)[1:]
    global_step[layout.shape] = there.unknowns - here.unknowns
    return global_step


def readout_error(joint: JointRig) -> tuple[FloatArray, FloatArray]:
    """Return the covariance (G, G) of all globals due to the errors of the readouts, to be added, and the quoted
    standard deviations (n,) of the readouts; zeros where none was solved for."""
    observations, state = joint.observations, joint.solution.state
    layout, cameras = state.layout(observations), len(state.cameras)
    sigmas = np.zeros(cameras)
    if state.exposures is None or not state.exposures.readouts.any():
        return np.zeros((layout.count, layout.count)), sigmas
    before, alone, freedom = readout_steps(observations, state)
    coarse = with_trajectories(state.exposures, state, observations, joint.times, POINTS - 1)
    by_speeds = readout_errors_of_speeds(observations, state, replace(state, exposures=coarse))
    alone = np.where(alone > 0.0, np.hypot(alone, by_speeds), 0.0)
    known = np.flatnonzero(alone)
    followed, left = np.zeros((layout.count, len(known))), np.zeros((len(known), len(known)))
    for k, c in enumerate(known.tolist()):
        step = np.where(np.arange(cameras) == c, alone, 0.0)
        moved = with_longer_readouts(observations, state, step)
        there = solve_rig(moved, state, joint.sigma_px, FROM_OPTIMUM).state
        left[:, k] = (before - readout_steps(moved, there)[0])[known] / alone[known]
        followed[:, k] = globals_between(layout, state, there)
    values, axes = np.linalg.eigh(0.5 * (left + left.T))
    root = axes / np.sqrt(np.maximum(values, MIN_LEFT))
    widened = [widening(own) for own in freedom[known].tolist()]
    sigmas[known] = widened * alone[known] * np.linalg.norm(root, axis=1)
    return (followed @ root) @ (followed @ root).T, sigmas
