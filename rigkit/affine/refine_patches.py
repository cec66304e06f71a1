"""Affinities refined to a fraction of a pixel by aligning the patches of two images.

Minimises sum_u w(u) (g I2(A u + q2) + b - I1(q1 + u))^2 over A, q2, gain g and offset b, with a Gaussian window w
(Lucas-Kanade with an affine warp, inverse compositional: Baker and Matthews, "Lucas-Kanade 20 Years On", 2004).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rigkit.core.arrays import Affines, BoolArray, FloatArray, Pixels
from rigkit.kernels.patches import MAX_LEVELS, PatchRules, Pyramid, aligned, starts_of

PATCH_STEPS = 20
HALF_WIDTH_OF_FEATURE = 16
"""Px, of a patch in the image that shows it larger; the surface is taken as flat within."""
PATCH_SETTLED_PX = 1e-3
"""Move of a patch's border at which it is done."""
WINDOW_OF_PATCH = 0.6
"""Standard deviation of the window, in half sides of the patch."""
MIN_CONTRAST = 2.0
"""Grey levels, standard deviation over a patch: below, there is nothing to align."""
FLOOR_PX = 0.05
"""What noise does not explain: interpolation, and perspective within the patch."""
BLUR_PX = 0.8
"""Both images are smoothed by this: gradients of raw pixels are not those of what interpolation makes of them."""
MIN_LEVEL_SIDE_PX = 40
"""Of the coarsest level of a pyramid: below, no patch fits in."""
EXCESS_NOISE = 4.0
"""Variance of a patch's place and affinity over that of noise independent from pixel to pixel: both images are smoothed
and interpolated, so that neighbouring pixels err together."""
QUANTISATION = 0.3
"""Grey levels: the noise of an image that is rounded to whole ones."""


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


def patch_pyramid(grey: NDArray[np.generic]) -> Pyramid:
    """Return the smoothed image (H, W), grey levels 0 to 255, and its halvings."""
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
    """Return how patches are aligned.

    Parameters
    ----------
    half_width : of the patch, px of the level that it is read from.
    coarsest : levels up to which a patch is aligned more coarsely where it has too little texture.
    max_move : px of its level by which a patch may move.
    min_correlation, max_sigma : of a good one; sigma in px of image 2, along the axis of which least is known.
    excess_noise : factor of the variance that the patches show.
    settled_px : move of a patch's border at which it is done.
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
    """Return the levels (...) by which image 1 is read more coarsely, as it shows the patches larger."""
    return np.asarray(np.maximum(np.floor(0.5 - 0.5 * np.log2(np.abs(np.linalg.det(A21)))), 0.0))


def refine_patches(
    pyramid1: Pyramid, pyramid2: Pyramid, pixels1: Pixels, pixels2: Pixels, A21: Affines
) -> RefinedPatches:
    """Return the affinities and points of image 2 that align the surroundings of `pixels1` best.

    Parameters
    ----------
    pyramid1, pyramid2 : of the two images (`patch_pyramid`).
    pixels1, pixels2 : (N, 2); pixels2 good to a few px.
    A21 : (N, 2, 2) good to a few tenths.
    """
    rules = patch_rules(HALF_WIDTH_OF_FEATURE, max_move=0.5 * HALF_WIDTH_OF_FEATURE, excess_noise=EXCESS_NOISE)
    found = aligned(pyramid1, pyramid2, rules, starts_of(pixels1, pixels2, A21))
    # Detail that only the sharper image 1 shows stays in the differences, alike over a pixel of image 2.
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
