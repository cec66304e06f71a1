"""What is known of every camera before any view: pixels are square, and the lens sits roughly before the sensor.

The standard deviations are so wide that a dozen views do not feel them (a centre known to 0.1 px is pulled by a
millionth of that). One or two views do not determine a lens by themselves: these keep them from running away.
"""

from __future__ import annotations

from functools import lru_cache

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
    rows, mean = _expected(names, camera.size_px)
    if "fy" not in names:
        return rows, rows @ (values - mean)
    x, y = names.index("fx"), names.index("fy")
    fx, fy = float(values[x]), float(values[y])
    rows, size = rows.copy(), SQUARE_SIGMA * 0.5 * (abs(fx) + abs(fy))
    rows[-1, x], rows[-1, y] = 1.0 / size, -1.0 / size
    return rows, rows @ (values - mean)


@lru_cache
def _expected(names: tuple[str, ...], size_px: tuple[int, int]) -> tuple[FloatArray, FloatArray]:
    """Return d r / d parameters (m, P), and the parameters (P,) of which r = 0; the last row, where there are two focal
    lengths, is theirs, and empty: it depends on them."""
    middle, reach = image_center(size_px).tolist(), CENTRE_SIGMA * max(size_px)
    expected = {"cx": (middle[0], reach), "cy": (middle[1], reach), "c": (1.0, SQUARE_SIGMA), "d": (0.0, SQUARE_SIGMA)}
    if "k6" in names:
        expected |= dict.fromkeys(("k4", "k5", "k6"), (0.0, DENOMINATOR_SIGMA))
    known = [name for name in expected if name in names]
    rows, mean = np.zeros((len(known) + ("fy" in names), len(names))), np.zeros(len(names))
    for row, name in zip(rows, known, strict=False):
        k = names.index(name)
        mean[k], row[k] = expected[name][0], 1.0 / expected[name][1]
    rows.flags.writeable = mean.flags.writeable = False
    return rows, mean
