"""Values drawn by Hypothesis: every writer's output is read back equal, by our readers and by other programs'.

RIGKIT_EXAMPLES=1000 draws more of them than the few that run by default.
"""

from __future__ import annotations

import csv
import io
import json
import os
import tempfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
import pytest
import yaml
from helpers.cameras import PARAMETERS, image_pixels, rays_within
from helpers.tolerances import ROUND_TRIP_PX
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rigkit.affine.correspondences import Correspondences
from rigkit.cameras.base import Camera
from rigkit.cameras.compare import compare_cameras
from rigkit.cameras.registry import MODELS, camera_model
from rigkit.core.boards import Board
from rigkit.core.cloud import OrientedCloud
from rigkit.core.detections import BoardDetection
from rigkit.core.errors import InputError
from rigkit.core.identifiers import MAX_IDENTIFIER, check_identifier
from rigkit.core.tables import Cell, Column, Table
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3
from rigkit.interop.colmap_cameras import read_colmap_cameras, write_colmap_cameras
from rigkit.interop.kalibr import read_kalibr, write_kalibr
from rigkit.interop.mrcal import read_cameramodel, write_cameramodel
from rigkit.interop.ocamcalib import read_ocamcalib, write_ocamcalib
from rigkit.interop.opencv import read_opencv, write_opencv
from rigkit.interop.ros import read_camera_info, write_camera_info
from rigkit.io.boards.board_file import board_text, load_board
from rigkit.io.calibrations.calibration_file import load_camera, save_camera
from rigkit.io.corners.corners_file import read_corners, write_corners
from rigkit.io.corners.correspondences import correspondences_text, read_correspondences
from rigkit.io.ply import read_ply, write_ply
from rigkit.report.tables import tables_to_csv, tables_to_json

EXAMPLES = int(os.environ.get("RIGKIT_EXAMPLES", "15"))
drawn = settings(
    max_examples=EXAMPLES,
    deadline=None,
    derandomize="RIGKIT_EXAMPLES" not in os.environ,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.filter_too_much],
)

SAME_PX = 1e-8
"""Another program's arithmetic on the same numbers, in an image of some thousand pixels."""
PRINTED_PX = 5.1e-6
"""Corners are printed with five decimals."""
PRINTED_REL = 5.1e-6
"""Sides of squares are printed with six digits."""
FIELD_RAD = np.radians(60.0)
"""Within it every camera drawn sees: closer to the edge a changed lens may fold."""

numbers = st.floats(allow_nan=False, allow_infinity=False, width=64)
moderate = st.floats(-1e6, 1e6, allow_nan=False)
positive = st.floats(1e-3, 1e3)
identifiers = st.text(
    st.characters(categories=["L", "Nd"], include_characters="_-+.() "), min_size=1, max_size=MAX_IDENTIFIER
)


def _is_identifier(name: str) -> bool:
    try:
        check_identifier(name, "board")
    except InputError:
        return False
    return True


names = identifiers.filter(_is_identifier)


@st.composite
def cameras(draw: Any, models: tuple[str, ...] = tuple(MODELS), labels: tuple[str, ...] = ()) -> Camera:
    """A camera near one of those of the contracts: each parameter up to two per cent off, the image of any size."""
    chosen = draw(st.sampled_from(labels or [label for label in PARAMETERS if _model_of(label) in models]))
    base = np.array(PARAMETERS[chosen])
    shifts = draw(st.lists(st.floats(-0.02, 0.02), min_size=base.size, max_size=base.size))
    size = draw(st.tuples(st.integers(640, 4000), st.integers(480, 3000)))
    return camera_model(_model_of(chosen))(size, base * (1.0 + np.array(shifts)))


def _model_of(label: str) -> str:
    return next(name for name in sorted(MODELS, key=len, reverse=True) if label.startswith(name))


@pytest.fixture(scope="module")
def folder() -> Any:
    with tempfile.TemporaryDirectory() as name:
        yield Path(name)


def same_projection(a: Camera, b: Camera) -> None:
    pixels = image_pixels(a)
    rays, valid = a.unproject(pixels)
    again, seen = b.project(rays[valid])
    assert a.size_px == b.size_px and seen.mean() > 0.9
    assert np.abs(again - pixels[valid])[seen].max() < SAME_PX + ROUND_TRIP_PX


@drawn
@given(camera=cameras())
def test_cameras_of_ours(folder: Path, camera: Camera) -> None:
    save_camera(folder / "camera.json", camera, force=True)
    back = load_camera(folder / "camera.json")
    assert back.model == camera.model and back.size_px == camera.size_px
    assert np.array_equal(back.parameters, camera.parameters)


FOREIGN: dict[str, tuple[tuple[str, ...], Any, Any]] = {
    "opencv": (("pinhole", "brown", "brown_rational", "kannala_brandt", "ucm"), write_opencv, read_opencv),
    "ros": (("pinhole", "brown", "brown_rational", "kannala_brandt"), write_camera_info, read_camera_info),
    "kalibr": (
        ("pinhole", "kannala_brandt", "ucm", "eucm", "double_sphere"),
        lambda c: write_kalibr([c]).cameras[0],
        lambda t: read_kalibr(t)[0][0],
    ),
    "colmap": (
        ("pinhole", "brown", "brown_rational", "kannala_brandt", "eucm"),
        lambda c: write_colmap_cameras({1: c})[1][1],
        lambda t: read_colmap_cameras(t)[1],
    ),
    "mrcal": (("pinhole", "brown", "brown_rational"), write_cameramodel, lambda t: read_cameramodel(t)[0]),
}


@pytest.mark.parametrize("name", sorted(FOREIGN))
@drawn
@given(data=st.data())
def test_cameras_of_others_come_back(name: str, data: Any) -> None:
    labels, write, read = FOREIGN[name]
    camera = data.draw(cameras(labels=labels))
    written = write(camera)
    assert written.max_error_px == 0.0
    same_projection(camera, read(written.text))


@settings(drawn, max_examples=max(EXAMPLES // 5, 3))
@given(camera=cameras(models=("scaramuzza",)))
def test_ocamcalib_comes_back(camera: Camera) -> None:
    """But for the rotation that its affine matrix of another form leaves."""
    back, _ = read_ocamcalib(write_ocamcalib(camera).text)
    assert compare_cameras(camera, back).max_px < SAME_PX


@drawn
@given(camera=cameras(labels=("pinhole", "brown", "brown_rational", "kannala_brandt")), seed=st.integers(0, 2**32 - 1))
def test_opencv_reads_what_we_write(folder: Path, camera: Camera, seed: int) -> None:
    path = folder / "camera.yml"
    path.write_text(write_opencv(camera).text)
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    K, d = (storage.getNode(key).mat() for key in ("camera_matrix", "distortion_coefficients"))
    size = tuple(int(storage.getNode(key).real()) for key in ("image_width", "image_height"))
    storage.release()
    points = rays_within(min(FIELD_RAD, 0.9 * camera.max_angle_rad), 50, np.random.default_rng(seed))
    still = (np.zeros(3), np.zeros(3))
    project = cv2.fisheye.projectPoints if camera.model == "kannala_brandt" else cv2.projectPoints
    theirs = project(points[:, None], *still, K, d)[0][:, 0]
    ours, valid = camera.project(points)
    assert size == camera.size_px and valid.mean() > 0.9
    assert np.abs(theirs - ours)[valid].max() < SAME_PX


@drawn
@given(camera=cameras(labels=("pinhole", "brown", "brown_rational", "eucm")), seed=st.integers(0, 2**32 - 1))
def test_colmap_reads_what_we_write(folder: Path, camera: Camera, seed: int) -> None:
    text, _ = write_colmap_cameras({7: camera})
    for name in ("images.txt", "points3D.txt", "rigs.txt", "frames.txt"):
        (folder / name).write_text("")
    (folder / "cameras.txt").write_text(text)
    model = pycolmap.Reconstruction()
    model.read_text(folder)
    points = rays_within(min(FIELD_RAD, 0.9 * camera.max_angle_rad), 50, np.random.default_rng(seed))
    ours, valid = camera.project(points)
    theirs = np.asarray(model.cameras[7].img_from_cam(points[valid]))
    assert (model.cameras[7].width, model.cameras[7].height) == camera.size_px and valid.mean() > 0.9
    assert np.abs(theirs - 0.5 - ours[valid]).max() < SAME_PX


@drawn
@given(data=st.data())
def test_a_chain_of_kalibr_is_yaml_with_the_rig_in_it(data: Any) -> None:
    """Read by PyYAML as Kalibr does: T_cn_cnm1 in metres, intrinsics as they are."""
    rig = data.draw(st.lists(cameras(labels=("pinhole", "kannala_brandt", "double_sphere")), min_size=2, max_size=4))
    turns = data.draw(st.lists(st.tuples(*[st.floats(-3.0, 3.0)] * 3), min_size=len(rig), max_size=len(rig)))
    places = data.draw(st.lists(st.tuples(*[moderate] * 3), min_size=len(rig), max_size=len(rig)))
    poses = [Rigid3(exp_so3(np.array(w)), np.array(t)) for w, t in zip(turns, places, strict=True)]
    text = write_kalibr(rig, poses).text
    theirs = yaml.safe_load(text)
    assert sorted(theirs) == [f"cam{k}" for k in range(len(rig))]
    for k in range(1, len(rig)):
        T = np.array(theirs[f"cam{k}"]["T_cn_cnm1"])
        between = poses[k] @ poses[k - 1].inverse()
        assert np.allclose(T[:3, :3], between.rotation, atol=1e-12)
        assert np.allclose(1000.0 * T[:3, 3], between.translation_mm, rtol=1e-12, atol=1e-9)
    back, again = read_kalibr(text)
    first = poses[0].inverse()
    for camera, pose, ours, theirs_pose in zip(rig, poses, back, again, strict=True):
        same_projection(camera, ours)
        relative = pose @ first
        assert np.allclose((theirs_pose @ again[0].inverse()).translation_mm, relative.translation_mm, atol=1e-4)


@drawn
@given(camera=cameras(labels=("pinhole", "brown", "brown_rational", "kannala_brandt")))
def test_ros_reads_what_we_write(camera: Camera) -> None:
    """As camera_info_manager does: YAML, matrices of rows, cols and data."""
    theirs = yaml.safe_load(write_camera_info(camera).text)
    K = np.array(theirs["camera_matrix"]["data"]).reshape(3, 3)
    assert (theirs["image_width"], theirs["image_height"]) == camera.size_px
    assert np.array_equal(K[[0, 1, 0, 1], [0, 1, 2, 2]], camera.parameters[:4])
    d = np.array(theirs["distortion_coefficients"]["data"])
    assert (
        np.array_equal(d[: camera.parameters.size - 4], camera.parameters[4:])
        and not d[camera.parameters.size - 4 :].any()
    )
    assert theirs["projection_matrix"]["cols"] == 4 and len(theirs["projection_matrix"]["data"]) == 12


@st.composite
def clouds(draw: Any) -> OrientedCloud:
    n = draw(st.integers(1, 20))
    boards = tuple(draw(st.lists(names, min_size=1, max_size=3, unique=True)))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    normals = rng.normal(size=(n, 3))
    points = np.array(draw(st.lists(moderate, min_size=3 * n, max_size=3 * n))).reshape(n, 3)
    return OrientedCloud(
        points_mm=points,
        normals=normals / np.linalg.norm(normals, axis=1, keepdims=True),
        colours=rng.integers(0, 256, (n, 3), dtype=np.uint8),
        board_index=rng.integers(0, len(boards), n),
        grid=rng.integers(-5, 50, (n, 2)),
        sigma_mm=np.array(draw(st.lists(positive, min_size=n, max_size=n))),
        normal_sigma_rad=rng.uniform(1e-6, 3.0, n),
        board_ids=boards,
    )


@drawn
@given(cloud=clouds(), comments=st.lists(st.text(max_size=80), max_size=3))
def test_clouds(folder: Path, cloud: OrientedCloud, comments: list[str]) -> None:
    """Whatever is in the comments: they stay in their lines."""
    write_ply(folder / "cloud.ply", cloud, comments=comments, force=True)
    back = read_ply(folder / "cloud.ply")
    assert back.board_ids == cloud.board_ids
    for name in ("points_mm", "normals", "colours", "board_index", "grid", "sigma_mm"):
        assert np.array_equal(getattr(back, name), getattr(cloud, name)), name
    assert np.allclose(back.normal_sigma_rad, cloud.normal_sigma_rad, rtol=1e-15, atol=0.0)


@st.composite
def detections(draw: Any) -> BoardDetection:
    columns, rows = draw(st.tuples(st.integers(3, 9), st.integers(3, 9)))
    every = [(c, r) for r in range(rows) for c in range(columns)]
    chosen = draw(st.lists(st.sampled_from(every), min_size=9, unique=True))
    # The farthest corner says how large an unnamed board is.
    grid = np.array(sorted({*chosen, (columns - 1, rows - 1)}))
    n = len(grid)
    pixels = np.array(draw(st.lists(st.floats(-100.0, 1e4), min_size=2 * n, max_size=2 * n))).reshape(n, 2)
    sigma = np.array(draw(st.lists(st.floats(1e-4, 10.0), min_size=n, max_size=n)))
    return BoardDetection(draw(st.none() | names), columns, rows, grid, pixels, sigma)


images = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\r"), min_size=1, max_size=40)


@drawn
@given(found=st.dictionaries(images, detections(), min_size=1, max_size=3))
def test_corners(folder: Path, found: dict[str, BoardDetection]) -> None:
    """Names of images with commas, quotes and line ends among them."""
    write_corners(folder / "corners.csv", {image: [d] for image, d in found.items()}, force=True)
    back = read_corners(folder / "corners.csv")
    assert list(back) == list(found)
    for image, (read,) in back.items():
        wrote = found[image]
        assert read.board_id == wrote.board_id and (read.columns, read.rows) == (wrote.columns, wrote.rows)
        assert np.array_equal(read.grid, wrote.grid)
        assert np.abs(read.pixels - wrote.pixels).max() < PRINTED_PX
        assert np.abs(read.sigma_px - wrote.sigma_px).max() < PRINTED_PX


@drawn
@given(data=st.data())
def test_correspondences(folder: Path, data: Any) -> None:
    n = data.draw(st.integers(1, 12))
    pixels = np.array(data.draw(st.lists(moderate, min_size=4 * n, max_size=4 * n))).reshape(2, n, 2)
    values = np.array(data.draw(st.lists(st.floats(-100.0, 100.0), min_size=4 * n, max_size=4 * n)))
    sigma = np.array(data.draw(st.lists(positive, min_size=n, max_size=n)))
    found = Correspondences(pixels[0], pixels[1], values.reshape(n, 2, 2), None, sigma, 2.0 * sigma)
    (folder / "pairs.csv").write_text(correspondences_text(found))
    arrays = {name: getattr(found, name) for name in ("pixels1", "pixels2", "A21", "sigma_px", "sigma_A")}
    np.savez(folder / "pairs.npz", **arrays)
    for name in ("pairs.csv", "pairs.npz"):
        back = read_correspondences(folder / name)
        for field, wrote in arrays.items():
            assert np.array_equal(getattr(back, field), wrote), (name, field)


@drawn
@given(
    name=names,
    size=st.tuples(st.integers(2, 60), st.integers(2, 60)),
    squares=st.tuples(st.floats(1.0, 200.0), st.floats(0.97, 1.03)),
    sigma=st.none() | st.floats(1e-3, 0.5),
)
def test_boards(folder: Path, name: str, size: tuple[int, int], squares: tuple[float, float], sigma: Any) -> None:
    side, ratio = squares
    board = Board(name, *size, side, side * ratio, square_sigma_mm=None if sigma is None else sigma * side / 100.0)
    path = folder / "board.toml"
    path.write_text(board_text(board, "drawn", path), encoding="utf-8")
    back = load_board(path)
    assert back.board_id == name and back.size == size
    assert back.squares_mm == pytest.approx(board.squares_mm, rel=PRINTED_REL)
    assert (back.square_sigma_mm is None) == (sigma is None)


@drawn
@given(cells=st.lists(st.text(max_size=30) | numbers, min_size=1, max_size=6))
def test_tables(cells: list[str | float]) -> None:
    """A spreadsheet reads as many cells as were written, none a formula; JSON the numbers to the last digit."""
    columns = tuple(Column(f"c{k}") for k in range(len(cells)))
    table = Table("drawn", "drawn at random", columns, (tuple(Cell(value) for value in cells),))
    read = list(csv.reader(io.StringIO(tables_to_csv([table]))))
    row = next(line for line in read[::-1] if line)
    assert len(row) == len(cells) or len(row) == len(cells) + 1
    for cell in row:
        assert not cell.startswith(("=", "@", "\t")) and "\r" not in cell
    reported = json.dumps(json.loads(tables_to_json([table])))
    for value in cells:
        if isinstance(value, float):
            assert json.dumps(value) in reported
