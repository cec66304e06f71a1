"""A few images of real boards, from the captures outside the repository."""

from __future__ import annotations

import functools

import cv2
import numpy as np

from helpers.data import CAPTURES

CHOSEN = {
    "webcam": "real/bouguet-stereo/left10.jpg",
    "strong fisheye": "real/camodocal-fisheye/img42.png",
    "three boards": "real/multi-board/e2.png",
}


@functools.cache
def real_images() -> dict[str, np.ndarray]:
    """Return those that are present, in grey, by name."""
    found = {name: CAPTURES / path for name, path in CHOSEN.items()}
    read = {name: cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for name, path in found.items() if path.is_file()}
    return {name: image for name, image in read.items() if image is not None}
