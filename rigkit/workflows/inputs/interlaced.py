"""Detection of interlaced images in a session: odd and even lines of two moments."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from rigkit.calibration.result import Calibration
from rigkit.core.errors import InputError
from rigkit.core.findings import Finding
from rigkit.detection.fields import shift_between_fields
from rigkit.io.media.images import read_image, to_grey

MAX_LINES = 1088
"""No interlaced format has more lines: larger images are not checked."""
IMAGES_OF_FIELDS = 4
"""Images checked, spread over the session; the board need not move in all of them."""
MIN_INTERLACED = 2
MIN_FIELD_SHIFT_PX = 0.2
"""Minimum shift between the two fields of an interlaced image. On 239 boards in REAL progressive images, 50 of them
degraded in other ways, the shift is at most 0.06 px (squares of 9 px); in an interlaced REAL one it is 0.37, in 14
whose odd lines were moved by 2.5 px rms 1.4 (median)."""


def interlaced(calibration: Calibration, images: Mapping[str, Path]) -> list[Finding]:
    """Return a finding if `images` (files by name) are interlaced; unreadable ones are skipped."""
    if calibration.camera.size_px[1] > MAX_LINES:
        return []
    there = [view for view in calibration.views if view.image in images]
    chosen = np.unique(np.linspace(0, len(there) - 1, min(IMAGES_OF_FIELDS, len(there))).astype(int)).tolist()
    shifts = dict[str, float]()
    for view in (there[k] for k in chosen):
        try:
            grey = to_grey(read_image(images[view.image])).astype(np.float64)
        except InputError:
            # Corners are kept beside the session: the image itself may have gone bad since.
            continue
        shifts[view.image] = abs(shift_between_fields(grey, view.pixels))
    shifted = {image: shift for image, shift in shifts.items() if shift > MIN_FIELD_SHIFT_PX}
    if len(shifted) < MIN_INTERLACED:
        return []
    image, most = max(shifted.items(), key=lambda one: one[1])
    return [
        Finding.look(
            f"images are interlaced: every second line is of another moment, in '{image}' shifted by {most:.1f} px "
            f"({len(shifted)} of {len(shifts)} images looked at)",
            "set the camera or the grabber to progressive, or hold board and camera still",
            image,
        )
    ]
