"""COLMAP's rig_config.json: lenses and poses of the cameras of a rig, each with a folder of images.

COLMAP has the size of images from these. Files of rigkit also state it, as `width` and `height`, which COLMAP ignores.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import PurePosixPath
from typing import Any

import numpy as np

from rigkit.cameras.base import Camera
from rigkit.core.arrays import FloatArray, Pixels
from rigkit.core.errors import InputError
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import nearest_rotation
from rigkit.interop.colmap_cameras import read_colmap_cameras, write_colmap_cameras
from rigkit.interop.colmap_model import quaternion_wxyz
from rigkit.interop.exchange import Written, image_size, numbers

SIZE = ("width", "height")
MAX_OFF_UNIT = 1e-3
"""Largest deviation of a quaternion's length from one: more is damage, not rounding."""


def write_colmap_rig(
    rig: Mapping[str, tuple[Camera, Rigid3]], outlines: Mapping[str, Pixels]
) -> tuple[str, list[Written]]:
    """Return rig_config.json of cameras and cam_from_rig (mm) by name, for images in one folder for each camera, and
    the cameras written; the first camera is the reference. `outlines` by name are as for `best_accepted`."""
    ids = {name: k for k, name in enumerate(rig, start=1)}
    seen = {ids[name]: outline for name, outline in outlines.items() if name in ids}
    _, written = write_colmap_cameras({ids[name]: camera for name, (camera, _) in rig.items()}, seen)
    reference = next(iter(rig.values()))[1]
    cameras: list[dict[str, object]] = []
    for (name, (_, pose)), line in zip(rig.items(), written.values(), strict=True):
        _, model, width, height, *values = line.text.split()
        entry: dict[str, object] = {"image_prefix": f"{name}/"}
        if cameras:
            from_reference = pose @ reference.inverse()
            entry["cam_from_rig_rotation"] = quaternion_wxyz(from_reference.rotation).tolist()
            entry["cam_from_rig_translation"] = from_reference.translation_mm.tolist()
        else:
            entry["ref_sensor"] = True
        size = dict(zip(SIZE, (int(width), int(height)), strict=True))
        cameras.append({**entry, "camera_model_name": model, "camera_params": [float(v) for v in values], **size})
    return json.dumps([{"cameras": cameras}], indent=1, allow_nan=False) + "\n", list(written.values())


def read_colmap_rig(
    text: str, name: str = "rig_config.json", size_px: tuple[int, int] | None = None
) -> dict[str, tuple[Camera, Rigid3]]:
    """Return (camera, cam_from_rig) by the last folder of their images, lengths as in the file; `size_px` is the size
    of images where the file states none.

    Raises InputError: no rig or several, a camera without lens, pose or size, and what is damaged.
    """
    try:
        (rig,) = json.loads(text)
        entries = [(entry["image_prefix"], dict(entry)) for entry in rig["cameras"]]
        if not entries:
            raise ValueError("no camera")
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise InputError(f"'{name}': not a rig_config.json with one rig ({error}); is the file whole?") from error
    references = sum(entry.get("ref_sensor") is True for _, entry in entries)
    if references > 1:
        raise InputError(
            f"'{name}': {references} cameras are ref_sensor, at one place; leave one, give poses of others"
        )
    out: dict[str, tuple[Camera, Rigid3]] = {}
    for prefix, entry in entries:
        camera = PurePosixPath(prefix).name if isinstance(prefix, str) else ""
        if camera in ("", "..", *out):
            raise InputError(f"'{name}': image_prefix '{prefix}' names no camera of its own; give each another folder")
        out[camera] = (_camera(entry, f"{name}, camera {camera}", size_px), _pose(entry, f"{name}, camera {camera}"))
    return out


def _camera(entry: Mapping[str, Any], name: str, size_px: tuple[int, int] | None) -> Camera:
    if "camera_model_name" not in entry or "camera_params" not in entry:
        raise InputError(
            f"'{name}': no camera_model_name and camera_params; give cameras.txt of COLMAP's model instead"
        )
    if all(key in entry for key in SIZE):
        size_px = image_size([entry[key] for key in SIZE], name, ", ".join(SIZE))
    if size_px is None:
        raise InputError(
            f"'{name}': the size of images is not stated; `rigkit export FILE --size WxH --to kalibr -o rig.yaml` "
            "makes a file that states it"
        )
    values = " ".join(repr(float(v)) for v in numbers(entry["camera_params"], name, "camera_params"))
    line = f"1 {entry['camera_model_name']} {size_px[0]} {size_px[1]} {values}"
    return read_colmap_cameras(line, name)[1]


def _pose(entry: Mapping[str, Any], name: str) -> Rigid3:
    if entry.get("ref_sensor") is True:
        return Rigid3.identity()
    keys = ("cam_from_rig_rotation", "cam_from_rig_translation")
    missing = [key for key in keys if key not in entry]
    if missing:
        raise InputError(f"'{name}': no {missing[0]}; calibrate the rig, or let COLMAP estimate it, and write it there")
    rotation, shift = (numbers(entry[key], name, key, count) for key, count in zip(keys, (4, 3), strict=True))
    if abs(np.linalg.norm(rotation) - 1.0) > MAX_OFF_UNIT:
        raise InputError(
            f"'{name}': {keys[0]} is no rotation: its length is {np.linalg.norm(rotation):.4g}, not 1; correct it"
        )
    return Rigid3(_rotation(rotation), shift)


def _rotation(wxyz: FloatArray) -> FloatArray:
    from scipy.spatial.transform import Rotation

    return nearest_rotation(Rotation.from_quat(np.roll(wxyz, -1)).as_matrix())
