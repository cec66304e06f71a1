"""Covariances clustered by image: right for independent errors of corners and for errors that an image shares."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from helpers.calibration_scenes import REACH_DEG, lens, random_views
from helpers.session_scenes import FAIR_PX, GOOD_PX, IMAGES_PX, disturbed, longer, sessions
from scipy.special import ndtr, stdtr

from rigkit.calibration.assemble import assemble
from rigkit.calibration.compare import CameraVerdict, compare_calibrations
from rigkit.calibration.result import Calibration
from rigkit.calibration.solving import clustered
from rigkit.calibration.solving.clustered import (
    SERIAL_LAGS,
    SERIAL_POWER,
    _serial_moments,
    clustered_covariance,
    products_between,
    root_of_inverse,
    summed_by,
    widening,
    with_block,
    without_leverage,
)
from rigkit.calibration.solving.fit import fit_kept
from rigkit.calibration.solving.state import State
from rigkit.calibration.views.observations import Observations
from rigkit.core.arrays import FloatArray
from rigkit.core.detections import BoardView

RUNS, VIEWS = 40, 15
RATIO = (0.75, 1.3)
"""Observed over predicted standard deviation, root mean square over parameters and runs: 40 runs of 15 views know it to
about 10 %."""
FEW_RUNS = 20
FEW_RATIO = (0.7, 2.2)
"""The same of three images, median of runs: 1.4, and 4.3 if corners are taken for independent."""
MOVED_PX = {"reg": 2.47, "wide": 1.82, "fish": 0.46}
"""Along x, and half as much along y: 0.2 px rms remain after the best rotation."""


def calibrated(views: list[BoardView], start: State) -> Calibration:
    observations = Observations.from_views(views)
    return assemble(observations, fit_kept(observations, start, observations.present), None, (), ())


@pytest.mark.parametrize("images_px", [0.0, IMAGES_PX])
def test_sigmas_are_right_for_errors_of_corners_and_of_whole_images(images_px: float) -> None:
    rng = np.random.default_rng(5)
    camera = lens("wide")
    squared, predicted, overdispersion = [], [], []
    for _ in range(RUNS):
        views, rotation, translation = random_views(camera, VIEWS, rng, reach_deg=REACH_DEG["wide"], noise_px=0.0)
        views = disturbed(views, rng, images_px)
        result = calibrated(views, State.start(camera, rotation, translation, Observations.from_views(views)))
        squared.append((result.camera.parameters - camera.parameters) ** 2)
        predicted.append(np.diag(result.covariance))
        overdispersion.append(result.overdispersion)
    ratio = float(np.sqrt((np.mean(squared, axis=0) / np.mean(predicted, axis=0)).mean()))
    assert RATIO[0] < ratio < RATIO[1]
    # Independent corners would promise as many times too much.
    assert (np.median(overdispersion) > 1.5) == (images_px > 0.0)


def test_power_and_false_alarms() -> None:
    results = sessions("fish", GOOD_PX, 4)
    for a, b in itertools.pairwise(results):
        assert compare_calibrations(a, b).verdict is not CameraVerdict.OTHER
    assert compare_calibrations(results[0], longer(results[1])).verdict is CameraVerdict.OTHER


@pytest.mark.parametrize("name", ["reg", "wide", "fish"])
def test_a_moved_principal_point_is_found_behind_an_uncertain_focal_length(name: str) -> None:
    """Of the move hardly more is left than what the focal length does by chance, but it is of another kind."""
    results = sessions(name, FAIR_PX if name != "fish" else 0.0, 2)
    moved = np.array(results[1].camera.parameters)
    moved[2:4] += MOVED_PX[name] * np.array([1.0, 0.5])
    touched = replace(results[1], camera=results[1].camera.with_parameters(moved))
    found = compare_calibrations(results[0], touched)
    assert found.verdict is CameraVerdict.OTHER
    assert found.difference.rms_px < 2.0 * found.interval_px[1]


def test_one_cluster_leaves_the_covariance_unchanged() -> None:
    unit = np.diag([1.0, 4.0])
    found = clustered_covariance(unit, np.eye(2)[None], np.ones((1, 2)), np.zeros((2, 2)), 0.5)
    assert (found.covariance == 0.25 * unit).all() and found.overdispersion == 1.0 and np.isinf(found.freedom)


def test_images_that_agree_too_well_do_so_by_chance(rng: np.random.Generator) -> None:
    """With half of the pulls that independent corners have, sigmas stay those of independent corners."""
    rows = rng.normal(size=(8, 60, 3))
    information = np.swapaxes(rows, 1, 2) @ rows
    score = 0.5 * np.einsum("vrn,vr->vn", rows, rng.normal(size=(8, 60)))
    unit = np.linalg.inv(information.sum(axis=0))
    found = clustered_covariance(unit, information, score, np.zeros((3, 3)), 1.0)
    assert found.overdispersion == 1.0
    assert np.trace(found.covariance @ np.linalg.inv(unit)) == pytest.approx(3.0)


def test_three_images_say_how_much_they_disagree() -> None:
    camera, squared, predicted = lens("fish"), [], []
    rng = np.random.default_rng(8)
    for _ in range(FEW_RUNS):
        views, rotation, translation = random_views(camera, 3, rng, reach_deg=REACH_DEG["fish"], noise_px=0.0)
        views = disturbed(views, rng, IMAGES_PX)
        result = calibrated(views, State.start(camera, rotation, translation, Observations.from_views(views)))
        assert 1.0 <= result.freedom <= 2.0
        squared.append((result.camera.parameters - camera.parameters) ** 2)
        predicted.append(np.diag(result.covariance))
    ratio = float(np.median(np.sqrt(np.mean(np.array(squared) / predicted, axis=1))))
    assert FEW_RATIO[0] < ratio < FEW_RATIO[1]


def test_what_follows_the_block(rng: np.random.Generator) -> None:
    root = rng.normal(size=(7, 7)) * 10.0 ** rng.uniform(-4.0, 4.0, 7)[:, None]
    covariance = root @ root.T
    assert with_block(covariance, covariance[:4, :4], 1.0) == pytest.approx(covariance, rel=1e-6)
    # Twice the block and twice the rest is twice the whole.
    assert with_block(covariance, 2.0 * covariance[:4, :4], 2.0) == pytest.approx(2.0 * covariance, rel=1e-6)


@pytest.mark.parametrize("count", [9, 40])
def test_little_leverage_has_the_covariance_of_all_eigenvalues(
    count: int, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Clusters of little leverage take a series; one has so much that it does not."""
    rows = rng.normal(size=(30, 60, count)) * np.where(np.arange(30) == 7, 4.0, 1.0)[:, None, None]
    information = np.swapaxes(rows, 1, 2) @ rows
    score = np.einsum("vrn,vr->vn", rows, rng.normal(size=(30, 60)))
    prior = np.eye(count)
    unit = np.linalg.inv(information.sum(axis=0) + prior)
    by_series = clustered_covariance(unit, information, score, prior, 1.0)
    monkeypatch.setattr(clustered, "MAX_FOR_SERIES", 0.0)
    by_eigenvalues = clustered_covariance(unit, information, score, prior, 1.0)
    assert by_series.overdispersion == pytest.approx(by_eigenvalues.overdispersion, rel=1e-10)
    scale = np.abs(by_eigenvalues.covariance).max()
    assert by_series.covariance == pytest.approx(by_eigenvalues.covariance, abs=1e-10 * scale)


def in_order(alike: float, count: int, rng: np.random.Generator) -> FloatArray:
    """Return the errors (count, 2) of frames, each `alike` the one before to this part."""
    errors = rng.normal(size=(count, 2))
    for k in range(1, count):
        errors[k] = alike * errors[k - 1] + np.sqrt(1.0 - alike**2) * errors[k]
    return errors


@pytest.mark.parametrize(("alike", "low", "high"), [(0.0, 0.9, 1.1), (0.6, 1.35, 2.0)])
def test_autocorrelated_frames_have_fewer_degrees_of_freedom(alike: float, low: float, high: float) -> None:
    """The mean of frames scatters by 1 and by 2 (first order: sqrt((1 + .6) / (1 - .6))) times 1 / sqrt(N)."""
    rng, count = np.random.default_rng(5), 60
    information = np.tile(np.eye(2), (count, 1, 1))
    unit, stated, freedom = np.eye(2) / count, [], []
    for _ in range(40):
        score = in_order(alike, count, rng)
        own = clustered_covariance(unit, information, score - score.mean(axis=0), np.zeros((2, 2)), 1.0, in_order=True)
        stated.append(np.trace(own.covariance) * count / 2.0)
        freedom.append(own.freedom)
    assert low < np.sqrt(np.mean(stated)) < high
    # Which frames are neighbours tells nothing where nobody says that they are in order.
    own = clustered_covariance(unit, information, score - score.mean(axis=0), np.zeros((2, 2)), 1.0)
    assert own.freedom == pytest.approx(count - 1.0)
    assert (np.median(freedom) < 0.7 * own.freedom) == (alike > 0.0)


@pytest.mark.parametrize("sigmas", [2.0, 4.0])
def test_widened_sigmas_contain_as_much_as_of_a_normal_distribution(sigmas: float) -> None:
    reach = sigmas * widening(8.0, sigmas)
    assert stdtr(8.0, -reach) == pytest.approx(ndtr(-sigmas))
    assert widening(1e9, sigmas) == 1.0


def test_the_moments_of_a_sum_include_what_successive_scores_share(rng: np.random.Generator) -> None:
    """Of an autoregression of factor r the covariances decrease as r^k; weights of Newey and West, 1 - k / (m + 1)."""
    count, factor = 4000, 0.7
    noise, scores = rng.normal(size=(count, 2)), np.zeros((count, 2))
    for k in range(1, count):
        scores[k] = factor * scores[k - 1] + noise[k]
    moments, alike = _serial_moments(scores)
    lags = np.arange(1, int(SERIAL_LAGS * (count / 100.0) ** SERIAL_POWER) + 1)
    expected = 1.0 + 2.0 * np.sum((1.0 - lags / (len(lags) + 1.0)) * factor**lags)
    assert alike == pytest.approx(expected, rel=0.05)
    np.testing.assert_allclose(np.diag(moments) / (scores**2).sum(axis=0), expected, rtol=0.1)
    # In a random order there is nothing alike, beyond SERIAL_SIGMAS by chance.
    found = [_serial_moments(rng.permutation(scores)[:200])[1] for _ in range(100)]
    assert np.mean(np.array(found) != 1.0) < 0.05


def test_products_of_scores_are_those_of_scores_without_leverage(rng: np.random.Generator) -> None:
    rows = rng.normal(size=(9, 12, 3)) * np.r_[4.0, np.ones(8)][:, None, None]
    information, score = np.swapaxes(rows, 1, 2) @ rows, rng.normal(size=(9, 3, 2))
    root = root_of_inverse(information.sum(axis=0))
    leverage = root.T @ information @ root
    size = np.linalg.norm(leverage, axis=(1, 2))
    assert size[1:].max() < 0.8 < size[0]  # Both ways are taken.
    each = np.stack([without_leverage(leverage, own @ root) for own in np.moveaxis(score, 2, 0)])
    assert np.allclose(products_between(root, information, score), np.einsum("avi,bvi->ab", each, each))


@pytest.mark.parametrize("group", [[0, 1, 2, 3], [2, 0, 3, 1], [1, 0, 1, 1], [3, 3, 0, 3]])
def test_sums_by_group(group: list[int], rng: np.random.Generator) -> None:
    values = rng.normal(size=(4, 2, 3))
    expected = np.zeros((max(group) + 1, 2, 3))
    np.add.at(expected, group, values)
    assert np.allclose(summed_by(np.array(group), values), expected)
