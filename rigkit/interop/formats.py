"""Camera formats by name: the table that commands choose from. A new format is one file and one line here."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from rigkit.cameras.base import Camera
from rigkit.errors import InputError
from rigkit.interop.colmap_cameras import read_colmap_cameras, write_colmap_cameras
from rigkit.interop.exchange import Written
from rigkit.interop.kalibr import read_kalibr, write_kalibr
from rigkit.interop.mrcal import read_cameramodel, write_cameramodel
from rigkit.interop.ocamcalib import read_ocamcalib, write_ocamcalib
from rigkit.interop.opencv import read_opencv, write_opencv
from rigkit.interop.ros import read_camera_info, write_camera_info

__all__ = ["CAMERA_FORMATS", "CameraFormat", "camera_format"]


@dataclass(frozen=True, eq=False, slots=True)
class CameraFormat:
    """How a file of one camera is written and read; `read` takes the text and the name that errors call it."""

    title: str
    write: Callable[[Camera], Written]
    read: Callable[[str, str], Camera]


def _write_kalibr(camera: Camera) -> Written:
    return write_kalibr([camera]).cameras[0]


def _read_kalibr(text: str, name: str) -> Camera:
    return _only(dict(enumerate(read_kalibr(text, name)[0])), name)


def _write_colmap(camera: Camera) -> Written:
    text, cameras = write_colmap_cameras({1: camera})
    w = cameras[1]
    return Written(text, w.camera, w.max_error_px, w.rms_error_px, w.covered, w.note)


def _read_colmap(text: str, name: str) -> Camera:
    return _only(read_colmap_cameras(text, name), name)


def _only(cameras: dict[int, Camera], name: str) -> Camera:
    if len(cameras) != 1:
        raise InputError(f"'{name}': {len(cameras)} cameras in it; keep the one you want and try again")
    return next(iter(cameras.values()))


CAMERA_FORMATS: dict[str, CameraFormat] = {
    "opencv": CameraFormat("OpenCV calibration YAML", write_opencv, read_opencv),
    "kalibr": CameraFormat("Kalibr camchain YAML", _write_kalibr, _read_kalibr),
    "ros": CameraFormat("ROS camera_info YAML", write_camera_info, read_camera_info),
    "colmap": CameraFormat("COLMAP cameras.txt", _write_colmap, _read_colmap),
    "ocamcalib": CameraFormat("OCamCalib calib_results.txt", write_ocamcalib, lambda t, n: read_ocamcalib(t, n)[0]),
    "mrcal": CameraFormat("mrcal .cameramodel", write_cameramodel, lambda t, n: read_cameramodel(t, n)[0]),
}


def camera_format(name: str) -> CameraFormat:
    """Return the format called `name`; raises InputError that lists the known ones."""
    if name not in CAMERA_FORMATS:
        raise InputError(f"camera format '{name}' is unknown; known: {', '.join(CAMERA_FORMATS)}")
    return CAMERA_FORMATS[name]
