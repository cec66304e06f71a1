"""What boards that are not quite what they were taken for have done to a rig: an error that all frames have in common.

How frames scatter does not show it. But the views say how the boards depart from their shape, and a step of the solver
with boards of a richer one says how far that would move cameras and mounts: that far they may be off.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rigkit.calibration.rig.solving.solver import rig_normal
from rigkit.calibration.rig.solving.state import RigObservations, RigState
from rigkit.calibration.solving.shape import SHAPES
from rigkit.core.arrays import FloatArray

CHANCE_SIGMAS = 3.0
"""Boards depart from their shape where a richer one takes this many standard deviations more off the cost than chance
does."""
STEP_DAMPING = 1e-12
"""Of the one step: keeps what no view determines where it is."""


def shape_error(observations: RigObservations, state: RigState, sigma_px: float) -> FloatArray:
    """Return by how much the globals but for the shape, (G,), would move if the boards had a richer shape: richer ones
    are tried as long as the boards depart from the one they have by more than chance. Zero where they do not.

    `sigma_px` is the standard deviation of a corner, the disagreement of the frames counted in.
    """
    count = state.layout(observations).shape.start
    found = np.zeros(count)
    if not sigma_px > 0.0:
        return found
    # Which boards are seen often enough, all cameras together.
    boards = np.concatenate([own.board for own in observations.cameras])
    everything = replace(observations.cameras[0], board=boards)
    for kind in SHAPES[SHAPES.index(observations.shape.kind) + 1 :]:
        shape, unknowns = observations.shape.richer(kind, everything, state.unknowns)
        normal = rig_normal(replace(observations, shape=shape), replace(state, unknowns=unknowns), sigma_px)
        step = normal.step(STEP_DAMPING)
        more = shape.count - observations.shape.count
        if step is None or step.predicted < sigma_px**2 * (more + CHANCE_SIGMAS * np.sqrt(2.0 * more)):
            break
        found = step.globals[:count]
    return found
