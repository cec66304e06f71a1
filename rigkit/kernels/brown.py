"""The call of the kernel in brown.c: pixels of the camera with Brown's distortion, and their derivatives."""

from __future__ import annotations

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray
from rigkit.kernels import kernels
from rigkit.kernels.calls import Struct, structure


@structure("brown_points_t")
class _BrownPoints(Struct):
    """Points in the camera frame and the camera."""


def brown_derivatives(
    points: tuple[FloatArray, FloatArray, FloatArray],
    parameters: FloatArray,
    max_r: float,
    d_pixels_d_point: FloatArray,
    d_pixels_d_parameters: FloatArray | None,
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Project `points` x, y, z (N,) and write the Jacobians as `Camera.derivatives` does; return u, v and valid.

    `max_r` is the tangent of the largest angle at which the camera, of 8, 9 or 12 `parameters`, sees anything.
    """
    count, own = len(points[0]), parameters.size
    x, y, z = (np.ascontiguousarray(one, np.float64) for one in points)
    by_point = _memory(d_pixels_d_point)
    by_parameters = np.empty((2, 0, count)) if d_pixels_d_parameters is None else _memory(d_pixels_d_parameters)
    u, v, valid = np.empty(count), np.empty(count), np.empty(count, dtype=bool)
    at = _BrownPoints.of(
        x=x,
        y=y,
        z=z,
        parameters=np.concatenate([parameters, np.zeros(12 - own)]),
        count=count,
        rows=by_parameters.shape[1],
        rational=int(own > 9),
        max_r=max_r,
    )
    kernels().differentiate_brown(at, by_point, by_parameters, u, v, valid)
    for out, memory in ((d_pixels_d_point, by_point), (d_pixels_d_parameters, by_parameters)):
        if out is not None and out is not memory:
            out[...] = memory
    return u, v, valid


def _memory(out: FloatArray) -> FloatArray:
    """Return `out`, or a copy of what is there where its rows do not lie one after the other."""
    return out if out.flags.c_contiguous else out.copy()
