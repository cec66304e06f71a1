"""Images of a rectified pair: their pose is not a guess but what the rectification made it."""

from __future__ import annotations

import numpy as np

from rigkit.cameras.base import Camera
from rigkit.core.errors import DegenerateError, InputError
from rigkit.core.matches import Matches
from rigkit.core.posetype import PoseType
from rigkit.relative_pose.refinement.select import pose_type_evidence

SAME_ROW = 1e-9
"""Tangents of rows of two rectified images agree to rounding: they are computed, not measured."""
PIXELS_A_SIDE = 9
RECTIFIED_NOTE = (
    "the cameras and the matches are those of a rectified pair, whose pose is exact; for one camera moved sideways by "
    "hand declare the pose type 'general'"
)


def are_rectified(camera1: Camera, camera2: Camera) -> bool:
    """Say whether the cameras are perspective ones of one focal length, whose rows look the same way up and down.

    Their principal points may differ along the row.
    """
    if camera1.size_px[1] != camera2.size_px[1]:
        return False
    tangents = []
    for camera in (camera1, camera2):
        width, height = camera.size_px
        at = np.stack(
            np.meshgrid(np.linspace(0, width - 1, PIXELS_A_SIDE), np.linspace(0, height - 1, PIXELS_A_SIDE)), axis=-1
        )
        rays, seen = camera.unproject(at)
        if not (seen.all() and (rays[..., 2] > 0.0).all()):
            return False
        x, y = rays[..., 0] / rays[..., 2], rays[..., 1] / rays[..., 2]
        slope = np.diff(x, axis=1) / np.diff(at[..., 0], axis=1)
        if np.ptp(slope) > SAME_ROW or np.ptp(y, axis=1).max() > SAME_ROW:
            return False
        tangents.append(np.append(y[:, 0], slope.mean()))
    return bool(np.abs(tangents[0] - tangents[1]).max() < SAME_ROW)


def seen_as_rectified(matches: Matches) -> bool:
    """Say whether matches that agree with one pose speak for a baseline along the rows and no rotation."""
    try:
        return pose_type_evidence(matches).choice is PoseType.STANDARD
    except (InputError, DegenerateError):
        return False
