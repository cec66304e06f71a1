"""Images are equalised with the local means of a wide window, in a time that does not depend on its width."""

from __future__ import annotations

import time

import cv2
import numpy as np
import pytest

from rigkit.detection.saddles.local_contrast import GAIN, MIDDLE, WINDOW_PART, equalised

LIMIT_S = 3.0
"""It takes 0.1 s; 22 s where the window is applied at every pixel."""


@pytest.mark.parametrize("shape", [(16, 16), (17, 900), (500, 400)])
def test_local_mean_and_deviation(shape: tuple[int, int], rng: np.random.Generator) -> None:
    noise = rng.uniform(0.0, 255.0, shape).astype(np.float32)
    grey = np.asarray(cv2.GaussianBlur(noise, (0, 0), 2.0), np.float32)
    window = WINDOW_PART * min(shape)
    off = grey - cv2.GaussianBlur(grey, (0, 0), window)
    expected = MIDDLE + GAIN * off / np.sqrt(cv2.GaussianBlur(off * off, (0, 0), window))
    off = equalised(grey) - np.clip(expected, 0.0, 255.0)
    assert np.sqrt(np.mean(off**2)) < 0.3


def test_large_images_take_no_longer_a_pixel() -> None:
    start = time.process_time()
    equalised(np.zeros((2160, 3840), np.float32))
    assert time.process_time() - start < LIMIT_S
