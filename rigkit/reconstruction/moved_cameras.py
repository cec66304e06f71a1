"""Cameras moved by one standard deviation along each principal axis of their calibrations' covariance.

The axes are independent: the squares of what they change in a quantity add up to its variance.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

import numpy as np

from rigkit.cameras.base import Camera
from rigkit.cameras.moving_pupil import as_other_with_fixed_pupil
from rigkit.cameras.uncertain import PosedPair, UncertainCamera, UncertainPair
from rigkit.core.arrays import BoolArray, Pixels, Points

Known: TypeAlias = tuple[UncertainCamera | None, UncertainCamera | None]
"""Both cameras as they are known, None: nothing is known of one."""
Calibrations: TypeAlias = tuple[UncertainCamera, UncertainCamera | None] | UncertainPair
"""Both cameras as they are known; None: the second is the first. Of a rig the pose between them, too."""


def moved_cameras(
    camera1: Camera, camera2: Camera, known1: UncertainCamera | None, known2: UncertainCamera | None, *, one: bool
) -> list[tuple[Camera, Camera]]:
    """Return both cameras for each axis of what their calibrations leave open; none where one is exact.

    With `one` both images are of one camera, and both move together; `known2` is not used then.
    """
    if known1 is None or (known2 is None and not one):
        return []
    first = [(moved, moved if one else camera2) for moved in known1.moved()]
    return first if one or known2 is None else first + [(camera1, moved) for moved in known2.moved()]


def moved_pairs(pair: PosedPair, calibrations: Calibrations) -> list[PosedPair]:
    """Return both cameras and the pose between them for each axis of what their calibrations leave open: that of a rig
    moves with its cameras, one that was measured by other means stays."""
    if isinstance(calibrations, UncertainPair):
        return calibrations.moved()
    moved = moved_cameras(pair.camera1, pair.camera2, *calibrations, one=calibrations[1] is None)
    return [PosedPair(*cameras, pair.cam2_from_cam1) for cameras in moved]


def moved_pixels(
    pixels: tuple[Pixels, Pixels], points: tuple[Points, Points], known: Known, moved: tuple[Camera, Camera]
) -> tuple[Pixels, Pixels]:
    """Return the pixels (N, 2) of both images as moved cameras have what was seen of points (N, 3) mm in each camera's
    frame: where a pupil moves, what that does is taken out anew (`as_other_with_fixed_pupil`)."""
    one, two = (
        at if camera is None else as_other_with_fixed_pupil(at, p, camera.camera, other)
        for at, p, camera, other in zip(pixels, points, known, moved, strict=True)
    )
    return one, two


def seen_by_all(cameras: Sequence[tuple[Camera, Camera]], pixels1: Pixels, pixels2: Pixels) -> BoolArray:
    """Return which pixels (N, 2) of both images have a ray in all of the cameras."""
    return np.asarray(np.all([a.unproject(pixels1)[1] & b.unproject(pixels2)[1] for a, b in cameras], axis=0))
