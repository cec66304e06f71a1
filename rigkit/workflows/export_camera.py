"""Cameras and rigs in other tools' formats, in and out."""

from __future__ import annotations

import logging
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from rigkit.cameras.base import Camera
from rigkit.core.errors import InputError
from rigkit.interop.colmap_cameras import read_colmap_cameras, write_colmap_cameras
from rigkit.interop.kalibr import read_kalibr, write_kalibr
from rigkit.interop.mrcal import read_cameramodel, write_cameramodel
from rigkit.interop.ocamcalib import read_ocamcalib, write_ocamcalib
from rigkit.interop.opencv import read_opencv, write_opencv
from rigkit.interop.ros import read_camera_info, write_camera_info
from rigkit.io.calibration_file import load_camera, refuse_mirrored, save_camera
from rigkit.io.files import ensure_writable, write_atomic
from rigkit.io.reading import read_text
from rigkit.io.rig_file import load_rig
from rigkit.workflows.formats import CAMERA_FORMATS, FOREIGN_ENDINGS

__all__ = [
    "ExportCameraOptions",
    "ExportedCamera",
    "camera_format",
    "export_camera",
    "export_rig",
    "foreign_files",
    "foreign_paths",
    "import_camera",
]

SIGNS = (
    ("mrcal", re.compile(r"['\"]lens_?model['\"]\s*:")),
    ("rigkit", re.compile(r'\A\s*\{\s*["}]')),
    ("ocamcalib", re.compile(r"\A\s*#\s*polynomial coefficients", re.IGNORECASE)),
    ("kalibr", re.compile(r"^cam\d+\s*:", re.MULTILINE)),
    ("opencv", re.compile(r"!!opencv-matrix|<opencv_storage>|\A%YAML")),
    ("ros", re.compile(r"^distortion_model\s*:", re.MULTILINE)),
    ("colmap", re.compile(r"^\s*\d+\s+[A-Z][A-Z_]+\s+\d+\s+\d+\s+[-+.\d]", re.MULTILINE)),
)
"""Format -> what its files have and those of the formats after it in this list have not."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True)
class ExportCameraOptions:
    """Which format goes where."""

    output: Path
    """File to write."""
    kind: str | None = None
    """Format, one of `CAMERA_FORMATS`; None: ours where the name ends on .json."""
    source_kind: str | None = None
    """Format of the camera given; None: told by its content."""
    force: bool = False
    """Replace a file that exists; what was read is never replaced."""


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class ExportedCamera:
    """What was written: the camera given, the format, and the file's largest error against the camera, in px."""

    camera: Camera
    kind: str
    max_error_px: float


def import_camera(path: str | Path, kind: str | None = None) -> Camera:
    """Return the camera of a file, of ours or of another tool's; `kind` is told by the content where it is None.

    Raises InputError for a file that is no camera of that format, holds several, or whose format nobody can tell.
    """
    source = Path(path)
    text, name = read_text(source, "camera file"), str(source)
    kind = kind or camera_format(text)
    if kind is None:
        raise InputError(f"'{name}': none of the known camera formats ({', '.join(CAMERA_FORMATS)}); check the file")
    if kind not in CAMERA_FORMATS:
        raise InputError(f"'{kind}' is no camera format; known are {', '.join(CAMERA_FORMATS)}")
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
    return read_opencv(text, name) if kind == "opencv" else read_camera_info(text, name)


def camera_format(text: str) -> str | None:
    """Return the format of a camera file's content, one of `CAMERA_FORMATS`; None where none of them looks so."""
    return next((kind for kind, sign in SIGNS if sign.search(text)), None)


def export_camera(source: str | Path, options: ExportCameraOptions) -> ExportedCamera:
    """Write the camera of a file in another format; what a user of the new file should know goes to the log.

    Raises InputError for no camera, a format that cannot follow it, or a file that cannot be written.
    """
    kind = options.kind or ("rigkit" if options.output.suffix == ".json" else None)
    if kind not in CAMERA_FORMATS:
        raise InputError(f"export: say the camera's format with --to, one of {', '.join(CAMERA_FORMATS)}")
    ensure_writable(options.output, force=options.force, inputs=[source])
    camera = import_camera(source, options.source_kind)
    refuse_mirrored(camera, source)
    if kind == "rigkit":
        save_camera(options.output, camera, force=options.force)
        return ExportedCamera(camera=camera, kind=kind, max_error_px=0.0)
    text, worst_px, words = _foreign(camera, kind)
    write_atomic(options.output, text, force=options.force)
    if words:
        _log.info(words)
    return ExportedCamera(camera=camera, kind=kind, max_error_px=worst_px)


def export_rig(source: str | Path, options: ExportCameraOptions) -> float:
    """Write a rig's file as Kalibr's camchain; return its largest error against the rig, in px.

    Raises InputError for no rig, another format, or a file that cannot be written.
    """
    if options.kind != "kalibr":
        raise InputError(
            f"export: '{source}' is a rig, which goes out with --to kalibr; for other formats export the "
            f"calibrations of its cameras, beside it: {Path(source).stem}-CAMERA.json"
        )
    ensure_writable(options.output, force=options.force, inputs=[source])
    rig = load_rig(source)
    chain = write_kalibr([camera for camera, _ in rig.values()], [pose for _, pose in rig.values()])
    write_atomic(options.output, chain.text, force=options.force)
    for k, (name, one) in enumerate(zip(rig, chain.cameras, strict=True)):
        _log.info(f"cam{k} is '{name}'" + (f"; {one.note}" if one.note else ""))
    return max(one.max_error_px for one in chain.cameras)


def foreign_files(camera: Camera, beside: Path, kinds: Sequence[str]) -> dict[Path, str]:
    """Return the files (path -> content) of a camera in other tools' formats, named after the calibration `beside`
    which they lie; what a user of them should know goes to the log.

    Raises InputError for a format that cannot follow the camera.
    """
    files = {}
    for kind, path in zip(kinds, foreign_paths(beside, kinds), strict=True):
        files[path], worst_px, words = _foreign(camera, kind)
        _log.info(f"{path}: {kind}, at most {worst_px:.4g} px from the calibration" + (f"; {words}" if words else ""))
    return files


def foreign_paths(beside: Path, kinds: Sequence[str]) -> list[Path]:
    """Return where `foreign_files` go; raises InputError for a format that nobody knows."""
    unknown = [kind for kind in kinds if kind not in FOREIGN_ENDINGS]
    if unknown:
        raise InputError(f"export: '{unknown[0]}' is none of the formats {', '.join(FOREIGN_ENDINGS)}")
    return [beside.with_name(f"{beside.stem}-{kind}{FOREIGN_ENDINGS[kind]}") for kind in kinds]


def _only(cameras: tuple[Camera, ...], name: str) -> Camera:
    if len(cameras) != 1:
        raise InputError(f"'{name}' holds {len(cameras)} cameras; leave the one that you want in it")
    return cameras[0]


def _foreign(camera: Camera, kind: str) -> tuple[str, float, str]:
    """Return the file's text, its largest error in px, and what a user should know."""
    if kind == "kalibr":
        chain = write_kalibr([camera])
        one = chain.cameras[0]
        return chain.text, one.max_error_px, one.note
    if kind == "colmap":
        text, lines = write_colmap_cameras({1: camera})
        return text, lines[1].max_error_px, lines[1].note
    write = {
        "opencv": write_opencv,
        "ros": write_camera_info,
        "ocamcalib": write_ocamcalib,
        "mrcal": write_cameramodel,
    }[kind]
    done = write(camera)
    return done.text, done.max_error_px, done.note
