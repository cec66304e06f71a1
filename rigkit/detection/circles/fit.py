"""The fit of circles to an image, with the standard deviations of their centres.

A circle's edge is c + M w + H(w, w) / 2 for the unit circle |w| = 1 in its plane, in radii. c is the image of the
centre. It differs from the centre of the visible ellipse by H, the second derivatives of the map from the plane to the
image, due to slant and lens. H comes from the circle's neighbours; c, M, blur and light are fitted to the pixels
(circles.c).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray, IntArray
from rigkit.detection.circles.blobs import scaled_up
from rigkit.detection.saddles.response import GreyImage
from rigkit.detection.subpixel.edge_model import TAIL_SIGMAS
from rigkit.kernels import circles as kernel

PLAIN_ITERATIONS, ITERATIONS = 5, 30
"""Fits of edges that follow the model converge in five steps; those of others (sharpened, moved) take up to thirty, the
later ones relaxed. They end when steps are below 0.001 px, or a twentieth of the sigma of the centre."""
NEAR_SIGMAS, WINDOW_MARGIN_PX = 4.0, 3.0
"""Distance from its edge, in sigmas of the blur and in px, up to which a circle has pixels."""
RIM_SIGMAS = 4.0
"""Distance from its edge, in sigmas of the blur, up to which a circle without a neighbour on some side has pixels: with
2.5 its error is a quarter above the Cramer-Rao bound, with 4 a tenth."""
MODEL_SIGMA_PX = 5e-4
"""Error of a centre without noise, as the edge model differs from rendered circles: 0.0003 to 0.0007 px."""


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class CircleFit:
    """N fitted circles.

    Attributes
    ----------
    pixels : (N, 2) images of the centres.
    maps : (N, 2, 2) px per radius; the rotation of the circle in its plane is the initial one.
    growth : (N, 3) symmetric part of the relative change of `maps`: size, and stretch along x and along the diagonal.
    growth_variance, covariance : (N, 3) and (N, 2, 2) of `growth` and `pixels` for white noise, the second in px^2.
    blur_px, brightness, contrast, residual : (N,) blur of the edge, level around the circle, difference of the level
        inside, RMS residual in grey levels.
    count : (N,) pixels.
    harmonics : (N, 6, 2) cosine and sine of harmonics 3 to 8 of the edge, in radii.
    uneven : (N, 5) normal equations of a correction of `uneven_px2` from the residuals, over their variance: the
        right-hand side and the matrix (xx, xy, yy).
    added_light, added_light_covariance : (N, 2) and (N, 2, 2) move of the centre if light added to the image (glare)
        had a gradient of its own, px, and its covariance for white noise.
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
    added_light: FloatArray
    added_light_covariance: FloatArray
    valid: BoolArray

    def enlarged(self, scale: int) -> CircleFit:
        """Return the circles in an image that is `scale` times as large."""
        return replace(
            self,
            pixels=scaled_up(self.pixels, scale),
            maps=scale * self.maps,
            covariance=scale**2 * self.covariance,
            blur_px=scale * self.blur_px,
            uneven=self.uneven / np.array([scale**2] * 2 + [scale**4] * 3),
            added_light=scale * self.added_light,
            added_light_covariance=scale**2 * self.added_light_covariance,
        )

    @property
    def share(self) -> FloatArray:
        """Return the contrasts (N,) relative to the brighter of circle and sheet."""
        brighter = np.maximum(self.brightness, self.brightness + self.contrast)
        return np.asarray(np.abs(self.contrast) / np.maximum(brighter, 1e-6))

    @property
    def sigma_px(self) -> FloatArray:
        """Return the standard deviations (N,) of a coordinate of `pixels`, the mean of both."""
        return np.asarray(np.sqrt(0.5 * np.trace(self.covariance, axis1=1, axis2=2)))


def _rules(iterations: int, *, brief: bool) -> kernel.CircleRules:
    return kernel.CircleRules.of(
        near_sigmas=NEAR_SIGMAS,
        near_px=WINDOW_MARGIN_PX,
        min_blur=0.25,
        max_blur=12.0,
        max_move_px=1.0,
        max_growth=0.2,
        max_light=1.5,
        converged_px=1e-3,
        converged_sigmas=0.05,
        near_beside=TAIL_SIGMAS,
        iterations=iterations,
        plain_iterations=PLAIN_ITERATIONS,
        min_pixels=16,
        brief=int(brief),
    )


def edge_reach(
    maps: FloatArray, half_way: float, blur_px: FloatArray, surrounded: BoolArray, corner: float = 1.0
) -> FloatArray:
    """Return the radius (N,) of each circle's own pixels, in its radii.

    It is half the distance to the next circle; without a next one the sheet may end before. If blur mixes the light of
    circles, the paper is visible at the corners of a cell only, and the radius is `corner` times as large.
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
    *,
    iterations: int = ITERATIONS,
    brief: bool = False,
) -> CircleFit:
    """Return the fit of circles to their pixels.

    Parameters
    ----------
    pixels : (N, 2) centres, known to a few tenths of the radius.
    maps : (N, 2, 2) px per radius.
    curvatures : (N, 2, 3) second derivatives of the image with respect to the plane, xx, xy, yy, px per radius squared.
    blur_px : (N,) initial blur.
    reach : (N,) radius of the circle's own pixels, in radii: half the distance to its neighbours.
    beside : (N, BESIDE) neighbours whose light blur brings into a circle's pixels; -1 for none.
    uneven_px2 : (2,) anisotropy of the blur, as with motion: half its variance along x minus that along y, and likewise
        along the diagonal minus across it.
    brief : for a further fit; `harmonics`, `uneven` and `added_light` are 0. It takes three fifths of the time.
    """
    rules = _rules(iterations, brief=brief)
    extent = np.sqrt((maps**2).sum(axis=2)).max(axis=1, initial=1.0)
    margin = np.abs(curvatures).sum(axis=(1, 2)) + 1.0
    own = np.minimum(reach * extent, extent + NEAR_SIGMAS * blur_px + WINDOW_MARGIN_PX) + margin
    finite = own[np.isfinite(own)]
    capacity = int((2.0 * float(finite.max(initial=1.0)) + 2.0) ** 2)
    capacity = min(capacity, grey.size)
    beside = np.full((len(pixels), kernel.BESIDE), -1) if beside is None else beside
    uneven = np.zeros((len(pixels), 2)) if uneven_px2 is None else np.tile(uneven_px2, (len(pixels), 1))
    rows = kernel.fit_circles(grey, pixels, maps, curvatures, blur_px, uneven, reach, beside, capacity, rules)
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
        harmonics=rows[:, 18:30].reshape(-1, 6, 2),
        uneven=rows[:, 30:35] / np.maximum(rows[:, 12:13], 1e-6) ** 2,
        added_light=rows[:, 35:37],
        added_light_covariance=rows[:, [37, 38, 38, 39]].reshape(-1, 2, 2) * (rows[:, 12] ** 2)[:, None, None],
        valid=valid,
    )


def _growth(maps: FloatArray, found: FloatArray) -> FloatArray:
    """Return the symmetric part (N, 3) of the relative change from the given maps to those `found`."""
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
