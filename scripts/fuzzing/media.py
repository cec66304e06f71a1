"""Good videos, registers, poses and other tools' boards, for `fuzz.py` to damage."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np

from rigkit.io.calibrations.history_file import HISTORY_SCHEMA

FRAMES = 8
CODECS = {"film.avi": "MJPG", "film.mp4": "mp4v", "film.mkv": "FFV1", "cam1.avi": "MJPG", "cam2.avi": "MJPG"}
"""A video of each container: pictures one by one, differences between them, and without loss."""

TEXTS = {
    "target.yaml": """target_type: 'aprilgrid'
tagCols: 3
tagRows: 2
tagSize: 0.04
tagSpacing: 0.3
""",
    "checkerboard.yaml": """target_type: 'checkerboard'
targetCols: 5
targetRows: 4
rowSpacingMeters: 0.03
colSpacingMeters: 0.03
""",
    "boofcv.yaml": """boofcv.alg.fiducial.calib.ConfigCalibrationTarget:
  type: CHESSBOARD
  grid:
    numRows: 5
    numCols: 6
    shapeSize: 30.0
    shapeDistance: 0.0
""",
    "settings.xml": """<?xml version="1.0"?>
<opencv_storage>
<Settings>
  <BoardSize_Width>5</BoardSize_Width>
  <BoardSize_Height>4</BoardSize_Height>
  <Square_Size>30</Square_Size>
  <Marker_Size>20</Marker_Size>
  <Calibrate_Pattern>"CHARUCOBOARD"</Calibrate_Pattern>
  <ArUco_Dict_Name>"DICT_4X4_50"</ArUco_Dict_Name>
</Settings>
</opencv_storage>
""",
    "charuco.toml": """columns = 6
rows = 5
board_height = 15.0
board_width = 18.0
dictionary = "DICT_4X4_100"
units = "cm"
aruco_scale = 0.75
square_size_overide_cm = 3.0
inverted = false
legacy_pattern = false
""",
    "public.toml": f"""schema = "rigkit.public/1"
name = "small"
about = "two pictures of a board"
rendered = false
source = "https://example.org/small"
licence = "CC-BY-4.0"
folder = "public/small"

[[boards]]
id = "board"
columns = 5
rows = 4
square_mm = 30.0

[[measured]]
id = "baseline"
value = 120.0
sigma = 0.1
unit = "mm"
how = "steel rule"

[files]
"left.png" = "{64 * "0"}"
"right.png" = "{64 * "a"}"
""",
    "poses.csv": """image,x_mm,y_mm,z_mm,qx,qy,qz,qw
view1.png,412.1,-88.0,630.5,0.0,0.0,0.0,1.0
view2.png,402.1,-80.0,610.5,0.0998334,0.0,0.0,0.9950042
""",
    "turns.csv": """image,x_m,y_m,z_m,rx_deg,ry_deg,rz_deg
view1.png,0.4121,-0.088,0.6305,10,20,30
view2.png,0.4021,-0.080,0.6105,20,0.5,-30
""",
    "pose.txt": """1 0 0 -100
0 1 0 2.5
0 0 1 1
""",
}


def write_media(folder: Path) -> None:
    """Write them into the folder of the good images."""
    image = np.asarray(cv2.imread(str(folder / "image.png")))
    for name, codec in CODECS.items():
        size_px = (image.shape[1], image.shape[0])
        video = cv2.VideoWriter(str(folder / name), cv2.VideoWriter.fourcc(*codec), 10.0, size_px)
        assert video.isOpened(), name
        for k in range(FRAMES):
            shift = np.array([[1.0, 0.0, 2.0 * k], [0.0, 1.0, -k]])
            video.write(cv2.warpAffine(image, shift, size_px, borderMode=cv2.BORDER_REPLICATE))
        video.release()
    for name, text in TEXTS.items():
        (folder / name).write_text(text)
    (folder / "catalogue").mkdir()
    (folder / "catalogue" / "small.toml").write_text(TEXTS["public.toml"])
    rows = [f"{k},{camera},{k + 3},{0.1 * k:.3f}" for k in range(FRAMES) for camera in (1, 2)]
    (folder / "times.csv").write_text("\n".join(["sync_index,cam_id,frame_index,frame_time", *rows]) + "\n")
    entry = {
        "schema": HISTORY_SCHEMA, "date": "2026-01-02T10:00:00Z", "kind": "check", "source": "calibration.json",
        "holds": True, "chance": 0.4, "verdict": "holds", "frames": 2, "rms_px": 0.04, "temperature_c": 21.5,
        "amounts": {"focus, %": [0.01, 0.02], "principal point 1, px": [0.1, 0.05]},
    }  # fmt: skip
    dates = (f"2026-0{month}-02T10:00:00Z" for month in range(1, 6))
    (folder / "history.jsonl").write_text("".join(json.dumps(entry | {"date": date}) + "\n" for date in dates))
    record = {
        "schema": "rigkit.frames/1", "asked": {"cameras": {"": "film.avi"}, "files": {}, "boards": "", "most": 40},
        "images": {"": ["000001.png"]},
    }  # fmt: skip
    (folder / "frames.json").write_text(json.dumps(record))
