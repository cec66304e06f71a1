"""The kernels of the map from a board's plane to an image agree with their definitions in numpy."""

from __future__ import annotations

import numpy as np
import pytest
from kernels.reference import surface as reference

from rigkit.core.arrays import FloatArray
from rigkit.detection.saddles.response import GreyImage
from rigkit.detection.tags.surface import MAX_LEVERAGE, SmoothMap
from rigkit.kernels.surface import (
    HARDLY_MORE,
    TERMS_OF_DEGREE,
    Polynomials,
    maps_of_quads,
    perspective,
    projected,
    read_codes,
    read_modules,
)

SAME = 1e-7
"""px: two ways to solve for 45 powers of numbers up to 1 agree so well."""


def seen(rng: np.random.Generator, *, bend: float) -> tuple[FloatArray, FloatArray]:
    """Return a grid of 12 x 10 points and where a slanted camera with a lens of the fifth order has them."""
    places = np.stack(np.meshgrid(np.arange(12.0), np.arange(10.0)), axis=-1).reshape(-1, 2)
    flat = (
        np.column_stack([places, np.ones(len(places))])
        @ np.array([[40.0, 3.0, 60.0], [-2.0, 38.0, 40.0], [0.02, 0.01, 1.0]]).T
    )
    pixels = flat[:, :2] / flat[:, 2:]
    off = (pixels - [300.0, 200.0]) / 300.0
    square = (off**2).sum(axis=1, keepdims=True)
    return places, pixels + 300.0 * bend * off * (square + square**2) + rng.normal(0.0, 0.02, pixels.shape)


def test_perspective(rng: np.random.Generator) -> None:
    places, pixels = seen(rng, bend=0.0)
    matrix, nearest = perspective(places, pixels)
    np.testing.assert_allclose(matrix, reference.perspective(places, pixels), rtol=1e-6, atol=1e-9)
    assert nearest == pytest.approx((places @ matrix[2, :2] + matrix[2, 2]).min())


def test_derivatives_of_a_perspective(rng: np.random.Generator) -> None:
    places, pixels = seen(rng, bend=0.0)
    matrix, _ = perspective(places, pixels)
    shown = projected(matrix, places)
    here, sides, curvatures = shown.pixels, shown.sides, shown.curvatures
    image = np.column_stack([places, np.ones(len(places))]) @ matrix.T
    np.testing.assert_allclose(here, image[:, :2] / image[:, 2:], rtol=1e-12)
    for k, step in enumerate(1e-3 * np.eye(2)):
        after, before = projected(matrix, places + step), projected(matrix, places - step)
        np.testing.assert_allclose(sides[:, k], (after.pixels - before.pixels) / 2e-3, rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose(
            curvatures[:, k], (after.sides[:, k] - before.sides[:, k]) / 2e-3, rtol=1e-6, atol=1e-6
        )


@pytest.mark.parametrize("bend", [0.0, 0.1, 0.6])
def test_polynomials(bend: float, rng: np.random.Generator) -> None:
    places, pixels = seen(rng, bend=bend)
    ours = Polynomials.through(places, pixels, len(places) // 2, MAX_LEVERAGE)
    np.testing.assert_allclose(ours.unit, [5.5, 4.5, 5.5])
    tried = int(np.isfinite(ours.misses).sum())
    best = int(ours.misses.argmin())
    assert tried == min(len(TERMS_OF_DEGREE), max(6, best + 3))
    whole = reference.Polynomials(places, pixels, ours.unit[:2], ours.unit[2], tried - 1)
    assert best == int(whole.misses.argmin())
    np.testing.assert_allclose(ours.misses[:tried], whole.misses, rtol=1e-6)
    assert ours.plain == int(np.argmax(whole.misses <= HARDLY_MORE * whole.misses.min()))
    off, leverage = np.hypot(*whole.predicted[best].T), whole.leverage[:, TERMS_OF_DEGREE[best] - 1]
    np.testing.assert_allclose(ours.off, off, atol=SAME)
    np.testing.assert_allclose(ours.gain, np.sqrt(leverage / (1.0 - leverage)), atol=1e-9)
    assert ours.scatter == pytest.approx(np.median(ours.off / np.hypot(1.0, ours.gain)))
    wanted = rng.uniform([-2.0, -2.0], [13.0, 11.0], (50, 2))
    plain, most_certain = (ours.added_to(None, wanted, most_certain=which) for which in (False, True))
    for one, two in zip((plain.pixels, plain.sides, plain.curvatures), whole.at(wanted, ours.plain), strict=True):
        np.testing.assert_allclose(one, two, atol=100.0 * SAME)
    for one, two in zip((most_certain.pixels, most_certain.gain), whole.most_certain(wanted, tried), strict=True):
        np.testing.assert_allclose(one, two, atol=100.0 * SAME)
    np.testing.assert_array_equal(plain.rows[:, 2:10], most_certain.rows[:, 2:10])


def test_lines_of_a_surface(rng: np.random.Generator) -> None:
    places, pixels = seen(rng, bend=0.6)
    polynomials = Polynomials.through(places, pixels, len(places) // 2, MAX_LEVERAGE)
    base = projected(np.array([[3.0, 0.1, 2.0], [-0.2, 2.0, 1.0], [0.01, 0.02, 1.0]]), places)
    surface = polynomials.added_to(base, places, most_certain=False)
    np.testing.assert_allclose(
        surface.pixels, base.pixels + polynomials.added_to(None, places, most_certain=False).pixels
    )
    lengths = np.linalg.norm(surface.sides, axis=2)
    bent = surface.sides[..., 0] * surface.curvatures[..., 1] - surface.sides[..., 1] * surface.curvatures[..., 0]
    np.testing.assert_allclose(surface.curvature, bent / lengths**3)
    np.testing.assert_allclose(surface.heights, np.abs(np.linalg.det(surface.sides))[:, None] / lengths)


def test_points_on_two_lines_leave_what_they_do_not_say_out(rng: np.random.Generator) -> None:
    places, pixels = seen(rng, bend=0.0)
    two = places[:, 1] < 2.0
    surface = SmoothMap(places[two], pixels[two]).at(places[two])
    assert np.abs(surface.pixels - pixels[two]).max() < 0.2
    assert np.isfinite(surface.sides).all()
    assert np.abs(surface.sides).max() < 60.0


QUADS = np.array(
    [
        [[10.0, 12.0], [40.0, 9.0], [45.0, 44.0], [7.0, 39.0]],
        [[60.0, 40.0], [85.0, 38.0], [88.0, 66.0], [61.0, 59.0]],
        [[5.0, 5.0], [5.0, 5.0], [5.0, 5.0], [5.0, 5.0]],
    ]
)
"""One within an image of 80 x 60 pixels, one that ends beyond it, and one that is a point."""


@pytest.mark.parametrize("dtype", [np.uint8, np.float32])
def test_modules(dtype: type, rng: np.random.Generator) -> None:
    image: GreyImage = rng.uniform(0.0, 255.0, (60, 80)).astype(dtype)
    for one, two in zip(read_modules(image, QUADS, 6), reference.read_modules(image, QUADS, 6), strict=True):
        # OpenCV's remap has places to 1/32 px.
        np.testing.assert_allclose(one, two, atol=2.0 if one.ndim == 1 else 0.03)


def test_maps_of_quads(rng: np.random.Generator) -> None:
    quads = np.concatenate([QUADS, rng.uniform(0.0, 100.0, (20, 4, 2))])
    np.testing.assert_allclose(maps_of_quads(quads), reference.maps_of_quads(quads), rtol=1e-12)
    corners = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 1.0], [1.0, 1.0, 1.0], [0.0, 1.0, 1.0]])
    there = corners @ maps_of_quads(QUADS[:2]).transpose(0, 2, 1)
    np.testing.assert_allclose(there[..., :2] / there[..., 2:], QUADS[:2], atol=1e-9)


@pytest.mark.parametrize("dtype", [np.uint8, np.float32])
def test_codes(dtype: type, rng: np.random.Generator) -> None:
    """Of an image of noise: the most like by far is the same, and a tag without contrast is none."""
    image: GreyImage = rng.uniform(0.0, 255.0, (60, 80)).astype(dtype)
    bright, _ = read_modules(image, QUADS[:2], 6)
    patterns = np.concatenate([rng.normal(0.0, 0.1, (30, 36)), bright[::-1], rng.normal(0.0, 0.1, (7, 36))])
    best, likeness = read_codes(image, QUADS, 6, patterns, 1.5)
    again, theirs = reference.read_codes(image, QUADS, 6, patterns, 1.5)
    assert best.tolist() == again.tolist() == [31, 30, 0]
    np.testing.assert_allclose(likeness, theirs, atol=0.03)
    assert likeness[2] == 0.0
    assert read_codes(image, QUADS, 6, patterns, 1e3)[1].tolist() == [0.0, 0.0, 0.0]


def test_a_code_without_any_correlation_hides_no_other() -> None:
    """The image is exactly as like the first four codes as unlike them, and is the fifth."""
    own = np.array([[255, 255], [0, 0]], np.uint8)
    image = np.kron(own, np.ones((20, 20), np.uint8))
    quads = np.array([[[-0.5, -0.5], [39.5, -0.5], [39.5, 39.5], [-0.5, 39.5]]])
    patterns = np.array([[0.5, -0.5, 0.5, -0.5]] * 4 + [[0.5, 0.5, -0.5, -0.5]])
    best, likeness = read_codes(image, quads, 2, patterns, 1.5)
    assert best.tolist() == [4]
    np.testing.assert_allclose(likeness, 1.0)
