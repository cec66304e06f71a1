"""Error of a rig from the shape of the boards, which is common to all frames and so not in their scatter.

One step of the solver with a richer board shape gives the change of cameras and mounts, which is taken as their error,
if the deviation of the boards from their shape is significant.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rigkit.calibration.rig.solving.solver import rig_normal
from rigkit.calibration.rig.solving.state import RigObservations, RigState
from rigkit.calibration.solving.evidence import chance_limit
from rigkit.calibration.solving.shape import SHAPES
from rigkit.core.arrays import FloatArray

STEP_DAMPING = 1e-12
"""Damping of the step: undetermined unknowns are not changed."""


def shape_error(observations: RigObservations, state: RigState, sigma_px: float) -> FloatArray:
    """Return the change of the globals except the shape, (G,), by the richest board shape that is significant against
    the one before it; zero if none is.

    `sigma_px` is the standard deviation of a corner, overdispersion of the frames included.
    """
    count = state.layout(observations).shape.start
    found = np.zeros(count)
    if not sigma_px > 0.0:
        return found
    # A board's views in all cameras count together for whether its shape is determined.
    boards = np.concatenate([own.board for own in observations.cameras])
    everything = replace(observations.cameras[0], board=boards)
    for kind in SHAPES[SHAPES.index(observations.shape.kind) + 1 :]:
        shape, unknowns = observations.shape.richer(kind, everything, state.unknowns)
        normal = rig_normal(replace(observations, shape=shape), replace(state, unknowns=unknowns), sigma_px)
        step = normal.step(STEP_DAMPING)
        more = shape.count - observations.shape.count
        if step is None or step.predicted < sigma_px**2 * chance_limit(more):
            break
        found = step.globals[:count]
    return found
