"""The error of a rig on frames that took no part in it: its headline."""

from __future__ import annotations

import numpy as np

from rigkit.calibration.choosing.heldout import MIN_IMAGES_OF_FIT
from rigkit.calibration.rig.joint import JointRig
from rigkit.calibration.rig.solving.solver import refine_frames, solve_rig
from rigkit.calibration.rig.solving.state import RigObservations
from rigkit.calibration.solving.solver import FROM_OPTIMUM
from rigkit.calibration.solving.state import weighted_squares


def heldout_rms(joint: JointRig, folds: int) -> tuple[float | None, tuple[float | None, ...]]:
    """Return the 2-D RMS over frames that took no part, of all cameras together and of each: cameras, mounts, places
    and shapes of boards from the other frames, only one pose a target refitted, by all cameras at once. Of fewer frames
    than folds each is one. None with less than MIN_IMAGES_OF_FIT, or where those of one fold alone tell where a camera
    sits.

    It counts what a held-out error of single cameras cannot see: cameras that disagree. Residuals are weighted
    as in the solution.
    """
    observations, state = joint.observations, joint.solution.state
    nothing = None, (None,) * len(observations.cameras)
    if folds < 2 or int(joint.frames.max()) + 1 < MIN_IMAGES_OF_FIT:
        return nothing
    fold = joint.folds(folds)
    squared, count = np.zeros(len(observations.cameras)), np.zeros(len(observations.cameras))
    for k in range(int(fold.max()) + 1):
        test = fold == k
        train = observations.subset(~test)
        if not _is_connected(train):
            return nothing
        solved = solve_rig(train, state, joint.sigma_px, FROM_OPTIMUM).state
        part = observations.subset(test)
        found = refine_frames(part, solved.with_frames(state))
        for c, (own, weight) in enumerate(zip(part.cameras, part.weights, strict=True)):
            squared[c] += float(weighted_squares(found.of_camera(c, part), own, weight).sum())
            count[c] += float((weight > 0.0).sum())
    each = tuple(float(np.sqrt(s / n)) if n else None for s, n in zip(squared, count, strict=True))
    return float(np.sqrt(squared.sum() / count.sum())), each


def _is_connected(observations: RigObservations) -> bool:
    """Say whether every camera shares a pose with the first, or with those that hang together with it."""
    poses = [set(own.tolist()) for own in observations.frame]
    linked, rest = poses[0], poses[1:]
    while rest:
        near = [own for own in rest if own & linked]
        if not near:
            return False
        linked, rest = linked.union(*near), [own for own in rest if not own & linked]
    return True
