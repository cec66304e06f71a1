"""OpenCV's calibration files: pinhole and Brown (calib3d), Kannala-Brandt (fisheye), unified (omnidir).

The keys are those that OpenCV's own calibration samples write. Pixels as ours.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from rigkit.cameras.base import Camera
from rigkit.cameras.pinhole import camera_matrix
from rigkit.core.arrays import FloatArray, Mat3, Pixels
from rigkit.core.errors import InputError
from rigkit.interop.exchange import (
    PERSPECTIVE,
    Accepted,
    Written,
    best_accepted,
    camera_of,
    field,
    numbers,
    unified_from_xi,
    unified_with_xi,
    written_size,
)
from rigkit.interop.opencv_storage import parse_storage

OPENCV_ACCEPTS = (*PERSPECTIVE, Accepted("kannala_brandt"), Accepted("ucm"))


def write_opencv(camera: Camera, outline: Pixels | None = None) -> Written:
    """Return the camera as OpenCV's YAML; `cv2.FileStorage` reads it. `outline`: as for `best_accepted`."""
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


def read_opencv(text: str, name: str = "OpenCV YAML") -> Camera:
    """Return the camera of OpenCV's YAML, XML or JSON; `name` is how errors call the file.

    Raises InputError for a file without the keys, or terms that no model here has (thin prism, tilt, skew, distortion
    on top of omnidir's sphere).
    """
    data = parse_storage(text, name)
    size = written_size(data, name)
    K = read_opencv_matrix(data, "camera_matrix", name)
    key = next((k for k in ("distortion_coefficients", "dist_coeffs", "distCoeffs", "D") if k in data), None)
    d = np.zeros(0) if key is None else read_opencv_matrix(data, key, name)
    if "xi" in data:
        xi = float(numbers(data["xi"]["data"] if _is_matrix(data["xi"]) else data["xi"], name, "xi", 1)[0])
        if d.any():
            raise InputError(f"'{name}': distortion on top of the unified model (xi) is not read; calibrate without it")
        return unified_from_xi(size, xi, _core(K, name), name)
    return camera_from_arrays(size, K, d, fisheye=bool(data.get("fisheye_model")), name=name)


def camera_from_arrays(size: tuple[int, int], K: FloatArray, d: FloatArray, *, fisheye: bool, name: str) -> Camera:
    """Return the camera of K (9) and distortion (N), as OpenCV has them: the reverse of `opencv_arrays`.

    Raises InputError for skew, and terms that no model here has.
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
    """Return the array (R, C) as OpenCV's storage writes a matrix of doubles."""
    rows, columns = array.shape
    values = ", ".join(repr(float(v)) for v in array.reshape(-1))
    return f"!!opencv-matrix\n   rows: {rows}\n   cols: {columns}\n   dt: d\n   data: [ {values} ]\n"


def read_opencv_matrix(data: dict[str, Any], key: str, name: str) -> FloatArray:
    """Return data[key] as numbers (N,), written as OpenCV's matrix or as a list."""
    value = field(data, key, name)
    return numbers(value["data"] if _is_matrix(value) else value, name, key)


def _core(K: FloatArray, name: str) -> FloatArray:
    """Return fx, fy, cx, cy."""
    if K.size != 9 or K[1] != 0.0:
        raise InputError(f"'{name}': camera_matrix must be 3x3 without skew, which no model has; calibrate without it")
    if K[3] != 0.0 or K[6:].tolist() != [0.0, 0.0, 1.0]:
        # Of MATLAB's older matrices, for row vectors, the principal point would be read as (0, 0).
        raise InputError(f"'{name}': camera_matrix must be fx 0 cx, 0 fy cy, 0 0 1, row by row; transpose it")
    return K[[0, 4, 2, 5]]


def _is_matrix(value: Any) -> bool:
    return isinstance(value, dict) and "data" in value
