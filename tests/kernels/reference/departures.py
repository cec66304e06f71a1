"""What kernels/departures.c computes, in numpy: all rows of all corners at once."""

from __future__ import annotations

import numpy as np

RADIAL_POWERS = (2, 4, 6, 8, 10)


def displacements(pixels: np.ndarray, size_px: tuple[int, int]) -> np.ndarray:
    """Return the displacements (2, J, M) at pixels (M, 2)."""
    centre, scale = 0.5 * (np.array(size_px) - 1.0), 2.0 / np.hypot(*size_px)
    x, y = (pixels - centre).T * scale
    square, none = x * x + y * y, np.zeros_like(x)
    radial = [(square ** (k // 2) * x, square ** (k // 2) * y) for k in RADIAL_POWERS]
    decentring = [(square + 2.0 * x * x, 2.0 * x * y), (2.0 * x * y, square + 2.0 * y * y)]
    prisms = [(square, none), (none, square), (square**2, none), (none, square**2)]
    return np.moveaxis(np.array([*radial, *decentring, *prisms, (x, -y), (y, x)]), 0, 1)


def averaged_amounts(information: np.ndarray, score: np.ndarray, sizes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return E[a a^T] (J, J) and E[a] (J,), averaged over all pairs of sizes."""
    along, others = (size.ravel() for size in np.meshgrid(sizes, sizes))
    prior = np.where(np.arange(len(score)) < len(RADIAL_POWERS), along[:, None], others[:, None])
    scaled = np.eye(len(score)) + prior[:, :, None] * information * prior[:, None, :]
    variance = np.linalg.inv(scaled) * prior[:, :, None] * prior[:, None, :]
    mean = variance @ score
    evidence = 0.5 * (mean @ score - np.linalg.slogdet(scaled)[1])
    weight = np.exp(evidence - evidence.max())
    weight /= weight.sum()
    second = np.einsum("h,hij->ij", weight, variance + mean[:, :, None] * mean[:, None])
    return second, weight @ mean


def products(
    d_pixels_d_point: np.ndarray,
    d_pixels_d_parameters: np.ndarray,
    sigmas: np.ndarray,
    lever: np.ndarray,
    pixels: np.ndarray,
    residuals: np.ndarray,
    usable: np.ndarray,
    view: np.ndarray,
    size_px: tuple[int, int],
) -> np.ndarray:
    """Return of every view (V,) the products of all rows (V, K + 6, K + 6); `view` (N,) is that of each corner,
    `pixels` are (N, 2)."""
    turn = np.cross(lever.T[:, None], d_pixels_d_point.transpose(2, 0, 1)).transpose(1, 2, 0)
    beyond = displacements(pixels, size_px)
    lens = sigmas[:, None] * d_pixels_d_parameters
    rows = np.concatenate([turn, d_pixels_d_point, lens, beyond, residuals.T[:, None]], axis=1)
    each = [rows[..., usable & (view == k)] for k in range(view.max() + 1)]
    return np.array([np.einsum("ikn,ijn->kj", part, part) for part in each])
