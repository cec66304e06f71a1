"""A lens with a moving entrance pupil, which is not central for points at a finite distance.

The entrance pupil of wide lenses moves with the angle t of a ray from the axis, by

    s(t) = e1 t^2 + e2 t^4        mm forwards along the optical axis.

The ray of a pixel has the direction given by the central camera, and starts at (0, 0, s). For far points the pupil has
no effect, and the central camera is exact. A point p is seen at the angle t for which

    p - s(t) (0, 0, 1)        is at the angle t,

which Newton's method solves; a point so near that it is on several rays is invalid.

Reference: D. B. Gennery, "Generalized camera calibration including fish-eye lenses", IJCV 68 (2006), section 2, the E
terms of CAHVORE.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike

from rigkit.cameras.base import Camera
from rigkit.core.arrays import BoolArray, Coordinates, FloatArray, Pixels, Points, Projected, RayJacobians, Rays

PUPIL_TERMS = 2
PUPIL_NAMES = ("pupil_mm_per_rad2", "pupil_mm_per_rad4")
MAX_NEWTON_ROUNDS, ROUNDING_RAD = 12, 1e-13
"""Newton's method needs four to six rounds for points farther than the pupil moves."""


def pupil_shift_mm(theta_rad: FloatArray, pupil: FloatArray) -> FloatArray:
    """Return the movement (...,) mm of the pupil (2,) along the axis at angles (...,) from it."""
    square = theta_rad * theta_rad
    return np.asarray(square * (pupil[0] + pupil[1] * square))


def pupil_shift_of_rays_mm(rays: Rays, pupil: FloatArray) -> FloatArray:
    """Return the position (...,) mm on the axis at which rays (..., 3) of a lens with this pupil (2,) start."""
    return pupil_shift_mm(np.arctan2(np.hypot(rays[..., 0], rays[..., 1]), rays[..., 2]), pupil)


@dataclass(frozen=True, eq=False, slots=True)
class NearCamera(Camera):
    """The camera that projects points in mm: unlike other cameras, its `project` and derivatives depend on the distance
    of a point. `parameters` are those of its `lens`, the central camera for far points, and the two terms of the pupil.
    `unproject` returns the directions of rays, those of the lens."""

    lens: Camera

    model: ClassVar[str] = "moving pupil"

    @classmethod
    def of(cls, lens: Camera, pupil: ArrayLike = (0.0, 0.0)) -> NearCamera:
        """Return the lens with the pupil (2,), mm rad^-2 and mm rad^-4."""
        return cls(lens.size_px, np.append(lens.parameters, pupil), lens)

    def with_parameters(self, parameters: ArrayLike) -> Self:
        values = np.asarray(parameters, dtype=np.float64)
        return type(self)(self.size_px, values, self.lens.with_parameters(values[:-PUPIL_TERMS]))

    def parameter_names(self) -> tuple[str, ...]:
        return (*self.lens.parameter_names(), *PUPIL_NAMES)

    @property
    def ends(self) -> FloatArray:
        unlimited = np.repeat([[-np.inf], [np.inf]], PUPIL_TERMS, axis=1)
        return np.concatenate([self.lens.ends, unlimited], axis=1)

    @property
    def series(self) -> tuple[int, ...]:
        return self.lens.series

    @property
    def pupil(self) -> FloatArray:
        """The two terms of the pupil, mm rad^-2 and mm rad^-4."""
        return self.parameters[-PUPIL_TERMS:]

    @property
    def max_angle_rad(self) -> float:
        return self.lens.max_angle_rad

    # Directions of rays are those of the lens.
    def rays_and_jacobians(self, pixels: Pixels) -> tuple[Rays, BoolArray, RayJacobians]:
        return self.lens.rays_and_jacobians(pixels)

    @property
    def axis_px(self) -> Pixels:
        return self.lens.axis_px

    @property
    def focal_px(self) -> float:
        return self.lens.focal_px

    def seen(self, points: Points) -> Points:
        """Return points (N, 3) relative to the entrance pupil of their own ray, so that the central lens projects them
        to the same pixels; NaN where a point is too near."""
        x, y, z = points.T
        _, ahead, _, _, valid = self._through_pupil(x, y, z)
        return np.where(valid[:, None], np.stack([x, y, ahead], axis=1), np.nan)

    def as_with_fixed_pupil(self, pixels: Pixels, points: Points) -> Pixels:
        """Return the pixels (N, 2) that points (N, 3), measured at `pixels` (N, 2), would have if the pupil did not
        move; NaN where a point is invalid."""
        return np.asarray(pixels - self.project(points)[0] + self.lens.project(points)[0])

    def _through_pupil(
        self, x: FloatArray, y: FloatArray, z: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, BoolArray]:
        """Return the distance of points from the axis, their z relative to their pupil, their angle, ds / dt there, and
        which are valid; all (N,)."""
        e1, e2 = self.pupil.tolist()
        across = np.hypot(x, y)
        theta = np.arctan2(across, z)
        for _ in range(MAX_NEWTON_ROUNDS):
            square = theta * theta
            ahead, slope = z - square * (e1 + e2 * square), theta * (2.0 * e1 + 4.0 * e2 * square)
            sine, cosine = np.sin(theta), np.cos(theta)
            step = (across * cosine - ahead * sine) / (across * sine + ahead * cosine - slope * sine)
            theta = theta + step
            if not np.nanmax(np.abs(step), initial=0.0) > ROUNDING_RAD:
                break
        square = theta * theta
        ahead, slope = z - square * (e1 + e2 * square), theta * (2.0 * e1 + 4.0 * e2 * square)
        sine = np.sin(theta)
        along = across * sine + ahead * np.cos(theta)
        # The ray crosses its neighbours in front of the point, not behind it.
        valid = (np.abs(step) <= 1e3 * ROUNDING_RAD) & (along > np.abs(slope * sine)) & (theta >= 0.0)
        return across, ahead, theta, slope, valid

    def _project(self, x: FloatArray, y: FloatArray, z: FloatArray) -> Projected:
        _, ahead, _, _, near = self._through_pupil(x, y, z)
        u, v, valid = self.lens._project(x, y, ahead)
        return u, v, valid & near

    def _unproject(self, u: FloatArray, v: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, BoolArray]:
        return self.lens._unproject(u, v)

    def _derivatives(
        self, at: Coordinates, d_pixels_d_point: FloatArray, d_pixels_d_parameters: FloatArray | None
    ) -> Projected:
        x, y, z = at
        across, ahead, theta, slope, near = self._through_pupil(x, y, z)
        of_lens = None if d_pixels_d_parameters is None else d_pixels_d_parameters[:, :-PUPIL_TERMS]
        u, v, valid = self.lens._derivatives((x, y, ahead), d_pixels_d_point, of_lens)
        # With c = (t^2, t^4), g the gradient of the angle at the point relative to its pupil, and R its distance:
        # ds = s' dt + c de and dt = g dp + rho / R^2 ds give ds = (s' g dp + c de) / (1 - s' rho / R^2).
        distance = across * across + ahead * ahead
        grown = 1.0 / (1.0 - slope * across / distance)
        forward = d_pixels_d_point[:, 2].copy()
        if d_pixels_d_parameters is not None:
            square = theta * theta
            d_pixels_d_parameters[:, -2] = -forward * (square * grown)
            d_pixels_d_parameters[:, -1] = -forward * (square * square * grown)
        turn = slope * grown / distance
        sideways = turn * ahead / np.maximum(across, np.finfo(float).tiny)
        d_pixels_d_point[:, 0] -= forward * (sideways * x)
        d_pixels_d_point[:, 1] -= forward * (sideways * y)
        d_pixels_d_point[:, 2] += forward * (turn * across)
        return u, v, valid & near


def as_other_with_fixed_pupil(pixels: Pixels, points: Points, camera: Camera, other: Camera) -> Pixels:
    """Return pixels (N, 2) of points (N, 3), given `as_with_fixed_pupil` of `camera`, as those of `other`, which saw
    the same image. Pixels of invalid points, and all if one camera is central, are returned unchanged."""
    if not (isinstance(camera, NearCamera) and isinstance(other, NearCamera)):
        return pixels
    seen = pixels - camera.as_with_fixed_pupil(np.zeros_like(pixels), points)
    again = other.as_with_fixed_pupil(seen, points)
    return np.where(np.isfinite(again), again, pixels)


def with_pupil_of(lens: Camera, camera: Camera) -> Camera:
    """Return the central camera `lens` with the moving pupil of `camera`; `lens` itself if that is central."""
    return NearCamera.of(lens, camera.pupil) if isinstance(camera, NearCamera) else lens


def far_camera(camera: Camera) -> Camera:
    """Return the central camera for far points: the lens of a `NearCamera`, else the camera itself."""
    return camera.lens if isinstance(camera, NearCamera) else camera
