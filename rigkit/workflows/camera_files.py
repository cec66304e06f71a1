"""Cameras and rigs from files, of ours and of other tools, told by their content."""

from __future__ import annotations

import logging
import re
from pathlib import Path

from rigkit.cameras.base import Camera
from rigkit.core.errors import InputError
from rigkit.geometry.rigid3 import Rigid3
from rigkit.interop.colmap_cameras import read_colmap_cameras
from rigkit.interop.kalibr import read_kalibr
from rigkit.interop.mrcal import read_cameramodel
from rigkit.interop.ocamcalib import read_ocamcalib, read_py_ocamcalib
from rigkit.interop.opencv import read_opencv
from rigkit.interop.opencv_stereo import read_opencv_stereo
from rigkit.interop.ros import read_camera_info
from rigkit.io.calibration_file import load_camera
from rigkit.io.reading import read_text
from rigkit.io.rig_file import is_rig_file, load_rig
from rigkit.workflows.formats import READ_FORMATS

SIGNS = (
    ("mrcal", re.compile(r"['\"]lens_?model['\"]\s*:")),
    ("py-ocamcalib", re.compile(r'\A\s*\{.*"taylor_coefficient"\s*:', re.DOTALL)),
    ("rigkit", re.compile(r'\A\s*\{\s*["}]')),
    ("ocamcalib", re.compile(r"\A\s*#\s*polynomial coefficients", re.IGNORECASE)),
    ("kalibr", re.compile(r"^cam\d+\s*:", re.MULTILINE)),
    ("opencv", re.compile(r"!!opencv-matrix|<opencv_storage>|\A%YAML")),
    ("ros", re.compile(r"^distortion_model\s*:", re.MULTILINE)),
    ("colmap", re.compile(r"^\s*\d+\s+[A-Z][A-Z_]+\s+\d+\s+\d+\s+[-+.\d]", re.MULTILINE)),
)
"""Format -> what its files have and those of the formats after it in this list have not."""

STEREO = re.compile(r"^M1\s*:", re.MULTILINE)
"""What OpenCV's files of pairs have."""

_log = logging.getLogger(__name__)


def import_camera(path: str | Path, kind: str | None = None, *, size_px: tuple[int, int] | None = None) -> Camera:
    """Return the camera of a file, of ours or of another tool's; `kind` is told by the content where it is None.

    `size_px` is what py-OCamCalib's files do not say, the images' size; all others say it, and need none.

    Raises InputError for a file that is no camera of that format, holds several, or whose format nobody can tell.
    """
    source = Path(path)
    text, name = read_text(source, "camera file"), str(source)
    kind = kind or camera_format(text)
    if kind is None:
        raise InputError(f"'{name}': none of the known camera formats ({', '.join(READ_FORMATS)}); check the file")
    if kind not in READ_FORMATS:
        raise InputError(f"'{kind}' is no camera format; known are {', '.join(READ_FORMATS)}")
    if kind == "rigkit":
        return load_camera(source)
    if kind == "kalibr":
        return _only(read_kalibr(text, name)[0], name)
    if kind == "colmap":
        return _only(tuple(read_colmap_cameras(text, name).values()), name)
    if kind == "mrcal":
        camera, _, worst = read_cameramodel(text, name)
        if worst > 0.0:
            _log.info(f"the spline was refitted as '{camera.model}', at most {worst:.4g} px away")
        return camera
    if kind == "ocamcalib":
        return read_ocamcalib(text, name)[0]
    if kind == "py-ocamcalib":
        if size_px is None:
            raise InputError(f"'{name}': py-OCamCalib writes no image size; use `rigkit export --size`")
        return read_py_ocamcalib(text, size_px, name)[0]
    return read_opencv(text, name) if kind == "opencv" else read_camera_info(text, name)


def camera_format(text: str) -> str | None:
    """Return the format of a camera file's content, one of `READ_FORMATS`; None where none of them looks so."""
    return next((kind for kind, sign in SIGNS if sign.search(text)), None)


def is_ours(path: str | Path) -> bool:
    """Say whether the file is of rigkit's own format; raises InputError for one that cannot be read."""
    return camera_format(read_text(path, "camera file")) == "rigkit"


def is_rig(path: str | Path) -> bool:
    """Say whether the file is one of several cameras, ours or another tool's; False for what cannot be read."""
    if is_rig_file(path):
        return True
    try:
        text = read_text(path, "rig file")
    except InputError:
        return False
    kind = camera_format(text)
    return (kind == "kalibr" and "T_cn_cnm1" in text) or (kind == "opencv" and STEREO.search(text) is not None)


def import_rig(path: str | Path) -> dict[str, tuple[Camera, Rigid3]]:
    """Return camera and cam_from_rig (mm) by name: of our rig's file, Kalibr's camchain, or OpenCV's file of a pair.

    Kalibr's cameras are called cam0, cam1 ..., OpenCV's left and right. Raises InputError for any other file, and a
    damaged one.
    """
    if is_rig_file(path):
        return load_rig(path)
    text, name = read_text(path, "rig file"), str(path)
    kind = camera_format(text)
    if kind == "kalibr":
        cameras, poses = read_kalibr(text, name)
        return {f"cam{k}": one for k, one in enumerate(zip(cameras, poses, strict=True))}
    if kind == "opencv" and STEREO.search(text):
        (left, right), right_from_left = read_opencv_stereo(text, name)
        return {"left": (left, Rigid3.identity()), "right": (right, right_from_left)}
    if kind == "rigkit":
        return load_rig(path)
    raise InputError(f"'{name}': no rig of rigkit, Kalibr (camchain) or OpenCV (M1, D1, M2, D2, R, T); check the file")


def _only(cameras: tuple[Camera, ...], name: str) -> Camera:
    if len(cameras) != 1:
        raise InputError(f"'{name}' holds {len(cameras)} cameras; leave the one that you want in it")
    return cameras[0]
