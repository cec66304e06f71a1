"""The uncertainty of a rig from that of its cameras' readout times.

For each camera the rig is solved again with its readout one standard deviation longer. `readout_steps` holds all but
the poses of views; the rest of the rig follows and explains a part of the residuals, which lowers the information on
this readout, and changes what the other cameras say of theirs. So readouts are correlated, and their covariance is the
inverse of the information on all of them. Speeds of boards, from poses in some frames, have an error that no scatter of
residuals shows; it is estimated from speeds with one pose less.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rigkit.calibration.rig.certainty.between_models import globals_between
from rigkit.calibration.rig.joint import JointRig
from rigkit.calibration.rig.solving.exposure_times import POINTS
from rigkit.calibration.rig.solving.lags import with_trajectories
from rigkit.calibration.rig.solving.shutters import readout_errors_of_speeds, readout_steps, with_longer_readouts
from rigkit.calibration.rig.solving.solver import solve_rig
from rigkit.calibration.solving.clustered import widening
from rigkit.calibration.solving.solver import FROM_OPTIMUM
from rigkit.core.arrays import FloatArray

MIN_LEFT = 0.05
"""Least part of the information on readouts that remains, in any direction: less is rounding error."""


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
