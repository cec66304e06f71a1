"""MATLAB's calibrations: Bouguet's Calib_Results (.mat, .m), and structures that toStruct makes of Computer Vision
Toolbox's cameraParameters, cameraIntrinsics, fisheyeParameters, fisheyeIntrinsics and stereoParameters.

A .mat file is converted to the assignments of a script and read as Calib_Results.m. Bouguet's first pixel is (0, 0), as
in rigkit, the toolbox's is (1, 1). Lengths in mm. `Calib_Results_stereo` and stereoParameters are stereo pairs.
"""

from __future__ import annotations

import re
from collections.abc import Mapping

import numpy as np

from rigkit.cameras.base import Camera
from rigkit.core.arrays import FloatArray
from rigkit.core.errors import InputError
from rigkit.geometry.rigid3 import Rigid3
from rigkit.interop.exchange import field, image_size, numbers, pose_of
from rigkit.interop.mat5 import OBJECTS, assignments_of
from rigkit.interop.ocamcalib import camera_of_taylor
from rigkit.interop.opencv import camera_from_arrays

SizePx = tuple[int, int]
Values = Mapping[str, FloatArray]

MAT5, MAT73 = b"MATLAB 5.0 MAT-file", b"MATLAB 7.3 MAT-file"
"""Start of files written by save -v6 and -v7, and by save -v7.3."""
MAT_SIGN = re.compile(
    r"^\s*(?:\w+\.)*(?:fc|fc_left|FocalLength|MappingCoefficients|IntrinsicMatrix|K)\s*=\s*\[|^% MATLAB\b", re.MULTILINE
)
"""Pattern in scripts of cameras and in converted .mat files."""
ASSIGNMENT = re.compile(r"^\s*([A-Za-z][\w.]*)\s*=\s*(\[[^\]]*\]|[-+.\w]+)\s*;?", re.MULTILINE)
BOUGUET = ("fc", "cc", "kc", "alpha_c")
"""Variables of each camera of a pair, where _left and _right are appended."""


def matlab_text(data: bytes, name: str) -> str | None:
    """Return the assignments of a .mat file; None for other data.

    Raises InputError for a damaged file, and for HDF5 (-v7.3).
    """
    if data.startswith(MAT73):
        raise InputError(f"'{name}' was saved with -v7.3; save it in MATLAB with save(..., '-v7')")
    if not data.startswith(MAT5):
        return None
    return assignments_of(data, name)


def read_matlab(text: str, name: str = "camera.mat", size_px: SizePx | None = None) -> Camera:
    """Return the camera of a .mat file's assignments (`matlab_text`) or of a Calib_Results.m.

    `size_px` is the image size, for files that do not state it. Raises InputError for skew, stereo pairs, objects
    instead of structures, and damaged files.
    """
    values = _values(text, name)
    found = _cameras(values)
    if len(found) > 1 or is_matlab_pair(text):
        raise InputError(f"'{name}' holds several cameras; give it as a rig (--rig), or save the one that you want")
    if not found:
        raise _no_camera_error(text, name)
    return _camera(found[next(iter(found))], name, size_px)


def is_matlab_pair(text: str) -> bool:
    """Return whether a text with `MAT_SIGN` describes a stereo pair."""
    return re.search(r"^\s*(?:\w+\.)*(?:fc_right|CameraParameters2\.\w+)\s*=", text, re.MULTILINE) is not None


def read_matlab_pair(
    text: str, name: str = "stereo.mat", size_px: SizePx | None = None
) -> tuple[tuple[Camera, Camera], Rigid3]:
    """Return left and right camera, and right_from_left, mm; raises InputError as `read_matlab`."""
    values = _values(text, name)
    if "fc_left" in values:
        sides = [{k: values[f"{k}_{s}"] for k in BOUGUET if f"{k}_{s}" in values} for s in ("left", "right")]
        size: dict[str, FloatArray] = {k: values[k] for k in ("nx", "ny") if k in values}
        left, right = (_camera(side | size, name, size_px) for side in sides)
        R, t = (numbers(field(dict(values), key, name), name, key, n) for key, n in (("R", 9), ("T", 3)))
        return (left, right), pose_of(R.reshape(3, 3), t, name)
    found = _cameras(values)
    first = next((key for key in found if "CameraParameters1" in key), None)
    second = None if first is None else first.replace("CameraParameters1", "CameraParameters2")
    if first is None or second not in found:
        raise _no_camera_error(text, name)
    left, right = (_camera(found[key], name, size_px) for key in (first, second))
    of = first.split("CameraParameters1")[0]
    if f"{of}PoseCamera2.R" in values:
        # Newer versions: rigidtform3d, which acts on columns.
        R, t = values[f"{of}PoseCamera2.R"], values.get(f"{of}PoseCamera2.Translation", np.zeros(0))
    else:
        keys = (f"{of}RotationOfCamera2", f"{of}TranslationOfCamera2")
        R, t = (numbers(field(dict(values), key, name), name, key) for key in keys)
        # Older ones: points are rows, x2 = x1 R + t.
        R = R.reshape(3, 3).T if R.size == 9 else R
    R, t = numbers(R, name, "rotation", 9).reshape(3, 3), numbers(t, name, "translation", 3)
    return (left, right), pose_of(R, t, name)


def _values(text: str, name: str) -> dict[str, FloatArray]:
    """Return the assigned numbers (N,) by name, row by row; the last assignment counts, as in MATLAB."""
    found = {}
    for key, words in ASSIGNMENT.findall(re.sub(r"%[^\n]*", "", text)):
        plain = re.sub(r"[\[\];,]|\.\.\.", " ", words).split()
        try:
            found[key] = numbers([float(word) for word in plain], name, key)
        except ValueError:
            continue  # an expression or a word
    return found


def _cameras(values: Values) -> dict[str, dict[str, FloatArray]]:
    """Return the numbers of each camera by the name of its structure."""
    found: dict[str, dict[str, FloatArray]] = {}
    for key in values:
        of, _, last = key.rpartition(".")
        if last in ("fc", "FocalLength", "MappingCoefficients", "IntrinsicMatrix", "K"):
            found.setdefault(of, {k.rpartition(".")[2]: v for k, v in values.items() if k.rpartition(".")[0] == of})
    # Newer cameraParameters repeat the numbers in their field Intrinsics.
    return {of: v for of, v in found.items() if not (of.endswith(".Intrinsics") and of.rpartition(".")[0] in found)}


def _camera(of: Values, name: str, size_px: SizePx | None) -> Camera:
    """Return the camera from Bouguet's or the toolbox's numbers."""
    data = dict(of)
    if "ImageSize" in data and data["ImageSize"].size == 2:
        size = image_size(data["ImageSize"][::-1], name, "ImageSize")
    elif "nx" in data and "ny" in data:
        size = image_size([data["nx"][0], data["ny"][0]], name, "nx, ny")
    elif size_px is not None:
        size = size_px
    else:
        raise InputError(f"'{name}': it does not say the images' size; use `rigkit export --size`")
    if "MappingCoefficients" in data:
        a = numbers(data["MappingCoefficients"], name, "MappingCoefficients", 4)
        centre = numbers(field(data, "DistortionCenter", name), name, "DistortionCenter", 2) - 1.0
        stretch = numbers(data.get("StretchMatrix", np.eye(2)), name, "StretchMatrix", 4).reshape(2, 2)
        return camera_of_taylor(size, np.insert(a, 1, 0.0), centre, stretch, name)
    if "fc" in data:
        return _bouguet(data, size, name)
    K = _toolbox_matrix(data, name)
    radial = numbers(data.get("RadialDistortion", np.zeros(2)), name, "RadialDistortion")
    tangential = numbers(data.get("TangentialDistortion", np.zeros(2)), name, "TangentialDistortion", 2)
    if radial.size not in (2, 3):
        raise InputError(f"'{name}': RadialDistortion has {radial.size} numbers, not 2 or 3; is the file whole?")
    return camera_from_arrays(size, K, np.array([*radial[:2], *tangential, *radial[2:]]), fisheye=False, name=name)


def _bouguet(data: dict[str, FloatArray], size: SizePx, name: str) -> Camera:
    fc, cc = (numbers(field(data, key, name), name, key, 2) for key in ("fc", "cc"))
    skew = float(data.get("alpha_c", np.zeros(1))[0])
    d = numbers(data.get("kc", np.zeros(5)), name, "kc")
    if d.size != 5:
        # The toolbox's fisheye (calib_fisheye) has four, and nothing else that identifies it.
        raise InputError(
            f"'{name}': kc has {d.size} numbers, not 5; of a perspective lens add zeros; a fisheye's kc is OpenCV's: "
            "write it into OpenCV's file with fisheye_model: 1"
        )
    K = np.array([fc[0], skew * fc[0], cc[0], 0.0, fc[1], cc[1], 0.0, 0.0, 1.0])
    return camera_from_arrays(size, K, d, fisheye=False, name=name)


def _toolbox_matrix(data: dict[str, FloatArray], name: str) -> FloatArray:
    """Return K (9), with the principal point counted from 0."""
    if "K" in data or "IntrinsicMatrix" in data:
        key = "K" if "K" in data else "IntrinsicMatrix"
        K = numbers(data[key], name, key, 9).reshape(3, 3)
        # Older versions state it for row vectors.
        K = K.T.copy() if K[0, 2] == 0.0 and K[2, 0] != 0.0 else K.copy()
    else:
        focal = numbers(field(data, "FocalLength", name), name, "FocalLength", 2)
        centre = numbers(field(data, "PrincipalPoint", name), name, "PrincipalPoint", 2)
        skew = float(data.get("Skew", np.zeros(1))[0])
        K = np.array([[focal[0], skew, centre[0]], [0.0, focal[1], centre[1]], [0.0, 0.0, 1.0]])
    K[:2, 2] -= 1.0
    return K.reshape(9)


def _no_camera_error(text: str, name: str) -> InputError:
    if OBJECTS in text:
        which = text.split(OBJECTS)[1].split()[0]
        return InputError(
            f"'{name}': '{which}' is an object, which only MATLAB reads; there: s = toStruct({which}); "
            "save('camera.mat', '-struct', 's', '-v7')"
        )
    return InputError(f"'{name}': no camera of MATLAB in it (fc, cc, kc, or what toStruct makes); check the file")
