"""OpenCV's files: terms that they have alone, and those that they leave out."""

from __future__ import annotations

import re

import numpy as np
import pytest
from helpers.cameras import sample_cameras

from rigkit.core.errors import InputError
from rigkit.interop.opencv import camera_from_arrays, read_opencv, write_opencv

CAMERAS = sample_cameras()


@pytest.mark.parametrize("term", [8, 12])
def test_one_term_of_opencv_beyond_eight_is_not_lost(term: int) -> None:
    d = np.zeros(14)
    d[[0, term]] = -0.1, 1e-3
    with pytest.raises(InputError, match="more than 8"):
        camera_from_arrays((640, 480), np.diag([500.0, 500.0, 1.0]).ravel(), d, fisheye=False, name="a.yml")


def test_what_a_file_of_opencv_leaves_out_is_zero_and_what_it_has_is_not_lost() -> None:
    text = write_opencv(CAMERAS["pinhole"]).text
    without = re.sub(r"distortion_coefficients:.*?\]\n", "", text, flags=re.DOTALL)
    assert without != text
    camera = read_opencv(without)
    assert camera.model == "pinhole"
    np.testing.assert_array_equal(camera.parameters, CAMERAS["pinhole"].parameters)
    one_term = write_opencv(CAMERAS["brown"].with_parameters([*CAMERAS["brown"].parameters[:4], *np.eye(5)[2] * 1e-3]))
    with pytest.raises(InputError, match="on top of the unified model"):
        read_opencv(one_term.text + "xi: 0.9\n")
