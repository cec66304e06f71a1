"""Cross-validation of a rig over frames."""

from __future__ import annotations

import numpy as np

from rigkit.calibration.choosing.choice import MIN_IMAGES_OF_FIT
from rigkit.calibration.rig.certainty.frame_covariance import residual_sigma
from rigkit.calibration.rig.joint import JointRig
from rigkit.calibration.rig.solving.lags import cost_of_own_times
from rigkit.calibration.rig.solving.shutters import readout_steps, with_longer_readouts
from rigkit.calibration.rig.solving.solver import refine_frames, solve_rig
from rigkit.calibration.rig.solving.state import RigObservations
from rigkit.calibration.solving.solver import FROM_OPTIMUM
from rigkit.calibration.solving.state import weighted_squares


def heldout_rms(joint: JointRig, folds: int) -> tuple[float | None, tuple[float | None, ...]]:
    """Return the 2-D RMS over held-out frames, of all cameras together and of each: cameras, mounts, places and shapes
    of boards are from the other folds, only one pose for each target is fitted, jointly to all cameras. Readouts of
    rolling shutters, too, are corrected to first order to those of the other folds. The images' own times are those of
    the solution; what it costs to predict them instead (`cost_of_own_times`) is in the first error. With fewer frames
    than folds each is a fold. None with less than MIN_IMAGES_OF_FIT frames, or where a camera's mount is determined by
    the frames of one fold alone.

    Unlike the held-out errors of single cameras it includes disagreement between cameras. Residuals are weighted as in
    the solution.
    """
    observations, state = joint.observations, joint.solution.state
    nothing = None, (None,) * len(observations.cameras)
    if folds < 2 or int(joint.frames.max()) + 1 < MIN_IMAGES_OF_FIT:
        return nothing
    fold = joint.folds(folds)
    squared, count = np.zeros(len(observations.cameras)), np.zeros(len(observations.cameras))
    sigma, own_times = residual_sigma(observations, joint.solution, joint.sigma_px), 0.0
    for k in range(int(fold.max()) + 1):
        test = fold == k
        train = observations.subset(~test)
        if not _is_connected(train):
            return nothing
        solved = solve_rig(train, state, joint.sigma_px, FROM_OPTIMUM).state
        part, start = observations.subset(test), solved.with_frames(state)
        if joint.timing == "readouts":
            part = with_longer_readouts(part, start, readout_steps(train, solved)[0])
        found = refine_frames(part, start)
        own_times += cost_of_own_times(part, found, sigma)
        for c, (own, weight) in enumerate(zip(part.cameras, part.weights, strict=True)):
            squared[c] += float(weighted_squares(found.of_camera(c, part), own, weight).sum())
            count[c] += float((weight > 0.0).sum())
    each = tuple(float(np.sqrt(s / n)) if n else None for s, n in zip(squared, count, strict=True))
    return float(np.sqrt((squared.sum() + own_times) / count.sum())), each


def _is_connected(observations: RigObservations) -> bool:
    """Return whether all cameras are connected by shared poses."""
    poses = [set(own.tolist()) for own in observations.frame]
    linked, rest = poses[0], poses[1:]
    while rest:
        near = [own for own in rest if own & linked]
        if not near:
            return False
        linked, rest = linked.union(*near), [own for own in rest if not own & linked]
    return True
