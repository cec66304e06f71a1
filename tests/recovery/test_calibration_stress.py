"""The conditions under which calibrations usually fail: each is solved, and nothing is dropped without a reason."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest
from helpers.calibration_scenes import CENTRE, REACH_DEG, SIZE, lens, random_views, with_outliers

from rigkit.calibration.calibrate import calibrate
from rigkit.core.errors import DegenerateError

FEW_SEEDS, SEEDS = 2, 20
RMS_FACTOR = 1.25
"""Training RMS over what the noise leaves after fitting: 1 but for chance (54 corners of one view: +-10 %); a lost view
or a wrong minimum gives 2 and more."""
OUTLIER_PX = 40.0


class Case(NamedTuple):
    lens: str
    model: str
    degree: int | None
    views: int = 20
    reach_deg: float | None = None
    centre: tuple[float, float] = (float(CENTRE[0]), float(CENTRE[1]))
    tilt_deg: tuple[float, float] = (10.0, 45.0)
    noise_px: float = 0.2
    outliers: float = 0.0


KB = ("kannala_brandt", None)
LENSES = [("reg", "brown", 5), ("wide", *KB), ("fish", *KB), ("fish", "scaramuzza", 6), ("fish200", "scaramuzza", 8)]
CASES = {f"to-{reach}": Case("fish", *KB, reach_deg=reach) for reach in (60.0, 75.0, 85.0, 92.5)}
CASES["to-100"] = Case("fish200", *KB, reach_deg=100.0)
for _lens in LENSES:
    _name = f"{_lens[0]}-{_lens[1]}"
    CASES |= {
        f"{_name}-5-views": Case(*_lens, views=5),
        f"{_name}-2-views": Case(*_lens, views=2),
        f"{_name}-1-view": Case(*_lens, views=1),
        f"{_name}-near-parallel": Case(*_lens, tilt_deg=(0.0, 5.5)),
        f"{_name}-centre-off-250": Case(*_lens, centre=(1058.0, 515.0)),
        f"{_name}-outliers": Case(*_lens, outliers=0.05),
        f"{_name}-4-views-1px-outliers": Case(*_lens, views=4, noise_px=1.0, outliers=0.05),
    }


REFUSED = {"reg-brown-1-view": 1, "fish200-scaramuzza-1-view": 7, "fish200-scaramuzza-2-views": 1}
"""Refused, and rightly, in so many of twenty seeds: the only view is tilted by 9 degrees against the image, and with
five terms of distortion its focal length comes out as 1064 +- 969 px where 1364 is true; one or two views leave the
coefficients of a polynomial of degree 8 open beyond what arithmetic resolves, so that no covariance can be stated."""
REFUSALS = ("do not determine the focal length", "not identifiable from these images")


def failure(case: Case, seed: int) -> str | None:
    """Return what went wrong with one set of views, None if nothing."""
    rng = np.random.default_rng(1000 + seed)
    reach = case.reach_deg or REACH_DEG[case.lens]
    camera = lens(case.lens, np.array(case.centre))
    views, _, _ = random_views(camera, case.views, rng, reach_deg=reach, tilt_deg=case.tilt_deg, noise_px=case.noise_px)
    views = with_outliers(views, case.outliers, OUTLIER_PX, rng)
    try:
        result = calibrate(views, SIZE, model=case.model, degree=case.degree, board="flat", folds=0)
    except DegenerateError as error:
        return str(error)
    unknowns = result.camera.parameters.size + 6 * case.views
    freedom = 1.0 - unknowns / (2 * result.corner_count)
    expected = case.noise_px * np.sqrt(2.0 * freedom)
    if len(result.views) < case.views:
        return f"dropped: {result.dropped}"
    if result.rms_px > RMS_FACTOR * expected:
        return f"RMS {result.rms_px:.3f}, expected {expected:.3f}"
    if case.outliers == 0.0 and len(result.outliers) > 1:
        return f"{len(result.outliers)} outliers among good corners"
    return None


@pytest.mark.parametrize("name", sorted(CASES))
def test_solved(name: str) -> None:
    failures = {seed: why for seed in range(FEW_SEEDS) if (why := failure(CASES[name], seed))}
    assert not failures or (name in REFUSED and all(any(r in why for r in REFUSALS) for why in failures.values()))


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(CASES))
def test_solved_twenty_times(name: str) -> None:
    failures = {seed: why for seed in range(SEEDS) if (why := failure(CASES[name], seed))}
    assert len(failures) <= REFUSED.get(name, 0), failures
    assert all(any(r in why for r in REFUSALS) for why in failures.values()), failures
