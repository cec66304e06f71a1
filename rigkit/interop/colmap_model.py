"""A pair and its cloud as a text model of COLMAP: cameras.txt, images.txt, points3D.txt."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from rigkit.cameras.base import Camera
from rigkit.core.arrays import FloatArray, Mat3, Pixels
from rigkit.core.cloud import OrientedCloud
from rigkit.geometry.rigid3 import Rigid3
from rigkit.interop.colmap import HALF_PIXEL
from rigkit.interop.colmap_cameras import write_colmap_cameras


def colmap_model(
    cameras: tuple[Camera, Camera],
    cam2_from_cam1: Rigid3,
    pixels: tuple[Pixels, Pixels],
    cloud: OrientedCloud,
    images: tuple[Path, Path],
    *,
    error_px: float,
) -> tuple[dict[str, str], tuple[str, ...]]:
    """Return the files by name, and notes; a lens that COLMAP has no model for is refitted, with a note on the error.

    Parameters
    ----------
    cameras : cameras of the two images; the same object twice becomes one camera of the model.
    cam2_from_cam1 : in mm; the world frame is that of camera 1.
    pixels : (N, 2) pixels of the points in each image.
    cloud : N points.
    images : the two image files. The model names them by their paths relative to their common folder, which is
        COLMAP's image folder.
    error_px : error that is stated for every point.
    """
    one = cameras[0] is cameras[1]
    text, written = write_colmap_cameras({1: cameras[0]} if one else {1: cameras[0], 2: cameras[1]})
    names, renamed = _names(images)
    notes = (*(w.note for w in written.values() if w.note), *renamed)
    lines = ["# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, then X Y POINT3D_ID of every corner"]
    for number, pose in ((1, Rigid3.identity()), (2, cam2_from_cam1)):
        numbers = [*quaternion_wxyz(pose.rotation), *pose.translation_mm]
        head = " ".join(f"{v:.17g}" for v in numbers)
        lines += [f"{number} {head} {1 if one else number} {names[number - 1]}", _observations(pixels[number - 1])]
    points = ["# POINT3D_ID X Y Z R G B ERROR TRACK as (IMAGE_ID POINT2D_IDX)"]
    for n, (x, colour) in enumerate(zip(cloud.points_mm, cloud.colours, strict=True)):
        place = " ".join(f"{v:.17g}" for v in x)
        points.append(f"{n + 1} {place} {' '.join(map(str, colour))} {error_px:.6g} 1 {n} 2 {n}")
    files = {"cameras.txt": text, "images.txt": "\n".join(lines) + "\n", "points3D.txt": "\n".join(points) + "\n"}
    return files, notes


def _names(images: tuple[Path, Path]) -> tuple[list[str], tuple[str, ...]]:
    """Return different names of the images without blanks, and notes on files to rename."""
    whole = [Path(os.path.abspath(path)) for path in images]
    folder = os.path.commonpath([path.parent for path in whole])
    names = [path.relative_to(folder).as_posix() for path in whole]
    blank = [name for name in names if name.split() != [name]]
    if not blank:
        return names, ()
    words = f"COLMAP ends a name at its first blank: '{blank[0]}' is written with '_' instead; rename the file to match"
    return ["_".join(name.split(" ")) for name in names], (words,)


def _observations(pixels: Pixels) -> str:
    return " ".join(f"{u:.9g} {v:.9g} {n + 1}" for n, (u, v) in enumerate(pixels + HALF_PIXEL))


def quaternion_wxyz(rotation: Mat3) -> FloatArray:
    """Return the quaternion (w, x, y, z) of a rotation, in COLMAP's order."""
    from scipy.spatial.transform import Rotation

    return np.roll(Rotation.from_matrix(np.array(rotation)).as_quat(), 1)
