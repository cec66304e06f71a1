"""A corner of three textured walls, seen by any camera: images, and the exact surface at every pixel."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import cv2
import numpy as np

from rigkit.cameras.base import Camera
from rigkit.cameras.kannala_brandt import KannalaBrandt
from rigkit.cameras.pinhole import Pinhole
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3, unit

SIZE, SMALL_SIZE = (480, 360), (320, 240)
LENSES: dict[str, Camera] = {
    "pinhole": Pinhole(SIZE, np.array([420.0, 420.0, 239.5, 179.5])),
    "fisheye": KannalaBrandt(SIZE, np.array([230.0, 230.0, 240.0, 180.0, -0.02, 0.002, 0.0, 0.0])),
}
SMALL_LENSES: dict[str, Camera] = {
    "pinhole": Pinhole(SMALL_SIZE, np.array([280.0, 280.0, 159.5, 119.5])),
    "fisheye": KannalaBrandt(SMALL_SIZE, np.array([150.0, 150.0, 160.0, 120.0, -0.02, 0.002, 0.0, 0.0])),
}
TURN = exp_so3(np.array([0.05, -0.25, 0.1]))
CAM2_FROM_CAM1 = Rigid3(TURN, -TURN @ [320.0, -60.0, 60.0])
"""For two views of `Corner.of_a_room`."""

OVERSAMPLING = 2
TEXEL_MM = 1.0
TEXELS = 2048


def texture(rng: np.random.Generator) -> np.ndarray:
    """Noise of several octaves, (TEXELS, TEXELS) float32, 0 to 255."""
    octaves = [
        weight * cv2.resize(rng.normal(size=(n, n)).astype(np.float32), (TEXELS, TEXELS), interpolation=cv2.INTER_CUBIC)
        for n, weight in ((25, 1.0), (100, 1.0), (400, 0.8))
    ]
    total = np.sum(octaves, axis=0)
    return np.clip(127.0 + 45.0 * total / total.std(), 0, 255).astype(np.float32)


@dataclass(frozen=True)
class Corner:
    """Three planes that are perpendicular to each other and meet in `apex_mm`; axes are the columns of `axes`."""

    axes: np.ndarray
    apex_mm: np.ndarray
    textures: tuple[np.ndarray, ...]

    @classmethod
    @functools.cache
    def of_a_room(cls, seed: int = 20) -> Corner:
        """A corner 1.3 m in front of camera 1, diagonal towards the camera, floor at the bottom, random textures."""
        diagonal = unit(np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]).sum(axis=0))
        turn = exp_so3(unit(np.cross(diagonal, [0, 0, -1.0])) * np.arccos(diagonal @ [0, 0, -1.0]))
        axes = exp_so3(np.array([0.1, -0.15, 0.4])) @ turn
        rng = np.random.default_rng(seed)
        return cls(axes, np.array([10.0, 20.0, 1300.0]), tuple(texture(rng) for _ in range(3)))

    def hit(self, origin: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the range (N,) along rays in the frame of camera 1, and the plane (N,) first hit (-1: none)."""
        p, d = (origin - self.apex_mm) @ self.axes, directions @ self.axes
        ranges = np.full(len(d), np.inf)
        plane = np.full(len(d), -1)
        for k in range(3):
            with np.errstate(divide="ignore", invalid="ignore"):
                at = -p[k] / d[:, k]
            better = (at > 0.0) & (at < ranges)
            ranges[better], plane[better] = at[better], k
        return ranges, plane

    def surface(self, camera: Camera, pixels1: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the points (N, 3) and normals (N, 3) towards camera 1 that its pixels see."""
        rays, _ = camera.unproject(pixels1)
        ranges, plane = self.hit(np.zeros(3), rays)
        normals = self.axes.T[plane]
        return rays * ranges[:, None], -normals * np.sign(np.sum(normals * rays, axis=1))[:, None]

    def image(self, camera: Camera, cam_from_cam1: Rigid3, rng: np.random.Generator) -> np.ndarray:
        """Return the camera's image, with noise of one grey level."""
        width, height = camera.size_px
        s = OVERSAMPLING
        u, v = np.meshgrid((np.arange(width * s) + 0.5) / s - 0.5, (np.arange(height * s) + 0.5) / s - 0.5)
        rays, seen = camera.unproject(np.stack([u.ravel(), v.ravel()], axis=1))
        cam1_from_cam = cam_from_cam1.inverse()
        origin, directions = cam1_from_cam.translation_mm, np.nan_to_num(rays) @ cam1_from_cam.rotation.T
        ranges, plane = self.hit(origin, directions)
        at = (origin + directions * np.where(np.isfinite(ranges), ranges, 0.0)[:, None] - self.apex_mm) @ self.axes
        out = np.zeros(len(rays), dtype=np.float32)
        for k in range(3):
            on = (plane == k) & seen
            first, second = (at[on][:, [i for i in range(3) if i != k]] / TEXEL_MM).astype(np.float32).T
            # cv2.remap accepts maps of at most 32767 columns.
            for part in np.array_split(np.flatnonzero(on), len(first) // 30000 + 1):
                places = np.searchsorted(np.flatnonzero(on), part)
                maps = first[None, places], second[None, places]
                # The texture is mirrored beyond its border.
                out[part] = cv2.remap(self.textures[k], *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)[0]
        fine = out.reshape(height * s, width * s)
        image = cv2.resize(fine, (width, height), interpolation=cv2.INTER_AREA)
        return np.clip(image + rng.normal(0.0, 1.0, image.shape), 0, 255).astype(np.uint8)
