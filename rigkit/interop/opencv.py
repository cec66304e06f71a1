"""OpenCV's calibration YAML: pinhole and Brown (calib3d), Kannala-Brandt (fisheye), unified (omnidir).

The keys are those that OpenCV's own calibration samples write. Pixels as ours.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from rigkit.cameras.base import Camera
from rigkit.core.arrays import FloatArray
from rigkit.core.errors import InputError
from rigkit.interop.exchange import (
    Accepted,
    Written,
    best_accepted,
    camera_of,
    field,
    image_size,
    numbers,
    unified_from_xi,
    unified_with_xi,
)
from rigkit.interop.yaml_text import parse_yaml

__all__ = ["read_opencv", "write_opencv"]

OPENCV_ACCEPTS = (
    Accepted("pinhole"),
    Accepted("brown", 4),
    Accepted("brown", 5),
    Accepted("brown", 8),
    Accepted("kannala_brandt"),
    Accepted("ucm"),
)


def write_opencv(camera: Camera) -> Written:
    """Return the camera as OpenCV's YAML; `cv2.FileStorage` reads it."""
    chosen = best_accepted(camera, OPENCV_ACCEPTS, "OpenCV")
    c = chosen.camera
    p, extra = c.parameters, ""
    fx, fy, cx, cy = p[:4]
    if c.model == "kannala_brandt":
        distortion, extra = p[4:].reshape(4, 1), "fisheye_model: 1\n"
    elif c.model == "ucm":
        xi, (fx, fy, cx, cy) = unified_with_xi(c)
        distortion, extra = np.zeros((1, 4)), f"xi: {xi!r}\n"
    else:
        distortion = (p[4:] if p.size > 4 else np.zeros(5)).reshape(1, -1)
    K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    text = (
        "%YAML:1.0\n---\n"
        f"image_width: {c.size_px[0]}\nimage_height: {c.size_px[1]}\n{extra}"
        f"camera_matrix: {_matrix(K)}distortion_coefficients: {_matrix(distortion)}"
    )
    return chosen.written(text)


def read_opencv(text: str, name: str = "OpenCV YAML") -> Camera:
    """Return the camera of OpenCV's YAML; `name` is how errors call the file.

    Raises InputError for a file without the keys, or terms that no model here has (thin prism, tilt, skew, distortion
    on top of omnidir's sphere).
    """
    data = parse_yaml(text, name)
    sides = [field(data, key, name) for key in ("image_width", "image_height")]
    size = image_size(sides, name, "image_width, image_height")
    K = _read_matrix(field(data, "camera_matrix", name), name, "camera_matrix")
    if K.size != 9 or K[1] != 0.0:
        raise InputError(f"'{name}': camera_matrix must be 3x3 without skew")
    core = K[[0, 4, 2, 5]]
    key = next((k for k in ("distortion_coefficients", "dist_coeffs", "distCoeffs", "D") if k in data), None)
    d = np.zeros(0) if key is None else _read_matrix(data[key], name, key)
    if "xi" in data:
        xi = float(numbers(data["xi"]["data"] if _is_matrix(data["xi"]) else data["xi"], name, "xi", 1)[0])
        if d.any():
            raise InputError(f"'{name}': distortion on top of the unified model (xi) is not supported; recalibrate")
        return unified_from_xi(size, xi, core, name)
    if data.get("fisheye_model"):
        return camera_of("kannala_brandt", size, np.concatenate([core, d if d.size else np.zeros(4)]), name)
    if d.size > 8 and d[8:].any():
        raise InputError(f"'{name}': thin prism and tilt terms (more than 8) are not supported; calibrate without them")
    d = d[:8]
    if not d.any():
        return camera_of("pinhole", size, core, name)
    return camera_of("brown", size, np.concatenate([core, d]), name)


def _matrix(array: FloatArray) -> str:
    rows, columns = array.shape
    values = ", ".join(repr(float(v)) for v in array.reshape(-1))
    return f"!!opencv-matrix\n   rows: {rows}\n   cols: {columns}\n   dt: d\n   data: [ {values} ]\n"


def _read_matrix(value: Any, name: str, key: str) -> FloatArray:
    return numbers(value["data"] if _is_matrix(value) else value, name, key)


def _is_matrix(value: Any) -> bool:
    return isinstance(value, dict) and "data" in value
