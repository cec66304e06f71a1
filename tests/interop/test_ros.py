"""The ost.txt of ROS's camera_calibration, and terms that files leave out."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from rigkit.cameras.brown import Brown
from rigkit.cameras.pinhole import Pinhole
from rigkit.core.errors import InputError
from rigkit.interop.ros import read_camera_info, write_camera_info
from rigkit.workflows.inputs.camera_files import import_camera, import_rig

OST = """# oST version 5.0 parameters


[image]

width
640

height
480

[narrow_stereo/left]

camera matrix
500.5 0.000000 320.25
0.000000 501.5 240.75
0.000000 0.000000 1.000000

distortion
{distortion}

rectification
1.000000 0.000000 0.000000
0.000000 1.000000 0.000000
0.000000 0.000000 1.000000

projection
500.5 0.000000 320.25 0.000000
0.000000 501.5 240.75 0.000000
0.000000 0.000000 1.000000 0.000000
"""


@pytest.mark.parametrize(
    ("model", "distortion"),
    [
        ("brown", "-0.2 0.05 0.001 -0.002 0.000000"),
        ("kannala_brandt", "-0.02 0.005 0.001 -0.002"),
        ("brown", "-0.2 0.05 0.001 -0.002 0.01 0.1 0.02 0.003"),
    ],
)
def test_ost_txt_of_ros(model: str, distortion: str, tmp_path: Path) -> None:
    (tmp_path / "ost.txt").write_text(OST.format(distortion=distortion))
    camera = import_camera(tmp_path / "ost.txt")
    assert (camera.model, camera.size_px) == (model, (640, 480))
    assert camera.parameters.tolist() == [500.5, 501.5, 320.25, 240.75, *(float(d) for d in distortion.split())]
    with pytest.raises(InputError, match=r"ost.txt': one camera of ROS, no rig"):
        import_rig(tmp_path / "ost.txt")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (OST.format(distortion="-0.2 0.05 0.001"), "3 terms of distortion"),
        (OST.format(distortion="-0.2 0.05 x 0.001 0"), "'distortion' is not a list of numbers"),
        (OST.format(distortion="0 0 0 0 0") + "\n[narrow_stereo/right]\ncamera matrix\n1 0 0\n", "holds 2 cameras"),
        (OST.split("distortion")[0], "'distortion' is missing"),
        (OST.replace("640", "0").format(distortion="0 0 0 0 0"), "no number of pixels"),
        ("[image]\n", "holds 0 cameras"),
    ],
)
def test_damaged_ost_txt_is_refused(text: str, words: str) -> None:
    with pytest.raises(InputError, match=words) as caught:
        read_camera_info(text)
    assert len(str(caught.value).splitlines()) == 1


def test_terms_that_a_message_leaves_out_are_zero_and_one_too_many_is_not_lost() -> None:
    camera = Brown((640, 480), np.array([500.0, 501.0, 320.0, 240.0, -0.2, 0.1, 1e-3, -2e-3]))
    text = write_camera_info(camera).text
    five = re.search(r"distortion_coefficients:\n.*?data: \[([^]]*)\]", text, re.DOTALL)
    assert five is not None and len(five[1].split(",")) == 5
    four = ", ".join(five[1].split(",")[:4])
    again = read_camera_info(text.replace(five[1], four).replace("cols: 5", "cols: 4"))
    np.testing.assert_array_equal(again.parameters[:8], camera.parameters)
    assert not again.parameters[8:].any()
    for more in ("0.0, 0.01", "0.01, 0.0"):
        with pytest.raises(InputError, match="plumb_bob has 5 coefficients, found 7"):
            read_camera_info(text.replace(five[1], f"{five[1]}, {more}"))
    pinhole = Pinhole((640, 480), np.array([500.0, 501.0, 320.0, 240.0]))
    plain = read_camera_info(write_camera_info(pinhole).text)
    assert plain.model == "pinhole"
    # Its projection is that of the lens without distortion, in the middle of the image.
    P = re.search(r"projection_matrix:\n.*?data: \[([^]]*)\]", write_camera_info(pinhole).text, re.DOTALL)
    assert P is not None
    wanted = [500.0, 0.0, 320.0, 0.0, 0.0, 501.0, 240.0, 0.0, 0.0, 0.0, 1.0, 0.0]
    assert [float(v) for v in P[1].split(",")] == wanted
