"""Poses of a robot's hand (base_from_hand) as CSV, one row for each image or moment.

::

    image,x_mm,y_mm,z_mm,qx,qy,qz,qw
    0001.png,412.1,-88.0,630.5,0.01,0.99,0.02,0.1

Lengths may be x_m, y_m, z_m instead; a rotation vector rx_rad, ry_rad, rz_rad (or rx_deg, ...) instead of the
quaternion. Motion capture has a column timestamp_ns instead of image: images are then named by their timestamps
(1606153907495166540.png), and their poses are interpolated.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from rigkit.core.errors import InputError
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3, log_so3
from rigkit.io.disk.reading import MAX_NUMBER, csv_table

LENGTHS = {"mm": 1.0, "m": 1000.0}
TURNS = {"rad": 1.0, "deg": np.pi / 180.0}
QUATERNION = ("qx", "qy", "qz", "qw")
MAX_GAP_NS = 200_000_000
"""Maximum time between poses to interpolate."""
UNIT_TOLERANCE = 0.01
"""Tolerance of a quaternion's length: files have three digits or more."""


def read_robot_poses(path: str | Path, images: Sequence[str] = ()) -> dict[str, Rigid3]:
    """Return base_from_hand by image name; from a table of timestamps, those of the `images`.

    Raises InputError, with the line, for missing columns, invalid numbers, a quaternion that is not of unit length, and
    a duplicate image; also for an image whose name is no timestamp, or whose timestamp is not between two close rows.
    """
    source = Path(path)
    head, rows = csv_table(source, "robot poses")
    length = next((unit for unit in LENGTHS if all(f"{axis}_{unit}" in head for axis in "xyz")), None)
    turn = next((unit for unit in TURNS if all(f"r{axis}_{unit}" in head for axis in "xyz")), None)
    key = "image" if "image" in head else "timestamp_ns"
    if key not in head or length is None or not (turn or all(key in head for key in QUATERNION)):
        raise InputError(
            f"'{source}': the first line must name the columns image (or timestamp_ns), x_mm, y_mm, z_mm (or _m), and "
            "qx, qy, qz, qw or rx_rad, ry_rad, rz_rad (or _deg)"
        )
    poses: dict[str, Rigid3] = {}
    for line, cells in rows:
        where = f"'{source}', line {line}"
        try:
            place = np.array([float(cells[f"{axis}_{length}"]) for axis in "xyz"]) * LENGTHS[length]
            keys = QUATERNION if turn is None else tuple(f"r{axis}_{turn}" for axis in "xyz")
            turned = np.array([float(cells[key]) for key in keys])
        except ValueError as error:
            raise InputError(f"{where}: {error}; write numbers with a decimal point") from error
        if not (np.abs([*place, *turned]) <= MAX_NUMBER).all():
            raise InputError(f"{where}: a value is not finite, or larger than anything measured; correct the row")
        if cells[key] in poses:
            raise InputError(f"{where}: {key} '{cells[key]}' is there twice; leave one")
        if turn is None and abs(float(np.linalg.norm(turned)) - 1.0) > UNIT_TOLERANCE:
            raise InputError(f"{where}: the quaternion has length {np.linalg.norm(turned):.3g}, not 1; correct the row")
        rotation = exp_so3(turned * TURNS[turn]) if turn else _rotation(turned)
        poses[cells[key]] = Rigid3(rotation, place)
    if not poses:
        raise InputError(f"'{source}': no pose in it; write one row an image")
    return poses if key == "image" else _between(source, poses, images)


def _between(source: Path, poses: Mapping[str, Rigid3], images: Sequence[str]) -> dict[str, Rigid3]:
    """Return the poses interpolated at the timestamps that images are named by."""
    try:
        times = np.array([int(time) for time in poses], dtype=np.int64)
    except (ValueError, OverflowError) as error:
        raise InputError(f"'{source}': timestamp_ns: {error}; write whole nanoseconds") from error
    order = np.argsort(times)
    times, known = times[order], [list(poses.values())[k] for k in order]
    out = {}
    for image in images:
        stem = Path(image).stem
        if not (stem.isascii() and stem.isdigit() and len(stem) <= 19):
            raise InputError(f"'{source}': image '{image}' is not named by its moment, in ns; give a column image")
        k = int(np.clip(np.searchsorted(times, int(stem)), 1, max(len(times) - 1, 1)))
        before, after = (int(times[max(k - 1, 0)]), int(times[min(k, len(times) - 1)]))
        if not before <= int(stem) <= after or after - before > MAX_GAP_NS:
            raise InputError(f"'{source}': no poses just before and after image '{image}'; leave the image out")
        part = (int(stem) - before) / max(after - before, 1)
        one, other = known[max(k - 1, 0)], known[min(k, len(times) - 1)]
        turn = exp_so3(part * log_so3(other.rotation @ one.rotation.T))
        place = (1.0 - part) * one.translation_mm + part * other.translation_mm
        out[image] = Rigid3(turn @ one.rotation, place)
    return out


def _rotation(quaternion: np.ndarray) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_quat(quaternion).as_matrix())
