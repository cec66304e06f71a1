"""The kernels of a sweep agree with their definitions in numpy."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
from kernels.reference import sweep as reference

from rigkit.kernels.sweep import fitted_level_planes, swept_costs, swept_rivals, swept_surfaces

SPACING = 8
RULES: dict[str, Any] = {"bend": 4, "jump": 48, "even": 8.0}
ROUNDED_BITS = 0.3
"""Of 24: weights are sixteenths, and their table has 16 steps to a factor e."""
MAX_DIFFERING = 2e-3
"""Share of costs: brightnesses that differ by less than single precision may be darker or not."""


def scene(rng: np.random.Generator, levels: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """An image, samples of another, and a table of places: a shift that grows from level to level."""
    image = cv2.GaussianBlur(rng.uniform(0.0, 255.0, (90, 120)), (0, 0), 1.5).astype(np.float32)
    samples = np.ascontiguousarray(image[:61, :75])
    at = np.stack(
        np.meshgrid(np.arange(0.0, 75.0 + SPACING, SPACING), np.arange(0.0, 61.0 + SPACING, SPACING)), axis=-1
    )
    table = at + np.array([0.7, 0.1]) * (np.arange(levels)[:, None, None, None] - 5.0)
    table[:, :2, :2] = np.nan
    samples[-1] = np.nan
    return image, samples, table.astype(np.float32)


@pytest.mark.parametrize("levels", [3, 16, 37])
def test_costs_and_surfaces_are_as_defined(rng: np.random.Generator, levels: int) -> None:
    image, samples, table = scene(rng, levels)
    ours, theirs = (fit(image, samples, table, SPACING) for fit in (swept_costs, reference.swept_costs))
    assert np.mean(ours[..., :levels] != theirs) < MAX_DIFFERING
    assert ours[..., :levels].max() > 18
    best, around = swept_surfaces(ours, levels, samples, **RULES)
    total = reference.total_costs(ours[..., :levels], samples, **RULES)
    np.testing.assert_array_equal(best, np.argmin(total, axis=2))
    np.testing.assert_array_equal(around[..., 0], total.min(axis=2))
    inner = np.clip(best, 1, levels - 2)[..., None]
    for k in (-1, 0, 1):
        np.testing.assert_array_equal(around[..., 2 + k], np.take_along_axis(total, inner + k, axis=2)[..., 0])


def test_the_surface_is_found_where_both_images_are_one(rng: np.random.Generator) -> None:
    image, samples, table = scene(rng, 16)
    best, _ = swept_surfaces(swept_costs(image, samples, table, SPACING), 16, samples, **RULES)
    # Level 5 is that without a shift; beside the hole of the table and the row without brightness little is known.
    assert np.mean(best[12:-3, 12:-3] == 5) > 0.99


def test_rivals_are_as_defined(rng: np.random.Generator) -> None:
    levels = 21
    image, samples1, table = scene(rng, levels)
    costs = swept_costs(image, samples1, table, SPACING)
    count = 200
    samples = np.stack([rng.integers(0, n, count) for n in samples1.shape], axis=1)
    surfaces = np.column_stack(
        [
            rng.uniform(-3.0, levels + 2.0, count),
            rng.uniform(-0.6, 0.6, (count, 2)),
            rng.uniform(1.0, 3.0, count),
        ]
    )
    rules = {"radius": 3.0, "alike": 40.0}
    ours = swept_rivals(costs, levels, samples1, samples, surfaces, **rules)
    theirs = reference.rivals(costs[..., :levels], samples1, samples, surfaces, **rules)
    np.testing.assert_array_equal(np.isnan(ours), np.isnan(theirs))
    known = np.isfinite(ours[:, 0])
    assert 0.6 * count < known.sum() < count
    assert np.abs(ours - theirs)[known].max() < ROUNDED_BITS
    # Level 5 is that without a shift.
    right = np.flatnonzero(known & (samples > 14).all(axis=1) & (samples < np.array(samples1.shape) - 15).all(axis=1))
    flat = np.tile([5.0, 0.0, 0.0, 1.5], (len(right), 1))
    own, other = swept_rivals(costs, levels, samples1, samples[right], flat, **rules).T
    assert len(right) > 20
    assert np.mean(own < 0.5 * other) > 0.95


def test_planes_of_levels_are_as_defined(rng: np.random.Generator) -> None:
    rows, columns, count = 40, 50, 90
    r, c = np.indices((rows, columns))
    near = np.hypot(r - 20, c - 25) < 12
    winners = np.where(near, 30.0, 12.0 + 0.2 * r - 0.1 * c) + 0.3 * rng.normal(size=r.shape)
    brightness = (np.where(near, 150.0, 90.0) + rng.normal(size=r.shape)).astype(np.float32)
    seen = rng.random(r.shape) < 0.9
    samples = np.stack([rng.integers(0, n, count) for n in (rows, columns)], axis=1)
    samples = samples[seen[samples[:, 0], samples[:, 1]]]
    rules: dict[str, Any] = {"reach": 8, "radius": 7.0, "alike": 10.0}
    ours = fitted_level_planes(winners, seen, brightness, samples, **rules)
    theirs = reference.level_planes(winners, seen, brightness, samples, **rules)
    assert len(samples) > 60
    # The table of weights has 16 steps to a factor e.
    np.testing.assert_allclose(ours.planes[:, 0], theirs[0][:, 0], atol=0.03)
    np.testing.assert_allclose(ours.planes[:, 1:], theirs[0][:, 1:], atol=0.01)
    np.testing.assert_allclose(np.linalg.inv(ours.normals), np.linalg.inv(theirs[1]), rtol=0.15, atol=1e-4)
    np.testing.assert_allclose(ours.agree, theirs[2], atol=0.03)
    np.testing.assert_allclose(ours.variance, theirs[3], rtol=0.1)
    # Beside the edge each surface keeps its own plane.
    on_card = near[samples[:, 0], samples[:, 1]]
    assert on_card.sum() > 3
    np.testing.assert_allclose(ours.planes[on_card, 0], 30.0, atol=0.4)
