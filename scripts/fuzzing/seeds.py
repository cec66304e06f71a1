"""The good files that `fuzz.py` damages, one of each kind that rigkit reads."""

from __future__ import annotations

import json
import re
from pathlib import Path

import cv2
import numpy as np

from fuzzing import media, scenes, views
from rigkit.affine.correspondences import Correspondences
from rigkit.cameras.registry import camera_model
from rigkit.core.cloud import OrientedCloud
from rigkit.core.detections import BoardDetection
from rigkit.geometry.rigid3 import Rigid3
from rigkit.interop.colmap_cameras import write_colmap_cameras
from rigkit.interop.colmap_rig import write_colmap_rig
from rigkit.interop.kalibr import write_kalibr
from rigkit.interop.mrcal import write_cameramodel
from rigkit.interop.ocamcalib import write_ocamcalib
from rigkit.interop.opencv import opencv_stereo, write_opencv
from rigkit.interop.ros import write_camera_info
from rigkit.io.corners import corner_cache
from rigkit.io.corners.corners_file import corners_text
from rigkit.io.corners.correspondences import correspondences_text
from rigkit.io.ply import write_ply

ROOT = Path(__file__).resolve().parents[2]
SIZE_PX = (160, 120)
COLUMNS, ROWS, SQUARE_PX = 5, 4, 18
UNSURE = 100.0
"""Parameters of the calibration that is scaled down to these pictures are so many times as uncertain: corners of theirs
are 0.04 px off where those of 1624 x 1240 px are 0.004, a tenth of the size."""

TOMLS = {
    "board.toml": """schema = "rigkit.board/1"
id = "small"
columns = 5
rows = 4
square_mm = 30.0
square_sigma_mm = 0.05
dictionary = "DICT_5X5_100"
marker_mm = 20.0
first_marker = 0
""",
    "aprilgrid.toml": """schema = "rigkit.board/1"
type = "aprilgrid"
id = "tags"
columns = 3
rows = 2
tag_mm = 40.0
spacing = 0.3
family = "tag36h11"
border = 2
first_tag = 4
numbering = "kalibr"
corner_squares = true
tag_sigma_mm = 0.05
""",
    "circles.toml": """schema = "rigkit.board/1"
type = "circles"
id = "dots"
columns = 4
rows = 5
distance_mm = 40.0
layout = "asymmetric"
stagger = "left"
diameter_mm = 15.0
inverted = false
""",
    "session.toml": """schema = "rigkit.session/1"
images = "image*.png"
board = "board.toml"
model = "brown"
degree = 5
board_shape = "auto"
""",
    "rig-session.toml": """schema = "rigkit.session/1"
boards = ["board.toml", "floor.toml"]
model = "brown"
frames = "order"

[[cameras]]
id = "left"
images = "image.png"

[[cameras]]
id = "right"
images = ["image.jpg"]

[[baselines]]
a = "left"
b = "right"
value_mm = 100.0
sigma_mm = 1.0
how = "steel rule"

[[rigid_boards]]
boards = ["small", "floor"]
layout = { small = "left", floor = "floor" }
angles = [{ a = "small", b = "floor", value_deg = 90.0, sigma_deg = 0.3, how = "set square" }]
distances = [{ a = "small.centre", b = "floor", value_mm = 150.0, sigma_mm = 1.0, how = "rule" }]
""",
    "dataset.toml": """schema = "rigkit.dataset/1"
name = "small"

[[boards]]
id = "wall"
file = "floor.toml"

[[boards]]
id = "floor"
columns = 5
rows = 4
square_x_mm = 30.0
square_y_mm = 30.1

[[cameras]]
id = "one"
calibration = "calibration.json"
session = "session.toml"

[[pairs]]
id = "first"
camera1 = "one"
camera2 = "one"
image1 = "image.png"
image2 = "image.jpg"
pose_type = "planar"
level = { sigma_deg = 0.2 }
boards = ["wall", "floor"]
layout = { wall = "back", floor = "floor" }

[pairs.truth]
baseline = { value_mm = 300.0, sigma_mm = 1.0, how = "rule" }
angles = [{ a = "wall", b = "floor", value_deg = 90.0, sigma_deg = 0.3, how = "set square" }]
distances = [{ a = "wall.centre", b = "floor", value_mm = 412.5, sigma_mm = 1.0, how = "rule" }]
""",
}


def write_seeds(folder: Path) -> None:
    """Write the good files into the new folder."""
    folder.mkdir(parents=True)
    for name, text in TOMLS.items():
        (folder / name).write_text(text)
    plain = TOMLS["board.toml"].split("dictionary")[0].replace("small", "floor")
    (folder / "floor.toml").write_text(plain)
    study = (ROOT / "datasets/synthetic/special.toml").read_text()
    # Of fewer noises and motions: a case is to take no seconds for drawing.
    study = study.replace('"planar", "standard"', '"standard"')
    (folder / "study.toml").write_text(re.sub(r"sigma_deg = .*", "sigma_deg = [0, 5]", study))
    write_images(folder)
    _write_calibrations(folder)
    _write_cameras(folder)
    _write_tables(folder)
    media.write_media(folder)
    scenes.write_scenes(folder)
    views.write_views(folder)
    (folder / "other").mkdir()
    (folder / "other" / "dataset.toml").write_text(TOMLS["dataset.toml"].replace('"small"', '"other"', 1))


def write_images(folder: Path) -> None:
    """A chessboard with a soft edge and noise, in every kind of image that is read."""
    v, u = np.mgrid[: SIZE_PX[1], : SIZE_PX[0]]
    column, row = (u - 20) // SQUARE_PX, (v - 12) // SQUARE_PX
    inside = (column >= 0) & (column <= COLUMNS) & (row >= 0) & (row <= ROWS)
    grey = np.where(inside & ((column + row) % 2 == 0), 30.0, 220.0)
    grey = cv2.GaussianBlur(grey, (0, 0), 0.8) + np.random.default_rng(0).normal(0.0, 2.0, grey.shape)
    image = np.clip(grey, 0, 255).astype(np.uint8)
    for ending in ("png", "jpg", "tif", "bmp", "pgm", "webp"):
        cv2.imwrite(str(folder / f"image.{ending}"), image)
    (folder / "pairs").mkdir()
    for number in (1, 2):
        cv2.imwrite(str(folder / f"pairs/view{number}.png"), image)
    cv2.imwrite(str(folder / "deep.png"), image.astype(np.uint16) * 257)


def _write_calibrations(folder: Path) -> None:
    """A real calibration, with two of its views, and a rig and boards on one mount as rigkit writes them."""
    data = json.loads((ROOT / "calib/cameras/mvca020_r61/calibration.json").read_text())
    data["views"] = data["views"][:2]
    scale = SIZE_PX[0] / data["camera"]["size_px"][0]
    data["camera"]["size_px"] = list(SIZE_PX)
    values = data["camera"]["parameters"]
    for name in values:
        # f(rho) / a0 stays the same function of rho / a0.
        power = 1 if name in ("a0", "cx", "cy") else 1 - int(name[1:]) if name[1:].isdigit() else 0
        values[name] *= scale**power
    data["covariance"] = [[UNSURE**2 * value for value in row] for row in data["covariance"]]
    for view in data["views"]:
        view["pixels"] = [[scale * u, scale * v] for u, v in view["pixels"]]
    (folder / "calibration.json").write_text(json.dumps(data))
    pinhole = {"fx": 150.0, "fy": 150.0, "cx": 79.5, "cy": 59.5}
    model = {"model": "pinhole", "size_px": list(SIZE_PX), "parameters": pinhole}
    poses = [np.eye(4)[:3].tolist(), [[1.0, 0.0, 0.0, -100.0], [0.0, 1.0, 0.0, 2.0], [0.0, 0.0, 1.0, 1.0]]]
    rig = {
        "schema": "rigkit.rig/1", "heldout_rms_px": 0.1, "rms_px": 0.1, "sigma_px": 0.05, "overdispersion": 1.0,
        "scale_sigma": 0.001, "verdicts": [],
        "baselines": [{"from": "left", "to": "right", "value_mm": 100.0, "sigma_mm": 0.1}],
        "cameras": [
            {"name": name, "camera": model, "cam_from_rig": pose, "rms_px": 0.1}
            for name, pose in zip(("left", "right"), poses, strict=True)
        ],
        "covariance": np.diag([0.01] * 8 + [1e-8] * 3 + [0.01] * 3).tolist(),
    }  # fmt: skip
    (folder / "rig.json").write_text(json.dumps(rig))
    points = [[30.0 * c, 30.0 * r, 0.0] for r in range(2) for c in range(3)]
    boards = [
        {"board_id": name, "size": [3, 2], "square_mm": [30.0, 30.0], "square_sigma_mm": None,
         "target_from_board": pose, "points_mm": points}
        for name, pose in zip(("a", "b"), poses, strict=True)
    ]  # fmt: skip
    mounted = {"image_count": 4, "scale_sigma": 0.0, "angles": [], "boards": boards}
    mounted["covariance"] = np.diag([1e-8] * 3 + [0.01] * 3).tolist()
    (folder / "board-rigs.json").write_text(json.dumps({"schema": "rigkit.board_rig/1", "rigs": [mounted]}))


def _write_cameras(folder: Path) -> None:
    """Cameras of every foreign format, by our own writers."""
    brown = camera_model("brown")((640, 480), np.array([420.0, 421.0, 320.0, 240.0, -0.28, 0.07, 2e-4, 1.7e-5]))
    fisheye = camera_model("kannala_brandt")(
        (640, 480), np.array([190.0, 190.0, 320.0, 240.0, 0.01, -0.005, 0.001, 0.0])
    )
    turned = Rigid3(np.eye(3), np.array([-100.0, 0.0, 0.0]))
    texts = {
        "opencv.yaml": write_opencv(fisheye).text,
        "kalibr.yaml": write_kalibr([brown]).text,
        "chain.yaml": write_kalibr([brown, fisheye], [Rigid3(np.eye(3), np.zeros(3)), turned]).text,
        "stereo.yaml": opencv_stereo(brown, brown, turned).text,
        "ros.yaml": write_camera_info(brown).text,
        "cameras.txt": write_colmap_cameras({1: brown})[0],
        "rig_config.json": write_colmap_rig(
            {"left": (brown, Rigid3(np.eye(3), np.zeros(3))), "right": (fisheye, turned)}, {}
        )[0],
        "lens.cameramodel": write_cameramodel(brown).text,
        "spline.cameramodel": write_cameramodel(fisheye).text,
        "calib_results.txt": write_ocamcalib(fisheye).text,
        "ocam.json": json.dumps(
            {
                "taylor_coefficient": [190.0, 0.0, -1.2e-3, 4e-7, -1e-9],
                "distortion_center": [320.0, 240.0],
                "stretch_matrix": [[1.0, 0.0], [0.0, 1.0]],
            }
        ),
    }
    for name, text in texts.items():
        (folder / name).write_text(text)


def small_detection(board_id: str | None = "small") -> BoardDetection:
    """Return all corners of the small board."""
    grid = np.array([(c, r) for r in range(ROWS) for c in range(COLUMNS)])
    pixels = 37.5 + SQUARE_PX * grid.astype(float) - (0.0, 8.0)
    return BoardDetection(board_id, COLUMNS, ROWS, grid, pixels, np.full(len(grid), 0.05))


def small_cloud() -> OrientedCloud:
    """Return a cloud of the small board's size."""
    d = small_detection()
    n = len(d.grid)
    points = np.column_stack([30.0 * d.grid, np.full(n, 900.0)])
    colours = np.full((n, 3), 128, dtype=np.uint8)
    normals = np.tile([0.0, 0.0, -1.0], (n, 1))
    return OrientedCloud(
        points_mm=points,
        normals=normals,
        colours=colours,
        board_index=np.zeros(n, int),
        grid=d.grid,
        sigma_mm=np.ones(n),
        normal_sigma_rad=np.full(n, 0.01),
        board_ids=("small",),
    )


def _write_tables(folder: Path) -> None:
    d = small_detection()
    (folder / "corners.csv").write_text(corners_text({"image.png": [d], "image.jpg": [small_detection(None)]}))
    kept = {name: getattr(d, name) for name in ("board_id", "columns", "rows")}
    kept |= {name: getattr(d, name).tolist() for name in ("grid", "pixels", "sigma_px")}
    entry = {"sha256": "0" * 64, "size_px": list(SIZE_PX), "boards": [kept], "lens": {"key": "0", "boards": [kept]}}
    data = {"schema": corner_cache.CORNERS_SCHEMA, "detector": "0 5x4", "images": {"image.png": entry}}
    (folder / "corners.json").write_text(json.dumps(data))
    lines = [f"image.png {u:.3f} {v:.3f} 0" for u, v in d.pixels]
    lines[3] = "image.png - - -"
    (folder / "corners.vnl").write_text("\n".join(["# filename x y level", *lines]) + "\n")
    (folder / "truth.csv").write_text(
        "pair,quantity,a,b,value [mm],sigma [mm],value [deg],sigma [deg],how\n"
        "first,baseline,,,300,2,,,steel rule\nfirst,angle,wall,floor,,,90,0.3,set square\n"
        "first,distance,wall.centre,floor,412.5,1,,,steel rule\n"
    )
    n = len(d.pixels)
    affine = np.tile([[1.0, 0.1], [0.0, 1.1]], (n, 1, 1))
    sigma = np.full(n, 0.1)
    pairs = Correspondences(d.pixels, d.pixels + 3.0, affine, None, sigma, sigma)
    (folder / "pairs.csv").write_text(correspondences_text(pairs))
    np.savez(folder / "pairs.npz", pixels1=d.pixels, pixels2=d.pixels + 3.0, A21=affine, sigma_px=sigma, sigma_A=sigma)
    write_ply(folder / "cloud.ply", small_cloud())
