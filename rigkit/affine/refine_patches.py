"""Affinities refined to a fraction of a pixel by aligning the patches of two images (Gauss-Newton, all at once)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rigkit.core.arrays import Affines, BoolArray, FloatArray, Pixels

__all__ = ["RefinedPatches", "refine_patches"]

Grey = NDArray[np.float32]

PATCH_STEPS = 20
SETTLED_PX = 1e-3
"""Move of a patch's border at which it is done."""
PATCH_SAMPLES = 19
"""Samples along a patch's side."""
PATCHES_AT_A_TIME = 1024
"""Patches at a time: about 25 MB of samples."""
MIN_CONTRAST = 2.0
"""Grey levels, standard deviation over a patch: below, there is nothing to align."""
FLOOR_PX = 0.05
"""What noise does not explain: interpolation, and perspective within the patch."""
BLUR_PX = 0.8
"""Both images are smoothed by this: gradients of raw pixels are not those of what interpolation makes of them."""


class _Grid(NamedTuple):
    """Sample positions u (P, 2) of a patch, and the square roots of their weights (P,)."""

    u: FloatArray
    root_w: FloatArray


class RefinedPatches(NamedTuple):
    """N patches aligned.

    Attributes
    ----------
    A21 : (N, 2, 2)
    pixels2 : (N, 2)
    sigma_A, sigma_px : (N,) from what the patches still differ by, with a floor for what noise does not explain.
    correlation : (N,) of the two patches, -1 to 1.
    valid : (N,) textured, inside both images, settled, not mirrored, moved by less than half a patch.
    """

    A21: Affines
    pixels2: Pixels
    sigma_A: FloatArray
    sigma_px: FloatArray
    correlation: FloatArray
    valid: BoolArray


def refine_patches(
    image1: Grey,
    image2: Grey,
    pixels1: Pixels,
    pixels2: Pixels,
    A21: Affines,
    *,
    half_width_px: float = 12.0,
) -> RefinedPatches:
    """Return the affinities and points of image 2 that align the surroundings of `pixels1` best.

    Parameters
    ----------
    image1, image2 : (H, W) grey levels 0 to 255.
    pixels1, pixels2 : (N, 2); pixels2 good to a few px.
    A21 : (N, 2, 2) good to a few tenths.
    half_width_px : of the patch in image 1; the surface is taken as flat within.

    Notes
    -----
    Minimises sum_u w(u) (g I2(A u + q2) + b - I1(q1 + u))^2 over A, q2, gain g and offset b, with a Gaussian window w
    (Lucas-Kanade with an affine warp, Baker and Matthews 2004).
    """
    import cv2

    smooth1, smooth2 = (np.asarray(cv2.GaussianBlur(v, (0, 0), BLUR_PX), dtype=np.float32) for v in (image1, image2))
    gradient_x, gradient_y = (
        np.asarray(cv2.Scharr(smooth2, cv2.CV_32F, *order) / 32.0, dtype=np.float32) for order in ((1, 0), (0, 1))
    )
    images = (smooth1, smooth2, (gradient_x, gradient_y))
    blocks = (slice(i, i + PATCHES_AT_A_TIME) for i in range(0, len(pixels1), PATCHES_AT_A_TIME))
    parts = [_refine_block(images, pixels1[b], pixels2[b], A21[b], half_width_px) for b in blocks]
    if not parts:
        empty = np.zeros(0)
        return RefinedPatches(np.zeros((0, 2, 2)), np.zeros((0, 2)), empty, empty, empty, np.zeros(0, dtype=bool))
    return RefinedPatches(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def _refine_block(
    images: tuple[Grey, Grey, tuple[Grey, Grey]], pixels1: Pixels, pixels2: Pixels, A21: Affines, half_width: float
) -> RefinedPatches:
    image1, image2, gradients = images
    n = len(pixels1)
    line = np.linspace(-half_width, half_width, PATCH_SAMPLES)
    u = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    grid = _Grid(u, np.exp(-0.25 * np.sum(u * u, axis=1) / (0.6 * half_width) ** 2))
    template, inside1 = _sample(image1, pixels1[:, None, :] + u)
    A, q = A21.copy(), pixels2.copy()
    usable = inside1 & (template.std(axis=1) > MIN_CONTRAST)
    moving = usable.copy()
    for _ in range(PATCH_STEPS):
        which = np.flatnonzero(moving)
        if not which.size:
            break
        step, gain, inside, _, _ = _align(image2, gradients, template[which], A[which], q[which], grid)
        A[which] += step[:, :4].reshape(-1, 2, 2)
        q[which] += step[:, 4:]
        border = np.abs(step[:, :4]).sum(axis=1) * half_width + np.abs(step[:, 4:]).sum(axis=1)
        lost = ~inside | ~(gain > 0.0) | ~np.isfinite(border)
        lost |= ~(np.linalg.norm(q[which] - pixels2[which], axis=1) < 0.5 * half_width)
        usable[which[lost]] = False
        moving[which[lost | (border < SETTLED_PX)]] = False
    sigma_A, sigma_px, correlation = np.full((3, n), np.nan)
    valid = usable & ~moving
    valid[valid] = np.linalg.det(A[valid]) > 0.0
    good = np.flatnonzero(valid)
    if good.size:
        _, _, inside, system, solution = _align(image2, gradients, template[good], A[good], q[good], grid)
        variances = _variances(template[good], system, solution, grid)
        sigma_A[good] = np.hypot(np.sqrt(variances[:, :4].mean(axis=1)), FLOOR_PX / half_width)
        sigma_px[good] = np.hypot(np.sqrt(variances[:, 4:].mean(axis=1)), FLOOR_PX)
        correlation[good] = _correlation(image2, template[good], A[good], q[good], grid)
        valid[good] = inside
    return RefinedPatches(A, q, sigma_A, sigma_px, correlation, valid)


def _align(
    image2: Grey, gradients: tuple[Grey, Grey], template: FloatArray, A: Affines, q: Pixels, grid: _Grid
) -> tuple[FloatArray, FloatArray, BoolArray, FloatArray, FloatArray]:
    """Return one step (N, 6) in (vec A, q), gains (N,), which patches are inside, and the system for `_covariance`."""
    at = q[:, None, :] + np.einsum("nij,pj->npi", A, grid.u)
    values, inside = _sample(image2, at)
    gx, gy = (_sample(g, at)[0] * grid.root_w for g in gradients)
    system = np.empty((len(A), 8, len(grid.u)))
    for row, gradient in ((0, gx), (2, gy)):
        np.multiply(gradient, grid.u[:, 0], out=system[:, row])
        np.multiply(gradient, grid.u[:, 1], out=system[:, row + 1])
    system[:, 4], system[:, 5] = gx, gy
    system[:, 6] = values * grid.root_w
    system[:, 7] = grid.root_w
    normal = system @ np.swapaxes(system, 1, 2)
    # A trace of damping: a patch without texture must not stop the others.
    scale = np.einsum("nii->ni", normal) + 1e-12
    normal[:, np.arange(8), np.arange(8)] += 1e-9 * scale
    right = system @ (template * grid.root_w)[:, :, None]
    solution: FloatArray = np.asarray(np.linalg.solve(normal, right)[..., 0], dtype=np.float64)
    gain = solution[:, 6]
    with np.errstate(divide="ignore", invalid="ignore"):
        step = np.asarray(solution[:, :6] / gain[:, None])
    return step, gain, inside, system, solution


def _variances(template: FloatArray, system: FloatArray, solution: FloatArray, grid: _Grid) -> FloatArray:
    """Return the variances (N, 6) of (vec A, q) from what the aligned patches still differ by."""
    residual = template * grid.root_w - np.einsum("nkp,nk->np", system, solution)
    variance = np.einsum("np,np->n", residual, residual) / (len(grid.u) - 8.0)
    normal = system @ np.swapaxes(system, 1, 2)
    scale = np.einsum("nii->ni", normal) + 1e-12
    normal[:, np.arange(8), np.arange(8)] += 1e-9 * scale
    inverse = np.linalg.inv(normal)
    return np.asarray(np.einsum("nii->ni", inverse)[:, :6] * (variance / solution[:, 6] ** 2)[:, None])


def _correlation(image2: Grey, template: FloatArray, A: Affines, q: Pixels, grid: _Grid) -> FloatArray:
    """Return the windowed normalised cross-correlation, (N,)."""
    values, _ = _sample(image2, q[:, None, :] + np.einsum("nij,pj->npi", A, grid.u))
    w = grid.root_w**2 / np.sum(grid.root_w**2)
    a, b = values - (values @ w)[:, None], template - (template @ w)[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(((a * b) @ w) / np.sqrt(((a * a) @ w) * ((b * b) @ w)))


def _sample(image: Grey, at: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Return the image at (N, P, 2) by cubic interpolation, and which of the N patches are wholly inside."""
    import cv2

    height, width = image.shape
    maps = at.astype(np.float32)
    values = cv2.remap(image, maps[..., 0], maps[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    with np.errstate(invalid="ignore"):
        inside = ((at >= 1.0) & (at <= [width - 2.0, height - 2.0])).all(axis=(1, 2))
    return values.astype(np.float64), np.asarray(inside)
