"""The calibrations' part of every sigma, against calibrations drawn from their covariance."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.board_scenes import fisheye_camera
from helpers.reconstructions import make_reconstruction

from rigkit.cameras.base import Camera
from rigkit.cameras.uncertain import UncertainCamera
from rigkit.core.arrays import principal_axes
from rigkit.core.truth import MeasuredAngle, MeasuredLength, PairTruth
from rigkit.reconstruction.calibration_shifts import calibration_shifts
from rigkit.reconstruction.reconstruct import Reconstruction
from rigkit.validation.checks import validate
from rigkit.validation.measure import measure

DRAWS = 20
SIGMA_RATIO = (0.55, 1.5)
"""Observed over predicted spread of 20 draws: its own standard deviation is 1 / sqrt(40) = 16 %; an axis left out or
counted twice is told by `test_principal_axes_add_up_to_the_covariance`."""
PAIRS = (("plane1", "plane2"), ("plane1", "plane3"), ("plane2", "plane3"))


def covariance_of(camera: Camera, rng: np.random.Generator) -> np.ndarray:
    """Correlated parameters, each good to about 1e-3 of itself or half a pixel."""
    sigma = np.where(np.abs(camera.parameters) > 1.0, 0.3, 3e-4)
    half = np.eye(len(sigma)) + 0.3 * rng.normal(size=(len(sigma), len(sigma)))
    return sigma[:, None] * (half @ half.T) * sigma


def test_principal_axes_add_up_to_the_covariance(rng: np.random.Generator) -> None:
    covariance = covariance_of(fisheye_camera(), rng)
    covariance[:, 3] = covariance[3, :] = 0.0  # a parameter that was not estimated
    axes = principal_axes(covariance)
    assert len(axes) == 7
    np.testing.assert_allclose(axes.T @ axes, covariance, atol=1e-12)


def exact(camera: Camera) -> Reconstruction:
    return make_reconstruction(camera=camera, baseline_sigma_mm=0.01)


@pytest.mark.parametrize("one_camera", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_predicted_share_is_the_observed_one(rng: np.random.Generator, one_camera: bool) -> None:
    made = exact(fisheye_camera())
    covariance = covariance_of(made.camera1, rng)
    known = UncertainCamera(made.camera1, covariance)
    shifts = calibration_shifts(made, known, None if one_camera else known)
    axes = principal_axes(covariance)
    values = []
    for _ in range(DRAWS):
        # Drawn calibrations: a single "axis" that is a random sum of all of them, estimated again by the same code.
        first = rng.normal(size=len(axes)) @ axes
        second = np.zeros_like(first) if one_camera else rng.normal(size=len(axes)) @ axes
        off = [UncertainCamera(made.camera1, np.outer(step, step)) for step in (first, second)]
        drawn = calibration_shifts(made, off[0], None if one_camera else off[1])
        moved = [[measure(r).angle_deg(*two)[0] for two in PAIRS] + [r.baseline_mm] for r in (drawn.base, *drawn.moved)]
        signs = rng.choice([-1.0, 1.0], size=len(moved) - 1)
        values.append(signs @ (np.array(moved[1:]) - moved[0]))
    with_share, without = measure(made, shifts), measure(made)
    predicted = [np.sqrt(with_share.angle_deg(*two)[1] ** 2 - without.angle_deg(*two)[1] ** 2) for two in PAIRS]
    predicted.append(np.sqrt(shifts.variance(lambda r: r.baseline_mm)))
    ratio = np.sqrt(np.mean(np.square(values), axis=0)) / predicted
    assert (ratio > SIGMA_RATIO[0]).all(), ratio
    assert (ratio < SIGMA_RATIO[1]).all(), ratio


def test_the_share_is_in_every_sigma_of_the_report(rng: np.random.Generator) -> None:
    made = exact(fisheye_camera())
    truth = PairTruth(MeasuredLength(297.3, 2.0, "rule"), (MeasuredAngle("plane1", "plane2", 90.0, 0.3, "square"),))
    shifts = calibration_shifts(made, UncertainCamera(made.camera1, covariance_of(made.camera1, rng)))
    plain, honest = validate(made, truth), validate(made, truth, shifts=shifts)
    for a, b in zip(plain.checks, honest.checks, strict=True):
        # Weights differ, exact points do not.
        assert a.ours == pytest.approx(b.ours, abs=1e-9)
        assert b.our_sigma > a.our_sigma + 1e-6
    assert honest.baseline_sigma_mm == honest.check("baseline").our_sigma
