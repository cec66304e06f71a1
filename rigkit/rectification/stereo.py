"""Stereo rectification of any two cameras: corresponding points have the same row.

Every plane through the baseline becomes a row of the perspective image, and of the panoramas around the baseline
(S. Abraham, W. Foerstner, "Fish-eye-stereo calibration and epipolar rectification", ISPRS 2005). The panoramas also
work for fields of view beyond 180 degrees and for forward motion.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from rigkit.cameras.base import Camera
from rigkit.cameras.compare import grid_pixels
from rigkit.cameras.pinhole import Pinhole
from rigkit.core.arrays import FloatArray, Mat3
from rigkit.core.errors import DegenerateError, InputError
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import angle_between, unit
from rigkit.rectification.panorama import EpipolarCylindrical, EpipolarEquirectangular
from rigkit.rectification.rectify import RectifyMap, rectify_map

StereoProjection = Literal["perspective", "cylindrical", "equirectangular"]

_TARGETS: dict[str, type[Camera]] = {
    "perspective": Pinhole,
    "cylindrical": EpipolarCylindrical,
    "equirectangular": EpipolarEquirectangular,
}
_REACH = {
    "perspective": (np.tan(np.radians(60.0)), np.tan(np.radians(60.0))),
    "cylindrical": (np.tan(np.radians(60.0)), np.pi),
    "equirectangular": (np.radians(85.0), np.pi),
}
"""Largest half extents of a target along and across the baseline, over its focal length: they limit the stretching."""
MIN_ANGLE_RAD = np.radians(15.0)
"""Smallest angle between baseline and viewing direction for a perspective target, whose axis is across the baseline."""
EXTENT_SAMPLES = 41
"""Sampled pixels per side of each image from which the extent of the target follows."""
MAX_ENLARGEMENT = 3.0
"""Largest side of the target over the largest side of the sources."""


@dataclass(frozen=True, eq=False, slots=True)
class StereoRectification:
    """Two maps into one target camera, in whose images corresponding points have the same row.

    Attributes
    ----------
    map1, map2 : the maps of the two cameras; `map1.target` and `map2.target` are the same.
    rect2_from_rect1 : no rotation; translation (-baseline, 0, 0) if camera 2 is on the right, else (baseline, 0, 0).
    """

    map1: RectifyMap
    map2: RectifyMap
    rect2_from_rect1: Rigid3

    @property
    def baseline_mm(self) -> float:
        return float(np.linalg.norm(self.rect2_from_rect1.translation_mm))


def rectify_pair(
    camera1: Camera, camera2: Camera, cam2_from_cam1: Rigid3, *, projection: StereoProjection = "perspective"
) -> StereoRectification:
    """Return the rectification of a pair of cameras of any models.

    Raises InputError: `projection` is unknown; DegenerateError: no baseline, a baseline along the viewing direction
    with a perspective projection, or no common field of view.

    Parameters
    ----------
    projection : "perspective" for ordinary lenses and side-by-side cameras; "cylindrical" and "equirectangular" around
        the baseline for wide ones, the latter for every direction of the baseline.

    The target covers the rows that both cameras see and all columns that either sees, within the extent that the
    projection allows, at the median resolution of the sources.
    """
    if projection not in _TARGETS:
        raise InputError(f"projection '{projection}' is unknown; known: {', '.join(_TARGETS)}")
    rect_from_cam1 = _common_rotation(cam2_from_cam1, projection)
    rect_from_cam2 = rect_from_cam1 @ cam2_from_cam1.rotation.T
    model = _TARGETS[projection]
    plain = model((1, 1), np.array([1.0, 1.0, 0.0, 0.0]))
    maps = [
        rectify_map(camera, plain, target_from_cam=rotation)
        for camera, rotation in ((camera1, rect_from_cam1), (camera2, rect_from_cam2))
    ]
    low, high, scale = _extent(maps, np.array(_REACH[projection]))
    largest = MAX_ENLARGEMENT * max(*camera1.size_px, *camera2.size_px)
    focal = min(float(1.0 / scale), largest / float((high - low).max()))
    size = np.ceil(focal * (high - low)).astype(int) + 1
    target = model((int(size[0]), int(size[1])), np.array([focal, focal, *(-focal * low)]))
    return StereoRectification(
        rectify_map(camera1, target, target_from_cam=rect_from_cam1),
        rectify_map(camera2, target, target_from_cam=rect_from_cam2),
        Rigid3(np.eye(3), rect_from_cam2 @ cam2_from_cam1.translation_mm),
    )


def _common_rotation(cam2_from_cam1: Rigid3, projection: str) -> Mat3:
    """Return rect_from_cam1: x along the baseline, to the right; z as close as possible to both viewing directions."""
    centre2 = cam2_from_cam1.inverse().translation_mm
    x = unit(centre2)
    if not np.isfinite(x).all():
        raise DegenerateError("stereo rectification: the two cameras have the same centre; rows need a baseline")
    axes2_in_cam1 = cam2_from_cam1.rotation.T
    right, forward = np.eye(3) + axes2_in_cam1, unit(np.eye(3)[:, 2] + axes2_in_cam1[:, 2])
    if x @ right[:, 0] < 0.0:
        x = -x
    angle = float(angle_between(x, forward))
    angle = min(angle, np.pi - angle)
    if projection == "perspective" and not angle >= MIN_ANGLE_RAD:
        raise DegenerateError(
            f"stereo rectification: the baseline is {np.degrees(angle):.0f} degrees off the viewing direction; "
            "take the projection 'equirectangular'"
        )
    across = np.cross(forward, x)
    # A baseline along the view does not determine the rotation about it: keep the cameras' vertical.
    y = unit(across) if np.linalg.norm(across) > 1e-3 else unit(right[:, 1] - (right[:, 1] @ x) * x)
    return np.stack([x, y, np.cross(x, y)])


def _extent(maps: list[RectifyMap], reach: FloatArray) -> tuple[FloatArray, FloatArray, float]:
    """Return the lower and upper corner of the target over its focal length, and the median scale of the maps."""
    lows, highs, scales = [], [], []
    for remap in maps:
        grid = grid_pixels(remap.camera.size_px, (EXTENT_SAMPLES, EXTENT_SAMPLES))
        there, valid = remap.pixels(grid)
        valid &= (np.abs(np.where(valid[..., None], there, np.inf)) <= reach).all(axis=-1)
        if not valid.any():
            raise DegenerateError(
                "stereo rectification: a camera looks away from the plane that both could share; "
                "rectify each alone (--camera)"
            )
        lows.append(there[valid].min(axis=0))
        highs.append(there[valid].max(axis=0))
        scales.append(remap.scale(grid[valid]))
    low, high = np.minimum(*lows), np.maximum(*highs)
    low[1], high[1] = max(lows[0][1], lows[1][1]), min(highs[0][1], highs[1][1])
    if low[1] >= high[1]:
        raise DegenerateError("stereo rectification: the two cameras have no row in common; check cam2_from_cam1")
    scale = np.concatenate(scales)
    return low, high, float(np.median(scale[np.isfinite(scale)]))
