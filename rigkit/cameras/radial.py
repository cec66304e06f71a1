"""Cameras that look the same in every direction around the axis: pixel = L s(r, z) (x, y) + centre.

r = |(x, y)|, s is the model's own scale, homogeneous of degree -1; L is diag(fx, fy), or Scaramuzza's affine part.
A model supplies s with its derivatives and the inverse profile; everything else is here.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, TypeVar

import numpy as np

from rigkit.cameras.base import Camera, RadialCurve
from rigkit.cameras.fit import nearest_camera
from rigkit.core.arrays import BoolArray, FloatArray
from rigkit.core.errors import InputError
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
    """What radially symmetric models have in common; see the module."""

    @abstractmethod
    def _scale(self, r2: FloatArray, z: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Return s and valid from r^2 and z."""

    @abstractmethod
    def _scale_derivatives(self, r2: FloatArray, z: FloatArray, shape: bool) -> ScaleDerivatives:
        """Return s with its derivatives; those by the shape parameters only where asked for."""

    @abstractmethod
    def _profile(self, radius2: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Return sin(theta) / radius, cos(theta) and valid, from the squared radius |s (x, y)|^2."""

    @abstractmethod
    def _linear(self) -> tuple[float, float, float, float, float]:
        """Return l00, l01, l11 of L (l10 = 0) and the centre."""

    @abstractmethod
    def _fill_parameters(
        self, out: FloatArray, m: tuple[FloatArray, FloatArray], by_shape: tuple[tuple[FloatArray, FloatArray], ...]
    ) -> None:
        """Write d pixel / d parameters (2, P, N) from m = s (x, y) and L (x, y) ds / d shape."""

    def _project(self, x: FloatArray, y: FloatArray, z: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
        scale, valid = self._scale(x * x + y * y, z)
        l00, l01, l11, cx, cy = self._linear()
        mx, my = scale * x, scale * y
        u = l00 * mx + cx
        if l01:
            u += l01 * my
        return u, l11 * my + cy, valid

    def _unproject(self, u: FloatArray, v: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, BoolArray]:
        l00, l01, l11, cx, cy = self._linear()
        my = (v - cy) / l11
        mx = (u - cx - l01 * my) / l00
        sine, cosine, valid = self._profile(mx * mx + my * my)
        return mx * sine, my * sine, cosine, valid

    def _derivatives(
        self,
        x: FloatArray,
        y: FloatArray,
        z: FloatArray,
        d_pixels_d_point: FloatArray,
        d_pixels_d_parameters: FloatArray | None,
    ) -> tuple[FloatArray, FloatArray, BoolArray]:
        d = self._scale_derivatives(x * x + y * y, z, d_pixels_d_parameters is not None)
        l00, l01, l11, cx, cy = self._linear()
        mx, my = d.scale * x, d.scale * y
        # L (x, y): with it d pixel / d point = s L [I 0] + L (x, y) (by_r x, by_r y, by_z).
        lx, ly = l00 * x + l01 * y, l11 * y
        rx, ry = d.by_r * x, d.by_r * y
        np.multiply(lx, rx, out=d_pixels_d_point[0, 0])
        d_pixels_d_point[0, 0] += l00 * d.scale
        np.multiply(lx, ry, out=d_pixels_d_point[0, 1])
        if l01:
            d_pixels_d_point[0, 1] += l01 * d.scale
        np.multiply(lx, d.by_z, out=d_pixels_d_point[0, 2])
        np.multiply(ly, rx, out=d_pixels_d_point[1, 0])
        np.multiply(ly, ry, out=d_pixels_d_point[1, 1])
        d_pixels_d_point[1, 1] += l11 * d.scale
        np.multiply(ly, d.by_z, out=d_pixels_d_point[1, 2])
        if d_pixels_d_parameters is not None:
            self._fill_parameters(d_pixels_d_parameters, (mx, my), tuple((lx * b, ly * b) for b in d.by_shape))
        return l00 * mx + l01 * my + cx, l11 * my + cy, d.valid


@dataclass(frozen=True, eq=False, slots=True, repr=False)
class FocalCamera(RadialCamera):
    """Radial models whose parameters are fx, fy, cx, cy in px and then the shape."""

    def _linear(self) -> tuple[float, float, float, float, float]:
        fx, fy, cx, cy = self.parameters[:4].tolist()
        return fx, 0.0, fy, cx, cy

    def _fill_parameters(
        self, out: FloatArray, m: tuple[FloatArray, FloatArray], by_shape: tuple[tuple[FloatArray, FloatArray], ...]
    ) -> None:
        out[0, 0], out[1, 1] = m
        out[0, 2] = out[1, 3] = 1.0
        for k, (du, dv) in enumerate(by_shape, start=4):
            out[0, k], out[1, k] = du, dv


_Focal = TypeVar("_Focal", bound=FocalCamera)


def fit_shape(
    model: type[_Focal],
    size_px: tuple[int, int],
    curve: RadialCurve,
    starts: Sequence[Sequence[float]],
) -> _Focal:
    """Return the camera of `model` nearest to the curve: one focal length and its shape, by least squares.

    Each of `starts` is a shape; the best end is returned. Raises InputError where no start sees the whole curve.
    """
    theta, centre = curve.theta_rad, curve.centre_px
    points = np.stack([np.sin(theta), np.zeros_like(theta), np.cos(theta)], axis=-1)
    pixels = centre + np.stack([curve.radius_px, np.zeros_like(theta)], axis=-1)
    best: tuple[_Focal, float] | None = None
    for start in starts:
        camera = model(size_px, np.array([1.0, 1.0, *centre, *start]))
        reached, valid = camera.project(points)
        if not valid.all():
            continue
        radius = reached[:, 0] - centre[0]
        focal = float(radius @ curve.radius_px / (radius @ radius))
        # One focal length along both axes, and the shape; the centre stays.
        free = np.eye(camera.parameters.size)[:, [0, *range(4, camera.parameters.size)]]
        free[1, 0] = 1.0
        camera = camera.with_parameters([focal, focal, *camera.parameters[2:]])
        found = nearest_camera(camera, points, pixels, free, STOP_OF_SHAPE)
        if best is None or found[1] < best[1]:
            best = found
    if best is None:
        raise InputError(
            f"radial curve: no {model.model} camera sees all of it, out to {np.degrees(theta[-1]):.1f} deg"
        )
    return best[0]
