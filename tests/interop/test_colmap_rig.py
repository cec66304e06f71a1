"""COLMAP's rig_config.json: what is missing or damaged is named."""

from __future__ import annotations

import copy
import json
from typing import Any

import numpy as np
import pytest

from rigkit.core.errors import InputError
from rigkit.interop.colmap_rig import read_colmap_rig

LENS = {"camera_model_name": "PINHOLE", "camera_params": [500.0, 501.0, 320.5, 240.5]}
POSE = {"cam_from_rig_rotation": [0.0, 0.0, 0.0, 1.0], "cam_from_rig_translation": [-100.0, 1.0, 2.0]}
CAMERAS: list[dict[str, Any]] = [
    {"image_prefix": "rig1/left/", "ref_sensor": True, **LENS},
    {"image_prefix": "rig1/right/", **LENS, **POSE},
]


def text_of(cameras: object) -> str:
    return json.dumps([{"cameras": cameras}])


def test_a_file_of_colmap_is_read_with_the_size_of_its_images() -> None:
    rig = read_colmap_rig(text_of(CAMERAS), size_px=(640, 480))
    assert list(rig) == ["left", "right"]
    camera, pose = rig["right"]
    np.testing.assert_array_equal(camera.parameters, [500.0, 501.0, 320.0, 240.0])
    assert camera.size_px == (640, 480)
    # The quaternion begins with w: half a turn about z.
    np.testing.assert_allclose(pose.rotation, np.diag([-1.0, -1.0, 1.0]), atol=1e-15)
    assert pose.translation_mm.tolist() == [-100.0, 1.0, 2.0]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"camera_params": None}, "camera_params"),
        ({"camera_params": [1.0]}, "PINHOLE has 4 parameters, found 1"),
        ({"camera_model_name": "FISH"}, "camera model 'FISH' is unknown"),
        ({"cam_from_rig_translation": [1.0]}, "should have 3 finite numbers"),
        ({"cam_from_rig_rotation": [0.0, 0.0, 0.0, 2.0]}, "no rotation: its length is 2, not 1"),
        ({"cam_from_rig_rotation": ...}, "no cam_from_rig_rotation; calibrate the rig"),
        ({"camera_model_name": ...}, "give cameras.txt"),
        ({"width": 640.5, "height": 480}, "no number of pixels"),
        ({"image_prefix": "other/left/"}, "names no camera of its own"),
        ({"image_prefix": "other/.."}, "names no camera of its own"),
        ({"image_prefix": None}, "names no camera of its own"),
        ({"ref_sensor": True}, "2 cameras are ref_sensor"),
        ({"image_prefix": ...}, "not a rig_config.json with one rig"),
    ],
)
def test_what_is_wrong_is_named(change: dict[str, Any], words: str) -> None:
    cameras = copy.deepcopy(CAMERAS)
    cameras[1] = {key: value for key, value in (cameras[1] | change).items() if value is not ...}
    with pytest.raises(InputError, match=words) as error:
        read_colmap_rig(text_of(cameras), size_px=(640, 480))
    assert "rig_config.json" in str(error.value)


@pytest.mark.parametrize("text", ["", "[]", "[1]", "[{}]", '{"image_prefix": 1}', text_of([]), text_of({}), text_of(3)])
def test_what_is_no_rig_is_refused(text: str) -> None:
    with pytest.raises(InputError, match=r"rig_config\.json"):
        read_colmap_rig(text)


def test_without_a_size_it_is_asked_for() -> None:
    with pytest.raises(InputError, match="--size WxH"):
        read_colmap_rig(text_of(CAMERAS))
