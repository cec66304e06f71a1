"""Read our files and project with the other programs' own code, for `round_trips.py`.

Programs that are not installed return None: mrcal (Debian: python3-mrcal), ROS (Debian:
python3-camera-calibration-parsers, python3-image-geometry). Kalibr's reader needs its compiled cameras, which no
package contains.
"""

from __future__ import annotations

import json
import subprocess
import tempfile
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from rigkit.geometry.rigid3 import Rigid3

SYSTEM_PYTHON = "/usr/bin/python3"
MM_PER_M = 1000.0
MRCAL = """
import sys, mrcal, numpy as np
model = mrcal.cameramodel(sys.argv[1])
np.savez(sys.argv[3], pixels=mrcal.project(np.load(sys.argv[2]), *model.intrinsics()),
         pose=model.extrinsics_rt_fromref())
"""
ROS = """
import sys, numpy as np
from camera_calibration_parsers import readCalibration
name, info = readCalibration(sys.argv[1])
np.savez(sys.argv[2], K=np.array(info.K), D=np.array(info.D), model=info.distortion_model)
"""
ROS_STEREO = """
import sys, cv2, numpy as np
from camera_calibration_parsers import readCalibration
from image_geometry import StereoCameraModel
pair = StereoCameraModel()
pair.fromCameraInfo(*(readCalibration(path)[1] for path in sys.argv[1:3]))
points, zero = np.load(sys.argv[3]), np.zeros(3)
seen = [pair.project3dToPixel(p) for p in points]
raw = []
for side, camera in enumerate((pair.left, pair.right)):
    rays = np.array([camera.projectPixelTo3dRay(two[side]) for two in seen]) @ np.array(camera.rotationMatrix())
    K, D = camera.intrinsicMatrix(), camera.distortionCoeffs()
    raw.append(cv2.projectPoints(rays, zero, zero, K, D)[0].reshape(-1, 2))
np.savez(sys.argv[4], raw=raw, found=[pair.projectPixelTo3d(l, l[0] - r[0]) for l, r in seen])
"""
"""Where raw images see points, by way of the rectified ones, and where the disparities say that they are, m. (Its
rectifyPoint stops after five iterations, which are too few for strong lenses.)"""


def _runs(module: str) -> bool:
    done = subprocess.run([SYSTEM_PYTHON, "-c", f"import {module}"], capture_output=True, check=False)
    return done.returncode == 0


@cache
def have_mrcal() -> bool:
    return Path(SYSTEM_PYTHON).exists() and _runs("mrcal")


@cache
def have_ros() -> bool:
    return Path(SYSTEM_PYTHON).exists() and _runs("camera_calibration_parsers, image_geometry")


def mrcal_projects(text: str, rays: np.ndarray) -> tuple[np.ndarray, Rigid3] | None:
    """Return the pixels (N, 2) of rays (N, 3), and cam_from_reference in mm, by mrcal."""
    if not have_mrcal():
        return None
    with tempfile.TemporaryDirectory() as folder:
        path, given, found = (Path(folder) / name for name in ("camera.cameramodel", "rays.npy", "found.npz"))
        path.write_text(text)
        np.save(given, rays)
        subprocess.run([SYSTEM_PYTHON, "-c", MRCAL, path, given, found], check=True)
        with np.load(found) as read:
            turn, shift = read["pose"][:3], read["pose"][3:]
            return read["pixels"], Rigid3(cv2.Rodrigues(turn)[0], MM_PER_M * shift)


def ros_projects(text: str, rays: np.ndarray) -> np.ndarray | None:
    """Return the pixels (N, 2) of rays (N, 3): camera_info by camera_calibration_parsers, projected by OpenCV as ROS
    does."""
    if not have_ros():
        return None
    with tempfile.TemporaryDirectory() as folder:
        path, found = Path(folder) / "camera.yaml", Path(folder) / "found.npz"
        path.write_text(text)
        subprocess.run([SYSTEM_PYTHON, "-c", ROS, path, found], check=True)
        with np.load(found) as read:
            return _projected(read["K"].reshape(3, 3), read["D"], rays, fisheye=str(read["model"]) == "equidistant")


def ros_stereo(left: str, right: str, points: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the raw pixels (2, N, 2) of points (N, 3), mm in the left camera's rectified frame, by image_geometry's
    stereo model, and where (N, 3) it says that their disparities are."""
    if not have_ros():
        return None
    with tempfile.TemporaryDirectory() as folder:
        one, two, given, found = (Path(folder) / name for name in ("left.yaml", "right.yaml", "given.npy", "found.npz"))
        one.write_text(left)
        two.write_text(right)
        np.save(given, points / MM_PER_M)
        subprocess.run([SYSTEM_PYTHON, "-c", ROS_STEREO, one, two, given, found], check=True)
        with np.load(found) as read:
            return read["raw"], MM_PER_M * read["found"]


def colmap_mount(text: str) -> Rigid3:
    """Return the second camera's pose from the first's by pycolmap's own reader of rig_config.json, mm."""
    import pycolmap

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "rig_config.json"
        path.write_text(json.dumps(json.loads(text)))
        _, second = pycolmap.read_rig_config(path)[0].cameras
    pose: Any = second.cam_from_rig
    return Rigid3(pose.rotation.matrix(), np.asarray(pose.translation))


def _projected(K: np.ndarray, distortion: np.ndarray, rays: np.ndarray, *, fisheye: bool) -> np.ndarray:
    """Return the pixels of rays (N, 3) by OpenCV."""
    points, zero = np.ascontiguousarray(rays[:, None, :]), np.zeros(3)
    if fisheye:
        return cv2.fisheye.projectPoints(points, zero, zero, K, distortion.reshape(-1, 1))[0].reshape(-1, 2)
    return cv2.projectPoints(points, zero, zero, K, distortion)[0].reshape(-1, 2)
