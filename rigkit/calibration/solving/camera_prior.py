"""Priors that hold for every camera: pixels are nearly square, and the lens is roughly centred on the sensor.

They are so wide that they do not affect a dozen views (a centre known to 0.1 px is shifted by a millionth of that). One
or two views do not determine a lens by themselves: there the priors keep the solution bounded.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from rigkit.cameras.base import Camera, image_center
from rigkit.core.arrays import FloatArray

CENTRE_SIGMA = 0.15
"""Of the distance between image centre and principal point, as a part of the image's longer side."""
SQUARE_SIGMA = 0.01
"""Of the ratio of the pixel's sides, and of its skew."""

DENOMINATOR_SIGMA = 1.0
"""Of the coefficients in the denominator of the rational distortion model: numerator and denominator can grow together
without limit (to 1e3, without convergence) while their ratio stays the same."""


def camera_prior(camera: Camera) -> tuple[FloatArray, FloatArray]:
    """Return d r / d parameters (m, P) and r (m,), the deviations from the prior means in standard deviations."""
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
    """Return d r / d parameters (m, P) and the prior means (P,). With two focal lengths the last row is theirs; it
    depends on their values and is zero here."""
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
