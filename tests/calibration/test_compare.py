"""Comparison of calibrations: a camera does not differ from itself, nor in another lens model; a moved lens does."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from helpers.calibration_scenes import REACH_DEG, lens, random_views

from rigkit.calibration import compare
from rigkit.calibration.calibrate import calibrate
from rigkit.calibration.compare import compare_calibrations
from rigkit.calibration.result import Calibration
from rigkit.calibration.solving.clustered import drawn_errors

SEEDS = 6
MOVED_PX = 3.0
"""A focal length that changed by this much is a lens that was touched; calibrations here know it to 0.3 px."""


@pytest.fixture(scope="module")
def calibrations() -> list[Calibration]:
    """Calibrations of one camera from different views."""
    out = []
    for seed in range(SEEDS):
        camera = lens("fish")
        views, _, _ = random_views(camera, 15, np.random.default_rng(seed), reach_deg=REACH_DEG["fish"])
        out.append(calibrate(views, camera.size_px, model="kannala_brandt", board="flat"))
    return out


def test_calibrations_of_one_camera_do_not_differ(calibrations: list[Calibration]) -> None:
    results = [compare_calibrations(a, b) for a, b in itertools.pairwise(calibrations)]
    assert all(result.same for result in results)
    ratio = float(np.median([result.ratio for result in results]))
    assert 0.4 < ratio < 1.6
    assert np.median([result.chance for result in results]) > 0.1


def test_a_moved_lens_differs(calibrations: list[Calibration]) -> None:
    a, b = calibrations[0], calibrations[1]
    shift = np.zeros(b.camera.parameters.size)
    shift[:2] = MOVED_PX
    moved = replace(b, camera=b.camera.with_parameters(b.camera.parameters + shift))
    result = compare_calibrations(a, moved)
    assert not result.same
    assert result.ratio > 2.0


@pytest.fixture(scope="module")
def in_other_models() -> dict[str, list[Calibration]]:
    """Calibrations of the same camera in other models, from other views, exact enough for the models to show."""
    out: dict[str, list[Calibration]] = {}
    kinds = {"kannala_brandt": None, "scaramuzza 5": 5, "scaramuzza 6": 6}
    for (name, degree), offset in zip(kinds.items(), (20, 40, 60), strict=True):
        for seed in range(3):
            camera = lens("fish")
            rng = np.random.default_rng(offset + seed)
            views, _, _ = random_views(camera, 14, rng, reach_deg=REACH_DEG["fish"], noise_px=0.1)
            model = name.split()[0]
            result = calibrate(views, camera.size_px, model=model, degree=degree, board="flat", folds=0)
            out.setdefault(name, []).append(result)
    return out


def test_one_camera_in_two_models_does_not_differ(in_other_models: dict[str, list[Calibration]]) -> None:
    """The polynomials are off this lens by several times what chance does to them."""
    ratios = []
    for a, b in itertools.combinations(in_other_models, 2):
        for first, second in zip(in_other_models[a], in_other_models[b], strict=True):
            result = compare_calibrations(first, second)
            assert result.same and not result.same_model, (a, b, result.ratio)
            ratios.append(result.ratio)
    assert 0.4 < np.median(ratios) < 1.6


def test_differences_between_models_of_one_lens_are_allowed_for(
    in_other_models: dict[str, list[Calibration]], monkeypatch: pytest.MonkeyPatch
) -> None:
    # Surer than the models are alike.
    pair = [
        replace(c, covariance=1e-2 * c.covariance, frame_covariance=1e-2 * c.frame_covariance)
        for c in (in_other_models["kannala_brandt"][0], in_other_models["scaramuzza 5"][0])
    ]
    allowed = compare_calibrations(*pair)
    monkeypatch.setattr(
        compare, "_model_difference", lambda a, b, difference, turn: np.zeros(2 * int(difference.covered.sum()))
    )
    assert compare_calibrations(*pair).predicted_px < 0.8 * allowed.predicted_px


def test_a_moved_lens_differs_in_another_model_too(in_other_models: dict[str, list[Calibration]]) -> None:
    for name in ("scaramuzza 5", "scaramuzza 6"):
        for first, second in zip(in_other_models["kannala_brandt"], in_other_models[name], strict=True):
            grown = np.array(first.camera.parameters)
            grown[:2] += MOVED_PX
            assert not compare_calibrations(replace(first, camera=first.camera.with_parameters(grown)), second).same


def test_a_moved_principal_point_is_found_in_either_model(in_other_models: dict[str, list[Calibration]]) -> None:
    """Most of it is a rotation of the lens: a part of the pixel remains, in a direction that all views know well."""
    for name in ("kannala_brandt", "scaramuzza 5", "scaramuzza 6"):
        first, second = in_other_models["kannala_brandt"][0], in_other_models[name][1]
        moved = np.array(first.camera.parameters)
        moved[2:4] += (MOVED_PX, 0.5 * MOVED_PX)
        result = compare_calibrations(replace(first, camera=first.camera.with_parameters(moved)), second)
        assert result.difference.rms_px < 0.5 * MOVED_PX and not result.same, (name, result.ratio, result.chance)


def test_a_significant_difference_has_a_p_value_below_one_tenth() -> None:
    """Of several answers the chance takes the one that says most: what lay just beyond nineteen of twenty sizes stood
    beyond "nine of ten cases" beside a chance of .15."""
    sigma = np.array([2.0, 1.0, 0.8, 0.6])
    null = sigma[:, None] * np.random.default_rng(0).normal(size=(4, 4000))
    sizes = np.sqrt((null**2).sum(axis=0))

    def asked(size: float) -> tuple[float, float]:
        modes = compare._Modes(np.eye(4), np.array([size, 0.0, 0.0, 0.0]), null, sigma**2, 0.0)
        return modes.chance([np.eye(4)[:, [k]] for k in (1, 2, 3)])

    chance, unusual = asked(float(np.quantile(sizes, 0.952)))
    assert chance > 0.13
    assert 0.02 < unusual < 0.045
    chance, _ = asked(float(np.quantile(sizes, 1.0 - unusual)) + 1e-3)
    assert 0.08 < chance <= 0.1 + 1e-3


def test_nine_of_ten_differences_are_not_significant(calibrations: list[Calibration]) -> None:
    a, b = calibrations[:2]
    # Errors as one camera's two calibrations have them, each as if it were found.
    step = drawn_errors(a.covariance, a.freedom, np.random.default_rng(1)).T
    inside = 0
    for k in range(100):
        moved = replace(a, camera=b.camera.with_parameters(b.camera.parameters + np.sqrt(2.0) * step[k]))
        result = compare_calibrations(moved, b, grid=(24, 18))
        low, high = result.interval_px
        assert low < result.predicted_px < high
        inside += low <= result.difference.rms_px <= high
        assert result.difference.rms_px <= high or result.chance <= 0.1 + 2e-3
    assert 78 <= inside <= 99
