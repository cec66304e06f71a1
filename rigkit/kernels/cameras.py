"""Calls of the kernels in brown.c and radial.c: pixels of cameras, and their derivatives."""

from __future__ import annotations

from typing import Any

import numpy as np

from rigkit.core.arrays import BoolArray, Coordinates, FloatArray, Projected
from rigkit.kernels import kernels
from rigkit.kernels.calls import make_struct


def brown_pixels(
    points: Coordinates,
    parameters: FloatArray,
    max_r: float,
    d_pixels_d_point: FloatArray | None = None,
    d_pixels_d_parameters: FloatArray | None = None,
) -> Projected:
    """Return u, v and valid of points, and write the given Jacobians as `Camera.derivatives` does.

    `max_r` is the tangent of the largest angle of the field of view of the camera, which has 8, 9 or 12 `parameters`.
    """
    camera = {"parameters": _brown_parameters(parameters), "rational": int(parameters.size > 9), "max_r": max_r}
    kernel = kernels().differentiate_brown
    return _written(kernel, "brown_points_t", points, d_pixels_d_point, d_pixels_d_parameters, camera)


def brown_places(
    m: FloatArray, start: FloatArray, parameters: FloatArray, max_r: float
) -> tuple[FloatArray, BoolArray]:
    """Return the (x, y) (2, N) at unit depth that a camera distorts to m (2, N), by Newton's method from `start` (2, N)
    within the circle of radius `max_r`, and which converged (N,)."""
    plane = np.array(start, order="C")
    return plane, kernels().undistort_brown(_brown_parameters(parameters), max_r, parameters.size > 9, m, plane)


def _brown_parameters(parameters: FloatArray) -> FloatArray:
    """Return the twelve parameters of Brown's model, zero where the camera has none."""
    return np.concatenate([parameters, np.zeros(12 - parameters.size)])


def radial_pixels(
    model: str,
    points: Coordinates,
    polynomial: FloatArray,
    linear: tuple[float, float, float, float, float],
    limits: tuple[float, float],
    d_pixels_d_point: FloatArray | None = None,
    d_pixels_d_parameters: FloatArray | None = None,
) -> Projected:
    """As `brown_pixels`, for the radial camera `model`: "kannala_brandt" or "scaramuzza".

    Parameters
    ----------
    polynomial : k1 ... k4, or the coefficients of f(rho), of the power zero first.
    linear : l00, l01, l11 and the centre, px, as of `RadialCamera`.
    limits : largest angle, rad, and largest radius, px, of the field of view; each model uses one of them.
    """
    # A copy: passing read-only arrays takes longer.
    camera: dict[str, Any] = {"polynomial": np.array(polynomial)}
    camera |= zip(("l00", "l01", "l11", "cx", "cy", "max_angle", "max_radius"), (*linear, *limits), strict=True)
    kernel = getattr(kernels(), f"differentiate_{model}")
    return _written(kernel, "radial_points_t", points, d_pixels_d_point, d_pixels_d_parameters, camera)


def _written(
    kernel: Any,
    structure: str,
    points: Coordinates,
    d_pixels_d_point: FloatArray | None,
    d_pixels_d_parameters: FloatArray | None,
    camera: dict[str, Any],
) -> Projected:
    """Return u, v and valid from the kernel for the points and the `camera`, the other members of the structure."""
    count = len(points[0])
    x, y, z = points
    wanted = d_pixels_d_point, d_pixels_d_parameters
    written = [_memory(out, count) for out in wanted]
    at = make_struct(structure, x=x, y=y, z=z, axes=written[0].shape[1], rows=written[1].shape[1], **camera)
    projected: Projected = kernel(at, *written)
    for out, memory in zip(wanted, written, strict=True):
        if out is not None and out is not memory:
            out[...] = memory
    return projected


def _memory(out: FloatArray | None, count: int) -> FloatArray:
    """Return `out`, or a contiguous copy; an array without rows for None."""
    if out is None:
        return np.empty((2, 0, count))
    return out if out.flags.c_contiguous else out.copy()
