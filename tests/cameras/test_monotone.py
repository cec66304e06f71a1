"""Inverting increasing functions: also where the slope vanishes and where a table is coarse."""

from __future__ import annotations

import numpy as np
import pytest

from rigkit.cameras.monotone import first_root, horner, invert_increasing


@pytest.mark.parametrize(
    ("polynomial", "end"),
    [
        ([0.0, 0.0, 0.0, 1.0], 2.0),  # the slope vanishes at the start,
        ([0.0, 1.0, 0.0, -1.0 / 3.0], 1.0),  # at the end,
        ([-1.0, 3.0, -3.0, 1.0], 2.0),  # in the middle
        ([0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 400.0], 3.0),
        ([0.5], 1.0),
    ],
)
@pytest.mark.parametrize("count", [3, 129])
def test_inverse(polynomial: list[float], end: float, count: int, rng: np.random.Generator) -> None:
    """Values come back even through a table of three points."""
    coefficients, linear = np.array(polynomial), float(len(polynomial) == 1)

    def function(x: np.ndarray) -> np.ndarray:
        return linear * x + horner(coefficients, x)

    knots = np.linspace(0.0, end, count)
    values = function(knots)
    target = np.concatenate([values[[0, -1]], rng.uniform(values[0], values[-1], 1000)])
    parts = np.full(1002, linear), np.ones(1002), target
    x = invert_increasing(coefficients, parts, target, knots, values)
    assert ((x >= 0.0) & (x <= end)).all()
    assert np.abs(function(x) - target).max() < 1e-13 * max(values[-1], 1.0)


def test_first_root() -> None:
    # (x - 2)(x - 3)(x + 1) = 6 + x - 4 x^2 + x^3
    cubic = np.array([6.0, 1.0, -4.0, 1.0])
    assert first_root(cubic, 10.0) == pytest.approx(2.0, abs=1e-12)
    assert first_root(cubic, 1.5) == 1.5
    assert first_root(np.array([1.0, 0.0, 0.0]), 7.0) == 7.0
    # A double root touches zero without crossing: there the derivative vanishes, which is an end as well.
    assert first_root(np.array([4.0, -4.0, 1.0]), 10.0) == pytest.approx(2.0, abs=1e-6)


def test_first_root_of_several() -> None:
    """The smallest root of all that are given together, whatever their degree."""
    cubic, line = np.array([6.0, 1.0, -4.0, 1.0]), np.array([3.0, -2.0, 0.0, 0.0])
    assert first_root(np.stack([cubic, line]), 10.0) == pytest.approx(1.5, abs=1e-12)
    assert first_root(np.stack([cubic, -line]), 1.0) == 1.0


def test_first_root_of_coefficients_in_pixels() -> None:
    """As in a lens polynomial: 1 - (x / 900)^8 has coefficients over 24 orders of magnitude."""
    coefficients = np.zeros(9)
    coefficients[[0, 8]] = 1.0, -(900.0**-8.0)
    assert first_root(coefficients, 2000.0) == pytest.approx(900.0, rel=1e-12)


def test_horner() -> None:
    x = np.array([0.5, -2.0])
    assert horner(np.array([1.0, 2.0, 3.0]), x).tolist() == [1.0 + 1.0 + 0.75, 1.0 - 4.0 + 12.0]
