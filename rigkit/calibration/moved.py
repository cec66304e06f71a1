"""Whether the lens stayed as it was while the images were taken: the first half of them against the second."""

from __future__ import annotations

import numpy as np

from rigkit.arrays import BoolArray
from rigkit.calibration.fit import Fit, fit_kept
from rigkit.calibration.observations import Observations
from rigkit.calibration.solver import evaluate

__all__ = ["moved_lens"]

MIN_IMAGES = 10
SIGMAS = 3.0
"""Halves this far apart (root of the mean squared distance of the parameters, in standard deviations) may be two
lenses."""
AGAINST_MIXED = 2.5
"""They are, if even and odd images, in which every time is mixed, agree better by this factor: errors of the board set
all halves apart alike."""


def moved_lens(observations: Observations, fit: Fit) -> tuple[str, ...]:
    """Return a verdict if the two halves of the images, in the order given, have different intrinsics."""
    images = list(dict.fromkeys(observations.images))
    if len(images) < MIN_IMAGES:
        return ()
    number = np.array([images.index(name) for name in observations.images])
    distance = _apart(observations, fit, number >= len(images) // 2)
    if not distance > SIGMAS or not distance > AGAINST_MIXED * _apart(observations, fit, number % 2 == 1):
        return ()
    return (
        f"bad: the lens (or the board) was another one in the second half of the images, from "
        f"'{images[len(images) // 2]}' on ({distance:.0f} standard deviations): focus, zoom or mount moved; calibrate "
        "the halves apart, or retake all",
    )


def _apart(observations: Observations, fit: Fit, second: BoolArray) -> float:
    """Return how far apart the intrinsics of the two sets of views are: by how much the cost falls when each has its
    own, which for one and the same lens is sigma^2 a parameter."""
    whole, split, count = 0.0, 0.0, 0
    for chosen in (np.flatnonzero(~second), np.flatnonzero(second)):
        part = observations.subset(chosen)
        kept = fit.kept[chosen]
        own = fit_kept(part, fit.state.subset(chosen), kept)
        for state in (fit.state.subset(chosen), own.state):
            squared = (evaluate(state, part).px ** 2).sum(axis=-1) * part.weight**2
            if state is own.state:
                split += float(squared[kept].sum())
            else:
                whole += float(squared[kept].sum())
        count += 2 * int(kept.sum()) - 6 * len(chosen)
    p = fit.state.camera.parameters.size
    variance = split / max(count - 2 * p, 1)
    return float(np.sqrt(max(whole - split, 0.0) / (p * variance))) if variance > 0.0 else 0.0
