"""Where the points of a board whose points are not evenly spaced lie in an image, and how its lines run there.

A smooth map from the board's plane to the image, told by a calibrated camera from the board's pose, corrected by what
the points around leave over, or by the points around alone.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from rigkit.cameras.base import Camera
from rigkit.core.arrays import FloatArray
from rigkit.detection.stencil import STENCIL, by_differences
from rigkit.geometry.rigid3 import Rigid3
from rigkit.kernels.surface import Polynomials, TagSurface, perspective, projected
from rigkit.optim.robust_scale import MEDIAN_OF_RAYLEIGH

MAX_LEVERAGE = 0.99
"""A point that a term is there for alone is foretold by nothing."""

POINTS_A_TERM = 2.5
"""Points that there must be for each coefficient."""

NEAREST_DEPTH = 0.1
"""A perspective in which a point of the board is nearer than this part of the mean distance is no camera's: the lens is
a wide fisheye."""

CURVATURES = (0.0, 0.15, 0.3, 0.45, 0.55, 0.65, 0.75, 0.85, 0.92)
"""Of half a space, what the outermost point may lie off the axis of a fisheye."""

SMALL_ANGLE, DIFFERENCE = 1e-4, 0.02
"""Its tangent is the angle, to 1e-8; and half the step of derivatives, in units of the board."""

CHORD = 0.4
"""Derivatives of a camera's projection are chords of this many sides of a tag to either side."""


class SmoothMap:
    """A smooth map through points at `places` (N, 2) of which the `pixels` (N, 2) are known.

    It is the map `base` of the board's plane, by default the perspective that fits best, and a polynomial for what that
    leaves: the lens, and the print. The polynomial has the degree that foretells points best that it was not fitted to.
    """

    def __init__(
        self, places: FloatArray, pixels: FloatArray, base: Callable[[FloatArray], TagSurface] | None = None
    ) -> None:
        terms = int(len(places) / POINTS_A_TERM)
        self._base = base
        if base is not None:
            rest = pixels - base(places).pixels
            rest = np.where(np.isfinite(rest[:, :1]), rest, 0.0)
            self._polynomial = Polynomials.through(places, rest, max(terms, 1), MAX_LEVERAGE)
            return
        fitted = Polynomials.beside_perspective(places, pixels, max(terms, 1), MAX_LEVERAGE, NEAREST_DEPTH)
        if fitted is None:
            fewest = min(3, len(places))
            self._polynomial = Polynomials.through(places, pixels, max(terms, fewest), MAX_LEVERAGE)
        else:
            self._base, self._polynomial = partial(projected, fitted[0]), fitted[1]

    def at(self, wanted: FloatArray) -> TagSurface:
        """Return the map at `wanted` (M, 2), NaN where the base has none."""
        return self._polynomial.added_to(self._base and self._base(wanted), wanted, most_certain=False)

    def beyond(self, wanted: FloatArray) -> TagSurface:
        """Return the map at `wanted` (M, 2), which may lie outside the points."""
        return self._polynomial.added_to(self._base and self._base(wanted), wanted, most_certain=True)

    def left_out(self) -> tuple[FloatArray, FloatArray]:
        """Return how far (N,) the points lie off where the others have them, px, and the gain (N,) of those."""
        return self._polynomial.off, self._polynomial.gain

    def scatter(self) -> float:
        """Return how far the points usually lie off where the others have them, px per axis, beside what those err by.

        Where the map has too few terms for the lens, that is more than what points are known to.
        """
        return self._polynomial.scatter / MEDIAN_OF_RAYLEIGH


def wide_perspective(
    places: FloatArray, pixels: FloatArray, centre: FloatArray
) -> Callable[[FloatArray], TagSurface] | None:
    """Return the perspective that fits the points best through a lens that may be a fisheye; None where none does.

    Rays of a fisheye make angles with its axis, here through `centre` (2,), as pixels have distances from that, r = f
    theta. Of CURVATURES for 1 / f, in parts of what would see half a space, the best leaves a smooth rest.
    """
    away = pixels - centre
    radius = np.hypot(away[:, 0], away[:, 1])
    best: tuple[float, Callable[[FloatArray], TagSurface]] | None = None
    for part in CURVATURES:
        bend = part * 0.5 * np.pi / max(float(radius.max()), 1.0)
        angle = bend * radius
        straight = away * np.where(angle > SMALL_ANGLE, np.tan(angle) / np.maximum(angle, SMALL_ANGLE), 1.0)[:, None]
        matrix, nearest = perspective(places, straight)
        if not nearest > NEAREST_DEPTH:
            continue
        seen = partial(_curved, matrix, bend, centre)
        off = float(np.mean((seen(places) - pixels) ** 2))
        if best is None or off < best[0]:
            best = off, partial(_surface_of, seen)
    return None if best is None else best[1]


def _curved(homography: FloatArray, bend: float, centre: FloatArray, places: FloatArray) -> FloatArray:
    """Return where a lens of 1 / f `bend` shows what a homography does of places (M, 2)."""
    straight = projected(homography, places).pixels
    length = bend * np.hypot(straight[:, 0], straight[:, 1])
    shrunk = np.where(length > SMALL_ANGLE, np.arctan(length) / np.maximum(length, SMALL_ANGLE), 1.0)
    return np.asarray(centre + shrunk[:, None] * straight)


def _surface_of(seen: Callable[[FloatArray], FloatArray], places: FloatArray) -> TagSurface:
    """Return a map and its derivatives at places (M, 2) by differences."""
    pixels = np.array([seen(places + DIFFERENCE * at) for at in STENCIL])
    return TagSurface.made_of(*by_differences(pixels, DIFFERENCE))


def seen_surface(camera: Camera, cam_from_board: Rigid3, unit_mm: FloatArray, wanted: FloatArray) -> TagSurface:
    """Return the map at `wanted` (M, 2), in units of `unit_mm` (2,), as a camera sees it; NaN where it does not."""
    places = (wanted + CHORD * STENCIL[:, None]) * unit_mm
    points = np.concatenate([places, np.zeros((*places.shape[:2], 1))], axis=2)
    pixels, valid = camera.project(cam_from_board.apply(points))
    return TagSurface.made_of(*by_differences(np.where(valid[..., None].all(axis=0), pixels, np.nan), CHORD))
