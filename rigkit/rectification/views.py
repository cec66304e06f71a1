"""Virtual perspective views: the part of a wide image that covers given rays, as a pinhole camera would see it."""

from __future__ import annotations

import numpy as np

from rigkit.cameras.base import Camera
from rigkit.cameras.pinhole import Pinhole
from rigkit.core.arrays import FloatArray, Mat3, Rays
from rigkit.core.errors import DegenerateError, InputError
from rigkit.geometry.rotation import angle_between, exp_so3, unit

__all__ = ["perspective_view", "smallest_cone"]

MAX_SPAN_RAD = np.radians(150.0)
"""Beyond it the corners of a perspective image are magnified more than 15 times against its centre."""
CONE_STEPS = 200
"""The enclosing cone is found to 1 part in this many of its angle, good enough for a margin."""


def smallest_cone(rays: Rays) -> tuple[FloatArray, float]:
    """Return the axis and half angle (rad) of the narrowest cone around unit rays (N, 3).

    Raises DegenerateError where the rays surround the camera, so that no cone has a meaning.

    Notes
    -----
    Badoiu and Clarkson's iteration: move towards the farthest ray by 1 / (k + 1) of the angle, which is within 1/k of
    the best after k steps.
    """
    rays = np.asarray(rays, dtype=np.float64).reshape(-1, 3)
    rays = rays[np.isfinite(rays).all(axis=-1)]
    if not len(rays):
        raise InputError("view: no ray to cover; check that the pixels lie in the camera's field of view")
    axis = unit(rays.sum(axis=0))
    if not np.isfinite(axis).all():
        raise DegenerateError("view: the rays point all around the camera; split them into several views")
    for k in range(1, CONE_STEPS):
        farthest = rays[np.argmin(rays @ axis)]
        axis = unit(axis + (farthest - axis) / (k + 1.0))
    return axis, float(angle_between(rays, axis).max())


def perspective_view(
    rays: Rays, camera: Camera, *, margin: float = 0.03, focal_scale: float = 1.0, max_span_rad: float = MAX_SPAN_RAD
) -> tuple[Pinhole, Mat3]:
    """Return a pinhole camera and its rotation target_from_cam that see all of `rays`.

    Parameters
    ----------
    rays : (..., 3) unit rays in the frame of `camera`; NaN rows are ignored.
    camera : the source; the view's focal length gives the view the source's own pixels per radian where the rays are,
        in the median, so that resampling neither loses nor invents detail.
    margin : room around the rays, as a share of the view's size.
    focal_scale : factor on that focal length.
    max_span_rad : the largest angle of the enclosing cone, below pi.

    Raises
    ------
    DegenerateError
        The rays span `max_span_rad` or more: no perspective image of them is of use.
    """
    rays = np.asarray(rays, dtype=np.float64).reshape(-1, 3)
    rays = rays[np.isfinite(rays).all(axis=-1)]
    axis, half_angle = smallest_cone(rays)
    if 2.0 * half_angle >= min(max_span_rad, np.pi):
        raise DegenerateError(
            f"view: the rays span {np.degrees(2.0 * half_angle):.0f} degrees, a perspective view shows less than "
            f"{np.degrees(max_span_rad):.0f}; work on the raw image or take several views"
        )
    target_from_cam = _turn_to(axis)
    turned = rays @ target_from_cam.T
    focal = focal_scale * _matching_focal(rays, turned, camera)
    xy = turned[:, :2] / turned[:, 2:]
    low, high = xy.min(axis=0), xy.max(axis=0)
    room = np.maximum(margin * (high - low), 1.0 / focal)
    low, high = low - room, high + room
    size = np.ceil(focal * (high - low)).astype(int) + 1
    return Pinhole((int(size[0]), int(size[1])), np.array([focal, focal, *(-focal * low)])), target_from_cam


def _turn_to(axis: FloatArray) -> Mat3:
    """Return the smallest rotation that takes `axis` to the optical axis: the view is not rolled against the source."""
    turn = np.cross(axis, [0.0, 0.0, 1.0])
    sine = float(np.linalg.norm(turn))
    if sine < 1e-12:
        return np.diag([1.0, -1.0, -1.0]) if axis[2] < 0.0 else np.eye(3)
    return exp_so3(turn / sine * np.arctan2(sine, axis[2]))


def _matching_focal(rays: Rays, turned: Rays, camera: Camera) -> float:
    """Return the focal length at which target and source have the same pixels per area in the median over the rays."""
    _, valid, d_pixels_d_point, _ = camera.project_with_jacobians(rays)
    if not valid.any():
        raise InputError("view: the camera sees none of the rays")
    d_pixels_d_point = d_pixels_d_point[valid]
    # Pixels per steradian of the source, 1 / sqrt(det B^T B), and of a pinhole of focal length 1: 1 / cos^3.
    density = np.sqrt(np.linalg.det(d_pixels_d_point @ np.swapaxes(d_pixels_d_point, -1, -2)))
    return float(np.sqrt(np.median(density * turned[valid, 2] ** 3)))
