"""The difference of two cameras over the image, in pixels, after the rotation that fits best.

Two calibrations of one camera may differ by a rotation that all board poses absorb, which is no error. The method is
that of mrcal (D. Kogan, "A tour of mrcal: differencing"), with code of our own.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rigkit.cameras.base import Camera
from rigkit.core.arrays import BoolArray, FloatArray, Mat3, Pixels, as_array, as_mask
from rigkit.core.errors import DegenerateError, InputError
from rigkit.geometry.rotation import exp_so3, nearest_rotation, rotation_angle, skew

MAX_ROTATION_STEPS = 20
ROTATION_SETTLED_RAD = 1e-12
"""The fit of the rotation stops at smaller steps, which move no pixel by a millionth."""
MIN_PIXELS = 20
"""Fewest common pixels for a comparison."""
MAX_WEIGHT = 1e150
MAX_GRID = 10_000
"""Most columns or rows of a map."""


@dataclass(frozen=True, eq=False, slots=True)
class CameraDifference:
    """The projection by camera b minus that by camera a, along the rays of camera a.

    Attributes
    ----------
    pixels : (rows, columns, 2) the grid in the image of camera a.
    difference_px : (rows, columns, 2), NaN where not covered.
    covered : (rows, columns) where the ray is in the field of view of both cameras (and in the caller's mask).
    b_from_a : (3, 3) the fitted rotation: x_in_b = b_from_a @ x_in_a.
    """

    pixels: Pixels
    difference_px: FloatArray
    covered: BoolArray
    b_from_a: Mat3

    def __repr__(self) -> str:
        return (
            f"CameraDifference(rms {self.rms_px:.3f} px, at most {self.max_px:.3f} px over {100.0 * self.coverage:.0f} "
            f"% of the image, after a rotation of {self.rotation_deg:.4f} deg)"
        )

    @property
    def map_px(self) -> FloatArray:
        """Length of the difference (rows, columns), NaN where not covered."""
        return np.asarray(np.linalg.norm(self.difference_px, axis=-1))

    @property
    def rms_px(self) -> float:
        """Root mean square length over the covered pixels."""
        return float(np.sqrt(np.mean(self.map_px[self.covered] ** 2)))

    @property
    def max_px(self) -> float:
        return float(self.map_px[self.covered].max())

    @property
    def rotation_deg(self) -> float:
        """Angle of the fitted rotation."""
        return float(np.degrees(rotation_angle(self.b_from_a)))

    @property
    def coverage(self) -> float:
        """Share of the grid that is covered."""
        return float(self.covered.mean())


def compare_cameras(
    a: Camera,
    b: Camera,
    *,
    grid: tuple[int, int] = (60, 45),
    mask: BoolArray | None = None,
    fit_rotation: bool = True,
    weights: FloatArray | None = None,
) -> CameraDifference:
    """Return the difference of camera `b` from camera `a` over the image of `a`, at infinity.

    Raises InputError: the sizes differ, the grid is no pair of numbers, or `mask` or `weights` have another shape than
    it; DegenerateError: the cameras have fewer than 20 pixels of the grid in common.

    Parameters
    ----------
    a, b : cameras of any models and of one image size.
    grid : (columns, rows) of the map, spread evenly from corner pixel to corner pixel.
    mask : (rows, columns) pixels to compare, such as those that boards of the calibration covered.
    fit_rotation : whether the rotation that minimises the sum of the squared differences is applied.
    weights : (rows, columns) of the squared differences in that fit, such as the inverse of predicted variances.
    """
    if a.size_px != b.size_px:
        raise InputError(f"cameras of {a.size_px} and {b.size_px} px cannot be compared; calibrate at one image size")
    columns, rows = grid = _checked_grid(grid)
    pixels = grid_pixels(a.size_px, grid)
    if mask is not None:
        mask = as_mask(mask, (rows, columns), "mask")
    if weights is not None:
        weights = as_array(weights, (rows, columns), "weights")
        if not ((weights >= 0.0) & (weights < MAX_WEIGHT)).all():
            raise InputError("weights: they cannot be negative, or too large to be summed")
    rays, covered = a.unproject(pixels)
    if mask is not None:
        covered = covered & mask
    weight = np.ones((rows, columns)) if weights is None else weights
    b_from_a = np.eye(3)
    if fit_rotation and covered.sum() >= MIN_PIXELS:
        b_from_a = best_rotation(rays[covered], pixels[covered], weight[covered], b)
    projected, seen = b.project(rays @ b_from_a.T)
    covered = covered & seen
    if covered.sum() < MIN_PIXELS:
        raise DegenerateError(
            f"the cameras share {covered.sum()} of {covered.size} pixels; their fields of view differ; compare "
            "calibrations of one camera"
        )
    difference = np.where(covered[..., None], projected - pixels, np.nan)
    return CameraDifference(pixels, difference, covered, b_from_a)


def _checked_grid(grid: tuple[int, int]) -> tuple[int, int]:
    """Return (columns, rows) as integers; raises InputError for invalid counts."""
    numbers = as_array(grid, (2,), "grid")
    if not ((numbers == np.rint(numbers)) & (numbers >= 1) & (numbers <= MAX_GRID)).all():
        raise InputError(f"grid: columns and rows must be whole numbers from 1 to {MAX_GRID}, got {grid}")
    return int(numbers[0]), int(numbers[1])


def grid_pixels(size_px: tuple[int, int], grid: tuple[int, int]) -> Pixels:
    """Return (columns, rows) pixels spread evenly from corner pixel to corner pixel, (rows, columns, 2)."""
    u, v = (np.linspace(0.0, size - 1.0, count) for size, count in zip(size_px, grid, strict=True))
    return np.stack(np.meshgrid(u, v), axis=-1)


def best_rotation(rays: FloatArray, pixels: FloatArray, weight: FloatArray, b: Camera) -> Mat3:
    """Return the rotation b_from_a with which `b` projects `rays` (N, 3) closest to `pixels` (N, 2).

    Undamped Gauss-Newton from the rotation that fits the rays, which is within pixels of the solution.
    """
    rays_b, seen = b.unproject(pixels)
    covariance = np.einsum("n,ni,nj->ij", weight[seen], rays_b[seen], rays[seen])
    rotation = nearest_rotation(covariance) if seen.sum() >= 3 else np.eye(3)
    for _ in range(MAX_ROTATION_STEPS):
        turned = rays @ rotation.T
        projected, valid, d_pixels_d_point, _ = b.project_with_jacobians(turned)
        if valid.sum() < 3:
            break
        # d pixel / d w for the left rotation exp([w]x): J d(w x ray) = -J [ray]x w.
        by_turn = -d_pixels_d_point[valid] @ skew(turned[valid])
        residual = projected[valid] - pixels[valid]
        w = weight[valid]
        normal = np.einsum("n,nki,nkj->ij", w, by_turn, by_turn)
        gradient = np.einsum("n,nki,nk->i", w, by_turn, residual)
        step = np.linalg.lstsq(normal, -gradient, rcond=None)[0]
        rotation = exp_so3(step) @ rotation
        if np.linalg.norm(step) < ROTATION_SETTLED_RAD:
            break
    return nearest_rotation(rotation)
