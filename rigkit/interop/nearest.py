"""Refit of other programs' lenses that rigkit lacks: the best camera, and its largest error."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from rigkit.cameras.base import Camera
from rigkit.cameras.convert import FOLLOWS_PX, fit_camera
from rigkit.cameras.registry import camera_model
from rigkit.core.arrays import BoolArray, Pixels, Rays
from rigkit.core.errors import InputError

Lens = Callable[[Rays], tuple[Pixels, BoolArray]]
"""Function of unit rays (N, 3) that returns pixels (N, 2) and a mask of the rays that the lens sees."""

NEAREST = (
    ("scaramuzza", 10),
    ("kannala_brandt", None),
    ("double_sphere", None),
    ("eucm", None),
    ("ucm", None),
    ("brown", 5),
    ("brown", 8),
)
"""Models in the order in which they are tried, with their orders. Polynomials have the highest degree, because there is
no noise to overfit; the last models have few terms, and are the original models of some lenses."""
EXACT_PX = 0.01
"""A camera with a smaller error is accepted at once, and notes state none: corners are no more accurate."""
MIN_SEEN = 0.99
"""Fraction of the lens's rays that a camera must see."""
AZIMUTHS, ANGLES = 144, 120
"""Rays at which a camera is fitted: number of azimuths and of angles from the axis."""
CHECKED = (251, 211)
"""Other rays, at which its error is measured."""
FIRST_LOOK = np.geomspace(1e-4, 1.0, 500)
"""Fractions of the largest angle for a coarse search of the image border: fields of view may be 1 or 300 degrees."""
MIN_RAYS = 100
SPREAD = 0.75
"""Exponent of the spacing of angles, between equal angles (1), which overweight the centre, and equal areas (1/2)."""


def nearest_camera_of(
    lens: Lens, size_px: tuple[int, int], name: str, reach_rad: float, worst_px: float = FOLLOWS_PX
) -> tuple[Camera, float]:
    """Return the camera that fits a lens best over its image, in the same frame, and its largest error, px.

    `reach_rad` is an upper bound of the lens's angles. Raises InputError, with the file `name`, for a lens that sees
    almost nothing, and if no model has an error below `worst_px`.
    """
    rays, pixels = rays_of_image(lens, size_px, reach_rad, (AZIMUTHS, ANGLES))
    if len(rays) < MIN_RAYS:
        raise InputError(f"'{name}': the lens has hardly any valid rays in the image; is the file complete?")
    checked_rays, checked = rays_of_image(lens, size_px, reach_rad, CHECKED)
    centre = lens(np.array([[0.0, 0.0, 1.0]]))[0][0]
    best: tuple[Camera, float] | None = None
    for kind, order in NEAREST:
        try:
            camera = fit_camera(camera_model(kind), size_px, rays, pixels, centre, order=order)
        except (InputError, np.linalg.LinAlgError):
            continue
        projected, seen = camera.project(checked_rays)
        error = np.linalg.norm((projected - checked)[seen], axis=-1)
        worst = float(error.max()) if seen.mean() > MIN_SEEN else np.inf
        if best is None or worst < best[1]:
            best = camera, worst
        if worst < EXACT_PX:
            break
    if best is None or not best[1] < worst_px:
        off = "" if best is None or np.isinf(best[1]) else f" (the nearest, {best[0].model}, is {best[1]:.2g} px off)"
        raise InputError(
            f"'{name}': no model here follows this lens{off}; calibrate from its images with `rigkit calibrate`, or "
            "bring it into a model of OpenCV with the program that wrote it"
        )
    return best


def rays_of_image(
    lens: Lens, size_px: tuple[int, int], reach_rad: float, count: tuple[int, int]
) -> tuple[Rays, Pixels]:
    """Return unit rays (N, 3) and pixels (N, 2) that fill the image, at `count` azimuths and angles from the axis."""
    shares = FIRST_LOOK
    for _ in range(2):
        theta = reach_rad * shares
        phi = np.arange(count[0]) * (2.0 * np.pi / count[0])
        ray = np.empty((count[0], theta.size, 3))
        ray[..., 0] = np.sin(theta) * np.cos(phi)[:, None]
        ray[..., 1] = np.sin(theta) * np.sin(phi)[:, None]
        ray[..., 2] = np.cos(theta)
        pixels, seen = lens(ray.reshape(-1, 3))
        pixels, seen = pixels.reshape(*ray.shape[:2], 2), seen.reshape(ray.shape[:2])
        on = seen & ((pixels >= -0.5) & (pixels <= np.array(size_px) - 0.5)).all(axis=-1)
        # Beyond the angle at which a polynomial folds back, pixels of the image recur.
        centre = lens(np.array([[0.0, 0.0, 1.0]]))[0][0]
        radius = np.linalg.norm(pixels - centre, axis=-1)
        on[:, 1:] &= np.diff(radius, axis=1) > 0.0
        on = np.minimum.accumulate(on, axis=1)
        if not on.any():
            break
        reach_rad = float(theta[min(int(np.flatnonzero(on.any(axis=0)).max()) + 1, theta.size - 1)])
        shares = np.linspace(0.0, 1.0, count[1]) ** SPREAD
    return ray[on], pixels[on]
