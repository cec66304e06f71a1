"""The uncertainty of a rig from that of its cameras' readout times.

For each camera the rig is solved again with its readout one standard deviation longer. `readout_steps` holds all but
the poses of views; the rest of the rig follows and explains a part of the residuals, which lowers the information on
the readout by the same part.
"""

from __future__ import annotations

import numpy as np

from rigkit.calibration.rig.certainty.between_models import globals_between
from rigkit.calibration.rig.joint import JointRig
from rigkit.calibration.rig.solving.shutters import readout_steps, with_longer_readouts
from rigkit.calibration.rig.solving.solver import solve_rig
from rigkit.calibration.solving.solver import FROM_OPTIMUM
from rigkit.core.arrays import FloatArray

MIN_LEFT = 0.05
"""Least part of the information on a readout that remains: less is rounding error."""


def readout_error(joint: JointRig) -> tuple[FloatArray, FloatArray]:
    """Return the covariance (G, G) of all globals due to the errors of the readouts, to be added, and the standard
    deviations (n,) of the readouts; zeros where none was solved for."""
    observations, state = joint.observations, joint.solution.state
    layout, cameras = state.layout(observations), len(state.cameras)
    out, sigmas = np.zeros((layout.count, layout.count)), np.zeros(cameras)
    if state.exposures is None or not state.exposures.readouts.any():
        return out, sigmas
    before, alone, _ = readout_steps(observations, state)
    for c in np.flatnonzero(alone).tolist():
        step = np.where(np.arange(cameras) == c, alone, 0.0)
        moved = with_longer_readouts(observations, state, step)
        there = solve_rig(moved, state, joint.sigma_px, FROM_OPTIMUM).state
        left = float((before - readout_steps(moved, there)[0])[c] / alone[c])
        followed = globals_between(layout, state, there) / np.sqrt(max(left, MIN_LEFT))
        out += np.outer(followed, followed)
        sigmas[c] = alone[c] / np.sqrt(max(left, MIN_LEFT))
    return out, sigmas
