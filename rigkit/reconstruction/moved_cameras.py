"""Cameras moved by one standard deviation along each principal axis of their calibrations' covariance.

The axes are independent: the squares of what they change in a quantity add up to its variance.
"""

from __future__ import annotations

from rigkit.cameras.base import Camera
from rigkit.core.arrays import FloatArray
from rigkit.geometry.principal_axes import principal_axes


def moved_cameras(
    camera1: Camera, camera2: Camera, covariance1: FloatArray, covariance2: FloatArray | None = None
) -> list[tuple[Camera, Camera]]:
    """Return both cameras for each axis of the covariances of their parameters, (P, P) and (Q, Q).

    Without `covariance2` both images are of one camera, and both move together.
    """
    cameras: list[tuple[Camera, Camera]] = []
    for axis in principal_axes(covariance1):
        shifted = camera1.with_parameters(camera1.parameters + axis)
        cameras.append((shifted, shifted if covariance2 is None else camera2))
    for axis in [] if covariance2 is None else principal_axes(covariance2):
        cameras.append((camera1, camera2.with_parameters(camera2.parameters + axis)))
    return cameras
