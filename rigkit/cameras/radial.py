"""Radially symmetric cameras: pixel = L s(r, z) (x, y) + centre.

r = |(x, y)|, s is the model's scale, homogeneous of degree -1; L is diag(fx, fy), or Scaramuzza's affine part. A model
implements s with its derivatives and the inverse profile; everything else is here.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import ClassVar, NamedTuple, Self

import numpy as np

from rigkit.cameras.base import Camera, RadialCurve
from rigkit.cameras.fit import nearest_camera
from rigkit.core.arrays import BoolArray, Coordinates, FloatArray, Projected
from rigkit.core.errors import InputError
from rigkit.kernels.cameras import radial_pixels
from rigkit.optim.damping import Stop

STOP_OF_SHAPE = Stop(steps=40, gain=1e-6)


class ScaleDerivatives(NamedTuple):
    """The scale s with its derivatives: `by_r` is (ds/dr) / r, which has a limit on the axis."""

    scale: FloatArray
    valid: BoolArray
    by_r: FloatArray
    by_z: FloatArray
    by_shape: tuple[FloatArray, ...]


@dataclass(frozen=True, eq=False, slots=True, repr=False)
class RadialCamera(Camera):
    """Common part of radially symmetric models; see the module."""

    @abstractmethod
    def _profile(self, radius2: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Return sin(theta) / radius, cos(theta) and valid, from the squared radius |s (x, y)|^2."""

    def _linear(self) -> tuple[float, float, float, float, float]:
        """Return l00, l01, l11 of L (l10 = 0) and the centre; here for parameters that begin with fx, fy, cx, cy."""
        fx, fy, cx, cy = self.parameters[:4].tolist()
        return fx, 0.0, fy, cx, cy

    def _unproject(self, u: FloatArray, v: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, BoolArray]:
        l00, l01, l11, cx, cy = self._linear()
        my = (v - cy) / l11
        mx = (u - cx - l01 * my) / l00
        sine, cosine, valid = self._profile(mx * mx + my * my)
        return mx * sine, my * sine, cosine, valid


@dataclass(frozen=True, eq=False, slots=True, repr=False)
class CompiledCamera(RadialCamera):
    """Radial models whose formulas are in the kernel of their name in radial.c."""

    @abstractmethod
    def _shape(self) -> tuple[FloatArray, tuple[float, float]]:
        """Return the polynomial and the limits for `radial_pixels`."""

    def _project(self, x: FloatArray, y: FloatArray, z: FloatArray) -> Projected:
        polynomial, limits = self._shape()
        return radial_pixels(self.model, (x, y, z), polynomial, self._linear(), limits)

    def _derivatives(
        self, at: Coordinates, d_pixels_d_point: FloatArray, d_pixels_d_parameters: FloatArray | None
    ) -> Projected:
        memory = d_pixels_d_point, d_pixels_d_parameters
        polynomial, limits = self._shape()
        return radial_pixels(self.model, at, polynomial, self._linear(), limits, *memory)


@dataclass(frozen=True, eq=False, slots=True, repr=False)
class FocalCamera(RadialCamera):
    """Radial models whose parameters are fx, fy, cx, cy in px and then the shape."""

    shape_names: ClassVar[tuple[str, ...]] = ()
    shape_starts: ClassVar[tuple[tuple[float, ...], ...]] = ((),)
    """Initial values of the shape from a nearly perspective lens to a fisheye, of which the best result is used."""

    @classmethod
    def from_radial_curve(cls, size_px: tuple[int, int], curve: RadialCurve, *, order: int | None = None) -> Self:
        """Return the camera that fits the curve best: one focal length and its shape, by least squares.

        Raises InputError where the field of view of none includes the whole curve.
        """
        theta, centre = curve.theta_rad, curve.centre_px
        points = np.stack([np.sin(theta), np.zeros_like(theta), np.cos(theta)], axis=-1)
        pixels = centre + np.stack([curve.radius_px, np.zeros_like(theta)], axis=-1)
        best: tuple[Self, float] | None = None
        for start in cls.shape_starts:
            camera = cls(size_px, np.array([1.0, 1.0, *centre, *start]))
            reached, valid = camera.project(points)
            if not valid.all():
                continue
            radius = reached[:, 0] - centre[0]
            focal = float(radius @ curve.radius_px / (radius @ radius))
            # One focal length for both axes, and the shape; the centre is held.
            free = np.eye(camera.parameters.size)[:, [0, *range(4, camera.parameters.size)]]
            free[1, 0] = 1.0
            camera = camera.with_parameters([focal, focal, *camera.parameters[2:]])
            found = nearest_camera(camera, points, pixels, free, STOP_OF_SHAPE)
            if best is None or found[1] < best[1]:
                best = found
        if best is None:
            raise InputError(
                f"radial curve: no {cls.model} camera sees all of it, out to {np.degrees(theta[-1]):.1f} deg"
            )
        return best[0]

    def parameter_names(self) -> tuple[str, ...]:
        return ("fx", "fy", "cx", "cy", *self.shape_names)

    @abstractmethod
    def _scale(self, r2: FloatArray, z: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Return s and valid from r^2 and z."""

    @abstractmethod
    def _scale_derivatives(self, r2: FloatArray, z: FloatArray, shape: bool) -> ScaleDerivatives:
        """Return s with its derivatives, with those by the shape parameters if `shape`."""

    def _project(self, x: FloatArray, y: FloatArray, z: FloatArray) -> Projected:
        scale, valid = self._scale(x * x + y * y, z)
        fx, fy, cx, cy = self.parameters[:4].tolist()
        return fx * (scale * x) + cx, fy * (scale * y) + cy, valid

    def _derivatives(
        self, at: Coordinates, d_pixels_d_point: FloatArray, d_pixels_d_parameters: FloatArray | None
    ) -> Projected:
        x, y, z = at
        d = self._scale_derivatives(x * x + y * y, z, d_pixels_d_parameters is not None)
        fx, fy, cx, cy = self.parameters[:4].tolist()
        mx, my = d.scale * x, d.scale * y
        # L (x, y): with it d pixel / d point = s L [I 0] + L (x, y) (by_r x, by_r y, by_z).
        lx, ly = fx * x, fy * y
        for own, out in zip((lx, ly), d_pixels_d_point, strict=True):
            np.multiply(own, d.by_r * x, out=out[0])
            np.multiply(own, d.by_r * y, out=out[1])
            np.multiply(own, d.by_z, out=out[2])
        d_pixels_d_point[0, 0] += fx * d.scale
        d_pixels_d_point[1, 1] += fy * d.scale
        if d_pixels_d_parameters is not None:
            d_pixels_d_parameters[0, 0], d_pixels_d_parameters[1, 1] = mx, my
            d_pixels_d_parameters[0, 2] = d_pixels_d_parameters[1, 3] = 1.0
            for k, by in enumerate(d.by_shape, start=4):
                d_pixels_d_parameters[0, k], d_pixels_d_parameters[1, k] = lx * by, ly * by
        return fx * mx + cx, fy * my + cy, d.valid
