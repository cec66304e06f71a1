"""The map from a board with unevenly spaced points to an image, and the directions and curvatures of its lines there.

It is a smooth map: the projection of a calibrated camera for the board's pose, corrected by a polynomial through the
residuals of the points, or a map through the points only.
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
"""Largest leverage of a point: one with more determines a term alone, so that nothing else predicts it."""

POINTS_A_TERM = 2.5
"""Smallest number of points per coefficient."""

NEAREST_DEPTH = 0.1
"""Smallest depth of a point of the board relative to the mean: a perspective with a smaller one is not that of a
camera, but the lens is a wide fisheye."""

CURVATURES = (0.0, 0.15, 0.3, 0.45, 0.55, 0.65, 0.75, 0.85, 0.92)
"""Angles of the outermost point from the axis of a fisheye that are tried, in parts of 90 degrees."""

SMALL_ANGLE, DIFFERENCE = 1e-4, 0.02
"""Angle that equals its tangent to 1e-8; and half the step of derivatives, in units of the board."""

CHORD = 0.4
"""Step, in sides of a tag, of the differences of a camera's projection."""


class SmoothMap:
    """A smooth map through points at `places` (N, 2) with known `pixels` (N, 2).

    It is the map `base` of the board's plane, by default the best perspective, plus a polynomial through its residuals
    due to distortion and printing. The degree of the polynomial has the smallest leave-one-out error.
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
        """Return the map at `wanted` (M, 2), NaN where the base is undefined."""
        return self._polynomial.added_to(self._base and self._base(wanted), wanted, most_certain=False)

    def beyond(self, wanted: FloatArray) -> TagSurface:
        """Return the map at `wanted` (M, 2), which may be outside of the points."""
        return self._polynomial.added_to(self._base and self._base(wanted), wanted, most_certain=True)

    def left_out(self) -> tuple[FloatArray, FloatArray]:
        """Return the leave-one-out errors (N,) of the points, px, and the gains (N,) of these predictions."""
        return self._polynomial.off, self._polynomial.gain

    def scatter(self) -> float:
        """Return the standard deviation of the points from their leave-one-out errors, px per axis.

        If the map has too few terms for the lens, it is larger than the uncertainty of the points.
        """
        return self._polynomial.scatter / MEDIAN_OF_RAYLEIGH


def wide_perspective(
    places: FloatArray, pixels: FloatArray, centre: FloatArray
) -> Callable[[FloatArray], TagSurface] | None:
    """Return the best perspective through a lens that may be a fisheye; None if there is none.

    Its axis passes through `centre` (2,), and a ray at the angle theta to the axis is seen at the distance r = f theta.
    1 / f is the one with the smallest residuals for CURVATURES.
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
    """Return the images of places (M, 2) by a homography and a lens with 1 / f = `bend`."""
    straight = projected(homography, places).pixels
    length = bend * np.hypot(straight[:, 0], straight[:, 1])
    shrunk = np.where(length > SMALL_ANGLE, np.arctan(length) / np.maximum(length, SMALL_ANGLE), 1.0)
    return np.asarray(centre + shrunk[:, None] * straight)


def _surface_of(seen: Callable[[FloatArray], FloatArray], places: FloatArray) -> TagSurface:
    """Return a map and its derivatives at places (M, 2), by differences."""
    pixels = np.array([seen(places + DIFFERENCE * at) for at in STENCIL])
    return TagSurface.made_of(*by_differences(pixels, DIFFERENCE))


def seen_surface(camera: Camera, cam_from_board: Rigid3, unit_mm: FloatArray, wanted: FloatArray) -> TagSurface:
    """Return a camera's map at `wanted` (M, 2), in units of `unit_mm` (2,); NaN where it is not visible."""
    places = (wanted + CHORD * STENCIL[:, None]) * unit_mm
    points = np.concatenate([places, np.zeros((*places.shape[:2], 1))], axis=2)
    pixels, valid = camera.project(cam_from_board.apply(points))
    return TagSurface.made_of(*by_differences(np.where(valid[..., None].all(axis=0), pixels, np.nan), CHORD))
