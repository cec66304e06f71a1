"""Registry of other programs' camera formats, with their signs, readers and writers.

A new format needs a module, a line here and, if it is written, its ending in `rigkit.workflows.inputs.formats`.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

from rigkit.cameras.base import Camera
from rigkit.core.arrays import Pixels
from rigkit.core.errors import InputError
from rigkit.interop.colmap_cameras import read_colmap_cameras, write_colmap_cameras
from rigkit.interop.exchange import Written
from rigkit.interop.kalibr import read_kalibr, write_kalibr
from rigkit.interop.matlab import MAT_SIGN, read_matlab
from rigkit.interop.mrcal import read_cameramodel, write_cameramodel
from rigkit.interop.ocamcalib import read_ocamcalib, read_py_ocamcalib, write_ocamcalib
from rigkit.interop.opencv import read_opencv, write_opencv
from rigkit.interop.opencv_storage import STORAGE
from rigkit.interop.ros import OST, read_camera_info, write_camera_info

SizePx = tuple[int, int]

_log = logging.getLogger(__name__)


class CameraFormat(NamedTuple):
    """A format of one camera a file.

    Attributes
    ----------
    sign : pattern in its files that files of later formats in `FOREIGN_FORMATS` lack.
    read : function of text, file name and image size (for formats without one) that returns the camera.
    write : function of a camera and the outline of the pixels that corners covered (None: the whole image, see
        `best_accepted`) that returns the file; None for formats that are only read.
    """

    sign: re.Pattern[str]
    read: Callable[[str, str, SizePx | None], Camera]
    write: Callable[[Camera, Pixels | None], Written] | None = None


def _read_mrcal(text: str, name: str, size_px: SizePx | None) -> Camera:
    camera, _, worst = read_cameramodel(text, name)
    if worst > 0.0:
        _log.info(f"{name}: the lens was refitted as '{camera.model}', at most {worst:.2g} px away")
    return camera


def _read_py_ocamcalib(text: str, name: str, size_px: SizePx | None) -> Camera:
    if size_px is None:
        raise InputError(f"'{name}': py-OCamCalib writes no image size; use `rigkit export --size`")
    return read_py_ocamcalib(text, size_px, name)[0]


def _write_colmap(camera: Camera, outline: Pixels | None) -> Written:
    text, lines = write_colmap_cameras({1: camera}, {} if outline is None else {1: outline})
    return replace(lines[1], text=text)


def _single_camera(cameras: tuple[Camera, ...], name: str) -> Camera:
    if len(cameras) != 1:
        raise InputError(
            f"'{name}' holds {len(cameras)} cameras; `rigkit export {name} --names cam0 -o cam0.json` takes out one"
        )
    return cameras[0]


FOREIGN_FORMATS: dict[str, CameraFormat] = {
    "mrcal": CameraFormat(
        re.compile(r"['\"]lens_?model['\"]\s*:"), _read_mrcal, lambda c, outline: write_cameramodel(c, outline=outline)
    ),
    "py-ocamcalib": CameraFormat(re.compile(r'\A\s*\{.*"taylor_coefficient"\s*:', re.DOTALL), _read_py_ocamcalib),
    "ocamcalib": CameraFormat(
        re.compile(r"\A\s*#\s*polynomial coefficients", re.IGNORECASE),
        lambda text, name, _: read_ocamcalib(text, name)[0],
        write_ocamcalib,
    ),
    "kalibr": CameraFormat(
        re.compile(r"^cam\d+\s*:", re.MULTILINE),
        lambda text, name, _: _single_camera(read_kalibr(text, name)[0], name),
        lambda c, outline: write_kalibr([c], outlines=[outline]).cameras[0],
    ),
    "matlab": CameraFormat(MAT_SIGN, read_matlab),
    "opencv": CameraFormat(STORAGE, read_opencv, write_opencv),
    "ros": CameraFormat(
        re.compile(rf"^distortion_model\s*:|{OST.pattern}", re.MULTILINE),
        lambda text, name, _: read_camera_info(text, name),
        lambda c, outline: write_camera_info(c, outline=outline),
    ),
    "colmap": CameraFormat(
        re.compile(r"^\s*\d+\s+[A-Z][A-Z_]+\s+\d+\s+\d+\s+[-+.\d]", re.MULTILINE),
        lambda text, name, _: _single_camera(tuple(read_colmap_cameras(text, name).values()), name),
        _write_colmap,
    ),
}
"""Formats by name, in the order in which their signs are searched."""
