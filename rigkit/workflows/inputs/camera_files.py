"""Cameras and rigs from rigkit's files and other tools' files; the format is recognised by the content."""

from __future__ import annotations

import logging
import re
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np

from rigkit.calibration.result import Calibration
from rigkit.cameras.base import Camera
from rigkit.cameras.moving_pupil import pupil_shift_of_rays_mm
from rigkit.core.arrays import FloatArray, Pixels
from rigkit.core.errors import InputError
from rigkit.core.findings import Finding, Severity
from rigkit.core.identifiers import known_name
from rigkit.geometry.rigid3 import Rigid3
from rigkit.interop.camera_formats import FOREIGN_FORMATS
from rigkit.interop.colmap_cameras import colmap_cameras_text
from rigkit.interop.colmap_rig import read_colmap_rig
from rigkit.interop.kalibr import read_kalibr
from rigkit.interop.matlab import is_matlab_pair, matlab_text, read_matlab_pair
from rigkit.interop.opencv import read_opencv_stereo
from rigkit.io.calibrations.calibration_file import load_calibration_or_camera
from rigkit.io.calibrations.rig_file import SavedRig, is_rig_file, load_rig, load_saved_rig
from rigkit.io.disk.reading import read_bytes, read_text
from rigkit.workflows.inputs.formats import READ_FORMATS

_log = logging.getLogger(__name__)

OURS = re.compile(r'\A\s*\{\s*["}]')
"""Start of a JSON object: rigkit's files, and those of the formats `JSON_TOO`."""
JSON_TOO = ("mrcal", "py-ocamcalib", "opencv")
STEREO = re.compile(r'^\s*["<]?M1\b', re.MULTILINE)
"""Key that OpenCV's stereo files have and single cameras lack."""
COLMAP_RIG = re.compile(r'"image_prefix"\s*:')
"""Key of COLMAP's rig_config.json."""


def import_camera(path: str | Path, kind: str | None = None, *, size_px: tuple[int, int] | None = None) -> Camera:
    """Return the central camera of a file of rigkit or another tool; warns if the entrance pupil moves.

    `kind` is the format; None: recognised by the content. `size_px` is the image size, which files of py-OCamCalib and
    some of MATLAB do not state.

    Raises InputError for a file of unknown format, one that is no camera of the format, or one with several cameras.
    """
    known = _camera_or_calibration(Path(path), kind, size_px)
    if isinstance(known, Camera):
        return known
    warn_of_pupil(path, known)
    return known.camera


def import_near_camera(path: str | Path) -> Camera:
    """Return the camera of a file for points in mm: a `NearCamera` if the pupil moves, else as `import_camera`."""
    known = _camera_or_calibration(Path(path), None, None)
    return known if isinstance(known, Camera) else known.near


def _camera_or_calibration(source: Path, kind: str | None, size_px: tuple[int, int] | None) -> Camera | Calibration:
    """Return the calibration or camera of a file; warns of a calibration with a verdict BAD."""
    text, name = camera_text(source), str(source)
    kind = kind or camera_format(text)
    if kind is None:
        if COLMAP_RIG.search(text):
            raise InputError(f"'{name}' is a rig; `rigkit export {name} --names CAMERA -o CAMERA.json` takes out one")
        raise InputError(f"'{name}': none of the known camera formats ({', '.join(READ_FORMATS)}); check the file")
    if kind not in READ_FORMATS:
        raise InputError(f"'{kind}' is no camera format; known are {', '.join(READ_FORMATS)}")
    if kind == "rigkit":
        known = load_calibration_or_camera(source)
        if isinstance(known, Calibration):
            warn_if_bad(source, known.verdicts)
        return known
    return FOREIGN_FORMATS[kind].read(text, name, size_px)


def camera_text(path: str | Path) -> str:
    """Return a camera file as text; binary files of COLMAP and MATLAB are converted. Raises as `read_text`."""
    data = read_bytes(path, "camera file")
    return colmap_cameras_text(data) or matlab_text(data, str(path)) or read_text(path, "camera file")


def camera_format(text: str) -> str | None:
    """Return which of `READ_FORMATS` the content of a camera file has, or None."""
    found = next((kind for kind, known in FOREIGN_FORMATS.items() if known.sign.search(text)), None)
    return "rigkit" if OURS.search(text) and found not in JSON_TOO else found


def camera_with_calibration(path: str | Path) -> tuple[Camera, Calibration | None]:
    """Return the camera of a file of rigkit or another tool, and the calibration if it is one; raises as
    `import_camera`."""
    calibration = calibration_of_file(path)
    return (import_camera(path), None) if calibration is None else (calibration.camera, calibration)


def calibration_of_file(path: str | Path) -> Calibration | None:
    """Return the calibration in a file of rigkit's, None for any other; raises InputError if it cannot be read."""
    if camera_format(camera_text(path)) != "rigkit":
        return None
    known = load_calibration_or_camera(path)
    return known if isinstance(known, Calibration) else None


def require_covariance(source: Path) -> None:
    """Raise InputError for another program's camera file, which has no covariance."""
    if source.is_file() and camera_format(camera_text(source)) not in (None, "rigkit"):
        raise InputError(
            f"'{source}': a file of another program has no covariance, so its own error is unknown; run `rigkit "
            "calibrate` on images of boards, and give its result"
        )


def bad_verdict_in_file(path: str | Path) -> Finding | None:
    """Return the verdict BAD on a calibration or rig of rigkit's; None if it has none."""
    if is_rig_file(path):
        verdicts = load_saved_rig(path).verdicts
    else:
        known = calibration_of_file(path)
        verdicts = () if known is None else known.verdicts
    return bad_verdict(verdicts)


def bad_verdict(verdicts: Iterable[Finding]) -> Finding | None:
    """Return the first verdict of severity BAD, reworded as said of a calibration in use; None if there is none."""
    bad = next((finding for finding in verdicts if finding.severity is Severity.BAD), None)
    return None if bad is None else replace(bad, message=f"the calibration's verdict is bad: {bad.message}")


def warn_if_bad(path: str | Path, verdicts: Iterable[Finding] | None = None) -> Finding | None:
    """Warn of a file's verdict BAD, and return it, None if it has none; `verdicts` are its own, or None to read
    them."""
    bad = bad_verdict_in_file(path) if verdicts is None else bad_verdict(verdicts)
    if bad is not None:
        _log.warning("'%s': %s", path, bad.text)
    return bad


def warn_if_exact(path: str | Path, stated: object | None) -> None:
    """Warn of a file that states no uncertainty, such as one of another tool; `stated` is None then."""
    if stated is None:
        _log.warning("'%s' states no uncertainty: sigmas do not include the errors of its cameras", path)


def _neglected_pupil(which: str, camera: Camera, pupil: FloatArray, pixels: Pixels) -> str:
    """Return the note on a camera, with the largest displacement of its rays at `pixels`, mm."""
    rays = camera.unproject(pixels)[0]
    off = pupil_shift_of_rays_mm(rays, pupil) * np.hypot(rays[:, 0], rays[:, 1])
    return (
        f"the entrance pupil of {which} moves, which is left out here: what is far away is exact, near the camera "
        f"rays are off by up to {float(np.nanmax(np.abs(off))):.1f} mm"
    )


def warn_of_pupils(path: str | Path, rig: SavedRig) -> None:
    """Warn of the cameras of a rig's file whose moving entrance pupil is neglected."""
    for name, pupil in rig.pupils.items():
        if name in rig.outlines:
            note = _neglected_pupil(f"camera '{name}'", rig.cameras[name][0], pupil.terms, rig.outlines[name])
            _log.warning("'%s': %s", path, note)


def warn_of_pupil(path: str | Path, calibration: Calibration) -> None:
    """Warn if the moving entrance pupil of a file's camera is neglected."""
    if (pupil := calibration.pupil) is not None:
        note = _neglected_pupil("this lens", calibration.camera, pupil.terms, calibration.corners.used[0])
        _log.warning("'%s': %s", path, note)


def is_rig(path: str | Path) -> bool:
    """Return whether a file of rigkit or another tool holds several cameras; False if it cannot be read."""
    if is_rig_file(path):
        return True
    try:
        text = camera_text(path)
    except InputError:
        return False
    kind = camera_format(text)
    if kind == "matlab":
        return is_matlab_pair(text)
    if kind is None:
        return COLMAP_RIG.search(text) is not None
    return (kind == "kalibr" and "T_cn_cnm1" in text) or (kind == "opencv" and STEREO.search(text) is not None)


def rig_of_file(path: str | Path) -> SavedRig:
    """Return the rig in a file of rigkit or, without a covariance, of another tool; raises as `import_rig`."""
    return load_saved_rig(path) if is_rig_file(path) else SavedRig(cameras=import_rig(path), covariance=None)


def import_rig(path: str | Path, *, size_px: tuple[int, int] | None = None) -> dict[str, tuple[Camera, Rigid3]]:
    """Return (camera, cam_from_rig in mm) by name from a rig of rigkit, a Kalibr camchain, a rig_config.json of COLMAP,
    or a stereo pair of OpenCV or MATLAB. The cameras are central; warns if an entrance pupil moves.

    Kalibr's cameras are named cam0, cam1, ..., those of a pair left and right. `size_px` is the size of images where a
    file of COLMAP does not state it. Raises InputError for any other file or a damaged one.
    """
    if is_rig_file(path):
        rig = load_saved_rig(path)
        warn_of_pupils(path, rig)
        return dict(rig.cameras)
    text, name = camera_text(path), str(path)
    kind = camera_format(text)
    if kind == "kalibr":
        cameras, poses = read_kalibr(text, name)
        return {f"cam{k}": one for k, one in enumerate(zip(cameras, poses, strict=True))}
    if (kind == "opencv" and STEREO.search(text)) or (kind == "matlab" and is_matlab_pair(text)):
        read = read_opencv_stereo if kind == "opencv" else read_matlab_pair
        (left, right), right_from_left = read(text, name)
        return {"left": (left, Rigid3.identity()), "right": (right, right_from_left)}
    if kind == "rigkit":
        return load_rig(path)
    if COLMAP_RIG.search(text):
        return read_colmap_rig(text, name, size_px)
    one = " one camera of ROS," if kind == "ros" else ""
    raise InputError(
        f"'{name}':{one} no rig of rigkit, Kalibr (camchain), OpenCV (M1, D1, M2, D2, R, T), COLMAP or MATLAB; check "
        "the file"
    )


def file_of_camera(rig: Path, camera: str) -> Path:
    """Return the path of one camera's calibration, in the folder of the rig's file."""
    return rig.with_name(f"{rig.stem}-{camera}.json")


def files_of_cameras(rig: Path) -> dict[str, Path]:
    """Return the calibration files of a rig's cameras by name.

    Raises InputError if one is not in the folder of the rig's file.
    """
    files = {name: file_of_camera(rig, name) for name in load_saved_rig(rig).cameras}
    if missing := [f"'{path.name}'" for path in files.values() if not path.is_file()]:
        raise InputError(
            f"'{rig}': the calibrations of its cameras are needed, and {', '.join(missing)} "
            f"{'is' if len(missing) == 1 else 'are'} not beside it; give each camera's own file"
        )
    return files


def import_pair(
    path: str | Path, names: tuple[str, str] | None = None, *, near: bool = False
) -> tuple[tuple[str, str], tuple[Camera, Camera], Rigid3]:
    """Return names, cameras and cam2_from_cam1 (mm) of two cameras of a rig; `names` None: its first two.

    With `near`, cameras are those for points in mm: a `NearCamera` if a pupil moves. Raises InputError as `import_rig`,
    and for an unknown camera.
    """
    rig = rig_of_file(path).near_cameras if near else import_rig(path)
    wanted = names or tuple(rig)[:2]
    chosen = [own for name in wanted if (own := known_name(name, rig)) is not None]
    if len(set(chosen)) != 2:
        missing = [name for name in wanted if known_name(name, rig) is None]
        what = f"no camera '{', '.join(missing)}'" if missing else f"'{', '.join(wanted)}' are not two cameras"
        raise InputError(f"'{path}': {what}; there are {', '.join(rig)}")
    warn_if_bad(path)
    (camera1, cam1_from_rig), (camera2, cam2_from_rig) = (rig[name] for name in chosen)
    return (chosen[0], chosen[1]), (camera1, camera2), cam2_from_rig @ cam1_from_rig.inverse()
