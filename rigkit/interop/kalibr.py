"""Kalibr's camchain YAML of one camera or a rig.

Pixel (0, 0) is the centre of the first pixel, as in rigkit; lengths are in metres, T_cn_cnm1 is cam_n from cam_(n-1).
"""

from __future__ import annotations

import logging
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from rigkit.cameras.base import Camera
from rigkit.core.arrays import FloatArray, Pixels
from rigkit.core.errors import InputError
from rigkit.geometry.rigid3 import Rigid3
from rigkit.interop.exchange import (
    MM_PER_M,
    PERSPECTIVE,
    Accepted,
    Written,
    best_accepted,
    camera_of,
    field,
    image_size,
    numbers,
    pose_of,
    unified_from_xi,
    unified_with_xi,
)
from rigkit.interop.foreign_lenses import fov_lens, unified_brown_lens
from rigkit.interop.nearest import Lens, nearest_camera_of
from rigkit.interop.yaml_text import flow, parse_yaml

KALIBR_ACCEPTS = (*PERSPECTIVE[:2], *(Accepted(model) for model in ("kannala_brandt", "ucm", "eucm", "double_sphere")))
_log = logging.getLogger(__name__)

CAMERA = re.compile(r"cam[0-9]{1,3}")


@dataclass(frozen=True, eq=False, slots=True)
class KalibrChain:
    """A camchain file: its `text`, and each camera as `Written`, whose `text` is its part of the file."""

    text: str
    cameras: tuple[Written, ...]


def write_kalibr(
    cameras: Sequence[Camera],
    cam_from_rig: Sequence[Rigid3] | None = None,
    outlines: Sequence[Pixels | None] | None = None,
) -> KalibrChain:
    """Return the cameras as a camchain.

    Parameters
    ----------
    cam_from_rig : pose of each camera, in mm; needed for several cameras.
    outlines : outline of each camera, as for `best_accepted`; None: unknown.

    Raises InputError for missing poses, or a lens that no model of Kalibr fits.
    """
    if not cameras or (len(cameras) > 1 and cam_from_rig is None):
        raise InputError("camchain: give at least one camera, and for several the pose of each (cam_from_rig)")
    if cam_from_rig is not None and len(cam_from_rig) != len(cameras):
        raise InputError(f"camchain: {len(cameras)} cameras, but {len(cam_from_rig)} poses")
    parts = []
    for i, camera in enumerate(cameras):
        chosen = best_accepted(camera, KALIBR_ACCEPTS, "Kalibr", None if outlines is None else outlines[i])
        model, intrinsics, distortion_model, distortion = _described(chosen.camera)
        lines = [f"cam{i}:"]
        if i and cam_from_rig is not None:
            matrix = (cam_from_rig[i] @ cam_from_rig[i - 1].inverse()).matrix()
            matrix[:3, 3] /= MM_PER_M
            lines += ["  T_cn_cnm1:", *(f"  - {flow(row)}" for row in matrix)]
        lines += [
            f"  camera_model: {model}",
            f"  distortion_coeffs: {flow(distortion)}",
            f"  distortion_model: {distortion_model}",
            f"  intrinsics: {flow(intrinsics)}",
            f"  resolution: {flow(list(camera.size_px))}",
            f"  rostopic: /cam{i}/image_raw",
        ]
        parts.append(replace(chosen, text="\n".join(lines) + "\n"))
    return KalibrChain("".join(part.text for part in parts), tuple(parts))


def read_kalibr(text: str, name: str = "camchain") -> tuple[tuple[Camera, ...], tuple[Rigid3, ...]]:
    """Return the cameras of a camchain and cam_from_rig of each; the rig's frame is that of cam0.

    "pinhole" with "fov" and "omni" with "radtan" are refitted, which is logged. Raises InputError for a camera after
    cam0 without T_cn_cnm1, unknown models, and damaged files.
    """
    data = parse_yaml(text, name)
    keys = sorted((k for k in data if CAMERA.fullmatch(k)), key=lambda k: int(k[3:]))
    if not keys:
        raise InputError(f"'{name}': no cam0; is it a camchain of Kalibr?")
    cameras, poses = [], [Rigid3.identity()]
    for key in keys:
        block = field(data, key, name)
        cameras.append(_camera(block, f"{name}, {key}"))
        if len(cameras) > 1:
            matrix = numbers(field(block, "T_cn_cnm1", f"{name}, {key}"), name, f"{key}: T_cn_cnm1", 16).reshape(4, 4)
            step = pose_of(matrix[:3, :3], matrix[:3, 3] * MM_PER_M, f"{name}, {key}: T_cn_cnm1")
            poses.append(step @ poses[-1])
    return tuple(cameras), tuple(poses)


def _described(camera: Camera) -> tuple[str, FloatArray, str, FloatArray]:
    """Return camera_model, intrinsics, distortion_model, distortion_coeffs."""
    p = camera.parameters
    nothing = np.zeros(0)
    if camera.model == "pinhole":
        return "pinhole", p, "radtan", np.zeros(4)
    if camera.model == "brown":
        return "pinhole", p[:4], "radtan", p[4:8]
    if camera.model == "kannala_brandt":
        return "pinhole", p[:4], "equidistant", p[4:8]
    if camera.model == "ucm":
        xi, core = unified_with_xi(camera)
        return "omni", np.array([xi, *core]), "none", nothing
    return {"eucm": "eucm", "double_sphere": "ds"}[camera.model], np.array([*p[4:], *p[:4]]), "none", nothing


def _camera(block: Any, name: str) -> Camera:
    model = str(field(block, "camera_model", name))
    distortion_model = str(block.get("distortion_model", "none"))
    size = image_size(field(block, "resolution", name), name, "resolution")
    intrinsics = numbers(field(block, "intrinsics", name), name, "intrinsics")
    distortion = numbers(block.get("distortion_coeffs") or [], name, "distortion_coeffs")
    expected = {"pinhole": 4, "omni": 5, "eucm": 6, "ds": 6}
    if model not in expected:
        raise InputError(f"'{name}': camera_model '{model}' is unknown; known: {', '.join(expected)}")
    if intrinsics.size != expected[model]:
        raise InputError(
            f"'{name}': {model} has {expected[model]} intrinsics, found {intrinsics.size}; "
            "correct 'intrinsics' or 'camera_model'"
        )
    if model == "pinhole" and distortion_model == "equidistant":
        return camera_of("kannala_brandt", size, np.concatenate([intrinsics, distortion]), name)
    if model == "pinhole" and distortion_model == "radtan" and distortion.any():
        return camera_of("brown", size, np.concatenate([intrinsics, distortion]), name)
    lens = _foreign_lens(model, distortion_model, intrinsics, distortion)
    if lens is not None:
        camera, worst = nearest_camera_of(lens, size, name, np.pi)
        _log.info(f"{name}: {model}-{distortion_model} was refitted as '{camera.model}', at most {worst:.2g} px away")
        return camera
    if distortion.any():
        raise InputError(
            f"'{name}': {model} with distortion_model '{distortion_model}' is not supported; calibrate with radtan, "
            "equidistant or fov on a pinhole, radtan on omni, or without distortion"
        )
    if model == "pinhole":
        return camera_of("pinhole", size, intrinsics, name)
    if model == "omni":
        return unified_from_xi(size, float(intrinsics[0]), intrinsics[1:], name)
    ours = {"eucm": "eucm", "ds": "double_sphere"}[model]
    return camera_of(ours, size, np.concatenate([intrinsics[2:], intrinsics[:2]]), name)


def _foreign_lens(model: str, distortion_model: str, intrinsics: FloatArray, distortion: FloatArray) -> Lens | None:
    """Return the lens of a model that rigkit lacks; None for other models, and for invalid parameters."""
    if model == "pinhole" and distortion_model == "fov" and distortion.size == 1 and 0.0 < distortion[0] < np.pi:
        return fov_lens(intrinsics, float(distortion[0]))
    if model == "omni" and distortion_model == "radtan" and distortion.size == 4 and distortion.any():
        return unified_brown_lens(intrinsics[1:], float(intrinsics[0]), distortion) if intrinsics[0] >= 0.0 else None
    return None
