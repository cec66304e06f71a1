"""Chessboard corners by maximum likelihood: Gauss-Newton on the edge model, all corners of an image at once.

For noise that is independent and equal in all pixels, least squares is maximum likelihood and reaches the Cramer-Rao
bound; the same normal equations predict the standard deviation. How large the noise is, is read from what the model
leaves and mirroring at the corner changes: blur of another shape, a tone curve or sharpening leave much, but the same
on both sides, and so do not move the corner.
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
    NEAR_SIGMAS,
    PAPER_SIGMAS,
    PIXEL_KURTOSIS,
    SHARP_BLUR_PX,
    TAIL_SIGMAS,
    WINDOW_REACH,
    Geometry,
)
from rigkit.kernels.edges import LAGS, Rules, fit_corners

BLUR_RANGE = (0.28, 5.0)
"""s of a perfectly sharp image is the pixel's own 0.29; above 5 px there is no edge to speak of."""

ANGLE_SIGMA_RAD = 0.1
LOG_BLUR_SIGMA = 0.7
LIGHT_SIGMA_PER_PX = 0.01
"""How well the lattice's angles, the start's log s and an even light (g = 0) are known beforehand. These matter only
where squares are so small that the pixels cannot tell; there, a gradient of the light passes for a shifted corner."""

MAX_MOVE_PX, MAX_TURN_RAD, MAX_BLUR_CHANGE, MAX_LIGHT_CHANGE = 1.0, 0.2, 0.3, 0.3
"""A step is cut where it would leave the region in which the model is nearly linear: position, angles, relative blur,
light."""

BLUR_LAG = 2.0
"""The last step may change s by this part of it for each px that it may move the corner: a wrong s hardly moves the
corner, but adds to the residuals and so to the predicted sigma, most of all on sharp edges."""

MIN_MIRRORED, MAX_MIRRORED_PX = 12, 2.0
"""Noise is read from so many pixels with a mirror image at least, and not where a corner has ended so far from the
middle of its window: little of the window has a mirror image then."""

ROUNDING_VARIANCE = 1.0 / 12.0
"""Of grey levels, the least in 8-bit images: in flat squares rounding is the same everywhere and leaves nothing, but at
the edges, where the corner comes from, its error varies evenly over a level."""

MIN_VARIANCE = 1e-6
FIT_RIDGE = 1e-9
"""Of grey levels, and on the normal equations' diagonal: keep an image without noise or without contrast solvable."""

VALID_MOVE_PX, VALID_MOVE_CELLS = 1.5, 0.2
"""A fit that ends further from its start, in px or in sides of its cell, has found something else."""


@dataclass(frozen=True, eq=False, slots=True)
class EdgeFit:
    """The fitted corners.

    Attributes
    ----------
    outcomes : (N, 35) as of `kernels.edges`: what follows, side by side.
    pixels : (N, 2)
    sigma_px : (N,) predicted standard deviation per axis, from the noise and the curvature of the likelihood.
    blur : (N,) s, px.
    contrast : (N,) 2 b, negative if bright and dark are the other way round than expected.
    residual : (N,) root mean square, grey levels.
    noise : (N,) the same of the part that mirroring changes, as that of independent noise.
    used : (N,) number of pixels.
    products, pairs : (N, 13) for each of `kernels.edges.LAGS` the sum of the products of what mirroring changes at two
        pixels so far apart, and of how many; 0 where the noise is not known or that of rounding.
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
        """Return this with the corners `which` (N,) as in `part`."""
        out = self.outcomes.copy()
        out[which] = part.outcomes
        return EdgeFit(out)

    def less_sure(self, times: FloatArray, *, all_is_noise: bool = False) -> EdgeFit:
        """Return this with sigmas `times` (N,) as large; `all_is_noise` : what the fit leaves counts as noise."""
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
    """Fit the edge model to `image` (as `grey_image` returns it) around the corners that are near `pixels` (N, 2).

    Parameters
    ----------
    sign : (N,) +1 where brightness grows with the angle across line 1.
    blur : (N,) expected s.
    radius_px : pixels further from the corner are not used.
    iterations : Gauss-Newton steps at most.
    mirrored : tell noise from other residuals; otherwise all counts as noise.
    converged_px : the last step moves the corner by less than this; the next one would by a hundredth of it.
    curvature_sigma : (N, 2) how well the geometry's curvatures are known, 1/px; where 0, and without, both are kept.
    contrast : (N,) expected contrast; where NaN, and without, it is read from the window.
    """
    expected = np.full(len(pixels), np.nan) if contrast is None else contrast
    loose = np.zeros((len(pixels), 2)) if curvature_sigma is None else curvature_sigma
    fitted = fit_corners(
        image,
        pixels,
        geometry.sides,
        geometry.curvature,
        loose,
        geometry.gaps,
        np.zeros(geometry.gaps.shape) if geometry.tilts is None else geometry.tilts,
        np.full(geometry.gaps.shape, np.nan) if geometry.reach is None else geometry.reach,
        np.full(geometry.gaps.shape, np.nan) if geometry.paper is None else geometry.paper,
        np.zeros((len(pixels), 2)) if geometry.single is None else geometry.single,
        geometry.ends,
        sign,
        blur,
        blur if geometry.window_blur is None else geometry.window_blur,
        expected,
        edge_rules(radius_px, iterations, converged_px, mirrored, image.dtype == np.uint8),
    )
    return EdgeFit(fitted)


@functools.cache
def edge_rules(radius_px: float, iterations: int, converged_px: float, mirrored: bool, rounded: bool) -> Rules:
    return Rules(
        reach=WINDOW_REACH,
        end_sigmas=END_SIGMAS,
        paper_sigmas=PAPER_SIGMAS,
        min_reach=MIN_REACH,
        near_sigmas=NEAR_SIGMAS,
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
