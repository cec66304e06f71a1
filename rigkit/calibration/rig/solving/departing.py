"""Lenses of a rig that depart from their models: do views disagree on the boards' poses because of that?

A view alone follows the departures of its lens with the pose of its board, each in its own way. So views that share a
pose disagree, as if the images of a frame were not taken at one moment. But a few numbers of each lens, the same in all
images, explain it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rigkit.calibration.certainty.departures import LARGEST_PX
from rigkit.calibration.certainty.displaced import with_amounts
from rigkit.calibration.rig.solving.solver import solve_rig
from rigkit.calibration.rig.solving.state import Key, RigObservations, RigState
from rigkit.calibration.rig.views.disagree import excess_cost
from rigkit.calibration.solving.solver import Solution
from rigkit.cameras.base import Camera
from rigkit.cameras.moving_pupil import far_camera, with_pupil_of
from rigkit.core.arrays import FloatArray
from rigkit.kernels.departures import DISPLACEMENTS, POSE


def cost_with_departures(
    observations: RigObservations, solution: Solution[RigState], sigma_px: float
) -> dict[Key, float] | None:
    """Return `cost_of_sharing` where lenses may depart from their models, with poses shared and without: the amounts of
    all displacements are solved for as well, a priori with a standard deviation of LARGEST_PX. Boards keep their shape.

    None where it would say nothing: there are as many amounts as constraints from shared poses, or lags of cameras,
    which explain disagreement as well.
    """
    state = solution.state
    layout, views = state.layout(observations), sum(len(frame) for frame in observations.frame)
    places = sum(run is not None for run in (*layout.mounts, *layout.boards))
    constraints = POSE * (views - len(observations.keys) - places)
    if state.exposures is not None or constraints <= DISPLACEMENTS * len(state.cameras):
        return None
    cameras, priors = zip(*(_departing(camera, sigma_px) for camera in state.cameras), strict=True)
    held = replace(observations, shape=observations.shape.held(state.unknowns), held=priors)
    state = replace(state, cameras=cameras, unknowns=np.zeros(0))
    shared = solve_rig(held, state, sigma_px).normal.costs
    alone = np.zeros(len(shared))
    for c, frame in enumerate(observations.frame):
        np.add.at(alone, frame, solve_rig(*_separate(held, state, c), sigma_px).normal.costs)
    return excess_cost(observations, shared, alone)


def _departing(camera: Camera, sigma_px: float) -> tuple[Camera, tuple[FloatArray, FloatArray]]:
    """Return a camera with the amounts of its departures, and the prior mean and information of its parameters."""
    lens = with_amounts(far_camera(camera), np.eye(DISPLACEMENTS))
    moving = with_pupil_of(lens, camera)
    information = np.zeros(moving.parameters.size)
    information[lens.parameters.size - DISPLACEMENTS : lens.parameters.size] = (sigma_px / LARGEST_PX) ** 2
    return moving, (moving.parameters, np.diag(information))


def _separate(observations: RigObservations, state: RigState, c: int) -> tuple[RigObservations, RigState]:
    """Return the observations and the state of camera `c` alone, every view with a pose of its own."""
    alone, count = state.of_camera(c, observations), len(observations.frame[c])
    own = replace(
        observations,
        cameras=observations.cameras[c : c + 1],
        weights=observations.weights[c : c + 1],
        frame=(np.arange(count),),
        keys=tuple((str(k), "") for k in range(count)),
        places=(False,) * len(observations.places),
        held=observations.held[c : c + 1],
    )
    return own, RigState(
        cameras=state.cameras[c : c + 1],
        mount_rotation=np.eye(3)[None],
        mount_mm=np.zeros((1, 3)),
        frame_rotation=alone.rotation,
        frame_mm=alone.translation_mm,
        board_rotation=state.board_rotation,
        board_mm=state.board_mm,
        unknowns=state.unknowns,
    )
