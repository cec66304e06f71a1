"""The prior of every camera: its centre, its aspect, its skew."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.cameras import sample_cameras

from rigkit.calibration.solving.camera_prior import CENTRE_SIGMA, DENOMINATOR_SIGMA, SQUARE_SIGMA, camera_prior
from rigkit.cameras.brown import Brown
from rigkit.cameras.scaramuzza import Scaramuzza

WIDTH, HEIGHT = 640, 480


def test_deviations_are_in_standard_deviations_of_what_is_expected() -> None:
    values = np.array([500.0, 520.0, 300.0, 250.0, 0.1, 0.0, 0.0, 0.0, 0.0, 0.3, -0.2, 0.1])
    rows, deviation = camera_prior(Brown((WIDTH, HEIGHT), values))
    reach = CENTRE_SIGMA * WIDTH
    expected = [
        (300.0 - 0.5 * (WIDTH - 1)) / reach,
        (250.0 - 0.5 * (HEIGHT - 1)) / reach,
        *(k / DENOMINATOR_SIGMA for k in (0.3, -0.2, 0.1)),
        # Of the ratio of the focal lengths.
        (500.0 / 520.0 - 1.0) / SQUARE_SIGMA,
    ]
    np.testing.assert_allclose(deviation, expected, rtol=0.03)
    np.testing.assert_allclose(deviation[:5], expected[:5], rtol=1e-12)
    # Moved to what is expected, nothing deviates.
    centred = values + np.linalg.lstsq(rows, -deviation, rcond=None)[0]
    np.testing.assert_allclose(camera_prior(Brown((WIDTH, HEIGHT), centred))[1], 0.0, atol=1e-9)
    fisheye = sample_cameras()["scaramuzza"]
    assert isinstance(fisheye, Scaramuzza)
    rows, deviation = camera_prior(fisheye)
    cx, cy, c, d = fisheye.parameters[-4:]
    middle, reach = (np.array(fisheye.size_px) - 1.0) / 2.0, CENTRE_SIGMA * max(fisheye.size_px)
    wanted = [(cx - middle[0]) / reach, (cy - middle[1]) / reach, (c - 1.0) / SQUARE_SIGMA, d / SQUARE_SIGMA]
    assert deviation == pytest.approx(wanted, rel=1e-12)
    assert rows.shape == (4, fisheye.parameters.size)
    # The fourth term of Kannala and Brandt is no denominator.
    assert len(camera_prior(sample_cameras()["kannala_brandt"])[1]) == 3
