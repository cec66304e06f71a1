"""Maximum likelihood estimation of chessboard corners: Gauss-Newton on the edge model, all corners of an image at once.

For independent noise of equal variance, least squares is maximum likelihood and attains the Cramer-Rao bound; the
normal equations also give the standard deviation. The noise is estimated from the part of the residuals that is
antisymmetric about the corner. Blur of another shape, a tone curve or sharpening cause symmetric residuals, which do
not shift the corner.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray, IntArray
from rigkit.detection.saddles.response import GreyImage
from rigkit.detection.subpixel.edge_model import (
    END_SIGMAS,
    MIN_REACH,
    NEAR_PX,
    PAPER_SIGMAS,
    PIXEL_KURTOSIS,
    SHARP_BLUR_PX,
    TAIL_SIGMAS,
    WINDOW_REACH,
    Geometry,
)
from rigkit.kernels.edges import LAGS, CornerWindows, Rules, fit_corners

BLUR_RANGE = (0.28, 5.0)
"""Bounds of s: it is 0.29 in a perfectly sharp image, due to the pixels; above 5 px there are hardly any edges."""

ANGLE_SIGMA_RAD = 0.1
LOG_BLUR_SIGMA = 0.7
LIGHT_SIGMA_PER_PX = 0.01
"""Prior standard deviations of the lattice's angles, the initial log s and the gradient g of the light about 0. They
matter only for very small squares, where a gradient of the light is not distinguishable from a shift of the corner."""

MAX_MOVE_PX, MAX_TURN_RAD, MAX_BLUR_CHANGE, MAX_LIGHT_CHANGE = 1.0, 0.2, 0.3, 0.3
"""Largest changes per step of position, angles, relative blur and light, for which the model is nearly linear."""

BLUR_LAG = 2.0
"""Convergence requires a relative change of s below this times the bound on the corner's move, per px: a wrong s hardly
shifts the corner, but increases the residuals and thus the predicted sigma, most of all for sharp edges."""

MIN_MIRRORED, MAX_MIRRORED_PX = 12, 2.0
"""Smallest number of pixels with a mirror image from which noise is estimated, and largest distance of the corner from
the centre of its window: further off few pixels have a mirror image."""

ROUNDING_VARIANCE = 1.0 / 12.0
"""Lower bound of the noise variance in 8-bit images, in squared grey levels. Rounding causes no residuals in uniform
squares, but a uniformly distributed error at the edges, which determine the corner."""

MIN_VARIANCE = 1e-6
FIT_RIDGE = 1e-9
"""Lower bound of the variance in other images, and ridge of the normal equations, for images without noise or
contrast."""

VALID_MOVE_PX, VALID_MOVE_CELLS = 1.5, 0.2
"""Largest distance of a valid fit from its start, in px and in sides of its cell."""


@dataclass(frozen=True, eq=False, slots=True)
class EdgeFit:
    """The fitted corners.

    Attributes
    ----------
    outcomes : (N, 35) of `kernels.edges`, with the following attributes as columns.
    pixels : (N, 2)
    sigma_px : (N,) predicted standard deviation per axis, from the noise and the curvature of the likelihood.
    blur : (N,) s, px.
    contrast : (N,) 2 b, negative if the polarity is opposite to the expected one.
    residual : (N,) root mean square, grey levels.
    noise : (N,) root mean square noise, estimated from the antisymmetric part of the residuals.
    used : (N,) number of pixels.
    products, pairs : (N, 13) for each of `kernels.edges.LAGS` the sum of the products of the antisymmetric residuals of
        two pixels at that lag, and the number of pairs; 0 if the noise is unknown or due to rounding.
    valid : (N,) the fit converged near its start, with pixels on all sides.
    """

    outcomes: FloatArray

    @property
    def pixels(self) -> FloatArray:
        return self.outcomes[:, :2]

    @property
    def sigma_px(self) -> FloatArray:
        return self.outcomes[:, 2]

    @property
    def blur(self) -> FloatArray:
        return self.outcomes[:, 3]

    @property
    def contrast(self) -> FloatArray:
        return self.outcomes[:, 4]

    @property
    def residual(self) -> FloatArray:
        return self.outcomes[:, 5]

    @property
    def noise(self) -> FloatArray:
        return self.outcomes[:, 6]

    @property
    def valid(self) -> BoolArray:
        return np.asarray(self.outcomes[:, 7] > 0.5)

    @property
    def used(self) -> FloatArray:
        return self.outcomes[:, 8]

    @property
    def products(self) -> FloatArray:
        return self.outcomes[:, -2 * len(LAGS) : -len(LAGS)]

    @property
    def pairs(self) -> FloatArray:
        return self.outcomes[:, -len(LAGS) :]

    def of(self, which: BoolArray | IntArray) -> EdgeFit:
        """Return the corners `which` (N,)."""
        return EdgeFit(self.outcomes[which])

    def with_part(self, which: BoolArray, part: EdgeFit) -> EdgeFit:
        """Return the fit with the corners `which` (N,) replaced by `part`."""
        out = self.outcomes.copy()
        out[which] = part.outcomes
        return EdgeFit(out)

    def with_sigma_factors(self, times: FloatArray, *, all_is_noise: bool = False) -> EdgeFit:
        """Return the fit with sigmas multiplied by `times` (N,); `all_is_noise` : all residuals count as noise."""
        out = EdgeFit(self.outcomes.copy())
        out.sigma_px[:] *= times
        if all_is_noise:
            out.noise[:] = self.residual
            out.products[:] *= (times**2)[:, None]
        return out


def fit_edges(
    image: GreyImage,
    pixels: FloatArray,
    geometry: Geometry,
    sign: FloatArray,
    blur: FloatArray,
    *,
    radius_px: float,
    iterations: int,
    converged_px: float = 1e-3,
    mirrored: bool = True,
    curvature_sigma: FloatArray | None = None,
    contrast: FloatArray | None = None,
) -> EdgeFit:
    """Return the fits of the edge model to `image` (as from `grey_image`) at corners near `pixels` (N, 2).

    Parameters
    ----------
    sign : (N,) +1 where brightness increases with the angle across line 1, else -1.
    blur : (N,) expected s.
    radius_px : pixels further from the corner are not used.
    iterations : largest number of Gauss-Newton steps.
    mirrored : separate noise from other residuals; otherwise all count as noise.
    converged_px : the fit ends when a step moves the corner by less; the next step would be about a hundredth of it.
    curvature_sigma : (N, 2) standard deviations of the geometry's curvatures, 1/px; None or 0: curvatures are fixed.
    contrast : (N,) expected contrast; None or NaN: it is estimated from the window.
    """
    unknown = np.full(geometry.gaps.shape, np.nan)
    windows = CornerWindows(
        pixels=pixels,
        sides=geometry.sides,
        curvature=geometry.curvature,
        curvature_sigma=np.zeros((len(pixels), 2)) if curvature_sigma is None else curvature_sigma,
        gaps=geometry.gaps,
        tilts=np.zeros(geometry.gaps.shape) if geometry.tilts is None else geometry.tilts,
        reach=unknown if geometry.reach is None else geometry.reach,
        paper=unknown if geometry.paper is None else geometry.paper,
        single=np.zeros((len(pixels), 2)) if geometry.single is None else geometry.single,
        sign=sign,
        blur=blur,
        window_blur=blur if geometry.window_blur is None else geometry.window_blur,
        contrast=np.full(len(pixels), np.nan) if contrast is None else contrast,
        ends=geometry.ends,
    )
    rules = edge_rules(radius_px, iterations, converged_px, mirrored, image.dtype == np.uint8)
    return EdgeFit(fit_corners(image, windows, rules))


@functools.cache
def edge_rules(radius_px: float, iterations: int, converged_px: float, mirrored: bool, rounded: bool) -> Rules:
    return Rules(
        reach=WINDOW_REACH,
        end_sigmas=END_SIGMAS,
        paper_sigmas=PAPER_SIGMAS,
        min_reach=MIN_REACH,
        near_sigmas=TAIL_SIGMAS,
        near_px=NEAR_PX,
        tail_sigmas=TAIL_SIGMAS,
        pixel_kurtosis=PIXEL_KURTOSIS,
        sharp_blur=SHARP_BLUR_PX,
        min_blur=BLUR_RANGE[0],
        max_blur=BLUR_RANGE[1],
        angle_sigma=ANGLE_SIGMA_RAD,
        log_blur_sigma=LOG_BLUR_SIGMA,
        light_sigma=LIGHT_SIGMA_PER_PX,
        max_move_px=MAX_MOVE_PX,
        max_turn=MAX_TURN_RAD,
        max_blur_change=MAX_BLUR_CHANGE,
        max_light_change=MAX_LIGHT_CHANGE,
        min_variance=ROUNDING_VARIANCE if rounded else MIN_VARIANCE,
        ridge=FIT_RIDGE,
        converged_px=converged_px,
        blur_lag=BLUR_LAG,
        valid_move_px=VALID_MOVE_PX,
        valid_move_cells=VALID_MOVE_CELLS,
        max_mirrored=MAX_MIRRORED_PX,
        radius_px=radius_px,
        iterations=iterations,
        mirrored=mirrored,
        min_mirrored=MIN_MIRRORED,
    )
