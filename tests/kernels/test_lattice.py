"""The kernels that judge whole lattices agree with their definitions in numpy."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from helpers.detection_scenes import corner_scene, regular
from helpers.real_images import real_images
from kernels.reference import lattice as reference

from rigkit.core.arrays import FloatArray
from rigkit.detection.checks import validate
from rigkit.detection.lattice.spacing import spacing_changes
from rigkit.detection.lattices import find_lattices
from rigkit.detection.saddles.response import grey_image, pyramid
from rigkit.detection.subpixel import scatter
from rigkit.detection.subpixel.scatter import excess_scatter
from rigkit.kernels import lattice as native

ROUNDING = 1e-9
"""Relative: differences of fifth and sixth order of pixels lose six digits."""

SAMPLED_CELLS = 2e-3
"""OpenCV rounds the places it samples at to 1/32 px."""


def board(rng: np.random.Generator, missing: float, noise_px: float) -> np.ndarray:
    """Return the corners (R, C, 2) of a board seen strongly aslant, some of them missing."""
    row, column = np.mgrid[:8, :11].astype(float)
    depth = 1.0 + 0.05 * column - 0.03 * row
    pixels = np.stack([100.0 + 30.0 * column + 4.0 * row, 80.0 + 33.0 * row - 3.0 * column], axis=-1) / depth[..., None]
    pixels += rng.normal(0.0, noise_px, pixels.shape)
    pixels[rng.random(depth.shape) < missing] = np.nan
    return pixels


@pytest.fixture
def in_numpy(monkeypatch: pytest.MonkeyPatch) -> Callable[[], None]:
    """Return what takes the kernels away."""

    def take_away() -> None:
        for name in ("uneven_steps", "excess_scatter", "shifts_of_edges"):
            monkeypatch.setattr(native, name, getattr(reference, name))

    return take_away


@pytest.mark.parametrize("missing", [0.0, 0.2, 0.7, 1.0])
@pytest.mark.parametrize("shape", [(8, 11), (2, 5), (3, 3), (5, 2), (1, 1)])
def test_unevenness(
    missing: float, shape: tuple[int, int], rng: np.random.Generator, in_numpy: Callable[[], None]
) -> None:
    pixels = board(rng, missing, 0.5)[: shape[0], : shape[1]]
    compiled = spacing_changes(pixels)
    in_numpy()
    for ours, theirs in zip(compiled, spacing_changes(pixels), strict=True):
        assert ours.seen == theirs.seen
        assert np.allclose([*ours.typical, ours.every], [*theirs.typical, theirs.every], rtol=ROUNDING, equal_nan=True)


def test_unevenness_of_a_seam() -> None:
    """Steps of 10 px, and of 15 px after the third of seven columns: there they differ by half of the shorter."""
    column = np.array([0.0, 10.0, 20.0, 35.0, 50.0, 65.0, 80.0])
    pixels = np.stack(np.meshgrid(column, 10.0 * np.arange(5.0)), axis=-1)
    rows, columns = spacing_changes(pixels)
    assert np.allclose(rows.typical, [0.0, 0.5, 0.0, 0.0, 0.0]) and rows.seen == [5] * 5
    assert (rows.every, columns.every) == (0.0, 0.0) and columns.typical == [0.0] * 3


@pytest.mark.parametrize("missing", [0.0, 0.1, 0.5, 0.9, 1.0])
@pytest.mark.parametrize("noise_px", [0.01, 0.05])
def test_excess_scatter(
    missing: float, noise_px: float, rng: np.random.Generator, in_numpy: Callable[[], None]
) -> None:
    """Parts of a sheet; sigmas of 0.01 px, which is right or five times too small."""
    one, two = board(rng, missing, noise_px), board(rng, 0.0, noise_px)[:5, :9]
    sheet = np.full((17, 11, 2), np.nan)
    parts = ((slice(0, 8), slice(0, 11)), (slice(12, 17), slice(0, 9)))
    sheet[parts[0]], sheet[parts[1]] = one, two
    sigma = np.where(np.isfinite(sheet[..., 0]), 0.01, np.nan)
    compiled = excess_scatter(sheet, sigma, parts)
    in_numpy()
    assert np.allclose(compiled, excess_scatter(sheet, sigma, parts), rtol=ROUNDING)
    if missing < 0.5:
        # The calmest of four looks, of fifty corners each.
        truth = 100.0 * noise_px
        assert (compiled > 0.6 * truth).all() and (compiled < 1.2 * truth).all()


def test_scatter_about_surfaces(rng: np.random.Generator) -> None:
    projected = 0
    for _ in range(60):
        rows, columns = (int(count) for count in rng.integers(2, 7, 2))
        cells = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1).astype(np.float64)
        pixels: FloatArray = 25.0 * cells + 0.6 * cells[..., ::-1] ** 2 + rng.normal(0.0, 0.05, cells.shape)
        sigma = rng.uniform(0.01, 0.1, (rows, columns))
        pixels[rng.random((rows, columns)) < rng.choice([0.0, 0.1])] = np.nan
        rules = scatter._rules()
        ours, theirs = native.surface_scatter(pixels, sigma, rules), reference.surface_scatter(pixels, sigma, rules)
        assert np.allclose(ours, theirs, rtol=1e-9, atol=0.0, equal_nan=True)
        projected += int(np.count_nonzero(np.isfinite(theirs)))
    assert projected >= 20


def test_scatter_of_a_flat_board_is_no_perspective(rng: np.random.Generator) -> None:
    """The differences of a strong perspective are not noise: with a sigma far below them they count for nothing."""
    pixels = board(rng, 0.1, 0.0)
    part = (slice(0, 8), slice(0, 11))
    assert excess_scatter(pixels, np.full((8, 11), 1e-6), (part,))[0] == 1.0


@pytest.mark.parametrize("holes", [0.0, 0.2])
def test_where_edges_lie(holes: float, rng: np.random.Generator, in_numpy: Callable[[], None]) -> None:
    grey = grey_image(corner_scene(rng, regular(), 1250.0).image(rng, noise_levels=4.0))
    level = pyramid(grey)[0]
    lattices = [item.lattice for item in find_lattices(grey, 12)]
    assert len(lattices) == 3
    lattices = [item.without(rng.random(item.known.shape) < holes) for item in lattices]
    ways = [
        ((validate.NARROW_STRIPE,), (0.5,)),
        ((validate.NARROW_STRIPE, *3 * (validate.WIDE_STRIPE,)), (0.5, 0.2, 0.5, 0.8)),
    ]
    compiled = [validate._edge_offsets(item, level, *way) for item in lattices for way in ways]
    in_numpy()
    plain = [validate._edge_offsets(item, level, *way) for item in lattices for way in ways]
    for ours, theirs in zip(compiled, plain, strict=True):
        assert np.abs(ours - theirs).max() < SAMPLED_CELLS
        assert np.abs(theirs).max() < validate.MAX_DARK


@pytest.mark.real
@pytest.mark.parametrize("name", list(real_images()))
def test_real_boards_are_judged_alike(name: str, in_numpy: Callable[[], None]) -> None:
    grey = grey_image(real_images()[name])
    level = pyramid(grey)[0]
    found = find_lattices(grey, 12)
    assert found

    def judged() -> list[list[float]]:
        numbers = []
        for item in found:
            pixels = item.lattice.pixels
            changes = [change.every for change in spacing_changes(pixels)]
            whole = (slice(0, pixels.shape[0]), slice(0, pixels.shape[1]))
            scatter = excess_scatter(pixels, item.sigma_px, (whole,))
            reach = [validate.WIDE_STRIPE for _ in validate.OFFSET_PARTS]
            shifts = validate._edge_offsets(item.lattice, level, reach, validate.OFFSET_PARTS)
            numbers.append([*changes, *scatter, *shifts])
        return numbers

    compiled = np.array(judged())
    in_numpy()
    plain = np.array(judged())
    assert np.allclose(compiled[:, :3], plain[:, :3], rtol=ROUNDING)
    assert np.abs(compiled[:, 3:] - plain[:, 3:]).max() < SAMPLED_CELLS
