"""The ost.txt of ROS's camera_calibration."""

from __future__ import annotations

from pathlib import Path

import pytest

from rigkit.core.errors import InputError
from rigkit.interop.ros import read_camera_info
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
