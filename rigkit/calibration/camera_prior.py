"""What is known of every camera before any view: pixels are square, and the lens sits roughly before the sensor.

The standard deviations are so wide that a dozen views do not feel them (a centre known to 0.1 px is pulled by a
millionth of that). One or two views do not determine a lens by themselves: these keep them from running away.
"""

from __future__ import annotations

import numpy as np

from rigkit.arrays import FloatArray
from rigkit.cameras.base import Camera, image_center

__all__ = ["camera_prior"]

CENTRE_SIGMA = 0.15
"""Of the distance from the middle of the image to the optical axis, as a part of the image's longer side."""
SQUARE_SIGMA = 0.01
"""Of the ratio of the pixel's sides, and of its skew."""

DENOMINATOR_SIGMA = 1.0
"""Of the denominator's coefficients in the rational distortion: numerator and denominator can grow together for ever
(to 1e3, without convergence) while their ratio stays."""


def camera_prior(camera: Camera) -> tuple[FloatArray, FloatArray]:
    """Return d r / d parameters (m, P) and r (m,): departures from what is expected, in standard deviations."""
    place = {name: i for i, name in enumerate(camera.parameter_names())}
    values = camera.parameters.tolist()
    middle = image_center(camera.size_px).tolist()
    reach = CENTRE_SIGMA * max(camera.size_px)
    expected = {
        "cx": (middle[0], reach),
        "cy": (middle[1], reach),
        "c": (1.0, SQUARE_SIGMA),
        "d": (0.0, SQUARE_SIGMA),
    }
    if "k6" in place:
        expected |= dict.fromkeys(("k4", "k5", "k6"), (0.0, DENOMINATOR_SIGMA))
    known = [(place[name], *prior) for name, prior in expected.items() if name in place]
    square = "fx" in place and "fy" in place
    rows, residuals = np.zeros((len(known) + square, len(values))), np.zeros(len(known) + square)
    for row, (k, mean, sigma) in enumerate(known):
        rows[row, k], residuals[row] = 1.0 / sigma, (values[k] - mean) / sigma
    if square:
        x, y = place["fx"], place["fy"]
        sigma = SQUARE_SIGMA * 0.5 * (abs(values[x]) + abs(values[y]))
        rows[-1, x], rows[-1, y], residuals[-1] = 1.0 / sigma, -1.0 / sigma, (values[x] - values[y]) / sigma
    return rows, residuals
