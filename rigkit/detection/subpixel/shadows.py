"""Corners beside the edge of a shadow: the light is found, taken out of the image, and the corners fitted again.

A shadow is a factor of the light. Across its edge, seen through a window, that goes in one straight step from 1 to what
is left; the edge model, whose light is smooth, takes part of the step for a shift of the corner. What corner and step
are together the window tells (eleven unknowns). The corner found so is still drawn aside by what the model does not
know of the edges: in even light that mirrors itself at the corner, but not here. So the window's pixels are divided by
the light, and the corner is fitted in them as any other.
"""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray
from rigkit.detection.saddles.response import FloatImage, GreyImage
from rigkit.kernels.light import LightRules, fit_light_steps, lit_unevenly

SAMPLED_ALONG, SAMPLED_LATERAL = np.array([0.15, 0.35]), 0.12
"""Where the light on opposite arms is compared: so far along them and aside, in sides of the cell. Beside the end of a
board, where squares may be cut, only the nearer ones are looked at."""

MIN_SHADOW_LATERAL_PX = 1.0
"""Nearer to a line its blur is seen, and nothing else."""

UNEVEN_LIGHT = 0.4
"""Opposite squares differ by more than this part of the contrast beside the edges of shadows that leave less than two
thirds of the light: REAL images without any had 63 such corners of 10 700, most of them at the ends of boards."""

LIGHT_RANGE = (0.1, 0.8)
"""What a shadow leaves of the light: of less, 8 bits show no squares, and it may be a hand."""

LIGHT_RULES = LightRules.of(
    # Of the window: as that of the edge model.
    radius_px=18.0,
    reach_cells=0.44,
    min_left=LIGHT_RANGE[0],
    max_left=LIGHT_RANGE[1],
    max_light=1.5,
    # Pixels on either side of a shadow's edge that tell it.
    min_pixels=20.0,
    # How well lines, blur, and the width of the shadow's edge are known beforehand.
    line_sigma=0.05,
    log_edge_sigma=0.1,
    log_width_sigma=0.7,
    first_width=0.8,
    min_width=0.3,
    max_width=6.0,
    # In so many directions a sharp step is sought; then corner and step are fitted with so many steps.
    angles=16,
    iterations=8,
)

MAX_LIGHT_STEP = np.array([0.7, 0.7, 0.2, 0.2, 0.3, 1e3, 1e3, 0.3, 1.5, 0.5, 0.3])
"""What one of them changes at most: corner, angles, log blur, levels; direction, place, log width, light."""

TILE_PX = 24
"""Half the side of the window's picture in even light: what the edge model may look at."""


@dataclass(frozen=True, eq=False, slots=True)
class LightSteps:
    """A step of the light in the windows of N corners.

    Attributes
    ----------
    centre : (N, 2) pixels that they are told from.
    towards, place : (N,) direction from light to dark, rad, and how far that way the edge lies, px.
    width : (N,) of the edge, as of a normal distribution, px.
    left : (N,) what is left of the light beyond it.
    pixels, sigma_px : (N, 2), (N,) the corners as found together with it, and how well.
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

    `lateral` (N,) : how far from the lines brightness may be read, px, at most; `ends` (N,) : where the board may end.
    """
    return lit_unevenly(
        image, pixels, sides, lateral, ends, SAMPLED_ALONG, SAMPLED_LATERAL, MIN_SHADOW_LATERAL_PX, UNEVEN_LIGHT
    )


def light_steps(
    image: GreyImage, start: FloatArray, sides: FloatArray, curvature: FloatArray, blur: float, lateral: FloatArray
) -> tuple[LightSteps, BoolArray]:
    """Return the steps of the light in the windows of corners near `start` (N, 2), and which were found.

    `sides` (N, 2, 2) and `curvature` (N, 2) of the lines as in `Geometry`, `blur` about that of their edges, px; pixels
    further than `lateral` (N,) px from both lines are not used.
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
    """Return the windows in even light, side by side, and what moves pixels of the image to theirs (N, 2)."""
    span = np.arange(-TILE_PX, TILE_PX + 1.0)
    offsets = np.stack(np.meshgrid(span, span), axis=-1)
    at = (steps.centre[:, None, None] + offsets).clip(0.0, np.array(image.shape[::-1]) - 1.0).astype(np.int64)
    lit = image[at[..., 1], at[..., 0]] / steps.light(offsets).clip(LIGHT_RANGE[0])
    picture = np.ascontiguousarray(np.concatenate(list(lit), axis=1), np.float32)
    middle = TILE_PX + np.stack([np.arange(len(lit)) * len(span), np.zeros(len(lit))], axis=1)
    return picture, np.asarray(middle - steps.centre, dtype=np.float64)


def _edge(z: FloatArray) -> FloatArray:
    """Return erf(z / sqrt 2), good to 3e-4."""
    value: FloatArray = np.tanh(np.sqrt(2.0 / np.pi) * z * (1.0 + 0.044715 * z * z))
    return value
