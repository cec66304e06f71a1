"""Move cameras by one standard deviation along each principal axis of their calibrations' covariance.

The axes are independent: the variance of a quantity is the sum of its squared changes.
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
"""Both cameras with their covariance; None if it is not known."""
Calibrations: TypeAlias = tuple[UncertainCamera, UncertainCamera | None] | UncertainPair
"""Both cameras with their covariance, None: the second is the first; or a rig, which includes the pose."""


def moved_cameras(
    camera1: Camera, camera2: Camera, known1: UncertainCamera | None, known2: UncertainCamera | None, *, one: bool
) -> list[tuple[Camera, Camera]]:
    """Return both cameras moved along each principal axis; no pairs if a covariance is not known.

    With `one` both images are of one camera, which moves for both; `known2` is not used.
    """
    if known1 is None or (known2 is None and not one):
        return []
    first = [(moved, moved if one else camera2) for moved in known1.moved()]
    return first if one or known2 is None else first + [(camera1, moved) for moved in known2.moved()]


def moved_pairs(pair: PosedPair, calibrations: Calibrations) -> list[PosedPair]:
    """Return both cameras and their pose moved along each principal axis; only a rig's pose moves with its cameras."""
    if isinstance(calibrations, UncertainPair):
        return calibrations.moved()
    moved = moved_cameras(pair.camera1, pair.camera2, *calibrations, one=calibrations[1] is None)
    return [PosedPair(*cameras, pair.cam2_from_cam1) for cameras in moved]


def moved_pixels(
    pixels: tuple[Pixels, Pixels], points: tuple[Points, Points], known: Known, moved: tuple[Camera, Camera]
) -> tuple[Pixels, Pixels]:
    """Return the pixels (N, 2) of both images, with their entrance-pupil correction redone for moved cameras.

    `points` (N, 3) mm are in each camera's frame; see `as_other_with_fixed_pupil`.
    """
    one, two = (
        at if camera is None else as_other_with_fixed_pupil(at, p, camera.camera, other)
        for at, p, camera, other in zip(pixels, points, known, moved, strict=True)
    )
    return one, two


def visible_in_all(cameras: Sequence[tuple[Camera, Camera]], pixels1: Pixels, pixels2: Pixels) -> BoolArray:
    """Return a mask (N,) of the pixels (N, 2) of both images that have a ray in all of the cameras."""
    return np.asarray(np.all([a.unproject(pixels1)[1] & b.unproject(pixels2)[1] for a, b in cameras], axis=0))
