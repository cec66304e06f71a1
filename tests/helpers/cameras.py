"""Cameras with every parameter non-trivial, one or more per model, for tests over the registry."""

from __future__ import annotations

import numpy as np

from rigkit.cameras.base import Camera
from rigkit.cameras.registry import MODELS, camera_model

SIZE_PX = (1280, 960)

# A lens of 2 x 100 degrees as a polynomial: f(rho) of a0 .. a6 in units of 450 px, chosen to be monotonic.
_SCARAMUZZA = np.array([1.0, -0.31, 0.02, -0.015, 0.003, -0.002])

PARAMETERS: dict[str, list[float]] = {
    "pinhole": [1210.0, 1190.0, 651.0, 471.0],
    "brown": [1010.0, 1004.0, 645.0, 470.0, -0.28, 0.11, 1e-3, -7e-4, -0.018],
    "brown_rational": [810.0, 804.0, 645.0, 470.0, 0.31, 0.05, 1e-3, -7e-4, 0.004, 0.62, 0.11, 0.009],
    "kannala_brandt": [380.0, 377.0, 648.0, 467.0, -0.021, 0.006, -0.0045, 0.0007],
    "kannala_brandt_folding": [450.0, 446.0, 648.0, 467.0, 0.02, -0.01, -0.0016, -0.0003],
    "scaramuzza": [*(_SCARAMUZZA * 450.0 ** (1.0 - np.array([0, 2, 3, 4, 5, 6]))), 648.0, 467.0, 1.004, 0.003],
    "scaramuzza_3": [450.0, -0.31 / 450.0, 0.02 / 450.0**2, 648.0, 467.0, 1.004, 0.003],
    "ucm": [390.0, 386.0, 648.0, 467.0, 0.61],
    "ucm_narrow": [990.0, 986.0, 648.0, 467.0, 0.31],
    "eucm": [390.0, 386.0, 648.0, 467.0, 0.63, 1.08],
    "double_sphere": [370.0, 366.0, 648.0, 467.0, -0.19, 0.59],
    "double_sphere_positive": [520.0, 516.0, 648.0, 467.0, 0.21, 0.55],
}


def sample_cameras() -> dict[str, Camera]:
    """Return cameras by label; raises where a model of the registry is missing."""
    cameras: dict[str, Camera] = {}
    for label, parameters in PARAMETERS.items():
        name = next(m for m in sorted(MODELS, key=len, reverse=True) if label.startswith(m))
        cameras[label] = camera_model(name)(SIZE_PX, np.array(parameters))
    missing = set(MODELS) - {camera.model for camera in cameras.values()}
    if missing:
        raise LookupError(f"tests/helpers/cameras.py: write parameters for {', '.join(sorted(missing))}")
    return cameras


def image_pixels(camera: Camera, columns: int = 37, rows: int = 29) -> np.ndarray:
    """Return a grid of pixels (N, 2) over the whole image."""
    u = np.linspace(0.0, camera.size_px[0] - 1.0, columns)
    v = np.linspace(0.0, camera.size_px[1] - 1.0, rows)
    return np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)


def rays_within(max_angle_rad: float, count: int, rng: np.random.Generator) -> np.ndarray:
    """Return unit rays (count, 3) spread evenly over the angle from the axis, axis included."""
    theta = np.linspace(0.0, max_angle_rad, count)
    phi = rng.uniform(-np.pi, np.pi, count)
    return np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1)
