"""The projection of points fixed to a rig into one of its cameras, with its derivatives by lens and mount."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rigkit.calibration.rig.solving.layout import Layout
from rigkit.cameras.base import Camera
from rigkit.core.arrays import BoolArray, FloatArray, Points
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import skew


@dataclass(frozen=True, eq=False, slots=True)
class RigProjection:
    """Pixels of points in a camera of a rig: which are `valid` (...,), and which of these are `seen` in its image; and
    the derivatives by the points in the rig's frame (..., 2, 3) and by the G globals of a layout (..., 2, G)."""

    valid: BoolArray
    seen: BoolArray
    d_pixels_d_point: FloatArray
    d_pixels_d_globals: FloatArray

    @classmethod
    def of(cls, camera: Camera, cam_from_rig: Rigid3, points: Points, layout: Layout, k: int) -> RigProjection:
        """Return that of `points` (..., 3) mm in the rig's frame into its camera `k`."""
        in_cam = cam_from_rig.apply(points)
        pixels, valid, d_pixels_d_x, d_pixels_d_parameters = camera.project_with_jacobians(in_cam)
        d_pixels_d_globals = np.zeros((*points.shape[:-1], 2, layout.count))
        d_pixels_d_globals[..., layout.cameras[k]] = d_pixels_d_parameters
        if (mount := layout.mounts[k]) is not None:
            # x = exp(w) R X + t + v.
            by_turn = d_pixels_d_x @ -skew(in_cam - cam_from_rig.translation_mm)
            d_pixels_d_globals[..., mount] = np.concatenate([by_turn, d_pixels_d_x], axis=-1)
        d_pixels_d_point = d_pixels_d_x @ cam_from_rig.rotation
        return cls(valid, valid & camera.on_image(pixels), d_pixels_d_point, d_pixels_d_globals)
