"""What is not sure of a rig because nobody is sure how long its cameras take to read an image.

The rig is solved again with the readout of one camera a standard deviation longer. What residuals then say of it, they
say beside the poses of views alone; the rest of the rig has followed by the part that they say less, and explains as
much of the information on the readout.
"""

from __future__ import annotations

import numpy as np

from rigkit.calibration.rig.certainty.between_models import globals_between
from rigkit.calibration.rig.joint import JointRig
from rigkit.calibration.rig.solving.shutters import read_on, readout_steps
from rigkit.calibration.rig.solving.solver import solve_rig
from rigkit.calibration.solving.solver import FROM_OPTIMUM
from rigkit.core.arrays import FloatArray

MIN_LEFT = 0.05
"""Part of the information on a readout that is its own, at least: less is rounding."""


def readout_error(joint: JointRig) -> tuple[FloatArray, FloatArray]:
    """Return what the errors of the readouts add to the covariance (G, G) of all globals, and their standard deviations
    (n,); zeros where none was solved for."""
    observations, state = joint.observations, joint.solution.state
    layout, cameras = state.layout(observations), len(state.cameras)
    out, sigmas = np.zeros((layout.count, layout.count)), np.zeros(cameras)
    if state.moments is None or not state.moments.readouts.any():
        return out, sigmas
    before, alone, _ = readout_steps(observations, state)
    for c in np.flatnonzero(alone).tolist():
        step = np.where(np.arange(cameras) == c, alone, 0.0)
        moved = read_on(observations, state, step)
        there = solve_rig(moved, state, joint.sigma_px, FROM_OPTIMUM).state
        left = float((before - readout_steps(moved, there)[0])[c] / alone[c])
        followed = globals_between(layout, state, there) / np.sqrt(max(left, MIN_LEFT))
        out += np.outer(followed, followed)
        sigmas[c] = alone[c] / np.sqrt(max(left, MIN_LEFT))
    return out, sigmas
