"""Predicted sigmas under correlated noise of neighbouring pixels, against the scatter about the truth."""

from __future__ import annotations

import functools
import warnings
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import pytest
from detection_bench.scenes import BENCH_PHOTOMETRY, BenchScene, one_board, small_board
from kernels.reference import edges as reference
from scipy.spatial import cKDTree

from rigkit.core.boards import Board
from rigkit.detection.detect import detect_boards
from rigkit.detection.subpixel import edge_fit, subpixel
from rigkit.detection.subpixel.correlation import board_factors, with_uneven
from rigkit.detection.subpixel.edge_fit import EdgeFit, fit_edges
from rigkit.detection.subpixel.edge_model import Geometry
from rigkit.synthetic.render import Optics

RADIUS_PX, SIDE_PX = 16.0, 32.0

SCATTER_REL = 0.15
"""A standard deviation from 2 x 160 errors is good to 4 %; the rest is correlation beyond two pixels."""

ALONE_REL = 0.03
"""Independent noise leaves sigmas as they are."""

BOARD_BAND = (0.83, 1.2)
"""Actual over predicted that is asked for; 700 errors are good to 4 %."""

Noise = Callable[[np.ndarray], np.ndarray]


def smoothed(sigma: float) -> Noise:
    return lambda white: np.asarray(cv2.GaussianBlur(white, (0, 0), sigma))


def sharpened(white: np.ndarray) -> np.ndarray:
    return np.asarray(white + 2.0 * (white - cv2.GaussianBlur(white, (0, 0), 1.0)))


def fitted(make: Noise, rng: np.random.Generator, *, count: int = 160) -> tuple[EdgeFit, np.ndarray, np.ndarray]:
    """Return the fit of separate corners under noise that `make` makes of white noise, their truth, and their sides."""
    pixels = np.stack([32.0 + 64.0 * np.arange(count), np.full(count, 32.0)], axis=1) + rng.uniform(
        -0.5, 0.5, (count, 2)
    )
    sides = SIDE_PX * np.array([[np.cos(0.3), np.sin(0.3)], [np.cos(1.8), np.sin(1.8)]])
    row, column = np.mgrid[:64, : 64 * count]
    corner = pixels[column // 64]
    rest = np.stack([column, row], axis=-1) - corner
    steps = [(rest @ np.array([-side[1], side[0]])) / np.linalg.norm(side) for side in sides]
    from scipy.special import erf

    plain = 110.0 - 80.0 * erf(steps[0] / (0.9 * np.sqrt(2.0))) * erf(steps[1] / (0.9 * np.sqrt(2.0)))
    image = (plain + make(rng.normal(0.0, 4.0, plain.shape))).astype(np.float32)
    every = np.broadcast_to(sides, (count, 2, 2)).copy()
    gap = np.full((count, 2, 2), SIDE_PX * np.sin(1.5))
    shape = Geometry(every, np.zeros((count, 2)), gap, np.zeros((count, 2, 2), bool))
    fit = fit_edges(image, pixels, shape, np.ones(count), np.full(count, 0.9), radius_px=RADIUS_PX, iterations=8)
    assert fit.valid.all()
    return fit, pixels, every


def factor(fit: EdgeFit, sides: np.ndarray) -> float:
    ((out,), _) = board_factors(fit, fit.valid, sides, np.zeros(len(sides), np.int64), 1, RADIUS_PX)
    return float(out)


@pytest.mark.parametrize("compiled", [True, False])
@pytest.mark.parametrize(
    ("make", "off"), [(smoothed(0.6), 1.4), (smoothed(1.0), 1.9), (sharpened, 0.87)], ids=["0.6", "1.0", "sharpened"]
)
def test_sigma_is_the_scatter(
    make: Noise, off: float, compiled: bool, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`off`: at least so wrong would they be as under independent noise."""
    if not compiled:
        monkeypatch.setattr(edge_fit, "fit_corners", reference.fit_corners)
    fit, truth, sides = fitted(make, rng)
    ratio = np.sqrt(((fit.pixels - truth) ** 2).mean() / (fit.sigma_px**2).mean())
    assert ratio > off if off > 1.0 else ratio < off
    assert abs(ratio / factor(fit, sides) - 1.0) < SCATTER_REL


@pytest.mark.parametrize("count", [9, 60, 160])
def test_independent_noise_changes_nothing(count: int, rng: np.random.Generator) -> None:
    fit, _, sides = fitted(lambda white: white, rng, count=count)
    assert abs(factor(fit, sides) - 1.0) < ALONE_REL


def test_each_board_has_its_own(rng: np.random.Generator) -> None:
    """Corners of two kinds of noise, mixed; what a ruler covers, and failed fits, say nothing."""
    (alone, _, sides), (shared, _, _) = fitted(lambda white: white, rng, count=40), fitted(smoothed(1.0), rng, count=40)
    both = EdgeFit(np.concatenate([alone.outcomes, shared.outcomes]))
    both.products[5] = 1e4 * both.pairs[5]
    both.noise[5] = 100.0
    both.pixels[6], both.blur[6], both.products[6], both.noise[6] = np.nan, np.nan, np.nan, np.nan
    good = np.arange(80) != 6
    order = rng.permutation(80)
    mixed = both.of(order)
    owner = (order >= 40).astype(np.int64)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        factors, _ = board_factors(mixed, good[order], np.concatenate([sides, sides])[order], owner, 3, RADIUS_PX)
    assert abs(factors[0] - 1.0) < ALONE_REL
    assert factors[1] == pytest.approx(factor(shared, sides), rel=1e-9)
    assert factors[1] > 1.9
    assert factors[2] == 1.0


@pytest.mark.parametrize("make", [smoothed(1.0), sharpened], ids=["smoothed", "sharpened"])
def test_correlated_noise_only_raises_sigmas_of_marked_boards(make: Noise, rng: np.random.Generator) -> None:
    fit, _, sides = fitted(make, rng, count=40)
    _, typical = with_uneven(fit, sides, RADIUS_PX, marked=True)
    assert typical == max(factor(fit, sides), 1.0)
    assert typical > 1.9 or make is sharpened


def demosaiced(levels: np.ndarray) -> np.ndarray:
    colour = cv2.cvtColor(levels, cv2.COLOR_BayerBG2BGR)
    return np.asarray(cv2.cvtColor(colour, cv2.COLOR_BGR2GRAY))


def enlarged(levels: np.ndarray) -> np.ndarray:
    return np.asarray(cv2.resize(levels, None, fx=2.0, fy=2.0, interpolation=cv2.INTER_LINEAR))


def compressed(levels: np.ndarray) -> np.ndarray:
    return np.asarray(cv2.imdecode(cv2.imencode(".jpg", levels, [cv2.IMWRITE_JPEG_QUALITY, 80])[1], 0))


@functools.cache
def small_scene(seed: int, blur_px: float) -> tuple[BenchScene, np.ndarray]:
    """A board of sixteen corners, and its picture before noise in grey levels."""
    board = Board("a", 4, 4, 30.0, 30.0)
    scene = one_board(np.random.default_rng(700 + seed), size_px=(200, 160), board=board, square_px=23.0)
    return scene, 255.0 * scene.radiance(Optics(blur_px)) * BENCH_PHOTOMETRY.exposure


@pytest.mark.parametrize(
    ("degrade", "blur_px", "noise", "scale", "guided"),
    [
        (demosaiced, 1.1, 5.0, 1.0, False),
        (enlarged, 0.8, 3.0, 2.0, False),
        (compressed, 0.6, 0.5, 1.0, False),
        (compressed, 0.6, 0.5, 1.0, True),
    ],
    ids=["demosaiced", "enlarged", "jpeg", "jpeg-camera"],
)
def test_boards_in_images_as_they_come(
    degrade: Callable[[np.ndarray], np.ndarray], blur_px: float, noise: float, scale: float, guided: bool
) -> None:
    """Boards of sixteen corners: too few for their scatter about smooth rows to tell."""
    errors, sigmas = [], []
    for seed in range(24):
        scene, levels = small_scene(seed, blur_px)
        white = noise * np.random.default_rng(seed).standard_normal(levels.shape)
        image = degrade(np.clip(np.rint(levels + white), 0, 255).astype(np.uint8))
        (truth,) = scene.truth()
        tree = cKDTree((truth.pixels + 0.5) * scale - 0.5)
        (found,) = detect_boards(image, [scene.boards[0].board], camera=scene.camera if guided else None)
        distance, nearest = tree.query(found.pixels)
        errors.append((found.pixels - tree.data[nearest])[distance < scale])
        sigmas.append(found.sigma_px[distance < scale])
    every, predicted = np.concatenate(errors), np.concatenate(sigmas)
    assert len(every) > 350
    assert BOARD_BAND[0] < np.sqrt((every**2).mean() / (predicted**2).mean()) < BOARD_BAND[1]


def test_windows_of_few_pixels_give_no_correlation(monkeypatch: pytest.MonkeyPatch) -> None:
    """Blurred squares of 6 px: the fit takes nearly all of the noise in their windows."""
    seen: list[np.ndarray] = []

    def kept(*arguments: Any) -> tuple[np.ndarray, np.ndarray]:
        both = board_factors(*arguments)
        seen.append(both[0])
        return both

    monkeypatch.setattr(subpixel, "board_factors", kept)
    for seed in range(6):
        rng = np.random.default_rng(seed)
        scene = small_board(rng, square_px=6.0)
        detect_boards(scene.render(blur_px=2.0, noise_levels=1.0, rng=rng), [scene.boards[0].board])
    assert sum(len(factors) for factors in seen) >= 4
    assert all((factors == 1.0).all() for factors in seen)
