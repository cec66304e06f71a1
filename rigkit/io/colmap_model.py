"""A reconstruction as COLMAP's text model: cameras.txt, images.txt, points3D.txt."""

from __future__ import annotations

import numpy as np

from rigkit.arrays import FloatArray, Mat3, Pixels
from rigkit.geometry.rigid3 import Rigid3
from rigkit.interop.colmap import HALF_PIXEL
from rigkit.interop.colmap_cameras import write_colmap_cameras
from rigkit.reconstruct import Reconstruction

__all__ = ["colmap_model"]


def colmap_model(reconstruction: Reconstruction, names: tuple[str, str]) -> tuple[dict[str, str], tuple[str, ...]]:
    """Return the files by name, and what was lost on the way in words.

    Parameters
    ----------
    reconstruction : of one pair; the world is camera 1, lengths are mm.
    names : file names of the two images.

    Notes
    -----
    Where both images are of one camera object, the model has one camera. A lens that COLMAP has no model for is
    refitted, and its largest error stated.
    """
    one = reconstruction.camera1 is reconstruction.camera2
    cameras = {1: reconstruction.camera1} if one else {1: reconstruction.camera1, 2: reconstruction.camera2}
    text, written = write_colmap_cameras(cameras)
    notes = tuple(w.note for w in written.values() if w.note)
    views = ((Rigid3.identity(), reconstruction.pixels1, 1), (reconstruction.cam2_from_cam1, reconstruction.pixels2, 2))
    images = ["# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, then X Y POINT3D_ID of every corner"]
    for (pose, pixels, number), name in zip(views, names, strict=True):
        numbers = [*_quaternion(pose.rotation), *pose.translation_mm]
        head = " ".join(f"{v:.17g}" for v in numbers)
        images += [f"{number} {head} {1 if one else number} {name}", _observations(pixels)]
    cloud = reconstruction.cloud
    points = ["# POINT3D_ID X Y Z R G B ERROR TRACK as (IMAGE_ID POINT2D_IDX)"]
    for n, (x, colour) in enumerate(zip(cloud.points_mm, cloud.colours, strict=True)):
        place = " ".join(f"{v:.17g}" for v in x)
        points.append(f"{n + 1} {place} {' '.join(map(str, colour))} {reconstruction.sampson_rms_px:.6g} 1 {n} 2 {n}")
    files = {
        "cameras.txt": text,
        "images.txt": "\n".join(images) + "\n",
        "points3D.txt": "\n".join(points) + "\n",
    }
    return files, notes


def _observations(pixels: Pixels) -> str:
    return " ".join(f"{u:.9g} {v:.9g} {n + 1}" for n, (u, v) in enumerate(pixels + HALF_PIXEL))


def _quaternion(rotation: Mat3) -> FloatArray:
    """Return (w, x, y, z) of a rotation, COLMAP's order."""
    from scipy.spatial.transform import Rotation

    return np.roll(Rotation.from_matrix(rotation).as_quat(), 1)
