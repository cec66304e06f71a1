"""What is known of every camera before any view: pixels are square, and the lens sits roughly before the sensor.

The standard deviations are so wide that a dozen views do not feel them (a centre known to 0.1 px is pulled by a
millionth of that). One or two views do not determine a lens by themselves: these keep them from running away.
"""

from __future__ import annotations

import numpy as np

from rigkit.cameras.base import Camera, image_center
from rigkit.core.arrays import FloatArray

CENTRE_SIGMA = 0.15
"""Of the distance from the middle of the image to the optical axis, as a part of the image's longer side."""
SQUARE_SIGMA = 0.01
"""Of the ratio of the pixel's sides, and of its skew."""

DENOMINATOR_SIGMA = 1.0
"""Of the denominator's coefficients in the rational distortion: numerator and denominator can grow together for ever
(to 1e3, without convergence) while their ratio stays."""


def camera_prior(camera: Camera) -> tuple[FloatArray, FloatArray]:
    """Return d r / d parameters (m, P) and r (m,): departures from what is expected, in standard deviations."""
    names, values = camera.parameter_names(), camera.parameters
    middle = image_center(camera.size_px).tolist()
    reach = CENTRE_SIGMA * max(camera.size_px)
    expected = {
        "cx": (middle[0], reach),
        "cy": (middle[1], reach),
        "c": (1.0, SQUARE_SIGMA),
        "d": (0.0, SQUARE_SIGMA),
    }
    if "k6" in names:
        expected |= dict.fromkeys(("k4", "k5", "k6"), (0.0, DENOMINATOR_SIGMA))
    known = [name for name in expected if name in names]
    index = np.array([names.index(name) for name in known], dtype=np.int64)
    mean, sigma = np.array([expected[name] for name in known]).reshape(-1, 2).T
    has_two_focals = "fx" in names and "fy" in names
    rows = np.zeros((len(known) + has_two_focals, len(names)))
    residuals = np.empty(len(rows))
    rows[np.arange(len(known)), index] = 1.0 / sigma
    residuals[: len(index)] = (values[index] - mean) / sigma
    if has_two_focals:
        x, y = names.index("fx"), names.index("fy")
        fx, fy = float(values[x]), float(values[y])
        size = SQUARE_SIGMA * 0.5 * (abs(fx) + abs(fy))
        rows[-1, x], rows[-1, y], residuals[-1] = 1.0 / size, -1.0 / size, (fx - fy) / size
    return rows, residuals
