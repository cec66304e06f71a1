"""The kernels of lattices agree with their definitions in numpy."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from helpers.detection_scenes import corner_scene, fisheye, regular
from helpers.real_images import real_images
from kernels.reference import growth as reference

from rigkit.detection.lattice import grow, lattice, local_fit
from rigkit.detection.lattice.links import Links, find_links
from rigkit.detection.saddles.response import grey_image, pyramid
from rigkit.detection.saddles.saddle import Corners, find_corners

ROUNDING = 1e-7
"""Cells with enough neighbours: the normal equations of a cubic lose half of the digits of a pixel."""

CONTRAST = 1.0
"""Grey levels: OpenCV rounds the places it samples at to 1/32 px."""


def bent_lattice(rng: np.random.Generator, missing: float) -> np.ndarray:
    row, column = np.mgrid[:9, :11].astype(float)
    u = 800.0 + 20.0 * column + 3.0 * row + 0.2 * column**2 - 0.01 * column**2 * row
    v = 400.0 + 25.0 * row - 2.0 * column + 0.1 * row * column
    pixels = np.stack([u, v], axis=-1) + rng.normal(0.0, 0.1, (9, 11, 2))
    pixels[rng.random((9, 11)) < missing] = np.nan
    return pixels


@pytest.mark.parametrize("degree, ridge", [(1, (1e-8, 1e-6)), (2, (0.02, 1.0)), (3, (1e-3, 1e-2)), (3, (1e-8, 1e-6))])
@pytest.mark.parametrize("leave_out", [False, True])
@pytest.mark.parametrize("missing", [0.0, 0.2])
def test_local_fits(
    degree: int,
    ridge: tuple[float, float],
    leave_out: bool,
    missing: float,
    rng: np.random.Generator,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    pixels = bent_lattice(rng, missing)
    cells = rng.random(pixels.shape[:2]) < 0.8
    fitted = partial(local_fit.fit_cells, pixels, cells, degree=degree, ridge=ridge, width=1.3, leave_out=leave_out)
    compiled = fitted()
    monkeypatch.setattr(local_fit, "fit", reference.fit)
    plain = fitted()
    clear = plain.support > 15
    assert clear.sum() > 60
    for name in ("pixels", "along_column", "along_row", "curvature_column", "curvature_row", "support", "gain"):
        one, two = getattr(compiled, name), getattr(plain, name)
        assert one.shape == two.shape
        assert np.abs(one - two)[clear].max() < ROUNDING * (1.0 + np.abs(two).max()), name


def without_kernels(monkeypatch: pytest.MonkeyPatch) -> None:
    for module, name in ((local_fit, "fit"), (lattice, "components_of"), (grow, "grown")):
        monkeypatch.setattr(module, name, getattr(reference, name))


@pytest.mark.parametrize("scene", ["regular", "fisheye", *real_images()])
def test_growth(scene: str, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch) -> None:
    """From one square of each board, with a noise that leaves holes: corner by corner the same, square by square."""
    if scene in real_images():
        image = real_images()[scene]
    else:
        camera, distance = (regular(), 1250.0) if scene == "regular" else (fisheye(), 480.0)
        image = corner_scene(rng, camera, distance).image(rng, noise_levels=6.0)
    levels = pyramid(grey_image(image))
    corners, saddles = find_corners(levels)
    links = find_links(corners, levels[0])
    one_square = (slice(2, 4), slice(3, 5))

    def grown_from_squares() -> tuple[list[lattice.Lattice], list[lattice.Lattice]]:
        found = list(lattice.build_lattices(corners, links))
        seeds = [item.cut(*one_square) for item in found if min(item.size) > 4]
        return found, grow.grow_all(seeds, saddles, levels[0], lambda _: True)

    compiled = grown_from_squares()
    without_kernels(monkeypatch)
    plain = grown_from_squares()
    assert sum(item.count for item in plain[1]) >= 30
    for ones, twos in zip(compiled, plain, strict=True):
        for one, two in zip(ones, twos, strict=True):
            assert one.rising == two.rising
            assert np.array_equal(one.pixels, two.pixels, equal_nan=True)
            assert np.allclose(one.contrast, two.contrast, rtol=0.0, atol=CONTRAST, equal_nan=True)


def test_lattices_of_contradicting_links(rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch) -> None:
    """Squares that share corners at random: what they make up contradicts itself nearly everywhere."""
    count = 60
    corner, arm = np.full((count, 4), -1), np.full((count, 4), -1)
    for _ in range(3000):
        four, out = rng.permutation(count)[:4], rng.integers(0, 4, 4)
        back = (out + 1) % 4
        if (corner[four, out] >= 0).any() or (corner[four, back] >= 0).any():
            continue
        following = np.roll(four, -1), np.roll(back, -1)
        corner[four, out], arm[four, out] = following
        corner[following], arm[following] = four, out
    pixels = rng.uniform(0.0, 500.0, (count, 2))
    corners = Corners(pixels, np.zeros((count, 2)), np.ones(count), np.ones(count))
    links = Links(np.where(corner >= 0, 4 * corner + arm, -1))
    compiled = list(lattice.build_lattices(corners, links))
    without_kernels(monkeypatch)
    plain = list(lattice.build_lattices(corners, links))
    assert len(plain) > 0
    for one, two in zip(compiled, plain, strict=True):
        assert one.rising == two.rising
        assert np.array_equal(one.pixels, two.pixels, equal_nan=True)
