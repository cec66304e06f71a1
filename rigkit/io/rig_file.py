"""Rig files (JSON, schema "rigkit.rig/1"): cameras, where they sit, and how sure that is."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from rigkit.calibration.rig import RigCalibration
from rigkit.cameras.base import Camera
from rigkit.errors import InputError
from rigkit.geometry.rigid3 import Rigid3
from rigkit.io.calibration_file import camera_from_json, camera_to_json
from rigkit.io.files import write_atomic

__all__ = ["SCHEMA", "load_rig", "save_rig"]

SCHEMA = "rigkit.rig/1"
KEYS = {"schema", "cameras", "rms_px", "sigma_px", "covariance", "baselines"}
CAMERA_KEYS = {"name", "camera", "cam_from_rig", "rms_px"}


def save_rig(path: str | Path, rig: RigCalibration, *, force: bool = False) -> None:
    """Write the rig; raises InputError where the file exists and `force` is not set."""
    names = [c.name for c in rig.cameras]
    pairs = [(a, b, *rig.baseline_mm(a, b)) for i, a in enumerate(names) for b in names[i + 1 :]]
    data = {
        "schema": SCHEMA,
        "rms_px": rig.rms_px,
        "sigma_px": rig.sigma_px,
        "baselines": [{"from": a, "to": b, "value_mm": v, "sigma_mm": s} for a, b, v, s in pairs],
        "cameras": [
            {
                "name": c.name,
                "camera": camera_to_json(c.camera),
                "cam_from_rig": c.cam_from_rig.matrix()[:3].tolist(),
                "rms_px": c.rms_px,
            }
            for c in rig.cameras
        ],
        "covariance": rig.covariance.tolist(),
    }
    write_atomic(path, json.dumps(data, indent=1, allow_nan=False) + "\n", force=force)


def load_rig(path: str | Path) -> dict[str, tuple[Camera, Rigid3]]:
    """Return camera and cam_from_rig of every camera by name.

    Raises InputError for a missing or damaged file, another schema or an unknown key.
    """
    try:
        data: Any = json.loads(Path(path).read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise InputError(f"rig file '{path}' does not exist; check the path") from error
    except (OSError, ValueError) as error:
        raise InputError(f"'{path}': not a rig file ({error}); calibrate again") from error
    if not isinstance(data, dict) or data.get("schema") != SCHEMA:
        raise InputError(f"'{path}': a file with schema '{SCHEMA}' is needed here")
    unknown = sorted(set(data) - KEYS)
    if unknown:
        raise InputError(f"'{path}': unknown key '{unknown[0]}'; known: {', '.join(sorted(KEYS))}")
    out: dict[str, tuple[Camera, Rigid3]] = {}
    try:
        for entry in data["cameras"]:
            if set(entry) != CAMERA_KEYS:
                raise InputError(f"'{path}': a camera must have the keys {', '.join(sorted(CAMERA_KEYS))}, no others")
            camera = camera_from_json(entry["camera"], path)
            out[str(entry["name"])] = (camera, Rigid3.from_matrix(entry["cam_from_rig"]))
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"'{path}': damaged ({error}); calibrate again") from error
    return out
