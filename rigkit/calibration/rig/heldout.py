"""The error of a rig on frames that took no part in it: its headline."""

from __future__ import annotations

import numpy as np

from rigkit.calibration.rig.joint import JointRig
from rigkit.calibration.rig.solver import refine_frames, solve_rig

__all__ = ["heldout_rms"]

TOLERANCE = 1e-6
"""A fold begins at the solution of all frames: a step that promises less of the cost changes no digit shown."""


def heldout_rms(joint: JointRig, folds: int) -> tuple[float | None, tuple[float | None, ...]]:
    """Return the 2-D RMS over frames that took no part, of all cameras together and of each: cameras, mounts, places
    and shapes of boards from the other frames, only one pose a target refitted, by all cameras at once. None with fewer
    frames than folds.

    It counts what a held-out error of single cameras cannot see: cameras that disagree.
    """
    observations, state = joint.observations, joint.solution.state
    frame = joint.frames
    nothing = None, (None,) * len(observations.cameras)
    # Poses that no two views share say nothing about the rig.
    if folds < 2 or int(frame.max()) + 1 < folds:
        return nothing
    squared, count = np.zeros(len(observations.cameras)), np.zeros(len(observations.cameras))
    for k in range(folds):
        test = frame % folds == k
        train = observations.subset(~test)
        if any(not len(own.views) for own in train.cameras):
            return nothing
        solved = solve_rig(train, state, joint.sigma_px, TOLERANCE).state
        part = observations.subset(test)
        _, normal = refine_frames(part, solved.with_frames(state))
        for c, (residuals, weight) in enumerate(zip(normal.residuals, part.weights, strict=True)):
            used = weight > 0.0
            squared[c] += float((residuals.px**2).sum(axis=-1)[used].sum())
            count[c] += float(used.sum())
    each = tuple(float(np.sqrt(s / n)) if n else None for s, n in zip(squared, count, strict=True))
    return float(np.sqrt(squared.sum() / count.sum())), each
