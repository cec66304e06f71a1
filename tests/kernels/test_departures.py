"""The kernels of model inadequacy agree with their definition in numpy."""

from __future__ import annotations

import numpy as np
import pytest
from kernels.reference import departures as reference

from rigkit.kernels.departures import DISPLACEMENTS, LensCorners, averaged_amounts, displacement, displacements

SIZE = (641, 480)
ROUNDING = 1e-12
"""Of the largest term: both add the same thousand products, in another order."""


def test_displacements_are_as_defined(rng: np.random.Generator) -> None:
    pixels = rng.uniform(-10.0, 700.0, (101, 2))
    ours, theirs = displacements(pixels, SIZE), reference.displacements(pixels, SIZE)
    assert ours.shape == (2, DISPLACEMENTS, 101)
    np.testing.assert_allclose(ours, theirs, rtol=ROUNDING, atol=ROUNDING)


def test_amounts_displace_as_defined(rng: np.random.Generator) -> None:
    """Pixels beyond the corners as those on the circle through them."""
    pixels, amounts = rng.uniform(-400.0, 1000.0, (101, 2)), rng.normal(size=DISPLACEMENTS)
    centre, reach = 0.5 * (np.array(SIZE) - 1.0), 0.5 * np.hypot(*SIZE)
    length = np.linalg.norm(pixels - centre, axis=1)
    assert (length > reach).any() and (length < reach).any()
    inside = centre + (pixels - centre) * np.minimum(reach / length, 1.0)[:, None]
    expected = np.einsum("ijn,j->in", reference.displacements(inside, SIZE), amounts)
    np.testing.assert_allclose(
        displacement(pixels[:, 0], pixels[:, 1], amounts, SIZE), expected, rtol=1e-10, atol=1e-10
    )


@pytest.mark.parametrize("usable", [0.0, 1.0, 1e6])
def test_amounts_are_averaged_as_defined(usable: float, rng: np.random.Generator) -> None:
    """Where nothing is told, a little, and all: other sizes are the likely ones."""
    root = rng.normal(size=(DISPLACEMENTS, 2 * DISPLACEMENTS))
    information = usable * root @ root.T
    score = information @ rng.normal(0.0, 0.1, DISPLACEMENTS)
    sizes = np.geomspace(1e-3, 1.0, 5)
    ours, theirs = (one(information, score, sizes) for one in (averaged_amounts, reference.averaged_amounts))
    for one, other in zip(ours, theirs, strict=True):
        assert one.shape == other.shape
        assert np.abs(one - other).max() <= 1e-9 * np.abs(other).max()


@pytest.mark.parametrize("parameters", [1, 8, 10, 13])
def test_products_are_as_defined(parameters: int, rng: np.random.Generator) -> None:
    """Views of fewer and of more corners than are worked on at a time, with some that tell nothing, NaN among them."""
    counts = np.array([1, 31, 32, 33, 140])
    count = int(counts.sum())
    d_pixels_d_point, d_pixels_d_parameters = rng.normal(size=(2, 3, count)), rng.normal(size=(2, parameters, count))
    lever, pixels = rng.normal(size=(3, count)), rng.uniform(0.0, 640.0, (count, 2))
    residuals, sigmas, usable = rng.normal(size=(count, 2)), rng.uniform(0.1, 2.0, parameters), rng.random(count) < 0.8
    residuals[~usable] = d_pixels_d_point[..., ~usable] = np.nan
    uv = (pixels[:, 0], pixels[:, 1])
    corners = LensCorners.make(
        d_pixels_d_point, d_pixels_d_parameters, sigmas, lever, uv, residuals, usable, counts, SIZE
    )
    ours = corners.products()
    view = np.repeat(np.arange(len(counts)), counts)
    theirs = reference.products(
        d_pixels_d_point, d_pixels_d_parameters, sigmas, lever, pixels, residuals, usable, view, SIZE
    )
    assert ours.shape == theirs.shape
    assert np.abs(ours - theirs).max() < ROUNDING * np.abs(theirs).max()
