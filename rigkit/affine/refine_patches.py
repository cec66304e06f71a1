"""Refinement of affinities by aligning the patches of two images.

Minimises sum_u w(u) (g I2(A u + q2) + b - I1(q1 + u))^2 over A, q2, gain g and offset b, with a Gaussian window w
(Lucas-Kanade with an affine warp, inverse compositional: Baker and Matthews, "Lucas-Kanade 20 Years On", 2004).

A plane maps as x2(u) = x2 + A u + u^T H u / 2, with H from perspective and distortion. Alignment by an affine warp
under a window w estimates the mean of that map over the window, and so is biased by sum_w u^T H u / 2. Pose and plane
determine H (`curvature_shift`). The bias is thousandths of a pixel between pinhole images of near surfaces and
hundredths between distorted ones: more than the noise of the mean of many patches, and similar throughout a part of the
image.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rigkit.cameras.base import Camera
from rigkit.core.arrays import Affines, BoolArray, FloatArray, Pixels
from rigkit.geometry.rigid3 import Rigid3
from rigkit.kernels.patches import MAX_LEVELS, PatchRules, Pyramid, aligned, starts_of

PATCH_STEPS = 20
HALF_WIDTH_OF_FEATURE = 16
"""Half width, px, of a patch in the image with the higher resolution; the surface is assumed to be flat within it."""
PATCH_SETTLED_PX = 1e-3
"""The alignment ends when a step moves a patch's border by less."""
WINDOW_OF_PATCH = 0.6
"""Standard deviation of the window, in half sides of the patch."""
MIN_CONTRAST = 2.0
"""Smallest standard deviation of the grey levels of a patch that can be aligned."""
FLOOR_PX = 0.05
"""Error in addition to noise, due to interpolation and to perspective within the patch."""
BLUR_PX = 0.8
"""Standard deviation of the smoothing of both images, so that their gradients fit their interpolation."""
MIN_LEVEL_SIDE_PX = 40
"""Smallest side of the coarsest level of a pyramid."""
EXCESS_NOISE = 4.0
"""Variance of a patch's position and affinity over that under independent noise: smoothing and interpolation correlate
neighbouring pixels."""
QUANTISATION = 0.3
"""Noise of an image rounded to whole grey levels."""
STENCIL_PX = 4.0
"""Step of the second differences, about the width of a window."""
MAX_CURVATURE_PX = 1.0
"""Larger shifts are due to wrong planes and set to zero."""


class RefinedPatches(NamedTuple):
    """N patches aligned.

    Attributes
    ----------
    A21 : (N, 2, 2)
    pixels2 : (N, 2)
    sigma_A, sigma_px : (N,) from the residuals of the patches, with the floor FLOOR_PX.
    correlation : (N,) of the two patches, -1 to 1.
    valid : (N,) textured, inside both images, converged, not mirrored, moved by less than half a patch.
    """

    A21: Affines
    pixels2: Pixels
    sigma_A: FloatArray
    sigma_px: FloatArray
    correlation: FloatArray
    valid: BoolArray


def patch_pyramid(grey: NDArray[np.generic]) -> Pyramid:
    """Return the image pyramid of the smoothed image (H, W), grey levels 0 to 255."""
    import cv2

    levels = [np.asarray(cv2.GaussianBlur(np.asarray(grey, np.float32), (0, 0), BLUR_PX), np.float32)]
    while len(levels) < MAX_LEVELS and min(levels[-1].shape) >= 2 * MIN_LEVEL_SIDE_PX:
        levels.append(np.asarray(cv2.pyrDown(levels[-1]), np.float32))
    return Pyramid.make(levels)


def patch_rules(
    half_width: int,
    *,
    coarsest: int = 0,
    max_move: float,
    min_correlation: float = -1.0,
    max_sigma: float = np.inf,
    excess_noise: float = 1.0,
    settled_px: float = PATCH_SETTLED_PX,
) -> PatchRules:
    """Return the parameters of the patch alignment.

    Parameters
    ----------
    half_width : of the patch, px of its pyramid level.
    coarsest : levels by which a patch with too little texture may be aligned more coarsely.
    max_move : px of its level by which a patch may move.
    min_correlation, max_sigma : of a valid patch; sigma in px of image 2, along the axis of largest variance.
    excess_noise : factor of the variance that the residuals of the patches show.
    settled_px : the alignment ends when a step moves a patch's border by less.
    """
    return PatchRules(
        half=half_width,
        coarsest=coarsest,
        max_steps=PATCH_STEPS,
        width=WINDOW_OF_PATCH * half_width,
        settled=settled_px,
        max_move=max_move,
        min_contrast=MIN_CONTRAST,
        min_correlation=min_correlation,
        max_sigma=max_sigma,
        min_noise=QUANTISATION,
        excess_noise=excess_noise,
    )


def levels_of_larger(A21: Affines) -> FloatArray:
    """Return the pyramid levels (...) of image 1 at which patches have about the resolution of image 2."""
    return np.asarray(np.maximum(np.floor(0.5 - 0.5 * np.log2(np.abs(np.linalg.det(A21)))), 0.0))


def refine_patches(
    pyramid1: Pyramid, pyramid2: Pyramid, pixels1: Pixels, pixels2: Pixels, A21: Affines
) -> RefinedPatches:
    """Return the affinities and pixels of image 2 that best align patches around `pixels1`.

    Parameters
    ----------
    pyramid1, pyramid2 : of the two images (`patch_pyramid`).
    pixels1, pixels2 : (N, 2); pixels2 with errors of at most a few px.
    A21 : (N, 2, 2) with errors of at most a few tenths.
    """
    rules = patch_rules(HALF_WIDTH_OF_FEATURE, max_move=0.5 * HALF_WIDTH_OF_FEATURE, excess_noise=EXCESS_NOISE)
    found = aligned(pyramid1, pyramid2, rules, starts_of(pixels1, pixels2, A21))
    # Detail that only the sharper image 1 shows remains in the residuals, correlated over a pixel of image 2.
    with np.errstate(invalid="ignore"):
        shown = np.abs(np.linalg.det(found.A21)) * 4.0 ** levels_of_larger(found.A21)
    variances = np.einsum("nii->ni", found.covariance) / np.minimum(shown, 1.0)[:, None]
    return RefinedPatches(
        A21=found.A21,
        pixels2=found.pixels2,
        sigma_A=np.hypot(np.sqrt(variances[:, 2:].mean(axis=1)), FLOOR_PX / HALF_WIDTH_OF_FEATURE),
        sigma_px=np.hypot(np.sqrt(variances[:, :2].mean(axis=1)), FLOOR_PX),
        correlation=found.correlation,
        valid=np.isfinite(found.correlation),
    )


def window_variance(half_width: int) -> float:
    """Return the variance of a patch's window along an axis, px^2 of its pyramid level."""
    offset = np.arange(-half_width, half_width + 1.0)
    weight = np.exp(-0.5 * (offset / (WINDOW_OF_PATCH * half_width)) ** 2)
    return float(np.sum(weight * offset**2) / np.sum(weight))


def curvature_shift(
    pixels1: Pixels,
    planes: FloatArray,
    variance: FloatArray,
    cameras: tuple[Camera, Camera],
    cam2_from_cam1: Rigid3,
    off: FloatArray | None = None,
) -> FloatArray:
    """Return the bias of the aligned positions in image 2, (N, 2) px; zero where unknown.

    Parameters
    ----------
    pixels1 : (N, 2) positions in image 1.
    planes : (N, 3) m of the planes m . X = 1, in the frame of camera 1; NaN where unknown.
    variance : (N,) of the window along an axis, px^2 of image 1.
    off : (N, 2) offset of `pixels1` from the window centres; None: zero.
    """
    by_uu, by_uv, by_vv = _second_derivatives(pixels1, planes, cameras, cam2_from_cam1)
    shift = variance[:, None] * (by_uu + by_vv)
    if off is not None:
        du, dv = off.T[:, :, None]
        shift = shift - (du**2 * by_uu + 2.0 * du * dv * by_uv + dv**2 * by_vv)
    shift = 0.5 * shift
    good = np.linalg.norm(shift, axis=1) < MAX_CURVATURE_PX
    return np.where(good[:, None], shift, 0.0)


def _second_derivatives(
    pixels1: Pixels, planes: FloatArray, cameras: tuple[Camera, Camera], cam2_from_cam1: Rigid3
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return d2 pixel2 by (u, u), (u, v) and (v, v), (N, 2) each, of the planes m . X = 1 (N, 3); NaN where unseen."""

    def seen_at(u: float, v: float) -> FloatArray:
        rays, _ = cameras[0].unproject(pixels1 + STENCIL_PX * np.array([u, v]))
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = 1.0 / np.sum(planes * rays, axis=1)
        points = np.where(distance > 0.0, distance, np.nan)[:, None] * rays
        return cameras[1].project(cam2_from_cam1.apply(points))[0]

    middle = seen_at(0.0, 0.0)
    right, left, down, up = seen_at(1.0, 0.0), seen_at(-1.0, 0.0), seen_at(0.0, 1.0), seen_at(0.0, -1.0)
    by_uu, by_vv = right + left - 2.0 * middle, down + up - 2.0 * middle
    by_uv = 0.5 * (seen_at(1.0, 1.0) + seen_at(-1.0, -1.0) - by_uu - by_vv) - middle
    return by_uu / STENCIL_PX**2, by_uv / STENCIL_PX**2, by_vv / STENCIL_PX**2
