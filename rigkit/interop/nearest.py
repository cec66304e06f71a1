"""Lenses of other programs that no model here is: the nearest camera of ours, and how far it is off."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from rigkit.cameras.base import Camera
from rigkit.cameras.convert import FOLLOWS_PX, fit_camera
from rigkit.cameras.registry import camera_model
from rigkit.core.arrays import BoolArray, Pixels, Rays
from rigkit.core.errors import InputError

Lens = Callable[[Rays], tuple[Pixels, BoolArray]]
"""Pixels (N, 2) of unit rays (N, 3), and which of them the lens sees."""

NEAREST = (
    ("scaramuzza", 10),
    ("kannala_brandt", None),
    ("double_sphere", None),
    ("eucm", None),
    ("ucm", None),
    ("brown", 5),
    ("brown", 8),
)
"""Tried in this order, with their terms: of a polynomial the highest degree, there is no noise to follow. The last ones
have few terms, and are what some other program's lens was."""
EXACT_PX = 0.01
"""A camera that is off by less is taken at once: corners are found to about as much."""
MIN_SEEN = 0.99
"""Of the lens's rays a camera must see: what it does not see it does not follow."""
DIRECTIONS, ANGLES = 144, 120
"""Rays at which a camera is fitted: around the axis and away from it."""
CHECKED = (251, 211)
"""Rays at which its error is measured: others."""
FIRST_LOOK = np.geomspace(1e-4, 1.0, 500)
"""Shares of the largest angle at which the edge of the image is looked for: it may be a lens of a degree, or of 300."""
MIN_RAYS = 100
SPREAD = 0.75
"""Between even over the angle (1), which counts the middle too much, and over the area (1/2), which leaves it out."""


def nearest_camera_of(
    lens: Lens, size_px: tuple[int, int], name: str, reach_rad: float, worst_px: float = FOLLOWS_PX
) -> tuple[Camera, float]:
    """Return the camera nearest to a lens over its image, in the same frame, and its largest error, px.

    `reach_rad` is an angle beyond which the lens sees nothing. Raises InputError, which calls the file `name`, for a
    lens that shows next to nothing on the image, and where no model is off by less than `worst_px`.
    """
    rays, pixels = rays_of_image(lens, size_px, reach_rad, (DIRECTIONS, ANGLES))
    if len(rays) < MIN_RAYS:
        raise InputError(f"'{name}': the lens shows next to nothing on the image; is the file whole?")
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
    """Return unit rays (N, 3) whose pixels (N, 2) fill the image, `count` around the axis and away from it."""
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
        # Beyond the angle at which a polynomial turns back, pixels of the image are met a second time.
        centre = lens(np.array([[0.0, 0.0, 1.0]]))[0][0]
        radius = np.linalg.norm(pixels - centre, axis=-1)
        on[:, 1:] &= np.diff(radius, axis=1) > 0.0
        on = np.minimum.accumulate(on, axis=1)
        if not on.any():
            break
        reach_rad = float(theta[min(int(np.flatnonzero(on.any(axis=0)).max()) + 1, theta.size - 1)])
        shares = np.linspace(0.0, 1.0, count[1]) ** SPREAD
    return ray[on], pixels[on]
