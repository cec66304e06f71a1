"""Corners near the edge of a shadow: the light is estimated and divided out, and the corners are fitted again.

A shadow multiplies the light by a factor. Within a window its edge is a straight step from 1 to that factor, which the
edge model, with its smooth light, partly explains by a shift of the corner. Corner and step are therefore fitted
together (eleven unknowns). The resulting corner is still biased by model errors of the edges, whose effects do not
cancel by symmetry in uneven light. So the window's pixels are divided by the estimated light, and the corner is fitted
in them by the edge model.
"""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray
from rigkit.detection.saddles.response import FloatImage, GreyImage
from rigkit.kernels.light import LightRules, fit_light_steps, lit_unevenly

SAMPLED_ALONG, SAMPLED_LATERAL = np.array([0.15, 0.35]), 0.12
"""Positions along and beside the arms at which the light on opposite sides is compared, in sides of the cell. At the
border of a board, where squares may be cut, only the nearer ones are used."""

MIN_SHADOW_LATERAL_PX = 1.0
"""Smallest distance of these positions from a line, whose blur is visible closer to it."""

UNEVEN_LIGHT = 0.4
"""Smallest difference of opposite squares, over the contrast, at edges of shadows with less than two thirds of the
light. REAL images without shadows had 63 such corners of 10 700, most of them at the borders of boards."""

LIGHT_RANGE = (0.1, 0.8)
"""Range of the factor of a shadow: with less light 8 bits show no squares, and it may be a hand."""

LIGHT_RULES = LightRules.of(
    # The window of the edge model.
    radius_px=18.0,
    reach_cells=0.44,
    min_left=LIGHT_RANGE[0],
    max_left=LIGHT_RANGE[1],
    max_light=1.5,
    # Smallest number of pixels on either side of the shadow's edge.
    min_pixels=20.0,
    # Prior standard deviations of lines, blur, and width of the shadow's edge.
    line_sigma=0.05,
    log_edge_sigma=0.1,
    log_width_sigma=0.7,
    first_width=0.8,
    min_width=0.3,
    max_width=6.0,
    # Directions in which a sharp step is sought, and iterations of the joint fit of corner and step.
    angles=16,
    iterations=8,
)

MAX_LIGHT_STEP = np.array([0.7, 0.7, 0.2, 0.2, 0.3, 1e3, 1e3, 0.3, 1.5, 0.5, 0.3])
"""Largest changes per iteration of corner, angles, log blur, levels, direction, position, log width, light."""

TILE_PX = 24
"""Half side of the corrected windows, which contain the windows of the edge model."""


@dataclass(frozen=True, eq=False, slots=True)
class LightSteps:
    """A step of the light in the windows of N corners.

    Attributes
    ----------
    centre : (N, 2) pixels, origins of the following.
    towards, place : (N,) direction from light to dark, rad, and distance of the edge in that direction, px.
    width : (N,) standard deviation of the edge, px.
    left : (N,) factor of the light in the shadow.
    pixels, sigma_px : (N, 2), (N,) the corners of the joint fit, and their standard deviations.
    """

    _: KW_ONLY
    centre: FloatArray
    towards: FloatArray
    place: FloatArray
    width: FloatArray
    left: FloatArray
    pixels: FloatArray
    sigma_px: FloatArray

    def light(self, offsets: FloatArray) -> FloatArray:
        """Return the light (N, ...) at pixels `offsets` (..., 2) from the centres."""
        along = np.stack([np.cos(self.towards), np.sin(self.towards)], axis=1) @ offsets.reshape(-1, 2).T
        dark = 0.5 + 0.5 * _edge((along - self.place[:, None]) / self.width[:, None])
        return (1.0 - (1.0 - self.left[:, None]) * dark).reshape(-1, *offsets.shape[:-1])


def beside_shadows(
    image: GreyImage, pixels: FloatArray, sides: FloatArray, lateral: FloatArray, ends: BoolArray
) -> BoolArray:
    """Return which of the corners `pixels` (N, 2) of cells with `sides` (N, 2, 2) are lit unevenly.

    `lateral` (N,) : largest distance from the lines at which brightness is read, px; `ends` (N,) : whether the board
    may end there.
    """
    return lit_unevenly(
        image, pixels, sides, lateral, ends, SAMPLED_ALONG, SAMPLED_LATERAL, MIN_SHADOW_LATERAL_PX, UNEVEN_LIGHT
    )


def light_steps(
    image: GreyImage, start: FloatArray, sides: FloatArray, curvature: FloatArray, blur: float, lateral: FloatArray
) -> tuple[LightSteps, BoolArray]:
    """Return the steps of the light in the windows of corners near `start` (N, 2), and which fits are valid.

    `sides` (N, 2, 2) and `curvature` (N, 2) of the lines as in `Geometry`, `blur` the initial s, px; pixels further
    than `lateral` (N,) px from both lines are not used.
    """
    fitted = fit_light_steps(image, start, sides, curvature, lateral, blur, MAX_LIGHT_STEP, LIGHT_RULES)
    _, _, sigma_px, towards, place, width, left, found = fitted.T
    step = LightSteps(
        centre=np.rint(start),
        towards=towards,
        place=place,
        width=width,
        left=left,
        pixels=fitted[:, :2],
        sigma_px=sigma_px,
    )
    return step, (found > 0.0) & (left > LIGHT_RANGE[0]) & (left < LIGHT_RANGE[1])


def in_even_light(image: GreyImage, steps: LightSteps) -> tuple[FloatImage, FloatArray]:
    """Return the windows divided by their light, side by side, and the shifts (N, 2) from image pixels to theirs."""
    span = np.arange(-TILE_PX, TILE_PX + 1.0)
    offsets = np.stack(np.meshgrid(span, span), axis=-1)
    at = (steps.centre[:, None, None] + offsets).clip(0.0, np.array(image.shape[::-1]) - 1.0).astype(np.int64)
    lit = image[at[..., 1], at[..., 0]] / steps.light(offsets).clip(LIGHT_RANGE[0])
    picture = np.ascontiguousarray(np.concatenate(list(lit), axis=1), np.float32)
    middle = TILE_PX + np.stack([np.arange(len(lit)) * len(span), np.zeros(len(lit))], axis=1)
    return picture, np.asarray(middle - steps.centre, dtype=np.float64)


def _edge(z: FloatArray) -> FloatArray:
    """Return erf(z / sqrt 2), accurate to 3e-4."""
    return np.asarray(np.tanh(np.sqrt(2.0 / np.pi) * z * (1.0 + 0.044715 * z * z)))
