"""The camera of a rectified image, for a given field of view and size, or for those of the source."""

from __future__ import annotations

from typing import Literal

import numpy as np

from rigkit.cameras.base import Camera, image_center
from rigkit.cameras.pinhole import Pinhole
from rigkit.core.errors import InputError
from rigkit.rectification.panorama import Cylindrical, Equirectangular

Projection = Literal["perspective", "cylindrical", "equirectangular"]
PROJECTIONS: dict[Projection, type[Camera]] = {
    "perspective": Pinhole,
    "cylindrical": Cylindrical,
    "equirectangular": Equirectangular,
}

WIDEST_RAD = {"perspective": np.radians(170.0), "cylindrical": 2.0 * np.pi, "equirectangular": 2.0 * np.pi}
DEFAULT_RAD = {"perspective": np.radians(100.0), "cylindrical": np.pi, "equirectangular": 2.0 * np.pi}
"""Default field of view across the image; smaller where the source sees less."""


def target_camera(
    camera: Camera,
    projection: Projection = "perspective",
    *,
    hfov_rad: float | None = None,
    size_px: tuple[int, int] | None = None,
) -> Camera:
    """Return the camera that shows `hfov_rad` from the left edge of the image to the right one.

    Parameters
    ----------
    camera : the source.
    hfov_rad : None: the source's own field of view, at most 100 degrees (perspective), 180 (cylindrical) or 360
        (equirectangular).
    size_px : (width, height). None: the width keeps the source's pixels per radian at the centre; the height follows
        from the source's aspect ratio (perspective), 45 degrees up and down (cylindrical), or the same angle as the
        width, at most 180 degrees (equirectangular).

    Raises InputError for an unknown projection, or a field of view that it cannot show.
    """
    if projection not in PROJECTIONS:
        raise InputError(f"projection '{projection}' is unknown; known: {', '.join(PROJECTIONS)}")
    hfov = min(DEFAULT_RAD[projection], field_across(camera)) if hfov_rad is None else float(hfov_rad)
    if not 0.0 < hfov <= WIDEST_RAD[projection]:
        raise InputError(
            f"field of view of {np.degrees(hfov):g} degrees: a {projection} image shows more than 0 and at most "
            f"{np.degrees(WIDEST_RAD[projection]):g}; for more take another projection ({', '.join(PROJECTIONS)})"
        )
    perspective = projection == "perspective"
    # Width in px per px of focal length; the image reaches half a pixel beyond the outermost pixels' centres.
    extent = 2.0 * np.tan(hfov / 2.0) if perspective else hfov
    width = max(1, round(camera.focal_px * extent)) if size_px is None else int(size_px[0])
    focal = width / extent
    if size_px is not None:
        height = int(size_px[1])
    elif perspective:
        height = max(1, round(width * camera.size_px[1] / camera.size_px[0]))
    else:
        height = max(1, round(2.0 * focal if projection == "cylindrical" else focal * min(hfov, np.pi)))
    if width < 1 or height < 1:
        raise InputError(f"image size {width} x {height}: width and height must be positive")
    size = (width, height)
    return PROJECTIONS[projection](size, np.array([focal, focal, *image_center(size)]))


def field_across(camera: Camera) -> float:
    """Return the angle, rad, between the rays at the left and right image edges in the row of the optical axis."""
    u = np.linspace(-0.5, camera.size_px[0] - 0.5, 201)
    rays, valid = camera.unproject(np.stack([u, np.full_like(u, camera.axis_px[1])], axis=-1))
    across = np.arctan2(rays[valid, 0], rays[valid, 2])
    return float(np.ptp(across)) if across.size else float(2.0 * camera.max_angle_rad)
