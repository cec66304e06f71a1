"""`rigkit export`: cameras, rigs and clouds to the formats of other programs and back, with the stated losses."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from helpers.data import REPOSITORY
from helpers.stereo_pictures import CAMERA as BROWN

from rigkit.calibration.pupil import SolvedPupil
from rigkit.cameras.base import Camera
from rigkit.cameras.brown import Brown
from rigkit.cameras.kannala_brandt import KannalaBrandt
from rigkit.cli.main import main
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3, skew
from rigkit.interop.mrcal import read_cameramodel
from rigkit.io.calibrations.calibration_file import camera_to_json, load_calibration, load_camera, save_camera
from rigkit.io.ply import read_ply
from rigkit.workflows.inputs.camera_files import import_rig
from rigkit.workflows.options.cameras import ExportCameraOptions
from rigkit.workflows.outputs.export_camera import export_camera, foreign_files, foreign_rig_files
from rigkit.workflows.reconstruction.pairs import find_boards

CAMERAS = REPOSITORY / "calib" / "cameras"
CALIBRATION = CAMERAS / "mvca020_fe185" / "calibration.json"
LAB = REPOSITORY / "datasets" / "lab-a"

REFIT_PX = 0.05
"""What another model may be off by and still be called the same lens here; the largest measured was 0.015."""


@pytest.mark.parametrize("kind", ["opencv", "kalibr", "ros", "colmap", "ocamcalib", "mrcal"])
def test_a_camera_goes_out_and_comes_back(kind: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    there, back = tmp_path / "there", tmp_path / "back.json"
    assert main(["export", str(CALIBRATION), "--to", kind, "-o", str(there)]) == 0
    assert "px from the input" in capsys.readouterr().out
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


def test_losses_of_a_format_are_reported(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level("INFO"):
        files = foreign_files(load_calibration(CALIBRATION), tmp_path / "fish.json", ["kalibr"])
    assert [path.name for path in files] == ["fish-kalibr.yaml"]
    assert "fish-kalibr.yaml: " in caplog.text


def test_a_moving_pupil_is_left_out_of_all_files_in_one_message(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    calibration = load_calibration(CALIBRATION)
    rows = len(calibration.frame_covariance)
    pupil = SolvedPupil(terms=np.array([1.0, 0.0]), covariance=np.eye(2), with_frame=np.zeros((rows, 2)))
    foreign_files(replace(calibration, pupil=pupil), tmp_path / "fish.json", ["kalibr", "ros"])
    (words,) = (record.getMessage() for record in caplog.records if "left out here" in record.getMessage())
    assert "fish-kalibr.yaml, " in words and "fish-ros.yaml'" in words


def test_a_lossless_format_reports_no_loss(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    p = BROWN.parameters.size
    calibration = load_calibration(CALIBRATION)
    brown = replace(calibration, camera=BROWN, covariance=np.eye(p), frame_covariance=np.eye(p + 6))
    with caplog.at_level("INFO"):
        files = foreign_files(brown, tmp_path / "brown.json", ["opencv", "ros"])
        save_camera(tmp_path / "camera.json", BROWN)
        options = ExportCameraOptions(output=tmp_path / "camera.yml", kind="opencv")
        done = export_camera(tmp_path / "camera.json", options)
    assert len(files) == 2 and done.max_error_px == 0.0 and not caplog.text


def test_a_cloud_as_colmap_model_and_npz(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    import pycolmap

    source = [str(LAB), "-p", "regular-general"]
    assert main(["export", *source, "-o", str(tmp_path / "model"), "--to", "colmap"]) == 0
    model = pycolmap.Reconstruction(str(tmp_path / "model"))
    assert model.num_points3D() == 144
    # COLMAP computes the errors anew, from its own projection of our points with our poses; those read are ours.
    model.update_point_3d_errors()
    assert model.compute_mean_reprojection_error() < REFIT_PX
    assert main(["export", *source, "-o", str(tmp_path / "cloud.npz")]) == 0
    data = np.load(tmp_path / "cloud.npz")
    theirs = np.stack([model.points3D[i].xyz for i in sorted(model.points3D)])
    assert np.abs(theirs - data["points_mm"]).max() < 1e-9
    assert main(["export", *source, "-o", str(tmp_path / "cloud.npz")]) == 2


@pytest.mark.parametrize("planes", ["free", "lattice"])
def test_a_cloud_is_the_same_by_export_and_reconstruct(
    planes: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Every command looks at the same two images through the same lens.
    found: list[Any] = []

    def find_once(*asked: Any) -> Any:
        if not found:
            found.append(find_boards(*asked))
        return found[0]

    monkeypatch.setattr("rigkit.workflows.reconstruction.pairs.find_boards", find_once)
    shutil.copytree(REPOSITORY / "calib", tmp_path / "calib")
    shutil.copytree(LAB, lab := tmp_path / "datasets" / "lab-a")
    manifest = lab / "dataset.toml"
    pair = 'id = "regular-general"\n'
    manifest.write_text(manifest.read_text().replace(pair, f'{pair}planes = "{planes}"\n'))
    asked = [str(lab), "-p", "regular-general"]
    assert main(["reconstruct", *asked, "--no-pictures", "-o", str(tmp_path / "out")]) == 0
    (theirs,) = (tmp_path / "out" / "regular-general").glob("*.ply")
    assert main(["export", *asked, "-o", str(tmp_path / "cloud.ply")]) == 0
    written = (tmp_path / "cloud.ply").read_bytes()
    assert b"and the covariance of the calibrations" in written.split(b"end_header")[0]
    assert written == theirs.read_bytes()
    manifest.write_text(manifest.read_text().replace(f'planes = "{planes}"\n', ""))
    assert main(["export", *asked, "--planes", planes, "-o", str(tmp_path / "cloud.npz")]) == 0
    cloud, arrays = read_ply(tmp_path / "cloud.ply"), np.load(tmp_path / "cloud.npz")
    np.testing.assert_array_equal(arrays["points_mm"], cloud.points_mm)
    np.testing.assert_array_equal(arrays["sigma_mm"], cloud.sigma_mm)
    assert arrays["calibration_in_sigmas"]


def saved_rig(path: Path, cameras: Sequence[Camera], poses: Sequence[Rigid3]) -> Path:
    """Write a rig's file of cameras called left, right and third."""
    entries = [
        {"name": name, "camera": camera_to_json(camera), "cam_from_rig": pose.matrix()[:3].tolist(), "rms_px": 0.1}
        for name, camera, pose in zip(("left", "right", "third"), cameras, poses, strict=False)
    ]
    path.write_text(json.dumps({"schema": "rigkit.rig/1", "cameras": entries}))
    return path


LEFT = Brown((640, 480), np.array([534.0, 534.2, 341.7, 238.9, -0.28, 0.1, 0.001, 0.0002, 0.0]))
RIGHT = Brown((640, 480), np.array([537.0, 536.8, 326.5, 250.1, -0.29, 0.11, -0.0005, 0.0001, 0.0]))
WIDE = KannalaBrandt((800, 600), np.array([300.0, 301.0, 398.0, 303.0, -0.02, 0.002, 0.0, 0.0]))
POSES = (
    Rigid3(exp_so3(np.array([0.1, 0.0, -0.2])), [5.0, 6.0, 7.0]),
    Rigid3(exp_so3(np.array([0.1, 0.05, -0.18])), [-95.0, 4.0, 9.0]),
    Rigid3(exp_so3(np.array([0.0, 0.3, 0.1])), [-250.0, 4.0, 9.0]),
)
"""The rig's frame is nobody's: what other tools keep is one camera against the other."""


def test_a_rig_goes_out_as_a_camchain_and_comes_back(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rig = saved_rig(tmp_path / "rig.json", (LEFT, WIDE), (POSES[0], POSES[2]))
    chain = tmp_path / "chain.yaml"
    assert main(["export", str(rig), "--to", "kalibr", "-o", str(chain)]) == 0
    printed = capsys.readouterr()
    assert "at most 0 px" in printed.out and "cam0 is 'left'" in printed.err and "cam1 is 'right'" in printed.err
    (one, _), (two, cam1_from_cam0) = import_rig(chain).values()
    # Kalibr has no k3, which is zero here.
    np.testing.assert_allclose(one.parameters, LEFT.parameters[:8], atol=1e-12)
    np.testing.assert_allclose(two.parameters, WIDE.parameters, atol=1e-12)
    np.testing.assert_allclose(cam1_from_cam0.matrix(), (POSES[2] @ POSES[0].inverse()).matrix(), atol=1e-9)
    # One of its cameras is taken out as the message says.
    one_out = str(tmp_path / "one.json")
    assert main(["export", str(chain), "-o", one_out]) == 2 and "--names ONE -o ONE.json" in capsys.readouterr().err
    assert main(["export", str(chain), "--to", "rigkit", "-o", one_out]) == 2
    assert "a rig needs no export to rigkit" in capsys.readouterr().err
    assert main(["export", str(chain), "--names", "cam1", "-o", one_out]) == 0
    np.testing.assert_allclose(load_camera(one_out).parameters, WIDE.parameters, atol=1e-12)
    # Another tool's rig is taken wherever ours is.
    assert main(["diff", str(rig), str(rig)]) == 0
    assert main(["diff", str(chain), str(chain)]) == 0


@pytest.mark.parametrize("wide", [False, True])
def test_a_stereo_pair_goes_out_as_opencv_and_ros(
    wide: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cameras = (WIDE, WIDE.with_parameters(WIDE.parameters + 1.0)) if wide else (LEFT, RIGHT)
    rig = saved_rig(tmp_path / "rig.json", (*cameras, WIDE), POSES)
    assert main(["export", str(rig), "--to", "opencv", "-o", str(tmp_path / "all.yml")]) == 2
    assert "3 cameras" in capsys.readouterr().err
    names = ["--names", "left", "right"]
    stereo = tmp_path / "stereo.yml"
    assert main(["export", str(rig), "--to", "opencv", "-o", str(stereo), *names]) == 0
    assert "at most 0 px" in capsys.readouterr().out
    storage = cv2.FileStorage(str(stereo), cv2.FILE_STORAGE_READ)
    K1, D1, K2, D2, R, T, R1, R2, P1, P2, Q, E, F = (
        storage.getNode(key).mat() for key in ["M1", "D1", "M2", "D2", "R", "T", "R1", "R2", "P1", "P2", "Q", "E", "F"]
    )
    # A point that both cameras see, through OpenCV's own functions: the same row after its own rectification, its
    # depth from the disparity through Q, and the epipolar line of F.
    in_left = np.random.default_rng(3).uniform([-200, -150, 900], [250, 150, 1500], (40, 3))
    project = cv2.fisheye.projectPoints if wide else cv2.projectPoints
    undistort = cv2.fisheye.undistortPoints if wide else cv2.undistortPoints
    rotation_vector = cv2.Rodrigues(R)[0]
    one = project(in_left[:, None], np.zeros(3), np.zeros(3), K1, D1)[0]
    two = project(in_left[:, None], rotation_vector, T, K2, D2)[0]
    np.testing.assert_allclose(one.reshape(-1, 2), cameras[0].project(in_left)[0], atol=1e-8)
    in_right = (POSES[1] @ POSES[0].inverse()).apply(in_left)
    np.testing.assert_allclose(two.reshape(-1, 2), cameras[1].project(in_right)[0], atol=1e-8)
    a, b = (
        undistort(p, K, D, R=R_, P=P).reshape(-1, 2)
        for p, K, D, R_, P in ((one, K1, D1, R1, P1), (two, K2, D2, R2, P2))
    )
    np.testing.assert_allclose(a[:, 1], b[:, 1], atol=1e-4)
    there = cv2.perspectiveTransform(np.column_stack([a, a[:, 0] - b[:, 0]])[:, None], Q)[:, 0]
    np.testing.assert_allclose(there, in_left @ R1.T, rtol=1e-4)
    flat = [cv2.convertPointsToHomogeneous(undistort(p, K, D, P=K))[:, 0] for p, K, D in ((one, K1, D1), (two, K2, D2))]
    lines = flat[0] @ F.T
    assert (np.abs(np.sum(flat[1] * lines, axis=1)) / np.linalg.norm(lines[:, :2], axis=1)).max() < 1e-4
    np.testing.assert_allclose(E, np.linalg.norm(T) * skew(T.ravel() / np.linalg.norm(T)) @ R, atol=1e-9)
    back = import_rig(stereo)
    np.testing.assert_allclose(back["right"][1].matrix(), (POSES[1] @ POSES[0].inverse()).matrix(), atol=1e-9)
    assert main(["export", str(rig), "--to", "ros", "-o", str(tmp_path / "info.yaml"), *names]) == 0
    right = yaml.safe_load((tmp_path / "info-right.yaml").read_text())
    np.testing.assert_allclose(right["rectification_matrix"]["data"], R2.ravel())
    np.testing.assert_allclose(np.reshape(right["projection_matrix"]["data"], (3, 4))[:, 3], P2[:, 3] / 1000.0)


def test_a_rig_goes_out_to_colmap_and_mrcal(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    import pycolmap

    rig = saved_rig(tmp_path / "rig.json", (LEFT, RIGHT, WIDE), POSES)
    assert main(["export", str(rig), "--to", "colmap", "-o", str(tmp_path / "rig_config.json")]) == 0
    (config,) = pycolmap.read_rig_config(tmp_path / "rig_config.json")
    back = import_rig(tmp_path / "rig_config.json")
    for name, (camera, pose) in import_rig(rig).items():
        np.testing.assert_allclose(back[name][0].parameters, camera.parameters, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(back[name][1].matrix(), (pose @ POSES[0].inverse()).matrix(), atol=1e-9)
        assert back[name][0].size_px == camera.size_px
    assert [c.ref_sensor for c in config.cameras] == [True, False, False]
    assert [c.image_prefix for c in config.cameras] == ["left/", "right/", "third/"]
    third = config.cameras[2]
    assert third.cam_from_rig is not None and third.camera is not None
    np.testing.assert_allclose(third.cam_from_rig.matrix(), (POSES[2] @ POSES[0].inverse()).matrix()[:3], atol=1e-9)
    point = np.array([[0.3, -0.2, 1.0]])
    pixel = np.asarray(third.camera.img_from_cam(point), dtype=np.float64)
    np.testing.assert_allclose(pixel - 0.5, WIDE.project(point)[0], atol=1e-9)
    assert (
        main(["export", str(rig), "--to", "mrcal", "-o", str(tmp_path / "x.cameramodel"), "--names", "left", "right"])
        == 0
    )
    _, pose, _ = read_cameramodel((tmp_path / "x-right.cameramodel").read_text(), "x")
    np.testing.assert_allclose(pose.matrix(), POSES[1].matrix(), atol=1e-9)
    capsys.readouterr()
    assert main(["export", str(rig), "--to", "ocamcalib", "-o", str(tmp_path / "x.txt")]) == 2
    assert "has no rigs" in capsys.readouterr().err
    assert main(["export", str(rig), "--to", "kalibr", "-o", str(tmp_path / "x.txt"), "--names", "middle"]) == 2
    assert "no camera 'middle'" in capsys.readouterr().err


@pytest.mark.parametrize("kind", ["opencv", "ros", "ocamcalib"])
def test_one_camera_of_a_rig_goes_out_to_formats_of_single_cameras(kind: str, tmp_path: Path) -> None:
    rig, file = saved_rig(tmp_path / "rig.json", (LEFT, RIGHT, WIDE), POSES), tmp_path / "third"
    assert main(["export", str(rig), "--to", kind, "-o", str(file), "--names", "third"]) == 0
    assert main(["export", str(file), "--from", kind, "-o", str(tmp_path / "third.json")]) == 0
    rays, _ = WIDE.unproject(np.array([[320.0, 240.0], [400.0, 300.0]]))
    expected, got = WIDE.project(rays)[0], load_camera(tmp_path / "third.json").project(rays)[0]
    assert np.abs(got - expected).max() < REFIT_PX


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


def test_missing_inputs_are_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["export", str(LAB), "-o", str(tmp_path / "x.ply")]) == 2
    assert "--pair" in capsys.readouterr().err
    assert main(["export", str(tmp_path / "none.yaml"), "--from", "opencv", "-o", str(tmp_path / "x.json")]) == 2
    assert "none.yaml" in capsys.readouterr().err


def test_a_camera_of_py_ocamcalib_needs_the_size_of_its_images(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    theirs, ours = tmp_path / "fisheye.json", tmp_path / "ours.json"
    printed = {
        "date": "today",
        "taylor_coefficient": [300.0, 0.0, -1.1e-3, 1.2e-6, -2.5e-9],
        "distortion_center": [640.5, 480.25],
        "stretch_matrix": [[1.001, 0.002], [-0.001, 1.0]],
        "extrinsics_t": [],
    }
    theirs.write_text(json.dumps(printed))
    assert main(["export", str(theirs), "-o", str(ours)]) == 2
    assert "--size" in capsys.readouterr().err
    assert main(["export", str(theirs), "--size", "1280x", "-o", str(ours)]) == 2
    assert "1280x960" in capsys.readouterr().err
    assert main(["export", str(theirs), "--size", "1280x960", "-o", str(ours)]) == 0
    camera = load_camera(ours)
    assert camera.size_px == (1280, 960)
    np.testing.assert_allclose(camera.project(np.array([0.0, 0.0, 1.0]))[0], [640.5, 480.25], atol=1e-9)


def test_a_refit_is_stated_once_for_opencv_and_ros(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO")
    known = load_calibration(CALIBRATION)
    foreign_files(known, Path("x.json"), ["opencv", "ros"])
    rig = {name: (known.camera, Rigid3(np.eye(3), [x, 0.0, 0.0])) for name, x in (("left", 0.0), ("right", -90.0))}
    foreign_rig_files(rig, Path("rig.json"), ["opencv", "ros"], {})
    assert ["refitted" in line for line in caplog.messages] == [True, False, True, False]
