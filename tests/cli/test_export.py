from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
from helpers.data import REPOSITORY

from rigkit.cameras.brown import Brown
from rigkit.cameras.kannala_brandt import KannalaBrandt
from rigkit.cli.main import main
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3
from rigkit.interop.kalibr import read_kalibr
from rigkit.io.calibration_file import camera_to_json, load_camera

CALIBRATION = REPOSITORY / "calib" / "cameras" / "mvca020_fe185" / "calibration.json"
LAB = REPOSITORY / "datasets" / "lab-a"

REFIT_PX = 0.05
"""What another model may be off by and still be called the same lens here; the largest measured was 0.015."""


@pytest.mark.parametrize("kind", ["opencv", "kalibr", "ros", "colmap", "ocamcalib", "mrcal"])
def test_a_camera_goes_out_and_comes_back(kind: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    there, back = tmp_path / "there", tmp_path / "back.json"
    assert main(["export", str(CALIBRATION), "--to", kind, "-o", str(there)]) == 0
    assert "px from the camera given" in capsys.readouterr().out
    assert main(["export", str(there), "--from", kind, "-o", str(back)]) == 0
    # A person sees at once whether the file was understood: a fisheye taken for a regular lens sees less.
    assert re.search(r"back.json: \w+, 1624x1240 px, sees 1[56]\d\.\d degrees across", capsys.readouterr().out)
    ours, theirs = load_camera(CALIBRATION), load_camera(back)
    u, v = np.meshgrid(np.linspace(300, 1300, 21), np.linspace(200, 1000, 17))
    pixels = np.stack([u, v], axis=-1)
    rays, valid = ours.unproject(pixels)
    assert valid.all()
    again, seen = theirs.project(rays)
    assert seen.all()
    assert np.abs(again - pixels).max() < REFIT_PX


def test_a_cloud_as_colmap_model_and_npz(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    import pycolmap

    source = [str(LAB), "-p", "regular-general"]
    assert main(["export", *source, "-o", str(tmp_path / "model"), "--to", "colmap"]) == 0
    model = pycolmap.Reconstruction(str(tmp_path / "model"))
    assert model.num_points3D() == 144
    # COLMAP computes the error itself, from its own projection of our points with our poses.
    assert model.compute_mean_reprojection_error() < REFIT_PX
    assert main(["export", *source, "-o", str(tmp_path / "cloud.npz")]) == 0
    data = np.load(tmp_path / "cloud.npz")
    theirs = np.stack([model.points3D[i].xyz for i in sorted(model.points3D)])
    assert np.abs(theirs - data["points_mm"]).max() < 1e-9
    assert main(["export", *source, "-o", str(tmp_path / "cloud.npz")]) == 2


def test_a_rig_goes_out_as_a_camchain(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    left = Brown((640, 480), np.array([534.0, 534.2, 341.7, 238.9, -0.28, 0.1, 0.001, 0.0002, 0.0]))
    right = KannalaBrandt((800, 600), np.array([300.0, 301.0, 398.0, 303.0, -0.02, 0.002, 0.0, 0.0]))
    # The rig's frame is nobody's: what Kalibr keeps is one camera against the other.
    poses = (
        Rigid3(exp_so3(np.array([0.1, 0.0, -0.2])), [5.0, 6.0, 7.0]),
        Rigid3(exp_so3(np.array([0.0, 0.3, 0.1])), [-250.0, 4.0, 9.0]),
    )
    entries = [
        {"name": name, "camera": camera_to_json(camera), "cam_from_rig": pose.matrix()[:3].tolist(), "rms_px": 0.1}
        for name, camera, pose in zip(("left", "right"), (left, right), poses, strict=True)
    ]
    rig, chain = tmp_path / "rig.json", tmp_path / "chain.yaml"
    rig.write_text(json.dumps({"schema": "rigkit.rig/1", "cameras": entries}))
    assert main(["export", str(rig), "--to", "kalibr", "-o", str(chain)]) == 0
    said = capsys.readouterr()
    assert "at most 0 px" in said.out and "cam0 is 'left'" in said.err and "cam1 is 'right'" in said.err
    (one, two), (_, cam1_from_cam0) = read_kalibr(chain.read_text())
    # Kalibr has no k3, which is zero here.
    np.testing.assert_allclose(one.parameters, left.parameters[:8], atol=1e-12)
    assert left.parameters[8] == 0.0
    np.testing.assert_allclose(two.parameters, right.parameters, atol=1e-12)
    np.testing.assert_allclose(cam1_from_cam0.matrix(), (poses[1] @ poses[0].inverse()).matrix(), atol=1e-9)
    assert main(["export", str(rig), "--to", "opencv", "-o", str(tmp_path / "x.yml")]) == 2
    assert "rig-CAMERA.json" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("files", "names"),
    [
        (("left/0001.jpg", "right/0001.jpg"), ("left/0001.jpg", "right/0001.jpg")),
        (("my rig/a 1.jpg", "my rig/a 2.jpg"), ("a_1.jpg", "a_2.jpg")),
        (("my rig/left/ä.jpg", "my rig/right one/ä.jpg"), ("left/ä.jpg", "right_one/ä.jpg")),
    ],
)
def test_a_colmap_model_names_its_two_images_differently(
    files: tuple[str, str], names: tuple[str, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    import pycolmap

    text = (LAB / "dataset.toml").read_text(encoding="utf-8").replace("../../calib", str(REPOSITORY / "calib"))
    for file, old in zip(files, ("view1.jpg", "view2.jpg"), strict=True):
        target = tmp_path / file
        target.parent.mkdir(parents=True, exist_ok=True)
        target.symlink_to(LAB / "images" / "regular-general" / old)
        text = text.replace(f"images/regular-general/{old}", file)
    (tmp_path / "dataset.toml").write_text(text, encoding="utf-8")
    assert main(["export", str(tmp_path), "-p", "regular-general", "-o", str(tmp_path / "m"), "--to", "colmap"]) == 0
    model = pycolmap.Reconstruction(str(tmp_path / "m"))
    assert tuple(model.images[k].name for k in sorted(model.images)) == names
    assert ("rename the file" in capsys.readouterr().err) == (" " in "".join(files).replace("my rig/", ""))


def test_what_is_missing_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["export", str(LAB), "-o", str(tmp_path / "x.ply")]) == 2
    assert "--pair" in capsys.readouterr().err
    assert main(["export", str(tmp_path / "none.yaml"), "--from", "opencv", "-o", str(tmp_path / "x.json")]) == 2
    assert "none.yaml" in capsys.readouterr().err
