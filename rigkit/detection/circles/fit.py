"""The fit of circles to an image: where their centres are, and how certain.

A circle's edge is c + M w + H(w, w) / 2 over the unit circle |w| = 1 of its plane, in radii. c is the image of the
centre. It differs from the middle of the ellipse seen by H, the curvature of the map from the plane to the image, which
slant and lens bring about: H comes from the circle's neighbours, c, M, the blur and the light from the pixels
(circles.c).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray, IntArray
from rigkit.detection.saddles.response import GreyImage
from rigkit.kernels import circles as kernel

NEAR_BESIDE = 3.0
"""Blur brings light of a neighbour into pixels that lie less than so many sigmas off it: a 700th of it."""
RULES = kernel.CircleRules.of(
    near_sigmas=4.0,
    near_px=3.0,
    min_blur=0.25,
    max_blur=12.0,
    max_move_px=1.0,
    max_growth=0.2,
    max_light=1.5,
    converged_px=1e-3,
    converged_sigmas=0.05,
    near_beside=NEAR_BESIDE,
    iterations=30,
    plain_iterations=5,
    min_pixels=16,
)
"""Fits of the model's own edges settle in five steps; those of others (sharpened, moved) take up to thirty, the later
ones relaxed. They end where steps are as small as MODEL_SIGMA_PX, or a twentieth of what the circle is known to."""
RIM_SIGMAS = 4.0
"""A circle without a neighbour on some side is fitted to the pixels up to so many sigmas of blur outside of it: with
2.5 the error there is a quarter over the bound, with 4 a tenth."""
MODEL_SIGMA_PX = 5e-4
"""What a centre is off without noise, by how the edge model departs from rendered circles: 0.0003 to 0.0007 px."""


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class CircleFit:
    """N circles as fitted.

    Attributes
    ----------
    pixels : (N, 2) images of the centres.
    maps : (N, 2, 2) px per radius; a turn of the circle in itself is as it was given.
    growth : (N, 3) symmetric part of how `maps` differ from those given: size, and stretch along and aslant of x.
    growth_variance, covariance : (N, 3) and (N, 2, 2) of `growth` and `pixels` for white noise, the second in px^2.
    blur_px, brightness, contrast, residual : (N,) blur of the edge, level around the circle, what the level inside is
        more, RMS residual in grey levels.
    count : (N,) pixels.
    harmonics : (N, 4, 2) cosine and sine of harmonics 3 to 6 of the edge, in radii.
    uneven : (N, 5) what residuals say of `uneven_px2` beyond what was given: products with its two columns, and its
        normal equations (xx, xy, yy), both over the variance of the residuals.
    valid : (N,)
    """

    pixels: FloatArray
    maps: FloatArray
    growth: FloatArray
    growth_variance: FloatArray
    covariance: FloatArray
    blur_px: FloatArray
    brightness: FloatArray
    contrast: FloatArray
    residual: FloatArray
    count: FloatArray
    harmonics: FloatArray
    uneven: FloatArray
    valid: BoolArray

    @property
    def share(self) -> FloatArray:
        """Return the contrasts (N,) in parts of the brighter of circle and ground."""
        brighter = np.maximum(self.brightness, self.brightness + self.contrast)
        return np.asarray(np.abs(self.contrast) / np.maximum(brighter, 1e-6))

    @property
    def sigma_px(self) -> FloatArray:
        """Return the standard deviations (N,) of a coordinate of `pixels`, the mean of both."""
        return np.asarray(np.sqrt(0.5 * np.trace(self.covariance, axis1=1, axis2=2)))


def edge_reach(
    maps: FloatArray, half_way: float, blur_px: FloatArray, surrounded: BoolArray, corner: float = 1.0
) -> FloatArray:
    """Return to how many radii (N,) pixels are a circle's own.

    That is half the way to the next circle; where there is none, the sheet may end there. Where blur mixes the light of
    circles the paper is seen at the corner of a cell alone, `corner` times as far.
    """
    narrow = np.sqrt(np.maximum(np.linalg.eigvalsh(maps @ np.swapaxes(maps, 1, 2))[:, 0], 1.0))
    return np.where(surrounded, corner * half_way, np.minimum(half_way, 1.0 + RIM_SIGMAS * blur_px / narrow))


def fit_circles(
    grey: GreyImage,
    pixels: FloatArray,
    maps: FloatArray,
    curvatures: FloatArray,
    blur_px: FloatArray,
    reach: FloatArray,
    beside: IntArray | None = None,
    uneven_px2: FloatArray | None = None,
) -> CircleFit:
    """Fit circles to their pixels.

    Parameters
    ----------
    pixels : (N, 2) centres, known to a few tenths of the radius.
    maps : (N, 2, 2) px per radius.
    curvatures : (N, 2, 3) second derivatives of the image by the plane, xx, xy and yy, px per radius squared.
    blur_px : (N,) where to start.
    reach : (N,) radii to which pixels are the circle's own: half the way to its neighbours.
    beside : (N, BESIDE) neighbours, whose light blur brings into a circle's pixels; -1 for none.
    uneven_px2 : (2,) half of what the variance of the blur is more along x than along y, and along the diagonal between
        them than across it: with motion it is.
    """
    extent = np.sqrt((maps**2).sum(axis=2)).max(axis=1, initial=1.0)
    margin = np.abs(curvatures).sum(axis=(1, 2)) + 1.0
    own = np.minimum(reach * extent, extent + RULES.near_sigmas * blur_px + RULES.near_px) + margin
    finite = own[np.isfinite(own)]
    capacity = int((2.0 * float(finite.max(initial=1.0)) + 2.0) ** 2)
    capacity = min(capacity, grey.size)
    beside = np.full((len(pixels), kernel.BESIDE), -1) if beside is None else beside
    uneven = np.zeros((len(pixels), 2)) if uneven_px2 is None else np.tile(uneven_px2, (len(pixels), 1))
    rows = kernel.fit_circles(grey, pixels, maps, curvatures, blur_px, uneven, reach, beside, capacity, RULES)
    found = rows[:, 2:6].reshape(-1, 2, 2)
    covariance = rows[:, [6, 7, 7, 8]].reshape(-1, 2, 2) * (rows[:, 12] ** 2)[:, None, None]
    covariance = covariance + MODEL_SIGMA_PX**2 * np.eye(2)
    valid = (rows[:, 14] > 0.5) & np.isfinite(rows).all(axis=1)
    return CircleFit(
        pixels=rows[:, :2],
        maps=found,
        growth=_growth(maps, found),
        covariance=covariance,
        blur_px=rows[:, 9],
        brightness=rows[:, 10],
        contrast=rows[:, 11],
        residual=rows[:, 12],
        count=rows[:, 13],
        growth_variance=rows[:, 15:18] * (rows[:, 12] ** 2)[:, None],
        harmonics=rows[:, 18:26].reshape(-1, 4, 2),
        uneven=rows[:, 26:] / np.maximum(rows[:, 12:13], 1e-6) ** 2,
        valid=valid,
    )


def _growth(maps: FloatArray, found: FloatArray) -> FloatArray:
    """Return the symmetric part (N, 3) of how the maps `found` differ from those given."""
    with np.errstate(all="ignore"):
        relative = np.linalg.solve(np.where(np.isfinite(maps), maps, 1.0) + 1e-9 * np.eye(2), found)
    return np.stack(
        [
            0.5 * (relative[:, 0, 0] + relative[:, 1, 1]) - 1.0,
            0.5 * (relative[:, 0, 0] - relative[:, 1, 1]),
            0.5 * (relative[:, 0, 1] + relative[:, 1, 0]),
        ],
        axis=1,
    )
