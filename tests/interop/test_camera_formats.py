"""Camera files of other programs: written, read back, and read by those programs where they are installed."""

from __future__ import annotations

import re
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from helpers.cameras import image_pixels, rays_within, sample_cameras

from rigkit.cameras.compare import compare_cameras
from rigkit.cameras.pinhole import Pinhole
from rigkit.core.errors import InputError
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3
from rigkit.interop.camera_formats import FOREIGN_FORMATS
from rigkit.interop.colmap_cameras import (
    MODELS_BY_ID,
    parameters_of,
    read_colmap_cameras,
    write_colmap_cameras,
)
from rigkit.interop.kalibr import read_kalibr, write_kalibr
from rigkit.interop.opencv import read_opencv, write_opencv
from rigkit.interop.ros import read_camera_info
from rigkit.workflows.inputs.camera_files import camera_format, import_camera, import_rig, is_rig
from rigkit.workflows.inputs.formats import FOREIGN_ENDINGS, READ_FORMATS

CAMERAS = sample_cameras()
SAME_PX = 1e-9
"""Text holds every digit of a double: reading back loses nothing but the rounding of a change of parameters."""
STATED_REL = 1e-3
"""The error that the writer states is the one found on reading the file back, on nearly the same pixels."""


FORMATS = {
    name: (lambda c, known=known: known.write(c, None), lambda t, known=known: known.read(t, "file", None))
    for name, known in FOREIGN_FORMATS.items()
    if known.write is not None
}
NATIVE = {
    "opencv": {"pinhole", "brown", "brown_rational", "kannala_brandt", "kannala_brandt_folding", "ucm", "ucm_narrow"},
    "kalibr": {
        "pinhole", "kannala_brandt", "kannala_brandt_folding", "ucm", "ucm_narrow", "eucm", "double_sphere",
        "double_sphere_positive",
    },
    "ros": {"pinhole", "brown", "brown_rational", "kannala_brandt", "kannala_brandt_folding"},
    "colmap": {"pinhole", "brown", "brown_rational", "kannala_brandt", "kannala_brandt_folding", "eucm"},
    "ocamcalib": {"scaramuzza", "scaramuzza_3"},
    "mrcal": {"pinhole", "brown", "brown_rational"},
}  # fmt: skip


def test_the_command_line_knows_every_format() -> None:
    assert set(READ_FORMATS) == {"rigkit", *FOREIGN_FORMATS}
    assert set(FOREIGN_ENDINGS) == set(FORMATS)


@pytest.mark.parametrize(("name", "label"), [(f, label) for f in sorted(NATIVE) for label in sorted(NATIVE[f])])
def test_native_models_come_back_unchanged(name: str, label: str) -> None:
    write, read = FORMATS[name]
    camera = CAMERAS[label]
    written = write(camera)
    assert written.max_error_px == 0.0
    assert written.covered == 1.0
    again = read(written.text)
    assert again.size_px == camera.size_px
    assert compare_cameras(camera, again, fit_rotation=name == "ocamcalib").max_px < SAME_PX


@pytest.mark.parametrize("name", sorted(set(FORMATS) - {"mrcal"}))
@pytest.mark.parametrize("label", sorted(CAMERAS))
def test_losses_of_a_format_are_stated(name: str, label: str) -> None:
    """Other models are refitted; the largest error stated is what a user of the file gets."""
    write, read = FORMATS[name]
    camera = CAMERAS[label]
    written = write(camera)
    again = read(written.text)
    pixels = image_pixels(camera, 64, 48)
    rays, valid = camera.unproject(pixels)
    if label not in NATIVE[name]:
        assert "refitted" in written.note
        match = re.search(r"within (\d+) degrees", written.note)
        if match is not None:
            theta = np.degrees(np.arctan2(np.hypot(rays[:, 0], rays[:, 1]), rays[:, 2]))
            valid &= theta < float(match[1]) - 0.5
    projected, seen = again.project(rays[valid])
    assert seen.mean() > 0.9
    found = np.linalg.norm((projected - pixels[valid])[seen], axis=-1)
    assert found.max() <= written.max_error_px * (1.0 + STATED_REL) + SAME_PX
    assert found.max() >= 0.3 * written.max_error_px - 1e-6


@pytest.mark.parametrize("label", ["pinhole", "brown", "brown_rational", "kannala_brandt", "ucm"])
def test_opencv_reads_what_we_write(label: str, tmp_path: Path, rng: np.random.Generator) -> None:
    camera = CAMERAS[label]
    path = tmp_path / "camera.yml"
    path.write_text(write_opencv(camera).text)
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    K, d = (storage.getNode(key).mat() for key in ("camera_matrix", "distortion_coefficients"))
    assert int(storage.getNode("image_width").real()) == camera.size_px[0]
    points = rays_within(min(0.95 * camera.max_angle_rad, np.radians(75.0)), 300, rng)
    still = (np.zeros(3), np.zeros(3))
    if label == "kannala_brandt":
        theirs = cv2.fisheye.projectPoints(points[:, None], *still, K, d)[0][:, 0]
    elif label == "ucm":
        theirs = cv2.omnidir.projectPoints(points[None], *still, K, storage.getNode("xi").real(), d)[0][0]
    else:
        theirs = cv2.projectPoints(points, *still, K, d)[0][:, 0]
    assert np.abs(theirs - camera.project(points)[0]).max() < SAME_PX


@pytest.mark.parametrize("ending", ["yml", "xml", "json"])
@pytest.mark.parametrize("keys", [("image_width", "camera_matrix"), ("image_Width", "Camera_Matrix")])
def test_we_read_what_opencv_writes(ending: str, keys: tuple[str, str], tmp_path: Path) -> None:
    """Every form that cv2.FileStorage has, and the names that OpenCV's sample wrote until version 4."""
    camera = CAMERAS["brown"]
    p = camera.parameters
    path = tmp_path / f"camera.{ending}"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("calibration_time", "Sat Nov 21 2026")
    storage.write(keys[0], 1280)
    storage.write(keys[0].replace("Width", "Height").replace("width", "height"), 960)
    storage.write("flags", 0)
    storage.write("fisheye_model", 0)
    storage.write(keys[1], np.array([[p[0], 0.0, p[2]], [0.0, p[1], p[3]], [0.0, 0.0, 1.0]]))
    old = keys[1][0] == "C"
    storage.write("Distortion_Coefficients" if old else "distortion_coefficients", p[4:].reshape(5, 1))
    storage.write("avg_reprojection_error", 0.2)
    storage.startWriteStruct("images", cv2.FileNode_SEQ)
    storage.write("", "left 1.jpg")
    storage.write("", "left 2.jpg")
    storage.endWriteStruct()
    storage.write("image_points", np.zeros((2, 54, 2), np.float32))
    storage.release()
    assert camera_format(path.read_text()) == "opencv"
    again = import_camera(path)
    assert again.model == "brown"
    assert np.allclose(again.parameters, p, rtol=1e-14)


@pytest.mark.parametrize("keys", [("cameraMatrix", "distCoeffs"), ("mtx", "dist")])
def test_what_scripts_write_with_opencv_is_read(keys: tuple[str, str], tmp_path: Path) -> None:
    """Under the names of its parameters and its tutorials, and without the images' size, which is then told."""
    camera = CAMERAS["brown"]
    p = camera.parameters
    path = tmp_path / "camera.yml"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write(keys[0], np.array([[p[0], 0.0, p[2]], [0.0, p[1], p[3]], [0.0, 0.0, 1.0]]))
    storage.write(keys[1], p[4:].reshape(1, 5))
    storage.release()
    again = import_camera(path, size_px=camera.size_px)
    assert again.model == "brown" and again.size_px == camera.size_px and np.allclose(again.parameters, p, rtol=1e-14)
    with pytest.raises(InputError, match=r"image_width.*--size"):
        import_camera(path)


@pytest.mark.parametrize("ending", ["yml", "xml", "json"])
def test_a_pair_in_every_form_of_opencv_is_a_rig(ending: str, tmp_path: Path) -> None:
    path = tmp_path / f"stereo.{ending}"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    K = np.array([[500.0, 0.0, 320.0], [0.0, 501.0, 240.0], [0.0, 0.0, 1.0]])
    storage.write("image_width", 640)
    storage.write("image_height", 480)
    for key, value in {"M1": K, "D1": np.zeros((1, 5)), "M2": K, "D2": np.zeros((1, 5)), "R": np.eye(3)}.items():
        storage.write(key, value)
    storage.write("T", np.array([[-120.0], [0.0], [0.0]]))
    storage.release()
    assert is_rig(path)
    assert import_rig(path)["right"][1].translation_mm.tolist() == [-120.0, 0.0, 0.0]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("<?xml version='1.0'?>\n<opencv_storage><camera_matrix>", "not readable as XML"),
        ("<!DOCTYPE x [<!ENTITY a 'b'>]><opencv_storage><a>&a;</a></opencv_storage>", "entities"),
        ("<other><opencv_storage/></other>", "none of OpenCV's"),
        ("<opencv_storage><a>1</a><a>2</a></opencv_storage>", "'a' is given twice"),
        (f"<opencv_storage>{'<a>' * 30}{'</a>' * 30}</opencv_storage>", "nested more"),
        ("<opencv_storage><image_width>640</image_width></opencv_storage>", "'image_height' is missing"),
    ],
)
def test_damaged_xml_is_refused_with_a_reason(text: str, words: str) -> None:
    with pytest.raises(InputError, match=words) as caught:
        read_opencv(text)
    assert len(str(caught.value).splitlines()) == 1


def test_a_transposed_matrix_is_not_a_camera_with_its_centre_at_the_first_pixel() -> None:
    text = write_opencv(CAMERAS["pinhole"]).text
    fx, fy, cx, cy = (repr(v) for v in CAMERAS["pinhole"].parameters.tolist())
    turned = text.replace(f"{fx}, 0.0, {cx}, 0.0, {fy}, {cy}, 0.0", f"{fx}, 0.0, 0.0, 0.0, {fy}, 0.0, {cx}, {cy}")
    turned = turned.replace(f"{cx}, {cy}, 0.0, 1.0", f"{cx}, {cy}, 1.0")
    assert turned != text
    with pytest.raises(InputError, match="transpose it"):
        read_opencv(turned)


@pytest.mark.parametrize("label", ["pinhole", "brown", "brown_rational", "kannala_brandt", "eucm", "ucm"])
def test_colmap_reads_what_we_write(label: str, tmp_path: Path, rng: np.random.Generator) -> None:
    """Through COLMAP's own reader: its pixels are ours plus one half."""
    camera = CAMERAS[label]
    text, written = write_colmap_cameras({3: camera})
    for name in ("images.txt", "points3D.txt", "rigs.txt", "frames.txt"):
        (tmp_path / name).write_text("")
    (tmp_path / "cameras.txt").write_text(text)
    model = pycolmap.Reconstruction()
    model.read_text(tmp_path)
    theirs = model.cameras[3]
    points = rays_within(min(0.95 * camera.max_angle_rad, np.radians(75.0)), 300, rng)
    assert np.abs(theirs.img_from_cam(points) - 0.5 - camera.project(points)[0]).max() < 1e-6
    assert (written[3].note != "") == (label in ("kannala_brandt", "eucm", "ucm"))


@pytest.mark.parametrize(
    "line",
    [
        "SIMPLE_PINHOLE 640 480 500 320.5 240.5",
        "PINHOLE 640 480 500 501 320.5 240.5",
        "SIMPLE_RADIAL 640 480 500 320.5 240.5 -0.1",
        "RADIAL 640 480 500 320.5 240.5 -0.1 0.02",
        "SIMPLE_FISHEYE 640 480 300 320.5 240.5",
        "FISHEYE 640 480 300 301 320.5 240.5",
        "SIMPLE_RADIAL_FISHEYE 640 480 300 320.5 240.5 -0.02",
        "RADIAL_FISHEYE 640 480 300 320.5 240.5 -0.02 0.003",
        "OPENCV 640 480 500 501 320.5 240.5 -0.1 0.02 1e-3 -2e-3",
        "OPENCV_FISHEYE 640 480 300 301 320.5 240.5 -0.02 0.003 1e-3 -2e-4",
        "FULL_OPENCV 640 480 500 501 320.5 240.5 -0.1 0.02 1e-3 -2e-3 0.03 0 0 0",
        "FULL_OPENCV 640 480 500 501 320.5 240.5 -0.1 0.02 1e-3 -2e-3 0 0.05 0 0",
        "FULL_OPENCV 640 480 500 501 320.5 240.5 -0.1 0.02 1e-3 -2e-3 0 0 0 0.05",
        "FULL_OPENCV 640 480 500 501 320.5 240.5 -0.1 0.02 1e-3 -2e-3 0.03 0.05 0.02 0.01",
        "EUCM 640 480 300 301 320.5 240.5 0.6 1.1",
    ],
)
def test_we_read_colmap_models(line: str, rng: np.random.Generator) -> None:
    camera = read_colmap_cameras(f"# comment\n7 {line}\n")[7]
    kind, _, _, *parameters = line.split()
    theirs = pycolmap.Camera(model=kind, width=640, height=480, params=np.array(parameters, dtype=np.float64))
    points = rays_within(np.radians(40.0), 200, rng)
    ours, valid = camera.project(points)
    assert valid.all()
    assert np.abs(theirs.img_from_cam(points) - 0.5 - ours).max() < SAME_PX


def test_kalibr_rig_poses_in_metres() -> None:
    poses = [
        Rigid3.identity(),
        Rigid3(exp_so3(np.array([0.1, -0.2, 0.05])), [-300.0, 10.0, 5.0]),
        Rigid3(exp_so3(np.array([0.3, 0.1, 0.0])), [-600.0, 0.0, 50.0]),
    ]
    cameras = [CAMERAS[k] for k in ("pinhole", "double_sphere", "eucm")]
    text = write_kalibr(cameras, poses).text
    assert re.search(r"cam1:\n  T_cn_cnm1:", text)
    assert re.search(r"distortion_coeffs: \[(0\.0, ){3}0\.0\]\n  distortion_model: radtan", text)
    again, cam_from_rig = read_kalibr(text)
    assert [c.model for c in again] == ["pinhole", "double_sphere", "eucm"]
    for a, b in zip(poses, cam_from_rig, strict=True):
        assert a.allclose(b, translation_tol_mm=1e-9)
    row = next(line for line in text.splitlines() if line.startswith("  - ["))
    assert abs(float(row.rstrip("]").split(",")[-1]) + 0.3) < 1e-12
    with pytest.raises(InputError, match="pose"):
        write_kalibr(cameras)


def test_kalibr_file_as_kalibr_writes_it() -> None:
    """Block and flow lists mixed, as in camchain files; radtan has four terms."""
    text = """cam0:
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [-0.28, 0.07, 0.0002,
    1.7e-05]
  distortion_model: radtan
  intrinsics: [458.6, 457.2, 367.2, 248.3]
  resolution: [752, 480]
  rostopic: /cam0/image_raw
cam1:
  T_cn_cnm1:
  - [1.0, 0.0, 0.0, -0.11]
  - [0.0, 1.0, 0.0, 0.0]
  - [0.0, 0.0, 1.0, 0.0]
  - [0.0, 0.0, 0.0, 1.0]
  cam_overlaps: [0]
  camera_model: omni
  distortion_coeffs: []
  distortion_model: none
  intrinsics: [0.9, 700.0, 701.0, 370.0, 240.0]
  resolution: [752, 480]
  rostopic: /cam1/image_raw
"""
    cameras, poses = read_kalibr(text)
    assert cameras[0].parameters.tolist() == [458.6, 457.2, 367.2, 248.3, -0.28, 0.07, 0.0002, 1.7e-05]
    (fewer,), _ = read_kalibr(text.split("cam1:")[0].replace("-0.28, 0.07", "-0.28, 0.0"))
    assert fewer.parameters.tolist() == [458.6, 457.2, 367.2, 248.3, -0.28, 0.0, 0.0002, 1.7e-05]
    assert cameras[1].model == "ucm"
    assert cameras[1].focal_px == pytest.approx(np.sqrt(700.0 * 701.0) / 1.9)
    assert poses[1].translation_mm.tolist() == pytest.approx([-110.0, 0.0, 0.0])


def test_ros_file_as_ros_writes_it() -> None:
    text = """image_width: 640
image_height: 480
camera_name: narrow
camera_matrix:
  rows: 3
  cols: 3
  data: [500.5, 0, 320.25, 0, 501.5, 240.75, 0, 0, 1]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.2, 0.05, 0.001, -0.002, 0]
rectification_matrix:
  rows: 3
  cols: 3
  data: [1, 0, 0, 0, 1, 0, 0, 0, 1]
projection_matrix:
  rows: 3
  cols: 4
  data: [500.5, 0, 320.25, 0, 0, 501.5, 240.75, 0, 0, 0, 1, 0]
"""
    camera = read_camera_info(text)
    assert camera.parameters.tolist() == [500.5, 501.5, 320.25, 240.75, -0.2, 0.05, 0.001, -0.002, 0.0]


@pytest.mark.parametrize("keys", [tuple("DKRP"), tuple("dkrp")])
def test_a_message_of_ros_as_echo_prints_it(keys: tuple[str, ...], tmp_path: Path) -> None:
    D, K, R, P = keys
    message = f"""header:
  frame_id: camera
height: 480
width: 640
distortion_model: plumb_bob
{D}: [-0.2, 0.05, 0.001, -0.002, 0.0]
{K}: [500.5, 0.0, 320.25, 0.0, 501.5, 240.75, 0.0, 0.0, 1.0]
{R}: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
{P}: [500.5, 0.0, 320.25, 0.0, 0.0, 501.5, 240.75, 0.0, 0.0, 0.0, 1.0, 0.0]
binning_x: 0
roi:
  x_offset: 0
---
"""
    (tmp_path / "topic.yaml").write_text(message * 2)
    camera = import_camera(tmp_path / "topic.yaml")
    assert camera.size_px == (640, 480)
    assert camera.parameters.tolist() == [500.5, 501.5, 320.25, 240.75, -0.2, 0.05, 0.001, -0.002, 0.0]


@pytest.mark.parametrize("name", sorted(FORMATS))
@pytest.mark.parametrize(
    "text", ["", "nonsense", "a: [1, 2", "cam0:\n  x: 1\n", "1 PINHOLE 640\n", "{'lensmodel': 'X'}"]
)
def test_damaged_files_are_refused_with_a_reason(name: str, text: str) -> None:
    with pytest.raises(InputError) as caught:
        FORMATS[name][1](text)
    assert len(str(caught.value).splitlines()) == 1


def test_we_read_binary_cameras_of_colmap(tmp_path: Path) -> None:
    model = pycolmap.Reconstruction()
    numbers = {1: ("OPENCV", [500.0, 501.0, 320.5, 240.5, -0.2, 0.05, 0.001, -0.002])}
    for camera_id, (name, values) in numbers.items():
        camera = pycolmap.Camera(camera_id=camera_id, model=name, width=640, height=480, params=values)
        model.add_camera_with_trivial_rig(camera)
    model.write_binary(tmp_path)
    ours = import_camera(tmp_path / "cameras.bin")
    assert (ours.model, ours.size_px) == ("brown", (640, 480))
    assert ours.parameters.tolist() == [500.0, 501.0, 320.0, 240.0, -0.2, 0.05, 0.001, -0.002]
    for number, name in enumerate(MODELS_BY_ID):
        theirs = pycolmap.Camera.create_from_model_name(1, name, 500.0, 640, 480)
        assert (int(theirs.model), len(theirs.params)) == (number, len(parameters_of(name)))
    (tmp_path / "cameras.bin").write_bytes((tmp_path / "cameras.bin").read_bytes()[:-3])
    with pytest.raises(InputError, match=r"not UTF-8|none of the known"):
        import_camera(tmp_path / "cameras.bin")


@pytest.mark.parametrize("name", sorted(FORMATS))
def test_cut_files_are_refused(name: str) -> None:
    """Cut anywhere: an error of ours, or (where only comments or optional keys were lost) still a camera."""
    write, read = FORMATS[name]
    text = write(CAMERAS["scaramuzza" if name == "ocamcalib" else "brown"]).text
    refused = 0
    for cut in range(0, len(text) - 2, 37):
        try:
            read(text[:cut])
        except InputError:
            refused += 1
    assert refused > 0.5 * len(range(0, len(text) - 2, 37)) or name == "ros"


def test_a_pinhole_stays_a_pinhole() -> None:
    camera = Pinhole((640, 480), np.array([500.0, 501.0, 320.0, 240.0]))
    for name in ("opencv", "kalibr", "ros", "colmap", "mrcal"):
        write, read = FORMATS[name]
        again = read(write(camera).text)
        assert again.model == "pinhole"
        assert again.parameters == pytest.approx(camera.parameters, abs=1e-12)
