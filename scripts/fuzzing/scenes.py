"""Good pictures of tags, of circles and of a textured scene, matches of that scene, and sessions of known cameras, for
`fuzz.py` to damage."""

from __future__ import annotations

import sqlite3
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from rigkit.io.boards.board_file import load_board

SIZE_PX = (160, 120)
FINER = 8
"""Pixels of the drawing along one of the picture, which is their mean."""
DISTANCE_MM = 1250.0
"""Of the scene, a plane that faces the cameras of the good rig."""
_K = np.array([[150.0, 0.0, 79.5], [0.0, 150.0, 59.5], [0.0, 0.0, 1.0]])
_T_MM = np.array([-100.0, 2.0, 1.0])
H21 = _K @ (np.eye(3) + np.outer(_T_MM, (0.0, 0.0, 1.0 / DISTANCE_MM))) @ np.linalg.inv(_K)
H21 /= H21[2, 2]
"""From the first picture of the scene to the second: affine, as the cameras look the same way."""
PLACES = np.stack(np.meshgrid(np.arange(30.0, 150.0, 15.0), np.arange(15.0, 110.0, 15.0)), -1).reshape(-1, 2)
MAX_IMAGES = 2147483647
"""COLMAP's number of a pair is this times the smaller number of an image, and the larger one."""

TEXTS = {
    "alone.toml": """schema = "rigkit.board/1"
type = "aprilgrid"
id = "alone"
columns = 3
rows = 2
tag_mm = 40.0
spacing = 0.3
border = 1
numbering = "opencv"
corner_squares = false
""",
    "hexagonal.toml": """schema = "rigkit.board/1"
type = "circles"
id = "hexagons"
columns = 4
rows = 5
distance_mm = 40.0
layout = "hexagonal"
stagger = "left"
diameter_mm = 24.0
""",
    "hexagonal.yaml": """boofcv.alg.fiducial.calib.ConfigCalibrationTarget:
  type: CIRCLE_HEXAGONAL
  grid:
    numRows: 5
    numCols: 8
    shapeSize: 24.0
    shapeDistance: 40.0
""",
    "known.toml": """schema = "rigkit.session/1"
board = "floor.toml"
frames = "order"

[[cameras]]
id = "left"
images = "image.png"
calibration = "calibration.json"

[[cameras]]
id = "right"
images = ["image.jpg"]
calibration = "rig.json"
""",
    "added.toml": """schema = "rigkit.session/1"
board = "floor.toml"
model = "pinhole"
frames = "order"
rig = "rig.json"

[[cameras]]
id = "left"
images = "image.png"

[[cameras]]
id = "third"
images = ["image.jpg"]
""",
}


def write_scenes(folder: Path) -> None:
    """Write them into the folder of the other good files."""
    for name, text in TEXTS.items():
        (folder / name).write_text(text)
    for board, picture in (("alone.toml", "tags.png"), ("hexagonal.toml", "dots.png")):
        cv2.imwrite(str(folder / picture), _drawn(folder / board))
    texture = np.random.default_rng(1).normal(size=SIZE_PX[::-1])
    smooth = sum(s * cv2.GaussianBlur(texture, (0, 0), s) for s in (1.0, 2.0, 4.0))
    grey = np.clip(128.0 + 60.0 * np.asarray(smooth), 0, 255).astype(np.uint8)
    cv2.imwrite(str(folder / "scene1.png"), grey)
    cv2.imwrite(str(folder / "scene2.png"), cv2.warpAffine(grey, H21[:2], SIZE_PX, borderMode=cv2.BORDER_REFLECT))
    _write_matches(folder)


def _drawn(path: Path) -> NDArray[np.uint8]:
    """Return a picture of a board straight on, with a soft edge and noise."""
    ink = load_board(path).ink()
    low = np.concatenate([ink.rectangles[:, :2], ink.circles[:, :2] - ink.circles[:, 2:]]).min(axis=0)
    high = np.concatenate([ink.rectangles[:, :2] + ink.rectangles[:, 2:], ink.circles[:, :2] + ink.circles[:, 2:]]).max(
        axis=0
    )
    px_per_mm = FINER * float(np.min((np.array(SIZE_PX) - 30.0) / (high - low)))
    large = np.full((FINER * SIZE_PX[1], FINER * SIZE_PX[0]), 220, np.uint8)
    start = 15.0 * FINER
    for x, y, w, h in ink.rectangles:
        corners = start + px_per_mm * (np.array([[x, y], [x + w, y + h]]) - low)
        (left, top), (right, bottom) = np.rint(corners).astype(int).tolist()
        large[top:bottom, left:right] = 30
    for x, y, radius in ink.circles:
        place = np.rint(start + px_per_mm * (np.array([x, y]) - low)).astype(int)
        cv2.circle(large, (int(place[0]), int(place[1])), round(px_per_mm * radius), 30, -1, cv2.LINE_AA)
    grey = cv2.GaussianBlur(cv2.resize(large, SIZE_PX, interpolation=cv2.INTER_AREA), (0, 0), 0.7).astype(float)
    grey += np.random.default_rng(0).normal(0.0, 2.0, grey.shape)
    return np.clip(grey, 0, 255).astype(np.uint8)


def _write_matches(folder: Path) -> None:
    """Matches of the scene as matchers save them, and COLMAP."""
    first, second = PLACES, PLACES @ H21[:2, :2].T + H21[:2, 2]
    which = np.repeat(np.arange(len(first))[:, None], 2, axis=1)
    np.savez(folder / "lightglue.npz", keypoints0=first[None], keypoints1=second[None], matches=which)
    frames = [np.concatenate([np.tile(np.eye(2), (len(p), 1, 1)), p[..., None]], axis=-1) for p in (first, second)]
    np.savez(folder / "lafs.npz", lafs0=frames[0][None], lafs1=frames[1][None])
    with sqlite3.connect(folder / "matches.db") as database:
        database.execute("CREATE TABLE images (image_id INTEGER, name TEXT)")
        database.executemany("INSERT INTO images VALUES (?, ?)", [(1, "scene1.png"), (2, "scene2.png")])
        database.execute("CREATE TABLE keypoints (image_id INTEGER, rows INTEGER, cols INTEGER, data BLOB)")
        for k, points in ((1, first), (2, second)):
            values = np.column_stack([points + 0.5, np.full((len(points), 2), (2.0, 0.1))]).astype(np.float32)
            database.execute("INSERT INTO keypoints VALUES (?, ?, ?, ?)", (k, *values.shape, values.tobytes()))
        for table in ("matches", "two_view_geometries"):
            database.execute(f"CREATE TABLE {table} (pair_id INTEGER, rows INTEGER, cols INTEGER, data BLOB)")
        blob = which.astype(np.uint32).tobytes()
        database.execute("INSERT INTO matches VALUES (?, ?, 2, ?)", (MAX_IMAGES + 2, len(which), blob))
    database.close()
