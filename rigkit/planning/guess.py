"""A camera from nothing but the approximate field of view of its lens."""

from __future__ import annotations

import numpy as np

from rigkit.cameras.base import Camera, RadialCurve, image_center
from rigkit.cameras.registry import camera_model
from rigkit.core.errors import InputError

PERSPECTIVE_DEG = 100.0
"""Lenses with a smaller horizontal field of view are mostly rectilinear; wider ones are fisheyes."""
CURVE_RADII = 64
CURVE_END = 1.05
"""End of the radial curve, relative to the corner of the image."""
MAX_THETA_RAD = 3.0


def check_field(hfov_deg: float) -> None:
    """Raise InputError for an impossible horizontal field of view."""
    if not 0.5 <= hfov_deg <= 300.0:
        raise InputError(f"a lens of {hfov_deg:g} degrees: give the field of view across the image's width, 0.5 to 300")


def guessed_camera(hfov_deg: float, size_px: tuple[int, int], model: str | None = None) -> Camera:
    """Return a camera with a horizontal field of view of `hfov_deg`: perspective below 100 degrees, else equidistant;
    of `model`, by default Brown's or Kannala and Brandt's.

    Raises InputError for an impossible angle, or a model that cannot represent it.
    """
    check_field(hfov_deg)
    half_px, half_rad = 0.5 * size_px[0], np.radians(0.5 * hfov_deg)
    straight = hfov_deg < PERSPECTIVE_DEG
    corner_px = CURVE_END * 0.5 * float(np.hypot(*size_px))
    if straight:
        focal = half_px / np.tan(half_rad)
        theta = np.linspace(0.0, np.arctan(corner_px / focal), CURVE_RADII)
        radius = focal * np.tan(theta)
    else:
        focal = half_px / half_rad
        theta = np.linspace(0.0, min(corner_px / focal, MAX_THETA_RAD), CURVE_RADII)
        radius = focal * theta
    kind = camera_model(model or ("brown" if straight else "kannala_brandt"))
    return kind.from_radial_curve(size_px, RadialCurve(image_center(size_px), theta, radius))
