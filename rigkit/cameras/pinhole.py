"""The perspective camera without distortion: the target of rectification and the camera of virtual views."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from rigkit.arrays import BoolArray, FloatArray, Mat3, Pixels, Points, RayJacobians, Rays
from rigkit.cameras.base import Camera

__all__ = ["Pinhole"]


@dataclass(frozen=True, eq=False, slots=True)
class Pinhole(Camera):
    """u = fx x/z + cx, v = fy y/z + cy; points with z <= 0 are not seen.

    Parameters are fx, fy, cx, cy in px.
    """

    model: ClassVar[str] = "pinhole"

    @classmethod
    def from_K(cls, K: Mat3, size_px: tuple[int, int]) -> Pinhole:
        """Build from a camera matrix without skew."""
        return cls(size_px, np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2]]))

    @property
    def K(self) -> Mat3:
        """The camera matrix."""
        fx, fy, cx, cy = self.parameters
        return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])

    def parameter_names(self) -> tuple[str, ...]:
        return ("fx", "fy", "cx", "cy")

    def project(self, points: Points) -> tuple[Pixels, BoolArray]:
        points = np.asarray(points, dtype=np.float64)
        valid = (points[..., 2] > 0.0) & np.isfinite(points).all(axis=-1)
        z = np.where(valid, points[..., 2], np.nan)
        pixels = points[..., :2] / z[..., None] * self.parameters[:2] + self.parameters[2:]
        return pixels, valid

    def unproject(self, pixels: Pixels) -> tuple[Rays, BoolArray]:
        pixels = np.asarray(pixels, dtype=np.float64)
        xy = (pixels - self.parameters[2:]) / self.parameters[:2]
        ray = np.concatenate([xy, np.ones((*xy.shape[:-1], 1))], axis=-1)
        ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
        valid = np.isfinite(ray).all(axis=-1)
        return np.where(valid[..., None], ray, np.nan), valid

    def ray_jacobian(self, pixels: Pixels) -> RayJacobians:
        pixels = np.asarray(pixels, dtype=np.float64)
        xy = (pixels - self.parameters[2:]) / self.parameters[:2]
        g = np.concatenate([xy, np.ones((*xy.shape[:-1], 1))], axis=-1)
        length = np.linalg.norm(g, axis=-1)[..., None, None]
        f = g[..., None] / length
        dg = np.zeros((3, 2))
        dg[0, 0], dg[1, 1] = 1.0 / self.parameters[:2]
        return np.asarray((dg - f @ (np.swapaxes(f, -1, -2) @ dg)) / length)

    def project_with_jacobians(self, points: Points) -> tuple[Pixels, BoolArray, FloatArray, FloatArray]:
        points = np.asarray(points, dtype=np.float64)
        pixels, valid = self.project(points)
        z = np.where(valid, points[..., 2], np.nan)
        xy = points[..., :2] / z[..., None]
        f = self.parameters[:2]
        by_point = np.zeros((*points.shape[:-1], 2, 3))
        by_point[..., 0, 0], by_point[..., 1, 1] = f[0] / z, f[1] / z
        by_point[..., :, 2] = -f * xy / z[..., None]
        by_parameter = np.zeros((*points.shape[:-1], 2, 4))
        by_parameter[..., 0, 0], by_parameter[..., 1, 1] = xy[..., 0], xy[..., 1]
        by_parameter[..., 0, 2] = by_parameter[..., 1, 3] = 1.0
        return pixels, valid, by_point, by_parameter
