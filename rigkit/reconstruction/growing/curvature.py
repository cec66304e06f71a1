"""Grown pairs without the curvature of what they were aligned by: an affine warp for a map that is none.

From image to image a plane is mapped by a homography, or by what lenses make of it: x2(u) = x2 + A u + u^T H u / 2.
Aligned by an affine warp with a window w, a patch finds the mean of that map over the window, which at the window's
middle is off by sum_w u^T H u / 2. With the pose the map of every pair's own plane is known, and with it H: that
shift is taken back. In pinhole images of near surfaces it is thousandths of a pixel, between fisheyes hundredths: more
than the noise of a surface, and in one direction everywhere.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rigkit.affine.refine_patches import WINDOW_OF_PATCH, levels_of_larger
from rigkit.cameras.base import Camera
from rigkit.core.arrays import BoolArray, FloatArray, Pixels
from rigkit.geometry.rigid3 import Rigid3
from rigkit.reconstruction.growing.grow import HALF_WIDTH, GrownPatches
from rigkit.reconstruction.growing.surface import PairRays

STENCIL_PX = 4.0
"""Of the second differences, about as wide as a window."""
MAX_CURVATURE_PX = 1.0
"""A larger shift comes of a plane that is wrong, and is not taken back."""


def without_curvature(grown: GrownPatches, camera1: Camera, camera2: Camera, cam2_from_cam1: Rigid3) -> GrownPatches:
    """Return the pairs, at their nodes or `centred`, with places in image 2 where their nodes' points are."""
    planes = PairRays.of(grown, camera1, camera2).planes(cam2_from_cam1)
    at = grown.valid & np.isfinite(planes[..., 0])
    place, plane, A21 = grown.pixels1[at], planes[at], grown.A21[at]
    by_uu, by_uv, by_vv = _second_derivatives(place, plane, camera1, camera2, cam2_from_cam1)
    rows, columns = np.nonzero(at)
    du, dv = (place - grown.step * np.stack([columns, rows], axis=1)).T[:, :, None]
    variance = (_window_variance() * 4.0 ** (grown.coarser[at] + levels_of_larger(A21)))[:, None]
    shift = 0.5 * (variance * (by_uu + by_vv) - (du**2 * by_uu + 2.0 * du * dv * by_uv + dv**2 * by_vv))
    good: BoolArray = np.linalg.norm(shift, axis=1) < MAX_CURVATURE_PX
    pixels2 = grown.pixels2.copy()
    pixels2[at] -= np.where(good[:, None], shift, 0.0)
    return replace(grown, pixels2=pixels2)


def _window_variance() -> float:
    """Return the variance of a patch's window along an axis, px^2 of the level that it is read from."""
    offset = np.arange(-HALF_WIDTH, HALF_WIDTH + 1.0)
    weight = np.exp(-0.5 * (offset / (WINDOW_OF_PATCH * HALF_WIDTH)) ** 2)
    return float(np.sum(weight * offset**2) / np.sum(weight))


def _second_derivatives(
    pixels1: Pixels, planes: FloatArray, camera1: Camera, camera2: Camera, cam2_from_cam1: Rigid3
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return d2 pixel2 by (u, u), (u, v) and (v, v), (N, 2) each, of the planes m . X = 1 (N, 3); NaN where unseen."""

    def seen_at(u: float, v: float) -> FloatArray:
        rays, _ = camera1.unproject(pixels1 + STENCIL_PX * np.array([u, v]))
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = 1.0 / np.sum(planes * rays, axis=1)
        points = np.where(distance > 0.0, distance, np.nan)[:, None] * rays
        return camera2.project(cam2_from_cam1.apply(points))[0]

    middle = seen_at(0.0, 0.0)
    right, left, down, up = seen_at(1.0, 0.0), seen_at(-1.0, 0.0), seen_at(0.0, 1.0), seen_at(0.0, -1.0)
    by_uu, by_vv = right + left - 2.0 * middle, down + up - 2.0 * middle
    by_uv = 0.5 * (seen_at(1.0, 1.0) + seen_at(-1.0, -1.0) - by_uu - by_vv) - middle
    return by_uu / STENCIL_PX**2, by_uv / STENCIL_PX**2, by_vv / STENCIL_PX**2
