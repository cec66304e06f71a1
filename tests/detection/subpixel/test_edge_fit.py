"""The edge model and its fit: derivatives, exact corners of exact pixels, sigma against repeated noise."""

from __future__ import annotations

import math
import warnings
from dataclasses import replace

import numpy as np
from kernels.reference.edge_model import PARAMETERS, _edge, collect, linearise, pattern_of

from rigkit.detection.subpixel.edge_fit import fit_edges
from rigkit.detection.subpixel.edge_model import PIXEL_KURTOSIS, Geometry, tilted

DERIVATIVE_REL = 0.01
"""Differences of a float32 model with steps of 1e-3 are good to 1e-4 / 1e-3 grey levels of 60."""

ASLANT_CORRELATION = 0.99
"""Of derivative and difference, where a small term is left out."""

EXACT_PX = 2e-4
"""float32 pixels of a model that the fit has exactly."""

SHAPED_REL = 0.2
"""As much as is asked of predicted sigmas: what a tone curve leaves is not quite the same on both sides."""

MONTE_CARLO_REL = 0.12
"""Scatter of a standard deviation estimated from 2 x 200 errors is 3.5 %; three times that."""


def geometry(count: int, *, bend: float = 0.0, side_px: float = 30.0, oblique: float = 1.4) -> Geometry:
    sides = side_px * np.array([[np.cos(0.2), np.sin(0.2)], [np.cos(0.2 + oblique), np.sin(0.2 + oblique)]])
    gap = side_px * np.sin(oblique)
    return Geometry(
        np.broadcast_to(sides, (count, 2, 2)).copy(),
        np.full((count, 2), bend),
        np.full((count, 2, 2), gap),
        np.zeros((count, 2, 2), bool),
    )


def image_of(pixels: np.ndarray, shape: Geometry, blur: float) -> tuple[np.ndarray, np.ndarray]:
    """Return an image with the model's own corners at `pixels` (N, 2), and the parameters (N, 11)."""
    image = np.full((64, 64 * len(pixels)), 120.0, np.float32)
    values = np.zeros((len(pixels), PARAMETERS))
    # Wider than any window of the fit, which need not be centred on the true corner, squares and all.
    wide = Geometry(2.0 * shape.sides, shape.curvature, shape.gaps, shape.ends)
    window = collect(image, pixels, wide, np.full(len(pixels), 20.0), 26.0)
    values[:, :2] = pixels - window.centre
    values[:, 2:4] = np.arctan2(shape.sides[..., 1], shape.sides[..., 0])
    values[:, 4:7] = blur, 120.0, 70.0
    values[:, 7:9] = 0.05, -0.04
    values[:, 9:11] = shape.curvature
    light = 1.0 + (values[:, 7:8] * window.u + values[:, 8:9] * window.v) / window.size[:, None]
    brightness = light * (values[:, 5:6] + values[:, 6:7] * pattern_of(values, window, shape))
    row, column = window.v + window.centre[:, 1:], window.u + window.centre[:, :1]
    used = window.weight > 0
    image[row[used].astype(int), column[used].astype(int)] = brightness[used]
    return image, values


def corners(count: int, rng: np.random.Generator) -> np.ndarray:
    return np.stack([32.0 + 64.0 * np.arange(count), np.full(count, 32.0)], axis=1) + rng.uniform(-0.4, 0.4, (count, 2))


def test_derivatives(rng: np.random.Generator) -> None:
    """Exact where lines cross at right angles; aslant, small terms of how the blur mixes them are left out."""
    shape = geometry(4, bend=0.01, oblique=0.5 * np.pi)
    pixels = corners(4, rng)
    image, values = image_of(pixels, shape, 1.2)
    window = collect(image, pixels, shape, np.full(4, 1.2), 18.0)
    rows = linearise(values, window, shape)
    for k in range(PARAMETERS):
        step = 1e-3 * max(1.0, abs(values[0, k]))
        up, down = values.copy(), values.copy()
        up[:, k] += step
        down[:, k] -= step
        # The last row is what the image has more than the model: its change is that of the model, reversed.
        numeric = (linearise(down, window, shape)[:, -1] - linearise(up, window, shape)[:, -1]) / (2.0 * step)
        scale = np.abs(numeric).max()
        assert scale > 0.0
        if k in (2, 3):
            # The angle between the lines also changes how the blur mixes them, near the corner.
            assert np.corrcoef(rows[:, k].ravel(), numeric.ravel())[0, 1] > ASLANT_CORRELATION
        else:
            assert np.abs(rows[:, k] - numeric).max() < DERIVATIVE_REL * scale


def test_finds_its_own_corners(rng: np.random.Generator) -> None:
    for bend in (0.0, 0.02):
        shape = geometry(6, bend=bend)
        pixels = corners(6, rng)
        image, _ = image_of(pixels, shape, 0.8)
        start = pixels + rng.uniform(-0.5, 0.5, pixels.shape)
        fit = fit_edges(image, start, shape, np.ones(6), np.full(6, 1.2), radius_px=18.0, iterations=12)
        assert fit.valid.all()
        assert np.abs(fit.pixels - pixels).max() < EXACT_PX
        assert np.abs(fit.blur - 0.8).max() < 0.01
        assert np.abs(fit.contrast - 140.0).max() < 0.5
        straight = Geometry(shape.sides, np.zeros_like(shape.curvature), shape.gaps, shape.ends)
        blind = fit_edges(image, start, straight, np.ones(6), np.full(6, 1.2), radius_px=18.0, iterations=12)
        moved = np.abs(blind.pixels - pixels).max()
        assert (moved > 0.1) == (bend > 0.0), "curvature is what keeps a bent row from pulling the corner aside"
        loose = np.full((6, 2), 0.02)
        free = fit_edges(
            image, start, straight, np.ones(6), np.full(6, 1.2), radius_px=18.0, iterations=12, curvature_sigma=loose
        )
        assert np.abs(free.pixels - pixels).max() < EXACT_PX, "a curvature known to be uncertain is fitted"


def test_brightness_told_wrong_leaves_no_residual(rng: np.random.Generator) -> None:
    """A fit that starts where it ends takes a step for the brightness all the same, and then looks at what is left."""
    shape, pixels = geometry(4), corners(4, rng)
    image, _ = image_of(pixels, shape, 0.8)
    fit = fit_edges(
        image,
        pixels,
        shape,
        np.ones(4),
        np.full(4, 0.8),
        radius_px=18.0,
        iterations=8,
        converged_px=0.05,
        mirrored=False,
        contrast=np.full(4, 60.0),
    )
    assert fit.valid.all()
    assert fit.residual.max() < 0.5


def test_windows_are_narrower_than_edges_ask_where_that_is_wanted(rng: np.random.Generator) -> None:
    shape, pixels = geometry(4), corners(4, rng)
    image, _ = image_of(pixels, shape, 0.8)
    wide, narrow = (
        fit_edges(image, pixels, shaped, np.ones(4), np.full(4, 0.8), radius_px=18.0, iterations=8)
        for shaped in (shape, replace(shape, window_blur=np.full(4, 0.3)))
    )
    assert (narrow.used < 0.75 * wide.used).all()
    assert np.abs(narrow.pixels - pixels).max() < EXACT_PX
    assert np.abs(narrow.blur - 0.8).max() < 0.01


def test_neighbouring_edges_within_the_blur_do_not_bias_corners() -> None:
    """A Gaussian-blurred chessboard with lines 7 px before and 8.5 px after the corner, at s = 1.9."""
    blur, before, after = 1.9, 7.0, 8.5

    def wave(x: np.ndarray) -> np.ndarray:
        lines = ((-2, -15.0), (-1, -before), (0, 0.0), (1, after), (2, 18.0))
        return sum((-1.0) ** k * np.vectorize(math.erf)((x - at) / (math.sqrt(2.0) * blur)) for k, at in lines)

    u, v = np.arange(64.0) - 32.3, np.arange(64.0) - 31.8
    image = (120.0 - 70.0 * wave(v)[:, None] * -wave(u)).astype(np.float32)
    sides = np.array([[[7.7, 0.0], [0.0, 7.7]]])
    # Line 1 runs along u: its neighbours lie before and after in v. For line 2 +90 degrees is -u.
    gaps = np.array([[[before, after], [after, before]]])
    off = []
    for known in (gaps, gaps + 1e3):
        shape = Geometry(sides, np.zeros((1, 2)), known, np.zeros((1, 2, 2), bool))
        start = np.array([[32.0, 32.0]])
        fit = fit_edges(image, start, shape, np.ones(1), np.full(1, 1.9), radius_px=18.0, iterations=12)
        assert fit.contrast[0] > 100.0
        off.append(float(np.abs(fit.pixels - [32.3, 31.8]).max()))
    assert off[0] < 0.01
    assert off[1] > 0.03


def test_the_background_beyond_the_board_does_not_bias_corners() -> None:
    """A board's last corner: squares 7.5 px wide to the right and 8.5 px high below, then paper; s = 2."""
    blur, right, below = 2.0, 7.5, 8.5

    def edge(x: np.ndarray) -> np.ndarray:
        return np.vectorize(math.erf)(x / (math.sqrt(2.0) * blur))

    u, v = np.arange(64.0) - 32.3, np.arange(64.0) - 31.8
    board = 0.25 * (1.0 - edge(u - right))[None] * (1.0 - edge(v - below))[:, None]
    squares = (edge(u) - edge(u + 16.0) + 1.0)[None] * (edge(v) - edge(v + 16.0) + 1.0)[:, None]
    image = (120.0 + 70.0 * (1.0 - board + board * squares)).astype(np.float32)
    off = []
    for known in (True, False):
        ends = np.array([[[False, known], [known, False]]])
        gaps = np.array([[[16.0, below], [right, 16.0]]])
        shape = Geometry(np.array([[[right, 0.0], [0.0, below]]]), np.zeros((1, 2)), gaps, ends)
        fit = fit_edges(
            image, np.array([[32.0, 32.0]]), shape, np.ones(1), np.full(1, blur), radius_px=18.0, iterations=12
        )
        assert fit.contrast[0] > 100.0
        off.append(float(np.abs(fit.pixels - [32.3, 31.8]).max()))
    assert off[1] > 0.05
    assert off[0] < 0.5 * off[1]


def test_lines_aslant_mix_as_in_a_gaussian_blur() -> None:
    """E[sign d1 sign d2] of two normal variables correlated by the lines' cosine, from their joint distribution."""
    from scipy.stats import multivariate_normal, norm

    for oblique, most in ((0.5 * np.pi, 1e-3), (1.0, 6e-3), (0.75, 0.025)):
        shape = geometry(1, oblique=oblique)
        window = collect(
            np.zeros((64, 64), np.float32), np.array([[32.0, 32.0]]), shape, np.full(1, 5.0), radius_px=6.0
        )
        values = np.zeros((1, PARAMETERS))
        values[:, 2:4] = 0.2, 0.2 + oblique
        # So blurred that the pixel's square does not show.
        values[:, 4:7] = 5.0, 0.0, 1.0
        far = Geometry(shape.sides, shape.curvature, shape.gaps + 1e3, shape.ends)
        ours = pattern_of(values, window, far)[0]
        x = [(np.cos(a) * window.v[0] - np.sin(a) * window.u[0]) / 5.0 for a in values[0, 2:4]]
        rho = np.cos(oblique)
        joint = multivariate_normal(cov=[[1.0, rho], [rho, 1.0]]).cdf(np.stack(x, axis=-1))
        true = -(4.0 * joint - 2.0 * norm.cdf(x[0]) - 2.0 * norm.cdf(x[1]) + 1.0)
        assert np.abs(ours - true)[window.weight[0] > 0].max() < most, oblique


def test_wrong_polarity_shows_as_negative_contrast(rng: np.random.Generator) -> None:
    shape = geometry(3)
    pixels = corners(3, rng)
    image, _ = image_of(pixels, shape, 0.8)
    fit = fit_edges(image, pixels, shape, -np.ones(3), np.full(3, 0.8), radius_px=18.0, iterations=8)
    assert (fit.contrast < -100.0).all()


def test_predicted_sigma_is_the_scatter(rng: np.random.Generator) -> None:
    count = 200
    shape = geometry(count, oblique=1.2)
    pixels = corners(count, rng)
    image, _ = image_of(pixels, shape, 0.8)
    noisy = image + rng.normal(0.0, 5.0, image.shape).astype(np.float32)
    fit = fit_edges(noisy, pixels, shape, np.ones(count), np.full(count, 0.8), radius_px=18.0, iterations=8)
    assert fit.valid.all()
    actual = np.sqrt(((fit.pixels - pixels) ** 2).mean())
    predicted = np.sqrt((fit.sigma_px**2).mean())
    assert abs(actual / predicted - 1.0) < MONTE_CARLO_REL


def test_what_is_the_same_on_both_sides_is_no_noise(rng: np.random.Generator) -> None:
    """A tone curve leaves residuals three times the noise; the corners scatter by what the noise explains."""
    count = 200
    shape = geometry(count, oblique=1.2)
    pixels = corners(count, rng)
    image, _ = image_of(pixels, shape, 0.8)
    curved = 230.0 * (np.clip(image - 40.0, 0.0, 170.0) / 170.0) ** 0.45
    noisy = (curved + rng.normal(0.0, 2.0, image.shape)).astype(np.float32)
    fit = fit_edges(noisy, pixels, shape, np.ones(count), np.full(count, 0.8), radius_px=18.0, iterations=8)
    assert fit.valid.all()
    assert np.median(fit.residual) > 5.0
    actual = np.sqrt(((fit.pixels - pixels) ** 2).mean())
    predicted = np.sqrt((fit.sigma_px**2).mean())
    assert abs(actual / predicted - 1.0) < SHAPED_REL
    blind = fit_edges(
        noisy, pixels, shape, np.ones(count), np.full(count, 0.8), radius_px=18.0, iterations=8, mirrored=False
    )
    assert np.sqrt((blind.sigma_px**2).mean()) > 2.0 * actual


def test_corner_at_the_frame_is_not_trusted() -> None:
    shape = geometry(1)
    image, _ = image_of(np.array([[32.0, 32.0]]), shape, 0.8)
    fit = fit_edges(image[:, 32:], np.array([[0.2, 32.0]]), shape, np.ones(1), np.ones(1), radius_px=18.0, iterations=4)
    assert not fit.valid.any()


def test_sharp_edges_have_the_pixel_s_shape() -> None:
    """An edge of a hundred grey levels under the exact integral over the pixel's square, from sharp to blurred."""
    nodes, weights = np.polynomial.legendre.leggauss(24)
    for blur, most in ((0.3, 0.1), (0.45, 0.03), (0.55, 0.03), (0.8, 0.01)):
        for angle in (0.0, 0.3, 0.25 * np.pi):
            x = np.linspace(-2.0, 2.0, 81)
            true = np.zeros_like(x)
            for a, wa in zip(nodes, weights, strict=True):
                for b, wb in zip(nodes, weights, strict=True):
                    at = x - 0.5 * (a * np.cos(angle) + b * np.sin(angle))
                    true += 0.25 * wa * wb * np.array([math.erf(v / (math.sqrt(2.0) * blur)) for v in at])
            width = math.hypot(blur, math.sqrt(1.0 / 12.0))
            flat = PIXEL_KURTOSIS * (np.cos(angle) ** 4 + np.sin(angle) ** 4)
            shape = (np.array([[width]], np.float32), np.array([[flat]], np.float32))
            ours = _edge(x[None].astype(np.float32), *shape)[0][0]
            assert 100.0 * np.abs(ours - true).max() / 2.0 < most, (blur, angle)


def test_a_covered_corner_shows_as_noise(rng: np.random.Generator) -> None:
    """A ruler over a third of a corner's window: residuals that mirroring changes, a dozen times those elsewhere."""
    shape = geometry(5)
    pixels = corners(5, rng)
    image, _ = image_of(pixels, shape, 0.8)
    image += rng.normal(0.0, 1.0, image.shape).astype(np.float32)
    image[:, 128 + 36 : 192] = 200.0
    fit = fit_edges(image, pixels, shape, np.ones(5), np.full(5, 0.8), radius_px=18.0, iterations=8)
    others = np.array([0, 1, 3, 4])
    assert np.abs(fit.noise[others] - 1.0).max() < 0.3
    assert fit.noise[2] > 12.0


def test_neighbours_that_fell_together_turn_no_line() -> None:
    """A tiny board: two corners in one place leave a cell without a direction, and no warning."""
    n = 9
    sides = np.tile(np.array([[10.0, 0.0], [0.0, 10.0]]), (n, 1, 1))
    sides[4, 0] = 0.0
    gaps = np.full((n, 2, 2), 10.0)
    geometry = Geometry(sides, np.zeros((n, 2)), gaps, np.zeros((n, 2, 2), np.bool_))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        turned = tilted(geometry, np.ones((3, 3), np.bool_))
    assert turned.tilts is not None and (turned.tilts == 0.0).all()
    assert np.isfinite(np.delete(turned.gaps, 4, axis=0)).all()
