"""Cross-validation: the error of a fit on images that were left out of it."""

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
"""Smallest number of images for leave-one-out: two others still determine a camera."""


def heldout_squares(observations: Observations, fit: Fit, folds: int) -> FloatArray | None:
    """Return the sum of squared held-out residuals, px^2, of the inliers of each image: camera and board shapes are
    those of the other folds, only the poses of its boards are fitted. Near-duplicate images are in one fold. With fewer
    images than folds each image is a fold. None with less than MIN_IMAGES_OF_FIT different images.

    Residuals are weighted as in the solution, so that blurred images count less.
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
