"""Properties of the installed OpenCV that tests depend on."""

from __future__ import annotations

import cv2
import pytest

exact_interpolation = pytest.mark.skipif(
    int(cv2.__version__.split(".")[0]) < 5, reason="OpenCV 4 interpolates at 32nds of a pixel: it is no reference"
)
