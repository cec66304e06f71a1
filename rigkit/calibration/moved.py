"""Whether the lens stayed as it was while the images were taken: the first half of them against the second."""

from __future__ import annotations

import numpy as np

from rigkit.arrays import BoolArray, FloatArray, IntArray
from rigkit.calibration.assemble import solution_normal
from rigkit.calibration.fit import Fit, fit_kept
from rigkit.calibration.observations import Observations
from rigkit.calibration.result import Calibration

__all__ = ["moved_lens"]

MIN_IMAGES = 10
SIGMAS = 3.0
"""Halves further apart than this (root of the mean squared distance in standard deviations) may be two lenses."""
AGAINST_MIXED = 2.0
"""They are, if even and odd images, in which every time is mixed, agree better by this factor: errors of the board,
which the covariance does not know, set all halves apart alike."""


def moved_lens(observations: Observations, fit: Fit, result: Calibration) -> tuple[str, ...]:
    """Return a verdict if the two halves of the images, in the order given, have different intrinsics."""
    images = list(dict.fromkeys(observations.images))
    if len(images) < MIN_IMAGES or result.sigma_px <= 0.0:
        return ()
    number = np.array([images.index(name) for name in observations.images])
    distance = _halves(observations, fit, number >= len(images) // 2)
    if not distance > SIGMAS or not distance > AGAINST_MIXED * _halves(observations, fit, number % 2 == 1):
        return ()
    return (
        f"bad: the lens was another one in the second half of the images (from '{images[len(images) // 2]}' on, "
        f"{distance:.0f} standard deviations): focus, zoom or mount moved; calibrate the halves apart, or retake all",
    )


def _halves(observations: Observations, fit: Fit, second: BoolArray) -> float:
    first, cov_first = _half(observations, fit, np.flatnonzero(~second))
    other, cov_other = _half(observations, fit, np.flatnonzero(second))
    return _distance(first - other, cov_first + cov_other)


def _half(observations: Observations, fit: Fit, chosen: IntArray) -> tuple[FloatArray, FloatArray]:
    part = observations.subset(chosen)
    own = fit_kept(part, fit.state.subset(chosen), fit.kept[chosen])
    p = own.state.camera.parameters.size
    covariance = solution_normal(part, own).covariance()[0][:p, :p] * own.sigma_px**2
    return own.state.camera.parameters, covariance


def _distance(difference: FloatArray, covariance: FloatArray) -> float:
    """Return the root mean squared distance in standard deviations, 0 where the covariance says nothing."""
    scale = np.sqrt(np.maximum(np.diag(covariance), np.finfo(float).tiny))
    scaled = covariance / scale[:, None] / scale
    try:
        squared = float((difference / scale) @ np.linalg.solve(scaled, difference / scale))
    except np.linalg.LinAlgError:
        return 0.0
    return float(np.sqrt(max(squared, 0.0) / len(difference))) if np.isfinite(squared) else 0.0
