"""The error of a fit on images that took no part in it: what lenses and shapes of boards are chosen by."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rigkit.calibration.solving.fit import Fit
from rigkit.calibration.solving.poses import refine_poses
from rigkit.calibration.solving.solver import FROM_OPTIMUM, solve
from rigkit.calibration.solving.state import weighted_squares
from rigkit.calibration.views.observations import Observations
from rigkit.core.arrays import FloatArray

MIN_IMAGES_OF_FIT = 3
"""So many images can be left out one at a time: two others still show a camera."""


def heldout_squares(observations: Observations, fit: Fit, folds: int) -> FloatArray | None:
    """Return the sum of squared residuals, px^2, of the kept corners of each image while it took no part: camera and
    shape from the other images, only the poses of its boards refitted. Images that repeat each other take part
    together, or not: else those that are left out would be known. Of fewer images than folds each is one. None with
    less than MIN_IMAGES_OF_FIT that differ.

    Residuals are weighted as in the solution, those of a corner of median quality: what blurred images say of a lens
    decides no more than it is worth.
    """
    if folds < 2:
        return None
    images = list(dict.fromkeys(observations.images))
    if int(observations.clusters().max()) + 1 < MIN_IMAGES_OF_FIT:
        return None
    place = {name: i for i, name in enumerate(images)}
    image = np.array([place[name] for name in observations.images])
    fold = observations.folds(folds)
    squared = np.zeros(len(images))
    weight = fit.weight(observations)
    for k in range(int(fold.max()) + 1):
        train, test = np.flatnonzero(fold != k), np.flatnonzero(fold == k)
        solved = solve(
            observations.subset(train),
            fit.state.subset(train),
            weight=weight[train],
            prior_sigma_px=fit.sigma_px,
            cost_tolerance=FROM_OPTIMUM,
        ).state
        part = observations.subset(test)
        start = fit.state.subset(test)
        moved = replace(solved, rotation=start.rotation, translation_mm=start.translation_mm)
        found, _ = refine_poses(part, moved, weight[test])
        np.add.at(squared, image[test], weighted_squares(found, part, weight[test]))
    return squared
