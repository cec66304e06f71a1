"""Synthetic calibration views with known truth: lenses of 60 to 200 degrees, boards anywhere in their field of view."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from rigkit.calibration.result import Calibration, Candidate
from rigkit.cameras.base import Camera
from rigkit.cameras.brown import Brown
from rigkit.cameras.kannala_brandt import KannalaBrandt
from rigkit.core.arrays import FloatArray
from rigkit.core.boards import Board
from rigkit.core.detections import BoardView
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import cross, exp_so3, unit

SIZE = (1624, 1240)
BOARD = Board("9x6", 9, 6, 30.0, 30.0)

LENSES: dict[str, Callable[[FloatArray], Camera]] = {
    "reg": lambda c: Brown(SIZE, np.array([1364.0, 1365.0, *c, -0.192, 0.113, 4e-4, -3e-4, 0.0])),
    "wide": lambda c: KannalaBrandt(SIZE, np.array([820.0, 821.0, *c, -0.02, 0.006, -0.002, 1e-4])),
    "fish": lambda c: KannalaBrandt(SIZE, np.array([371.6, 371.2, *c, 0.012, -0.006, 0.001, -2e-4])),
    "fish200": lambda c: KannalaBrandt(SIZE, np.array([341.0, 341.4, *c, 0.01, -0.005, 0.001, -1.5e-4])),
}
REACH_DEG = {"reg": 33.0, "wide": 55.0, "fish": 92.5, "fish200": 100.0}
CENTRE = np.array([808.0, 615.0])


def lens(name: str, centre: FloatArray = CENTRE) -> Camera:
    """Return the lens of this name with its optical axis at `centre`."""
    return LENSES[name](np.asarray(centre, dtype=float))


def random_views(
    camera: Camera,
    count: int,
    rng: np.random.Generator,
    *,
    reach_deg: float,
    board: Board = BOARD,
    tilt_deg: tuple[float, float] = (10.0, 45.0),
    noise_px: float = 0.2,
    points_mm: FloatArray | None = None,
) -> tuple[list[BoardView], FloatArray, FloatArray]:
    """Return views with all corners on the image and inside `reach_deg` off the axis, and the poses (R, t).

    `points_mm` are the board's true corners, where they differ from the nominal ones.
    """
    points = board.points() if points_mm is None else points_mm
    middle = board.points().mean(axis=0)
    extent = float(np.ptp(board.points(), axis=0).max())
    views: list[BoardView] = []
    rotations, translations = [], []
    for _ in range(20000):
        if len(views) == count:
            break
        # Density proportional to the angle from the axis: uniform over the area of an equidistant image.
        angle = np.radians(reach_deg) * np.sqrt(rng.random())
        about = rng.uniform(-np.pi, np.pi)
        direction = np.array([np.sin(angle) * np.cos(about), np.sin(angle) * np.sin(about), np.cos(angle)])
        distance = extent * rng.uniform(0.9, 2.2) * max(1.0, 30.0 / reach_deg)
        facing = _facing(direction) @ exp_so3(np.array([0.0, 0.0, rng.uniform(-np.pi, np.pi)]))
        axis = rng.uniform(-np.pi, np.pi)
        tilt = np.radians(rng.uniform(*tilt_deg))
        rotation = facing @ exp_so3(tilt * np.array([np.cos(axis), np.sin(axis), 0.0]))
        translation = distance * direction - rotation @ middle
        in_cam = points @ rotation.T + translation
        off_axis = np.degrees(np.arctan2(np.linalg.norm(in_cam[:, :2], axis=1), in_cam[:, 2]))
        if not (off_axis <= reach_deg).all():
            continue
        pixels, valid = camera.project(in_cam)
        if not (valid.all() and camera.on_image(pixels).all()):
            continue
        noisy = pixels + noise_px * rng.normal(size=pixels.shape)
        noisy = np.clip(noisy, -0.5, np.array(camera.size_px) - 0.5)
        sigma = np.full(len(noisy), max(noise_px, 1e-3))
        views.append(BoardView(f"{len(views):03d}.png", board, board.grid(), noisy, sigma))
        rotations.append(rotation)
        translations.append(translation)
    assert len(views) == count, "the board does not fit into that part of the view"
    return views, np.array(rotations), np.array(translations)


def noisy_view(
    camera: Camera,
    cam_from_board: Rigid3,
    name: str,
    rng: np.random.Generator,
    noise_px: float,
    *,
    board: Board = BOARD,
) -> BoardView:
    """Return the view of a board in one pose: its corners inside the image."""
    pixels, valid = camera.project(cam_from_board.apply(board.points()))
    valid &= camera.on_image(pixels)
    noisy = pixels[valid] + noise_px * rng.standard_normal((int(valid.sum()), 2))
    noisy = np.clip(noisy, -0.5, np.array(camera.size_px) - 0.5)
    return BoardView(name, board, board.grid()[valid], noisy, np.full(len(noisy), noise_px))


def with_outliers(views: list[BoardView], share: float, size_px: float, rng: np.random.Generator) -> list[BoardView]:
    """Return the views with a part of the corners moved by `size_px` in random directions."""
    out = []
    for view in views:
        pixels = view.pixels.copy()
        bad = rng.random(len(pixels)) < share
        about = rng.uniform(-np.pi, np.pi, len(pixels))
        pixels[bad] += size_px * np.stack([np.cos(about), np.sin(about)], axis=-1)[bad]
        out.append(
            BoardView(view.image, view.board, view.grid, np.clip(pixels, 0.0, np.array(SIZE) - 1.0), view.sigma_px)
        )
    return out


def projection_difference(
    camera: Camera, truth: Camera, reach_deg: float, *, covered: FloatArray | None = None
) -> FloatArray:
    """Return |pixel - true pixel| over the image out to `reach_deg`, after the rotation that minimises it.

    `covered` (M, 2): only grid pixels within 30 px of one of these.
    """
    u, v = np.meshgrid(np.arange(10.0, truth.size_px[0], 20.0), np.arange(10.0, truth.size_px[1], 20.0))
    pixels = np.stack([u.ravel(), v.ravel()], axis=-1)
    if covered is not None:
        near = np.array([np.min(np.sum((covered - p) ** 2, axis=1)) < 30.0**2 for p in pixels])
        pixels = pixels[near]
    rays, valid = truth.unproject(pixels)
    with np.errstate(invalid="ignore"):
        keep = valid & (np.degrees(np.arctan2(np.linalg.norm(rays[:, :2], axis=1), rays[:, 2])) <= reach_deg)
    rays, pixels = rays[keep], pixels[keep]
    assert len(rays) > 100
    rotation = np.eye(3)
    for _ in range(6):
        turned = rays @ rotation.T
        projected, seen, d_pixels_d_point, _ = camera.project_with_jacobians(turned)
        assert seen.mean() > 0.98
        design = np.cross(turned[:, None, :], d_pixels_d_point)[seen].reshape(-1, 3)
        step = np.linalg.lstsq(design, (pixels - projected)[seen].reshape(-1), rcond=None)[0]
        rotation = exp_so3(step) @ rotation
    projected, seen = camera.project(rays @ rotation.T)
    return np.asarray(np.linalg.norm((pixels - projected)[seen], axis=1))


def _facing(direction: FloatArray) -> FloatArray:
    """Return the rotation of a board in `direction` that faces the camera."""
    helper = np.array([1.0, 0.0, 0.0]) if abs(direction[0]) < 0.9 else np.array([0.0, 1.0, 0.0])
    x = unit(cross(cross(direction, helper), direction))
    return np.stack([x, cross(direction, x), direction], axis=-1)


def heldout(result: Calibration | Candidate) -> float:
    """Return the cross-validation error; fails where there is none."""
    assert result.heldout_rms_px is not None
    return result.heldout_rms_px
