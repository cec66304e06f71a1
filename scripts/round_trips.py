"""Convert every camera model, and a rig, to every format and back: the largest error over the image, px, and the error
of the other programs' own readers (calibrators/own_readers.py). The tables are part of the documentation.

python scripts/round_trips.py
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import yaml
from calibrators import own_readers

from rigkit.cameras.base import Camera
from rigkit.cameras.compare import grid_pixels
from rigkit.cameras.convert import convert_camera
from rigkit.cameras.kannala_brandt import KannalaBrandt
from rigkit.cameras.registry import MODELS
from rigkit.core.errors import RigkitError
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3
from rigkit.interop.camera_formats import FOREIGN_FORMATS
from rigkit.interop.colmap_cameras import write_colmap_cameras
from rigkit.interop.mrcal import write_cameramodel
from rigkit.interop.opencv import write_opencv
from rigkit.interop.rigs import RIG_FORMATS, write_rig
from rigkit.interop.ros import write_camera_info

LENS = KannalaBrandt((1280, 960), np.array([720.0, 721.0, 643.2, 477.9, -0.03, 0.004, -0.0008, 0.0]))
"""A lens of 85 by 65 degrees that every model can follow nearly."""
GRID = (41, 31)
EXACT_PX = 1e-6
"""Below this a file brings the same camera back: text has every digit."""
FORMATS = ("opencv", "ros", "kalibr", "colmap", "mrcal", "ocamcalib")
ORDERS = {"brown": (4, 5, 8), "scaramuzza": (6,)}
"""Terms, or degree, of the models that have several."""


def lens_as(model: str, order: int | None = None) -> Camera:
    """Return the lens as a camera of a model; without an `order` as good a one as it needs."""
    return convert_camera(LENS, model, order=order or {"brown": 5, "scaramuzza": 6}.get(model)).camera


def pixels_and_rays(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Return pixels (N, 2) over the image, and their rays (N, 3)."""
    pixels = grid_pixels(camera.size_px, GRID).reshape(-1, 2)
    rays, valid = camera.unproject(pixels)
    return pixels[valid], rays[valid]


def cell(camera: Camera, kind: str) -> str:
    """Return what a format makes of a camera: the largest error after writing and reading."""
    known = FOREIGN_FORMATS[kind]
    assert known.write is not None
    try:
        written = known.write(camera, None)
        back = known.read(written.text, kind, None)
    except RigkitError:
        return "cannot"
    pixels, rays = pixels_and_rays(camera)
    found, valid = back.project(rays)
    off = np.linalg.norm(found - pixels, axis=1)[valid]
    words = f"{off.max():.1e}" if off.max() < EXACT_PX else f"{off.max():.2g}"
    share = "" if valid.all() else f" over {valid.mean():.0%}"
    return words + share + (", refitted" if written.max_error_px > 0.0 else "")


def by_opencv(camera: Camera) -> float | None:
    """Return the largest error of OpenCV's own projection with what its own reader has of the file."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "camera.yaml"
        path.write_text(write_opencv(camera).text)
        stored = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
        K, d = stored.getNode("camera_matrix").mat(), stored.getNode("distortion_coefficients").mat()
        stored.release()
    pixels, rays = pixels_and_rays(camera)
    points = np.ascontiguousarray(rays[:, None, :])
    zero = np.zeros(3)
    if camera.model == "kannala_brandt":
        found, _ = cv2.fisheye.projectPoints(points, zero, zero, K, d.reshape(-1, 1)[:4])
    elif camera.model in ("pinhole", "brown"):
        found, _ = cv2.projectPoints(points, zero, zero, K, d)
    else:
        return None
    return float(np.linalg.norm(found.reshape(-1, 2) - pixels, axis=1).max())


def by_pycolmap(camera: Camera) -> float | None:
    """Return the largest error of pycolmap's own projection of the line that COLMAP's file has; its pixels count from
    the corner of the image."""
    import pycolmap

    try:
        text = write_colmap_cameras({1: camera})[0]
    except RigkitError:
        return None
    words = next(line for line in text.splitlines() if line and not line.startswith("#")).split()
    theirs = pycolmap.Camera(
        model=words[1], width=int(words[2]), height=int(words[3]), params=[float(v) for v in words[4:]]
    )
    pixels, rays = pixels_and_rays(camera)
    found = np.asarray(theirs.img_from_cam(rays / rays[:, 2:]))
    return float(np.linalg.norm(found - 0.5 - pixels, axis=1).max())


def by_mrcal(camera: Camera) -> float | None:
    """Return the largest error of mrcal's own projection with what its own reader has of the file."""
    pixels, rays = pixels_and_rays(camera)
    found = own_readers.mrcal_projects(write_cameramodel(camera).text, rays)
    return None if found is None else float(np.linalg.norm(found[0] - pixels, axis=1).max())


def by_ros(camera: Camera) -> float | None:
    """Return the largest error of a projection with what ROS's own reader has of the file."""
    pixels, rays = pixels_and_rays(camera)
    found = own_readers.ros_projects(write_camera_info(camera).text, rays)
    return None if found is None else float(np.linalg.norm(found - pixels, axis=1).max())


RIGHT_FROM_LEFT = Rigid3(exp_so3(np.array([0.02, -0.1, 0.03])), [-250.0, 4.0, 9.0])
MM_PER_M = 1000.0


def _mount_by_opencv(text: str) -> Rigid3:
    stored = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
    rotation, translation = stored.getNode("R").mat(), stored.getNode("T").mat()
    stored.release()
    return Rigid3(rotation, translation.ravel())


def _mount_by_ros(left: str, right: str) -> Rigid3:
    """A point of the rectified right camera is R_right x; P_right shifts it along the rows, in metres."""
    turns, shift = [], np.zeros(3)
    for text in (left, right):
        info = yaml.safe_load(text)
        turns.append(np.array(info["rectification_matrix"]["data"]).reshape(3, 3))
        projection = np.array(info["projection_matrix"]["data"]).reshape(3, 4)
        shift = np.array([projection[0, 3] / projection[0, 0], 0.0, 0.0])
    return Rigid3(turns[1].T @ turns[0], MM_PER_M * turns[1].T @ shift)


def _mount_by_kalibr(text: str) -> Rigid3:
    pose = np.array(yaml.safe_load(text)["cam1"]["T_cn_cnm1"])
    return Rigid3(pose[:3, :3], MM_PER_M * pose[:3, 3])


def _mount_by_mrcal(right: str) -> Rigid3 | None:
    found = own_readers.mrcal_projects(right, np.array([[0.0, 0.0, 1.0]]))
    return None if found is None else found[1]


MOUNTS: dict[str, Callable[..., Rigid3 | None]] = {
    "opencv": lambda text: _mount_by_opencv(text),
    "ros": _mount_by_ros,
    "kalibr": _mount_by_kalibr,
    "mrcal": lambda _, right: _mount_by_mrcal(right),
    "colmap": own_readers.colmap_mount,
}
"""Format -> right_from_left of its files, by the rules of that format, with nothing of rigkit's own readers; None where
its own reader is not installed."""
READ_BY = {
    "opencv": "`cv2.FileStorage`: R, T",
    "ros": "a YAML parser: R and P of both",
    "kalibr": "a YAML parser: T_cn_cnm1",
    "mrcal": "`mrcal.cameramodel`",
    "colmap": "`pycolmap.read_rig_config`",
}


def rigs_table() -> str:
    """Return what each format makes of a rig of two cameras, as Markdown."""
    lines = [
        "| format | read by | turned, deg | moved, mm | lenses, px | a point 1 m away, seen by right, px |",
        "| :-- | :-- | --: | --: | --: | --: |",
    ]
    left = lens_as("kannala_brandt")
    rig = {"left": (left, Rigid3.identity()), "right": (left, RIGHT_FROM_LEFT)}
    rays = pixels_and_rays(left)[1]
    points = rays / rays[:, 2:] * MM_PER_M
    for kind in RIG_FORMATS:
        written = write_rig(rig, kind)
        found = MOUNTS[kind](*written.files.values())
        if found is None:
            lines.append(f"| {kind} | {READ_BY[kind]} | - | - | {written.max_error_px:.1e} | - |")
            continue
        change = found @ RIGHT_FROM_LEFT.inverse()
        turned = np.degrees(np.linalg.norm(cv2.Rodrigues(change.rotation)[0]))
        moved = float(np.linalg.norm(found.inverse().translation_mm - RIGHT_FROM_LEFT.inverse().translation_mm))
        (seen, both), (truth, there) = (left.project(pose.apply(points)) for pose in (found, RIGHT_FROM_LEFT))
        off = float(np.linalg.norm(seen - truth, axis=1)[both & there].max())
        figures = " | ".join(f"{value:.1e}" for value in (turned, moved, written.max_error_px, off))
        lines.append(f"| {kind} | {READ_BY[kind]} | {figures} |")
    by_ros = stereo_by_ros()
    if by_ros is not None:
        lines.append(
            "\nROS's own reader and `image_geometry.StereoCameraModel`, a stereo pair of Brown lenses: raw pixels of "
            f"points within {by_ros[0]:.1e} px, the points of their disparities within {by_ros[1]:.1e} mm."
        )
    return "\n".join(lines) + "\n"


def stereo_by_ros() -> tuple[float, float] | None:
    """Return how far raw pixels (px) and points of disparities (mm) by ROS's own code are from ours, of points 1 m away
    that both cameras of a stereo pair of Brown lenses see."""
    lens = lens_as("brown")
    files = write_rig({"left": (lens, Rigid3.identity()), "right": (lens, RIGHT_FROM_LEFT)}, "ros").files
    rays = pixels_and_rays(lens)[1]
    points = rays / rays[:, 2:] * MM_PER_M
    there, seen = lens.project(RIGHT_FROM_LEFT.apply(points))
    points = points[seen & np.all((there >= 0.0) & (there < lens.size_px), axis=1)]
    ours = np.stack([lens.project(pose.apply(points))[0] for pose in (Rigid3.identity(), RIGHT_FROM_LEFT)])
    turn = np.array(yaml.safe_load(files["left"])["rectification_matrix"]["data"]).reshape(3, 3)
    read = own_readers.ros_stereo(files["left"], files["right"], points @ turn.T)
    if read is None:
        return None
    raw, found = read
    return float(np.linalg.norm(raw - ours, axis=2).max()), float(np.linalg.norm(found @ turn - points, axis=1).max())


READERS = {
    "OpenCV's own": by_opencv,
    "ROS's own": by_ros,
    "pycolmap's own": by_pycolmap,
    "mrcal's own": by_mrcal,
}


def table() -> str:
    """Return the table as Markdown."""
    head = ["model", *FORMATS, *READERS]
    lines = [f"| {' | '.join(head)} |", "| :-- " + "| --: " * (len(head) - 1) + "|"]
    for model, order in ((name, order) for name in MODELS for order in ORDERS.get(name, (None,))):
        camera = lens_as(model, order)
        own = [reader(camera) for reader in READERS.values()]
        cells = [cell(camera, kind) for kind in FORMATS] + ["-" if v is None else f"{v:.1e}" for v in own]
        lines.append(f"| `{model}`{'' if order is None else f' {order}'} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def main() -> int:
    print(f"{table()}\n{rigs_table()}", end="")
    return 0


if __name__ == "__main__":
    sys.exit(main())
