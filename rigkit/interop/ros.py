"""ROS camera_info YAML for camera_calibration_parsers: plumb_bob, rational_polynomial, equidistant; and ost.txt.

Pixel (0, 0) is the centre of the first pixel, as in rigkit; lengths are in metres. For a single camera, the
rectification matrix is the identity and the projection matrix the camera matrix.
"""

from __future__ import annotations

import re
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
    field,
    image_size,
    numbers,
    numbers_of_words,
    written_size,
)
from rigkit.interop.opencv import camera_from_arrays
from rigkit.interop.yaml_text import flow, parse_yaml

Rectification = tuple[Mat3, FloatArray]
"""Rotation from the camera into the rectified view (3, 3), and the rectified view's projection matrix (3, 4), whose
last column is in pixels times metres."""

COEFFICIENTS = {"plumb_bob": 5, "rational_polynomial": 8, "equidistant": 4}
"""Number of coefficients of each distortion model."""
OST = re.compile(r"^\[image\]\s*$", re.MULTILINE)
"""Pattern in ost.txt, which camera_calibration writes beside the YAML file."""
ROS_ACCEPTS = (*PERSPECTIVE, Accepted("kannala_brandt"))


def write_camera_info(
    camera: Camera,
    camera_name: str = "camera",
    *,
    rectification: Rectification | None = None,
    outline: Pixels | None = None,
) -> Written:
    """Return the camera as a camera_info YAML file called `camera_name` inside.

    `rectification` is for cameras of a stereo pair; `outline` is as for `best_accepted`. Raises InputError for a name
    that ROS does not accept.
    """
    if not camera_name or not camera_name.replace("_", "").isalnum():
        raise InputError(f"camera_info: name '{camera_name}'; ROS takes letters, digits and underscores")
    chosen = best_accepted(camera, ROS_ACCEPTS, "ROS", outline)
    c = chosen.camera
    p = c.parameters
    distortion = p[4:] if p.size > 4 else np.zeros(5)
    if c.model == "brown" and distortion.size == 4:
        # plumb_bob has five numbers; without k3 the last one is 0.
        distortion = np.append(distortion, 0.0)
    model = next(name for name, count in COEFFICIENTS.items() if count == distortion.size)
    K = camera_matrix(*p[:4])
    R, P = (np.eye(3), np.hstack([K, np.zeros((3, 1))])) if rectification is None else rectification
    text = (
        f"image_width: {c.size_px[0]}\nimage_height: {c.size_px[1]}\ncamera_name: {camera_name}\n"
        f"camera_matrix:\n{_matrix(K)}"
        f"distortion_model: {model}\n"
        f"distortion_coefficients:\n{_matrix(distortion.reshape(1, -1))}"
        f"rectification_matrix:\n{_matrix(R)}"
        f"projection_matrix:\n{_matrix(P)}"
    )
    return replace(chosen, text=text)


def read_camera_info(text: str, name: str = "camera_info") -> Camera:
    """Return the camera of a camera_info file, of a message printed by `ros2 topic echo` or `rostopic echo`, or of
    camera_calibration's ost.txt.

    Raises InputError for unknown distortion models and damaged files.
    """
    if OST.search(text):
        return _read_ost(text, name)
    data = _as_stored(parse_yaml(_first_message(text), name), name)
    size = written_size(data, name)
    K = numbers(field(field(data, "camera_matrix", name), "data", name), name, "camera_matrix", 9)
    distortion = numbers(field(field(data, "distortion_coefficients", name), "data", name), name, "distortion")
    model = str(field(data, "distortion_model", name))
    if model not in COEFFICIENTS:
        raise InputError(f"'{name}': distortion_model '{model}' is unknown; known: {', '.join(COEFFICIENTS)}")
    count = COEFFICIENTS[model]
    if distortion.size > count and distortion[count:].any():
        raise InputError(f"'{name}': {model} has {count} coefficients, found {distortion.size}; is the file whole?")
    distortion = np.concatenate([distortion[:count], np.zeros(max(count - distortion.size, 0))])
    return camera_from_arrays(size, K, distortion, fisheye=model == "equidistant", name=name)


def _read_ost(text: str, name: str) -> Camera:
    """Return the camera of an ost.txt: sections in brackets, and numbers under each key.

    The distortion model is not named; the number of its terms identifies it.
    """
    section, key = "", ""
    values: dict[str, dict[str, list[str]]] = {}
    for line in text.splitlines():
        words = line.split("#")[0].split()
        if words and words[0].startswith("["):
            section, key = " ".join(words).strip("[]"), ""
        elif words and words[0][0].isalpha():
            key = " ".join(words)
        elif words:
            values.setdefault(section, {}).setdefault(key, []).extend(words)
    image = values.pop("image", {})
    if len(values) != 1:
        raise InputError(f"'{name}' holds {len(values)} cameras; leave [image] and the one that you want in it")

    def read(section: dict[str, list[str]], key: str, count: int | None = None) -> FloatArray:
        return numbers_of_words(field(section, key, name), name, key, count)

    (camera,) = values.values()
    size = image_size([read(image, key, 1)[0] for key in ("width", "height")], name, "width, height")
    d = read(camera, "distortion")
    if d.size not in COEFFICIENTS.values():
        known = ", ".join(f"{count} ({model})" for model, count in COEFFICIENTS.items())
        raise InputError(f"'{name}': {d.size} terms of distortion; known are {known}; is the file whole?")
    fisheye = d.size == COEFFICIENTS["equidistant"]
    return camera_from_arrays(size, read(camera, "camera matrix", 9), d, fisheye=fisheye, name=name)


def _first_message(text: str) -> str:
    """Return the first of several messages; those of one camera are all the same."""
    return next((part for part in re.split(r"^---\s*$", text, flags=re.MULTILINE) if part.strip()), text)


def _as_stored(data: dict[str, Any], name: str) -> dict[str, Any]:
    """Return a message with K and D (in ROS 2 k and d), width and height under their names in files."""
    if "camera_matrix" in data:
        return data
    K, D = (next((data[key] for key in (big, big.lower()) if key in data), None) for big in "KD")
    if K is None or D is None:
        return data
    return {
        **data,
        "image_width": field(data, "width", name),
        "image_height": field(data, "height", name),
        "camera_matrix": {"data": K},
        "distortion_coefficients": {"data": D},
    }


def _matrix(array: FloatArray) -> str:
    rows, columns = array.shape
    return f"  rows: {rows}\n  cols: {columns}\n  data: {flow(array.reshape(-1))}\n"
