"""Plausibility check of cameras from files: parameters that were mistyped, damaged or in another unit would overflow
later in some computation."""

from __future__ import annotations

import numpy as np

from rigkit.cameras.base import MAX_SIDE_PX, Camera
from rigkit.cameras.compare import grid_pixels

MIN_FOCAL_PX, MAX_FOCAL_PX = 1.0, 1e7
"""A pixel of one radian, and one of a fiftieth of an arc second."""
MAX_FOCAL_RATIO = 100.0
"""Of the focal lengths along x and y; line scanners have tens."""
ASKED_PIXELS = (32, 24)
"""Columns and rows of pixels that are unprojected and projected again."""
MIN_ANSWERS = 4
"""Fewest of those that must return to themselves."""


def fault_of_lens(camera: Camera) -> str | None:
    """Return words for why no lens can have these parameters; None if they are plausible.

    Tested are the pixel of the optical axis, the focal lengths there, and which pixels have a ray that projects back to
    them.
    """
    with np.errstate(all="ignore"):
        pixels, valid, d_pixels_d_point, _ = camera.project_with_jacobians(np.array([[0.0, 0.0, 1.0]]))
        scales = d_pixels_d_point[0, :, :2]
        if not valid[0] or not np.isfinite(scales).all() or not np.isfinite(pixels).all():
            return "its numbers overflow on the optical axis, as no lens's do"
        if np.abs(pixels).max() > MAX_SIDE_PX:
            return f"its axis meets the image plane at ({pixels[0, 0]:g}, {pixels[0, 1]:g}) px, far from any image"
        if not (np.diag(scales) > 0.0).all():
            return (
                f"its focal lengths are {scales[0, 0]:g} and {scales[1, 1]:g} px; they are positive here, with x to "
                "the right, y down and z forward: turn the axes of the program that wrote the file"
            )
        longest, shortest = np.linalg.svd(scales, compute_uv=False).tolist()
        if not MIN_FOCAL_PX <= shortest <= longest <= min(MAX_FOCAL_PX, MAX_FOCAL_RATIO * shortest):
            return (
                f"its focal length is {shortest:g} to {longest:g} px, no lens's: a lens has {MIN_FOCAL_PX:g} to "
                f"{MAX_FOCAL_PX:g} px, along x and y nearly the same"
            )
        asked = grid_pixels(camera.size_px, ASKED_PIXELS).reshape(-1, 2)
        rays, _ = camera.unproject(asked)
        again, seen = camera.project(rays)
        if np.count_nonzero(seen & (np.abs(again - asked).max(axis=-1) < 1.0)) < MIN_ANSWERS:
            width, height = camera.size_px
            return f"with these numbers the lens sees nothing of its image of {width}x{height} px"
    return None
