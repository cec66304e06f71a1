"""Cylindrical and equirectangular targets of rectification, for fields of view too wide for a perspective image.

A panorama has an axis: the vertical (y) one for viewing, the horizontal (x) one for stereo pairs, where all planes
through the baseline become rows. Across the axis the image is linear in the angle; along it, in the tangent of the
elevation (cylindrical) or in the elevation itself (equirectangular).
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from rigkit.cameras.base import Camera
from rigkit.core.arrays import BoolArray, Coordinates, FloatArray, Projected


@dataclass(frozen=True, eq=False, slots=True)
class Panorama(Camera):
    """u = fx atan2(x, z) + cx, v = fy w(y, hypot(x, z)) + cy; with a horizontal axis x, y and u, v are swapped.

    Parameters are fx, fy in px per radian (per unit of the tangent along a cylinder), cx, cy in px. Such a camera is
    not calibrated: no lens makes such images.
    """

    horizontal_axis: ClassVar[bool] = False

    @property
    def max_angle_rad(self) -> float:
        return float(np.pi)

    def parameter_names(self) -> tuple[str, ...]:
        return ("fx", "fy", "cx", "cy")

    @staticmethod
    @abstractmethod
    def _rise(b: FloatArray, h: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return w and its derivatives by b (along the axis) and h (distance from it)."""

    @staticmethod
    @abstractmethod
    def _elevation(w: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Return sine and cosine of the elevation, and valid."""

    def _project(self, x: FloatArray, y: FloatArray, z: FloatArray) -> Projected:
        a, b = (y, x) if self.horizontal_axis else (x, y)
        h = np.sqrt(a * a + z * z)
        across, along = np.arctan2(a, z), self._rise(b, h)[0]
        fx, fy, cx, cy = self.parameters.tolist()
        s, t = (along, across) if self.horizontal_axis else (across, along)
        return fx * s + cx, fy * t + cy, (h > 0.0) & (h + np.abs(b) < np.inf)

    def _unproject(self, u: FloatArray, v: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, BoolArray]:
        fx, fy, cx, cy = self.parameters.tolist()
        s, t = (u - cx) / fx, (v - cy) / fy
        across, along = (t, s) if self.horizontal_axis else (s, t)
        sine, cosine, valid = self._elevation(along)
        a, z = cosine * np.sin(across), cosine * np.cos(across)
        x, y = (sine, a) if self.horizontal_axis else (a, sine)
        return x, y, z, valid & (np.abs(across) <= np.pi)

    def _derivatives(
        self, at: Coordinates, d_pixels_d_point: FloatArray, d_pixels_d_parameters: FloatArray | None
    ) -> Projected:
        x, y, z = at
        i, j = (1, 0) if self.horizontal_axis else (0, 1)
        a, b = (y, x) if self.horizontal_axis else (x, y)
        h = np.sqrt(a * a + z * z)
        _, by_b, by_h = self._rise(b, h)
        across, along = self.parameters[i], self.parameters[j]
        d_pixels_d_point[i, i], d_pixels_d_point[i, 2] = across * z / (h * h), -across * a / (h * h)
        d_pixels_d_point[i, j], d_pixels_d_point[j, j] = 0.0, along * by_b
        d_pixels_d_point[j, i], d_pixels_d_point[j, 2] = along * by_h * a / h, along * by_h * z / h
        u, v, valid = self._project(x, y, z)
        if d_pixels_d_parameters is not None:
            fx, fy, cx, cy = self.parameters.tolist()
            d_pixels_d_parameters[0, 0], d_pixels_d_parameters[1, 1] = (u - cx) / fx, (v - cy) / fy
            d_pixels_d_parameters[0, 2] = d_pixels_d_parameters[1, 3] = 1.0
        return u, v, valid


@dataclass(frozen=True, eq=False, slots=True)
class Cylindrical(Panorama):
    """v = fy y / hypot(x, z) + cy: vertical lines stay straight; the poles are at infinity."""

    model: ClassVar[str] = "cylindrical"

    @staticmethod
    def _rise(b: FloatArray, h: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        w = b / h
        return w, 1.0 / h, -w / h

    @staticmethod
    def _elevation(w: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
        cosine = 1.0 / np.sqrt(1.0 + w * w)
        return w * cosine, cosine, np.isfinite(w)


@dataclass(frozen=True, eq=False, slots=True)
class Equirectangular(Panorama):
    """v = fy atan2(y, hypot(x, z)) + cy: the whole sphere in 2 pi fx by pi fy pixels."""

    model: ClassVar[str] = "equirectangular"

    @staticmethod
    def _rise(b: FloatArray, h: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        n2 = b * b + h * h
        return np.arctan2(b, h), h / n2, -b / n2

    @staticmethod
    def _elevation(w: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
        return np.sin(w), np.cos(w), np.abs(w) <= np.pi / 2


@dataclass(frozen=True, eq=False, slots=True)
class EpipolarCylindrical(Cylindrical):
    """The cylinder around the x axis: u = fx x / hypot(y, z) + cx, v = fy atan2(y, z) + cy."""

    model: ClassVar[str] = "epipolar_cylindrical"
    horizontal_axis: ClassVar[bool] = True


@dataclass(frozen=True, eq=False, slots=True)
class EpipolarEquirectangular(Equirectangular):
    """The sphere with its poles on the x axis: u = fx atan2(x, hypot(y, z)) + cx, v = fy atan2(y, z) + cy."""

    model: ClassVar[str] = "epipolar_equirectangular"
    horizontal_axis: ClassVar[bool] = True
