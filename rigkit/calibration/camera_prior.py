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
    names = camera.parameter_names()
    values = camera.parameters
    middle = image_center(camera.size_px)
    reach = CENTRE_SIGMA * max(camera.size_px)
    rows, residuals = [], []

    def add(entries: dict[str, float], residual: float) -> None:
        row = np.zeros(len(names))
        for name, value in entries.items():
            row[names.index(name)] = value
        rows.append(row)
        residuals.append(residual)

    for name, expected, sigma in (
        ("cx", middle[0], reach),
        ("cy", middle[1], reach),
        ("c", 1.0, SQUARE_SIGMA),
        ("d", 0.0, SQUARE_SIGMA),
    ):
        if name in names:
            add({name: 1.0 / sigma}, float(values[names.index(name)] - expected) / sigma)
    if "fx" in names and "fy" in names:
        fx, fy = values[names.index("fx")], values[names.index("fy")]
        size = SQUARE_SIGMA * 0.5 * (abs(fx) + abs(fy))
        add({"fx": 1.0 / size, "fy": -1.0 / size}, float(fx - fy) / size)
    if "k6" in names:
        for name in ("k4", "k5", "k6"):
            add({name: 1.0 / DENOMINATOR_SIGMA}, float(values[names.index(name)]) / DENOMINATOR_SIGMA)
    return np.array(rows).reshape(-1, len(names)), np.array(residuals)
