"""Cameras moved by one standard deviation along each principal axis of their calibrations' covariance.

The axes are independent: the squares of what they change in a quantity add up to its variance.
"""

from __future__ import annotations

import numpy as np

from rigkit.cameras.base import Camera
from rigkit.cameras.uncertain import UncertainCamera
from rigkit.core.arrays import Pixels, RayJacobians, Rays


def moved_cameras(
    camera1: Camera, camera2: Camera, known1: UncertainCamera | None, known2: UncertainCamera | None, *, one: bool
) -> list[tuple[Camera, Camera]]:
    """Return both cameras for each axis of what their calibrations leave open; none where one is exact.

    With `one` both images are of one camera, and both move together; `known2` is not used then.
    """
    if known1 is None or (known2 is None and not one):
        return []
    first = [(moved, moved if one else camera2) for moved in known1.moved()]
    return first if one or known2 is None else first + [(camera1, moved) for moved in known2.moved()]


def moved_sights(camera: Camera, was: Camera, pixels: Pixels, by_coordinate: RayJacobians) -> tuple[Rays, RayJacobians]:
    """Return rays (N, 3) of pixels as a moved camera has them, and their derivatives by the coordinates of affinities,
    which were `by_coordinate` (N, 3, 2) in the camera as it was: coordinates (rectified, or the captured pixels) move
    with the pixels as they did."""
    captured_by_coordinate = np.linalg.pinv(was.ray_jacobian(pixels)) @ by_coordinate
    return camera.unproject(pixels)[0], camera.ray_jacobian(pixels) @ captured_by_coordinate
