"""OpenCV's calibration files: pinhole and Brown (calib3d), Kannala-Brandt (fisheye), unified (omnidir), and rectified
stereo pairs.

The keys are those of OpenCV's samples calibration and stereo_calib (M1, D1, M2, D2, R, T, R1, R2, P1, P2, Q), with E, F
and the image size. Pixel (0, 0) is the centre of the first pixel, as in rigkit; lengths are in mm.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np

from rigkit.cameras.base import Camera
from rigkit.cameras.pinhole import camera_matrix
from rigkit.core.arrays import FloatArray, Mat3, Pixels
from rigkit.core.errors import InputError
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import skew
from rigkit.interop.exchange import (
    PERSPECTIVE,
    Accepted,
    Written,
    best_accepted,
    camera_of,
    field,
    numbers,
    pose_of,
    unified_from_xi,
    unified_with_xi,
    written_size,
)
from rigkit.interop.opencv_storage import parse_storage

OPENCV_ACCEPTS = (*PERSPECTIVE, Accepted("kannala_brandt"), Accepted("ucm"))
FAMILIES = {False: PERSPECTIVE, True: (Accepted("kannala_brandt"),)}
"""Models that OpenCV rectifies together, by whether they are those of cv2.fisheye."""
MATRIX = ("camera_matrix", "cameraMatrix", "mtx")
DISTORTION = ("distortion_coefficients", "dist_coeffs", "distCoeffs", "D", "dist")
"""Keys in OpenCV's samples, functions and tutorials. K is not among them: it is cv2.fisheye's, with other terms."""
STEREO_KEYS = ("M1", "D1", "M2", "D2", "R", "T")


def write_opencv(camera: Camera, outline: Pixels | None = None) -> Written:
    """Return the camera as YAML for `cv2.FileStorage`; `outline` is as for `best_accepted`."""
    chosen = best_accepted(camera, OPENCV_ACCEPTS, "OpenCV", outline)
    c = chosen.camera
    extra = "fisheye_model: 1\n" if c.model == "kannala_brandt" else ""
    if c.model == "ucm":
        xi, (fx, fy, cx, cy) = unified_with_xi(c)
        K, distortion, extra = camera_matrix(fx, fy, cx, cy), np.zeros((1, 4)), f"xi: {xi!r}\n"
    else:
        K, distortion = opencv_arrays(c)
    text = (
        "%YAML:1.0\n---\n"
        f"image_width: {c.size_px[0]}\nimage_height: {c.size_px[1]}\n{extra}"
        f"camera_matrix: {opencv_matrix(K)}distortion_coefficients: {opencv_matrix(distortion)}"
    )
    return replace(chosen, text=text)


def read_opencv(text: str, name: str = "OpenCV YAML", size_px: tuple[int, int] | None = None) -> Camera:
    """Return the camera of OpenCV's YAML, XML or JSON; `name` is the file name for errors.

    `size_px` is the image size, for files that do not state it: only OpenCV's samples do. Raises InputError for missing
    keys, or terms that rigkit lacks (thin prism, tilt, skew, distortion with omnidir).
    """
    data = parse_storage(text, name)
    if "image_width" in data:
        size = written_size(data, name)
    elif size_px is not None:
        size = size_px
    else:
        remedy = "add image_width and image_height, or use `rigkit export --size`"
        raise InputError(f"'{name}': it does not say the images' size; {remedy}")
    K = read_opencv_matrix(data, next((k for k in MATRIX if k in data), MATRIX[0]), name)
    key = next((k for k in DISTORTION if k in data), None)
    d = np.zeros(0) if key is None else read_opencv_matrix(data, key, name)
    if "xi" in data:
        xi = float(numbers(data["xi"]["data"] if _is_matrix(data["xi"]) else data["xi"], name, "xi", 1)[0])
        if d.any():
            raise InputError(f"'{name}': distortion on top of the unified model (xi) is not read; calibrate without it")
        return unified_from_xi(size, xi, _core(K, name), name)
    return camera_from_arrays(size, K, d, fisheye=bool(data.get("fisheye_model")), name=name)


def camera_from_arrays(size: tuple[int, int], K: FloatArray, d: FloatArray, *, fisheye: bool, name: str) -> Camera:
    """Return the camera of OpenCV's K (9) and distortion (N): the inverse of `opencv_arrays`.

    Raises InputError for skew, and terms that rigkit lacks.
    """
    core = _core(K, name)
    if fisheye:
        return camera_of("kannala_brandt", size, np.concatenate([core, d if d.size else np.zeros(4)]), name)
    if d.size > 8 and d[8:].any():
        raise InputError(f"'{name}': thin prism and tilt terms (more than 8) are not supported; calibrate without them")
    d = d[:8]
    if not d.any():
        return camera_of("pinhole", size, core, name)
    return camera_of("brown", size, np.concatenate([core, d]), name)


def opencv_arrays(camera: Camera) -> tuple[Mat3, FloatArray]:
    """Return K and the distortion of a pinhole or Brown camera (1, N), or of a Kannala-Brandt one (4, 1)."""
    p = camera.parameters
    K = camera_matrix(*p[:4])
    if camera.model == "kannala_brandt":
        return K, p[4:].reshape(4, 1)
    return K, (p[4:] if p.size > 4 else np.zeros(5)).reshape(1, -1)


def opencv_matrix(array: FloatArray) -> str:
    """Return the array (R, C) as a matrix of doubles in OpenCV's YAML."""
    rows, columns = array.shape
    values = ", ".join(repr(float(v)) for v in array.reshape(-1))
    return f"!!opencv-matrix\n   rows: {rows}\n   cols: {columns}\n   dt: d\n   data: [ {values} ]\n"


def read_opencv_matrix(data: dict[str, Any], key: str, name: str) -> FloatArray:
    """Return data[key], an OpenCV matrix or a list, as numbers (N,)."""
    value = field(data, key, name)
    return numbers(value["data"] if _is_matrix(value) else value, name, key)


def _core(K: FloatArray, name: str) -> FloatArray:
    """Return fx, fy, cx, cy."""
    if K.size != 9 or K[1] != 0.0:
        raise InputError(f"'{name}': camera_matrix must be 3x3 without skew, which no model has; calibrate without it")
    if K[3] != 0.0 or K[6:].tolist() != [0.0, 0.0, 1.0]:
        # MATLAB's older matrices are transposed: their principal point would be read as (0, 0).
        raise InputError(f"'{name}': camera_matrix must be fx 0 cx, 0 fy cy, 0 0 1, row by row; transpose it")
    return K[[0, 4, 2, 5]]


def _is_matrix(value: Any) -> bool:
    return isinstance(value, dict) and "data" in value


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class OpenCVStereo:
    """A stereo pair in OpenCV's models.

    Attributes
    ----------
    cameras : the two cameras as written.
    R1, R2, P1, P2 : OpenCV's rectification, with lengths in mm.
    text : content of the file.
    """

    cameras: tuple[Written, Written]
    R1: Mat3
    R2: Mat3
    P1: FloatArray
    P2: FloatArray
    text: str


def opencv_stereo(
    camera1: Camera, camera2: Camera, cam2_from_cam1: Rigid3, outlines: Sequence[Pixels | None] = (None, None)
) -> OpenCVStereo:
    """Return the pair with OpenCV's own rectification (cv2.stereoRectify, cv2.fisheye.stereoRectify).

    `outlines` of both cameras are as for `best_accepted`. Raises InputError for images of different sizes, which OpenCV
    does not rectify, or if no family of OpenCV's models fits both lenses.
    """
    if camera1.size_px != camera2.size_px:
        sizes = " and ".join(f"{width}x{height}" for width, height in (camera1.size_px, camera2.size_px))
        raise InputError(f"OpenCV stereo: images of {sizes} px are not rectified together; take another format")
    chosen, fisheye = _family(camera1, camera2, outlines)
    (K1, D1), (K2, D2) = (opencv_arrays(one.camera) for one in chosen)
    R, T = cam2_from_cam1.rotation, cam2_from_cam1.translation_mm
    R1, R2, P1, P2, Q = _rectified((K1, D1, K2, D2), camera1.size_px, R, T.reshape(3, 1), fisheye=fisheye)
    E = skew(T) @ R
    F = np.linalg.inv(K2).T @ E @ np.linalg.inv(K1)
    arrays = {
        "M1": K1, "D1": D1, "M2": K2, "D2": D2, "R": R, "T": T.reshape(3, 1), "R1": R1, "R2": R2, "P1": P1, "P2": P2,
        "Q": Q, "E": E, "F": F,
    }  # fmt: skip
    width, height = camera1.size_px
    head = f"%YAML:1.0\n---\nimage_width: {width}\nimage_height: {height}\n" + ("fisheye_model: 1\n" if fisheye else "")
    text = head + "".join(f"{key}: {opencv_matrix(array)}" for key, array in arrays.items())
    return OpenCVStereo(cameras=chosen, R1=R1, R2=R2, P1=P1, P2=P2, text=text)


def read_opencv_stereo(text: str, name: str = "OpenCV stereo") -> tuple[tuple[Camera, Camera], Rigid3]:
    """Return both cameras and cam2_from_cam1 (mm) of a stereo file; raises InputError for missing keys."""
    data = parse_storage(text, name)
    size = written_size(data, name)
    found = {key: read_opencv_matrix(data, key, name) for key in STEREO_KEYS}
    for key, count in (("R", 9), ("T", 3)):
        if found[key].size != count:
            raise InputError(f"'{name}': '{key}' has {found[key].size} numbers instead of {count}; is the file whole?")
    fisheye = bool(data.get("fisheye_model"))
    camera1, camera2 = (
        camera_from_arrays(size, found[f"M{k}"], found[f"D{k}"], fisheye=fisheye, name=name) for k in (1, 2)
    )
    return (camera1, camera2), pose_of(found["R"].reshape(3, 3), found["T"], name)


def _family(
    camera1: Camera, camera2: Camera, outlines: Sequence[Pixels | None]
) -> tuple[tuple[Written, Written], bool]:
    """Return both cameras in the family of models that covers more of the images, then has the smaller error."""
    found = []
    for fisheye, accepted in FAMILIES.items():
        try:
            pair = (
                best_accepted(camera1, accepted, "OpenCV", outlines[0]),
                best_accepted(camera2, accepted, "OpenCV", outlines[1]),
            )
        except InputError:
            continue
        missed = 1.0 - min(one.covered for one in pair)
        found.append((missed, max(one.max_error_px for one in pair), fisheye, pair))
    if not found:
        raise InputError("OpenCV stereo: no family of OpenCV's models follows both lenses; take another format")
    _, _, fisheye, pair = min(found, key=lambda f: f[:3])
    return pair, fisheye


def _rectified(
    intrinsics: tuple[Mat3, FloatArray, Mat3, FloatArray],
    size_px: tuple[int, int],
    R: Mat3,
    T: FloatArray,
    *,
    fisheye: bool,
) -> tuple[FloatArray, ...]:
    """Return OpenCV's R1, R2, P1, P2, Q for rectified images without empty pixels (alpha or balance 0)."""
    found: Sequence[Any]
    if fisheye:
        found = cv2.fisheye.stereoRectify(*intrinsics, size_px, R, T, cv2.CALIB_ZERO_DISPARITY, balance=0.0)
    else:
        found = cv2.stereoRectify(*intrinsics, size_px, R, T, flags=cv2.CALIB_ZERO_DISPARITY, alpha=0.0)
    return tuple(np.asarray(array, dtype=np.float64) for array in found[:5])
