"""COLMAP's cameras.txt and cameras.bin, without COLMAP.

COLMAP's pixel (0.5, 0.5) is the centre of the first pixel: cx and cy differ by that. Models that rigkit lacks are
refitted by the model that fits best; the largest error goes to the log.
"""

from __future__ import annotations

import logging
import struct
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from rigkit.cameras.base import Camera
from rigkit.core.arrays import FloatArray, Pixels
from rigkit.core.errors import InputError
from rigkit.interop.colmap import HALF_PIXEL
from rigkit.interop.exchange import PERSPECTIVE, Accepted, Written, best_accepted, camera_of, image_size, numbers
from rigkit.interop.foreign_lenses import fisheye_prism_lens, fov_lens, thin_prism_fisheye_lens
from rigkit.interop.nearest import Lens, nearest_camera_of

_log = logging.getLogger(__name__)

COLMAP_ACCEPTS = (*PERSPECTIVE, Accepted("kannala_brandt"), Accepted("eucm"))
MAX_COLMAP_DIGITS = 9
SHARED = ("fx", "fy", "cx", "cy")
BEHIND = "COLMAP projects no point at or beyond 90 degrees"

# COLMAP's model -> rigkit's model, and the names of its parameters there; f is used as fx and fy.
LAYOUTS: dict[str, tuple[str, tuple[str, ...]]] = {
    "SIMPLE_PINHOLE": ("pinhole", ("f", "cx", "cy")),
    "PINHOLE": ("pinhole", ("fx", "fy", "cx", "cy")),
    "SIMPLE_RADIAL": ("brown", ("f", "cx", "cy", "k1")),
    "RADIAL": ("brown", ("f", "cx", "cy", "k1", "k2")),
    "OPENCV": ("brown", ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")),
    "FULL_OPENCV": ("brown", ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")),
    "SIMPLE_FISHEYE": ("kannala_brandt", ("f", "cx", "cy")),
    "FISHEYE": ("kannala_brandt", ("fx", "fy", "cx", "cy")),
    "SIMPLE_RADIAL_FISHEYE": ("kannala_brandt", ("f", "cx", "cy", "k1")),
    "RADIAL_FISHEYE": ("kannala_brandt", ("f", "cx", "cy", "k1", "k2")),
    "OPENCV_FISHEYE": ("kannala_brandt", ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4")),
    "EUCM": ("eucm", ("fx", "fy", "cx", "cy", "alpha", "beta")),
}

FURTHER = {
    "SIMPLE_DIVISION": ("f", "cx", "cy", "k"),
    "DIVISION": ("fx", "fy", "cx", "cy", "k"),
    "FOV": ("fx", "fy", "cx", "cy", "omega"),
    "THIN_PRISM_FISHEYE": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "sx1", "sy1"),
    "RAD_TAN_THIN_PRISM_FISHEYE": (
        "fx", "fy", "cx", "cy", "k0", "k1", "k2", "k3", "k4", "k5", "p0", "p1", "s0", "s1", "s2", "s3",
    ),
}  # fmt: skip
"""Parameters of COLMAP's models that rigkit lacks."""

OWN = {"pinhole": "PINHOLE", "brown": "OPENCV", "kannala_brandt": "OPENCV_FISHEYE", "eucm": "EUCM"}
"""rigkit's model -> COLMAP's; FULL_OPENCV for more than four terms of a Brown camera."""

COUNT_RECORD, CAMERA_RECORD = struct.Struct("<Q"), struct.Struct("<iiQQ")
MODELS_BY_ID = (
    "SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV", "FOV",
    "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "THIN_PRISM_FISHEYE", "RAD_TAN_THIN_PRISM_FISHEYE", "SIMPLE_DIVISION",
    "DIVISION", "SIMPLE_FISHEYE", "FISHEYE", "EUCM",
)  # fmt: skip
"""COLMAP's models by id (src/colmap/sensor/models.h)."""


def write_colmap_cameras(
    cameras: Mapping[int, Camera], outlines: Mapping[int, Pixels] | None = None
) -> tuple[str, dict[int, Written]]:
    """Return cameras.txt of cameras by COLMAP's id (from 1), and each camera as `Written`, whose `text` is its line.

    `outlines` by id are as for `best_accepted`.
    """
    written: dict[int, Written] = {}
    for camera_id, camera in cameras.items():
        chosen = best_accepted(camera, COLMAP_ACCEPTS, "COLMAP", (outlines or {}).get(camera_id))
        c = chosen.camera
        name = "FULL_OPENCV" if c.model == "brown" and c.parameters.size > 8 else OWN[c.model]
        ours = c.named(c.parameters)
        ours["cx"] += HALF_PIXEL
        ours["cy"] += HALF_PIXEL
        values = " ".join(repr(ours.get(key, 0.0)) for key in LAYOUTS[name][1])
        line = replace(chosen, text=f"{camera_id} {name} {c.size_px[0]} {c.size_px[1]} {values}\n")
        if c.model in ("kannala_brandt", "eucm") and _sees_behind(c):
            note = f"{line.note}; {BEHIND}" if line.note else BEHIND
            line = replace(line, note=note)
        written[camera_id] = line
    header = (
        "# Camera list with one line of data per camera:\n"
        "#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n"
        f"# Number of cameras: {len(written)}\n"
    )
    return header + "".join(line.text for line in written.values()), written


def read_colmap_cameras(text: str, name: str = "cameras.txt") -> dict[int, Camera]:
    """Return the cameras of cameras.txt by id; raises InputError for unknown models and damaged lines."""
    cameras: dict[int, Camera] = {}
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        where, at = f"'{name}', line {number}", f"{name}, line {number}"
        if len(words) < 5 or words[1] not in (*LAYOUTS, *FURTHER):
            model = words[1] if len(words) > 1 else ""
            raise InputError(f"{where}: camera model '{model}' is unknown; known: {', '.join((*LAYOUTS, *FURTHER))}")
        keys = parameters_of(words[1])
        try:
            camera_id, *size, values = (*(_integer(words[i]) for i in (0, 2, 3)), [float(w) for w in words[4:]])
        except ValueError as error:
            raise InputError(f"{where}: not a camera ({error}); correct the line") from error
        if camera_id in cameras:
            raise InputError(f"{where}: camera {camera_id} is there twice; leave one")
        if len(values) != len(keys):
            raise InputError(f"{where}: {words[1]} has {len(keys)} parameters, found {len(values)}; correct the line")
        size_px = image_size(size, at, "size")
        cameras[camera_id] = _camera(words[1], size_px, dict(zip(keys, values, strict=True)), at)
    if not cameras:
        raise InputError(f"'{name}': no camera in it; is it COLMAP's cameras.txt?")
    return cameras


def colmap_cameras_text(data: bytes) -> str | None:
    """Return the cameras.txt of a cameras.bin; None for other data.

    The file has a count, then for each camera id and model (int32), width and height (uint64) and the parameters, all
    little-endian. No text passes these checks.
    """
    lines, at = [], COUNT_RECORD.size
    if len(data) < at or not 0 < COUNT_RECORD.unpack_from(data)[0] <= len(data) // CAMERA_RECORD.size:
        return None
    for _ in range(COUNT_RECORD.unpack_from(data)[0]):
        if len(data) < at + CAMERA_RECORD.size:
            return None
        camera_id, model, width, height = CAMERA_RECORD.unpack_from(data, at)
        at += CAMERA_RECORD.size
        if not 0 <= model < len(MODELS_BY_ID):
            return None
        name = MODELS_BY_ID[model]
        count = len(parameters_of(name))
        if len(data) < at + 8 * count:
            return None
        values = struct.unpack_from(f"<{count}d", data, at)
        at += 8 * count
        lines.append(f"{camera_id} {name} {width} {height} {' '.join(map(repr, values))}\n")
    return "".join(lines) if at == len(data) else None


def parameters_of(model: str) -> tuple[str, ...]:
    """Return the names of the parameters of one of COLMAP's models."""
    return LAYOUTS[model][1] if model in LAYOUTS else FURTHER[model]


def _integer(word: str) -> int:
    if not word.isascii() or not word.isdigit() or len(word) > MAX_COLMAP_DIGITS:
        raise ValueError(f"'{word[:40]}' is no whole number")
    return int(word)


def _camera(kind: str, size_px: tuple[int, int], theirs: dict[str, float], name: str) -> Camera:
    """Return the camera of one of COLMAP's models; a refit is logged with its largest error."""
    if "f" in theirs:
        theirs = {"fx": theirs["f"], "fy": theirs["f"], **theirs}
    theirs = {**theirs, "cx": theirs["cx"] - HALF_PIXEL, "cy": theirs["cy"] - HALF_PIXEL}
    if kind in LAYOUTS:
        model = LAYOUTS[kind][0]
        return camera_of(model, size_px, _parameters(model, theirs), name)
    fx, fy, cx, cy, *rest = (theirs[key] for key in (*SHARED, *(k for k in FURTHER[kind] if k not in (*SHARED, "f"))))
    core, terms = numbers([fx, fy, cx, cy], name, "params"), numbers(rest, name, "params")
    if not (core[:2] > 0.0).all():
        raise InputError(f"'{name}': focal lengths are positive; correct the line")
    if kind.endswith("DIVISION"):
        # x / (1 + k r^2) is the ray (x, y, 1 + k r^2): Scaramuzza's polynomial, in pixels along y.
        return camera_of("scaramuzza", size_px, np.array([fy, terms[0] / fy, 0.0, cx, cy, fx / fy, 0.0]), name)
    lens: Lens
    if kind == "FOV":
        if not 0.0 < terms[0] < np.pi:
            raise InputError(f"'{name}': omega = {terms[0]:g} of the FOV model lies between 0 and pi; correct the line")
        lens = fov_lens(core, float(terms[0]))
    elif kind == "THIN_PRISM_FISHEYE":
        lens = thin_prism_fisheye_lens(core, terms)
    else:
        lens = fisheye_prism_lens(core, terms[:6], terms[6:])
    camera, worst = nearest_camera_of(lens, size_px, name, np.pi)
    _log.info(f"{name}: {kind} was refitted as '{camera.model}', at most {worst:.2g} px away")
    return camera


def _parameters(model: str, theirs: dict[str, float]) -> FloatArray:
    names = LAYOUTS[OWN[model]][1]
    if model == "brown" and any(theirs.get(k, 0.0) != 0.0 for k in ("k4", "k5", "k6")):
        names = LAYOUTS["FULL_OPENCV"][1]
    elif model == "brown" and "k3" in theirs:
        names = (*names, "k3")
    return np.array([theirs.get(key, 0.0) for key in names])


def _sees_behind(camera: Camera) -> bool:
    """Return whether a corner of the image is 90 degrees or more from the axis, or not seen."""
    width, height = camera.size_px
    corners = np.array([[0.0, 0.0], [width - 1.0, 0.0], [0.0, height - 1.0], [width - 1.0, height - 1.0]])
    rays, valid = camera.unproject(corners)
    return bool((~valid | (rays[:, 2] <= 0.0)).any())
