"""The kernel that fits steps of the light agrees with its definition in numpy, and both with the truth."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.opencv import exact_interpolation
from kernels.reference import light as reference

from rigkit.core.arrays import FloatArray
from rigkit.detection.saddles.response import GreyImage
from rigkit.detection.subpixel.shadows import beside_shadows, light_steps

SERIES_PX, SERIES = 1e-4, 1e-3
"""The kernel's edge is good to 1.5e-7 of the contrast, and starts come out the same: px, and of all other numbers."""
JACOBIAN_REL = 1e-5
"""Of differences over 1e-5."""
TRUE_PX, TRUE_LEFT = 0.02, 0.02
"""Of noise of one grey level."""

SIZE, CELL_PX, BLUR_PX = 64, 26.0, 0.9


def stored(picture: FloatArray, dtype: type) -> GreyImage:
    return np.rint(picture).astype(np.uint8) if dtype is np.uint8 else picture.astype(np.float32)


def windows(rng: np.random.Generator, count: int) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return pictures (N, H, W) of corners that the edge of a shadow crosses, where they are (N, 2), the sides of their
    cells (N, 2, 2), and what is left of the light (N,)."""
    truth = 0.5 * SIZE + rng.uniform(-0.5, 0.5, (count, 2))
    angles = np.array([0.0, 0.5 * np.pi]) + rng.uniform(-0.3, 0.3, (count, 2))
    sides = CELL_PX * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    left = rng.uniform(0.2, 0.6, count)
    row, column = np.mgrid[:SIZE, :SIZE].reshape(2, -1)
    at = np.stack([column, row], axis=-1) - truth[:, None]
    across = at[..., 1:] * np.cos(angles)[:, None] - at[..., :1] * np.sin(angles)[:, None]
    pattern = reference.edge_at(across / BLUR_PX)[0].prod(axis=2)
    towards, place = rng.uniform(0.0, 2.0 * np.pi, count), rng.uniform(-5.0, 5.0, count)
    beyond = (at * np.stack([np.cos(towards), np.sin(towards)], axis=1)[:, None]).sum(axis=2) - place[:, None]
    dark = 0.5 + 0.5 * reference.edge_at(beyond / 0.9)[0]
    picture = (120.0 + 80.0 * pattern) * (1.0 - (1.0 - left[:, None]) * dark) + rng.normal(0.0, 1.0, dark.shape)
    return picture.clip(0.0, 255.0).reshape(count, SIZE, SIZE), truth, sides, left


@pytest.mark.parametrize("dtype", [np.uint8, np.float32])
def test_steps_agree(dtype: type, rng: np.random.Generator) -> None:
    pictures, truth, sides, left = windows(rng, 24)
    image = stored(np.concatenate(list(pictures), axis=1), dtype)
    truth[:, 0] += SIZE * np.arange(len(truth))
    start = truth + rng.uniform(-0.4, 0.4, truth.shape)
    # One at the frame, of whose window a part is seen.
    start[-1] += [40.0, 20.0]
    curvature, lateral = rng.uniform(-1e-3, 1e-3, (len(start), 2)), rng.uniform(6.0, 18.0, len(start))
    ours, found = light_steps(image, start, sides, curvature, BLUR_PX, lateral)
    theirs, seen = reference.light_steps(image, start, sides, curvature, BLUR_PX, lateral)
    assert (found == seen).all()
    assert np.abs(ours.pixels - theirs[:, :2])[found].max() < SERIES_PX
    others = np.column_stack([ours.sigma_px, ours.towards, ours.place, ours.width, ours.left])
    assert np.allclose(others[found], theirs[found, 2:], rtol=SERIES, atol=SERIES)
    good = found[:-1]
    assert good.mean() > 0.8
    assert np.median(np.abs(ours.pixels - truth)[:-1][good]) < TRUE_PX
    assert np.median(np.abs(ours.left - left)[:-1][good]) < TRUE_LEFT


@exact_interpolation
@pytest.mark.parametrize("dtype", [np.uint8, np.float32])
def test_what_is_lit_unevenly_agrees(dtype: type, rng: np.random.Generator) -> None:
    image = stored(rng.uniform(0.0, 255.0, (15, 20)).repeat(16, axis=0).repeat(16, axis=1), dtype)
    pixels, sides = rng.uniform(-10.0, 330.0, (400, 2)), rng.normal(0.0, 15.0, (400, 2, 2))
    pixels[0], sides[1] = np.nan, 0.0
    parts = (image, pixels, sides, rng.uniform(1.0, 18.0, 400), rng.random(400) < 0.3)
    ours, theirs = beside_shadows(*parts), reference.beside_shadows(*parts)
    assert 50 < ours.sum() < 350
    assert (ours == theirs).all()


def test_nothing_is_found_where_there_is_no_window(rng: np.random.Generator) -> None:
    picture, sides = np.full((40, 40), 90.0, np.float32), np.tile(20.0 * np.eye(2), (4, 1, 1))
    start = np.array([[20.0, 20.0], [-90.0, 10.0], [np.nan, 3.0], [1e12, 0.0]])
    sides[0] = 0.0
    assert not light_steps(picture, start, sides, np.zeros((4, 2)), 1.0, np.full(4, 18.0))[1].any()


def test_derivatives_of_a_window_are_true(rng: np.random.Generator) -> None:
    unknowns = np.array([[0.3, -0.2, 0.2, 1.7, 0.1, 90.0, -60.0, 0.7, 1.3, 0.2, 0.4]])
    curvature = np.array([[0.003, -0.002]])
    jacobian = reference.picture(unknowns, curvature)[1]
    step = 1e-5
    for k in range(reference.UNKNOWNS):
        more, less = unknowns.copy(), unknowns.copy()
        more[:, k] += step
        less[:, k] -= step
        difference = (reference.picture(more, curvature)[0] - reference.picture(less, curvature)[0]) / (2.0 * step)
        assert np.abs(jacobian[:, k] - difference).max() < JACOBIAN_REL * np.abs(difference).max()
