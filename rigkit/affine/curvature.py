"""The bias of a patch aligned by an affine warp, due to the second derivatives of the map between the images.

A plane maps as x2(u) = x2 + A u + u^T H u / 2, with H from perspective and distortion. Alignment by an affine warp
under a window w estimates the mean of that map over the window, and so is biased by sum_w u^T H u / 2. Pose and plane
determine H. The bias is thousandths of a pixel between pinhole images of near surfaces and hundredths between distorted
ones: more than the noise of the mean of many patches, and similar throughout a part of the image.
"""

from __future__ import annotations

import numpy as np

from rigkit.affine.refine_patches import WINDOW_OF_PATCH
from rigkit.cameras.base import Camera
from rigkit.core.arrays import FloatArray, Pixels
from rigkit.geometry.rigid3 import Rigid3

STENCIL_PX = 4.0
"""Step of the second differences, about the width of a window."""
MAX_CURVATURE_PX = 1.0
"""Larger shifts are due to wrong planes and set to zero."""


def window_variance(half_width: int) -> float:
    """Return the variance of a patch's window along an axis, px^2 of its pyramid level."""
    offset = np.arange(-half_width, half_width + 1.0)
    weight = np.exp(-0.5 * (offset / (WINDOW_OF_PATCH * half_width)) ** 2)
    return float(np.sum(weight * offset**2) / np.sum(weight))


def curvature_shift(
    pixels1: Pixels,
    planes: FloatArray,
    variance: FloatArray,
    cameras: tuple[Camera, Camera],
    cam2_from_cam1: Rigid3,
    off: FloatArray | None = None,
) -> FloatArray:
    """Return the bias of the aligned positions in image 2, (N, 2) px; zero where unknown.

    Parameters
    ----------
    pixels1 : (N, 2) positions in image 1.
    planes : (N, 3) m of the planes m . X = 1, in the frame of camera 1; NaN where unknown.
    variance : (N,) of the window along an axis, px^2 of image 1.
    off : (N, 2) offset of `pixels1` from the window centres; None: zero.
    """
    by_uu, by_uv, by_vv = _second_derivatives(pixels1, planes, cameras, cam2_from_cam1)
    shift = variance[:, None] * (by_uu + by_vv)
    if off is not None:
        du, dv = off.T[:, :, None]
        shift = shift - (du**2 * by_uu + 2.0 * du * dv * by_uv + dv**2 * by_vv)
    shift = 0.5 * shift
    good = np.linalg.norm(shift, axis=1) < MAX_CURVATURE_PX
    return np.where(good[:, None], shift, 0.0)


def _second_derivatives(
    pixels1: Pixels, planes: FloatArray, cameras: tuple[Camera, Camera], cam2_from_cam1: Rigid3
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return d2 pixel2 by (u, u), (u, v) and (v, v), (N, 2) each, of the planes m . X = 1 (N, 3); NaN where unseen."""

    def seen_at(u: float, v: float) -> FloatArray:
        rays, _ = cameras[0].unproject(pixels1 + STENCIL_PX * np.array([u, v]))
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = 1.0 / np.sum(planes * rays, axis=1)
        points = np.where(distance > 0.0, distance, np.nan)[:, None] * rays
        return cameras[1].project(cam2_from_cam1.apply(points))[0]

    middle = seen_at(0.0, 0.0)
    right, left, down, up = seen_at(1.0, 0.0), seen_at(-1.0, 0.0), seen_at(0.0, 1.0), seen_at(0.0, -1.0)
    by_uu, by_vv = right + left - 2.0 * middle, down + up - 2.0 * middle
    by_uv = 0.5 * (seen_at(1.0, 1.0) + seen_at(-1.0, -1.0) - by_uu - by_vv) - middle
    return by_uu / STENCIL_PX**2, by_uv / STENCIL_PX**2, by_vv / STENCIL_PX**2
