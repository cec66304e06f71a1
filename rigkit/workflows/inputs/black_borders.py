"""Detection of images that were undistorted or rectified with black borders left in.

Where a program undistorts images of a lens with barrel distortion and keeps all of their content, the corners stay in
place, and black bulges in from the middle of the sides. The image circle of a fisheye lens is the reverse, and bars
have the same width everywhere.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from rigkit.calibration.result import Calibration
from rigkit.core.arrays import BoolArray, FloatArray
from rigkit.core.errors import InputError
from rigkit.core.findings import Finding
from rigkit.detection.saddles.response import GreyImage, grey_image
from rigkit.io.media.images import read_image

BLACK_LEVEL = 8
"""Largest grey level, of 255, of black: JPEG moves that of a border by a few levels."""
IMAGES_OF_BORDERS = 4
"""Images checked, spread over the session; the border is where all are black."""
LINES_OF_SIDE = 65
"""Rows or columns, spread along each side, whose black ends are measured."""
ALONG_SIDE = (0.08, 0.92)
"""The part of the side along which they are spread: nearer to its ends a line runs in the borders of other sides."""
MIN_BULGE_PX, MAX_PART_OF_SIZE = 4.0, 0.3
"""Limits of the height of the bulge, the second as a part of the image's size."""
MIN_SHARE_OF_PARABOLA = 0.9
"""Part of the variance of the border's width along the side that a parabola explains. Undistorted images (SIMULATED,
Brown, k1 of -0.05 to -0.35, JPEG): 0.93 and more where the bulge is higher than 5 px; a rectangle over half of the
side: 0.77."""


def black_borders(calibration: Calibration, images: Mapping[str, Path]) -> list[Finding]:
    """Return a finding if `images` (files by name) have black borders like those of undistorted ones; unreadable
    ones are skipped."""
    there = list(dict.fromkeys(view.image for view in calibration.views if view.image in images))
    chosen = np.unique(np.linspace(0, len(there) - 1, min(IMAGES_OF_BORDERS, len(there))).astype(int)).tolist()
    found = []
    for name in (there[k] for k in chosen):
        try:
            found.append(_widths(grey_image(read_image(images[name]))))
        except InputError:
            # Corners are kept beside the session: the image itself may have gone bad since.
            continue
    if len(found) < 2:
        return []
    bulges = [_bulge_px(width) for width in np.min(found, axis=0)]
    height = max(min(bulges[0], bulges[1]), min(bulges[2], bulges[3]))
    if not MIN_BULGE_PX <= height <= MAX_PART_OF_SIZE * min(calibration.camera.size_px):
        return []
    return [
        Finding.look(
            f"black bulges into the images from opposite sides, by {height:.0f} px: they seem undistorted or rectified "
            "already, perhaps with the parameters of another camera",
            "calibrate from the camera's own images if there are such; else apply no distortion to these again",
        )
    ]


def _widths(grey: GreyImage) -> FloatArray:
    """Return the widths (4, LINES_OF_SIDE) px of the black border at the left, right, top and bottom."""
    black = grey <= BLACK_LEVEL
    out = []
    for lines in (black, black.T):
        some = lines[(np.linspace(*ALONG_SIDE, LINES_OF_SIDE) * len(lines)).astype(int)]
        out += [_ends(some), _ends(some[:, ::-1])]
    return np.array(out)


def _ends(black: BoolArray) -> FloatArray:
    """Return how many pixels are black from the start of each line; none where all are."""
    return np.asarray(np.argmin(black, axis=1), dtype=np.float64)


def _bulge_px(width: FloatArray) -> float:
    """Return the height of the parabola that the border's width follows along a side, 0 if it follows none."""
    place = np.linspace(-1.0, 1.0, len(width))
    system = np.column_stack([np.ones_like(place), place, 1.0 - place**2])
    step = np.linalg.lstsq(system, width, rcond=None)[0]
    left, whole = float(((width - system @ step) ** 2).sum()), float(((width - width.mean()) ** 2).sum())
    return float(step[2]) if left <= (1.0 - MIN_SHARE_OF_PARABOLA) * whole and whole > 0.0 else 0.0
