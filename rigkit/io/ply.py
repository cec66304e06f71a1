"""Oriented clouds and triangle meshes as PLY files (binary, little endian) for Open3D, CloudCompare and MeshLab.

Points have the properties x y z nx ny nz red green blue, which these programs know, and sigma_mm, normal_sigma_deg and,
if there are boards, board, column, row, which they show as scalar fields.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rigkit.core.arrays import FloatArray, Normals, Points
from rigkit.core.cloud import OrientedCloud
from rigkit.core.errors import InputError
from rigkit.io.disk.reading import read_bytes
from rigkit.io.disk.writing import write_atomic

PLY_TYPES = (
    {"char": "i1", "uchar": "u1", "short": "<i2", "ushort": "<u2", "int": "<i4", "uint": "<u4"}
    | {"int8": "i1", "uint8": "u1", "int16": "<i2", "uint16": "<u2", "int32": "<i4", "uint32": "<u4"}
    | {"float": "<f4", "float32": "<f4", "double": "<f8", "float64": "<f8"}
)
"""Names of the types in headers -> numpy's."""
POINT = ("x", "y", "z")
NORMAL_COLUMNS = ("nx", "ny", "nz")
COLOUR = ("red", "green", "blue")
BOARD_COMMENT = "board "
SIGMA_COMMENT = "sigmas: noise of the image points and of the relative pose"
WITH_CALIBRATIONS = ", and the covariance of the calibrations"
SIGMAS_COMMENT = {
    True: f"{SIGMA_COMMENT}{WITH_CALIBRATIONS}",
    False: f"{SIGMA_COMMENT}; the calibrations, or one of two, count as exact",
}
"""Comment about the sigmas, by `OrientedCloud.calibration_in_sigmas`."""
FROM_ORIGIN_COMMENT = "all points were seen from the origin"
"""Comment of clouds with `OrientedCloud.from_origin`."""


def write_ply(
    path: str | Path,
    cloud: OrientedCloud,
    *,
    force: bool = False,
    single_precision: bool = False,
    comments: Iterable[str] = (),
) -> None:
    """Write a cloud as PLY, in mm and the frame of camera 1.

    Raises InputError: the cloud is empty, the file exists, or it cannot be written.

    Parameters
    ----------
    path : file; an existing one is refused unless `force`.
    cloud : oriented cloud with one point or more.
    single_precision : 32-bit coordinates, for programs that cannot read 64-bit ones.
    comments : lines for the header.
    """
    write_atomic(path, ply_bytes(cloud, single_precision=single_precision, comments=comments), force=force)


def ply_bytes(
    cloud: OrientedCloud,
    *,
    single_precision: bool = False,
    confidence: bool = False,
    comments: Iterable[str] = (),
    unit: str = "mm",
) -> bytes:
    """Return the content of the PLY file of a cloud; raises InputError for an empty one.

    With `confidence`, normals are scaled by median sigma / sigma: PoissonRecon's --confidence weights points by them.
    """
    if len(cloud) == 0:
        raise InputError("point cloud: it has no points, so there is nothing to write; see what was dropped, and why")
    real = "float" if single_precision else "double"
    normals = cloud.normals
    if confidence:
        sigma = cloud.normal_sigma_rad
        known = np.isfinite(sigma) & (sigma > 0.0)
        typical = float(np.median(sigma[known])) if known.any() else 1.0
        normals = normals * (typical / np.where(known, sigma, typical))[:, None]
    on_boards = (("board", cloud.board_index), *zip(("column", "row"), cloud.grid.T, strict=True))
    columns: list[tuple[str, str, NDArray[np.generic]]] = [
        *((name, real, cloud.points_mm[:, i]) for i, name in enumerate(POINT)),
        *((name, real, normals[:, i]) for i, name in enumerate(NORMAL_COLUMNS)),
        *((name, "uchar", cloud.colours[:, i]) for i, name in enumerate(COLOUR)),
        *((name, "int", values) for name, values in on_boards if (cloud.board_index >= 0).any()),
        ("sigma_mm", real, cloud.sigma_mm),
        ("normal_sigma_deg", real, np.rad2deg(cloud.normal_sigma_rad)),
    ]
    table = np.empty(len(cloud), dtype=[(name, PLY_TYPES[kind]) for name, kind, _ in columns])
    for name, _, values in columns:
        table[name] = values
    notes = ["rigkit oriented point cloud", f"units {unit}", "frame camera 1: x right, y down, z forward"]
    notes.append(SIGMAS_COMMENT[cloud.calibration_in_sigmas])
    notes += [FROM_ORIGIN_COMMENT] * cloud.from_origin
    notes += [f"{BOARD_COMMENT}{i} {_one_line(board_id)}" for i, board_id in enumerate(cloud.board_ids)]
    notes += [_one_line(line) for line in comments]
    header = ["ply", "format binary_little_endian 1.0", *(f"comment {line}" for line in notes)]
    header += [f"element vertex {len(cloud)}", *(f"property {kind} {name}" for name, kind, _ in columns), "end_header"]
    return ("\n".join(header) + "\n").encode("utf-8") + table.tobytes()


def mesh_bytes(points: Points, normals: Normals, colours: NDArray[np.uint8], triangles: NDArray[np.int32]) -> bytes:
    """Return the PLY of vertices (V, 3) with normals and colours, single precision, and triangles (T, 3)."""
    places = [(name, "<f4") for name in (*POINT, *NORMAL_COLUMNS)]
    vertices = np.empty(len(points), dtype=[*places, *((name, "u1") for name in COLOUR)])
    for names, columns in ((POINT, points), (NORMAL_COLUMNS, normals), (COLOUR, colours)):
        for name, column in zip(names, columns.T, strict=True):
            vertices[name] = column
    faces = np.empty(len(triangles), dtype=[("count", "u1"), ("corners", "<i4", 3)])
    faces["count"], faces["corners"] = 3, triangles
    header = ["ply", "format binary_little_endian 1.0", "comment rigkit mesh"]
    header += ["comment units mm, frame as of the cloud", f"element vertex {len(vertices)}"]
    header += [f"property float {name}" for name, _ in places]
    header += [f"property uchar {name}" for name in COLOUR]
    header += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header"]
    return ("\n".join(header) + "\n").encode() + vertices.tobytes() + faces.tobytes()


def _one_line(text: str) -> str:
    """Return the text for a header line: whitespace as blanks, other control characters as '?'."""
    return "".join(c if c.isprintable() else "?" for c in " ".join(str(text).split()))


def read_ply(path: str | Path) -> OrientedCloud:
    """Return the cloud of a binary little-endian PLY file with normals.

    Other properties may be missing: points are then grey, without boards, and have NaN sigmas.

    Raises InputError: no such file, not such a PLY, no normals, or truncated.
    """
    source = Path(path)
    data = read_bytes(source, "point cloud")
    count, fields, board_ids, start = _header(data, source)
    kinds = np.dtype(fields)
    if len(data) < start + count * kinds.itemsize:
        have = (len(data) - start) // kinds.itemsize
        raise InputError(f"point cloud '{source}' is cut off: {have} of {count} points; write or copy it again")
    table = np.frombuffer(data, dtype=kinds, count=count, offset=start)
    names = set(kinds.names or ())
    missing = [name for name in (*POINT, *NORMAL_COLUMNS) if name not in names]
    if missing:
        raise InputError(f"point cloud '{source}' has no {', '.join(missing)}; an oriented cloud needs x y z nx ny nz")

    def column(name: str, default: float) -> NDArray[np.generic]:
        return np.asarray(table[name]) if name in names else np.full(count, default)

    try:
        return OrientedCloud(
            points_mm=np.stack([table[name] for name in POINT], axis=-1).astype(np.float64),
            normals=_unit_normals(np.stack([table[name] for name in NORMAL_COLUMNS], axis=-1).astype(np.float64)),
            colours=np.stack([column(name, 128) for name in COLOUR], axis=-1).astype(np.uint8),
            board_index=column("board", -1).astype(np.int64),
            grid=np.stack([column("column", 0), column("row", 0)], axis=-1).astype(np.int64),
            sigma_mm=column("sigma_mm", np.nan).astype(np.float64),
            normal_sigma_rad=np.deg2rad(column("normal_sigma_deg", np.nan).astype(np.float64)),
            board_ids=board_ids,
            calibration_in_sigmas=f"{WITH_CALIBRATIONS}\n".encode() in data[:start],
            from_origin=f"\ncomment {FROM_ORIGIN_COMMENT}\n".encode() in data[:start],
        )
    except InputError as error:
        raise InputError(f"point cloud '{source}': {error}; write it again") from error


def ply_unit(path: str | Path) -> str:
    """Return the unit of length in a file's header, by default mm; raises as `read_ply`."""
    data = read_bytes(path, "point cloud")
    start = _header(data, Path(path))[-1]
    described = re.search(rb"^comment units (\S+)$", data[:start], re.MULTILINE)
    return "mm" if described is None else described[1].decode("utf-8", errors="replace")


def _unit_normals(normals: FloatArray) -> FloatArray:
    """Return normals (N, 3) scaled to unit length: some files store confidences in them. Zero normals are kept."""
    largest = np.abs(normals).max(axis=1, keepdims=True, initial=0.0)
    # NaN is refused with the cloud.
    with np.errstate(over="ignore", invalid="ignore"):
        # Squares of these would overflow or underflow.
        normals = normals / np.where((largest > 0.0) & ((largest < 1e-100) | (largest > 1e100)), largest, 1.0)
        length = np.linalg.norm(normals, axis=1, keepdims=True)
    # Unit normals up to rounding are kept as written.
    whole = (np.abs(length - 1.0) < 1e-6) | ~(length > 0.0)
    return np.asarray(normals / np.where(whole, 1.0, length))


def _header(data: bytes, source: Path) -> tuple[int, list[tuple[str, str]], tuple[str, ...], int]:
    """Return the number of points, their fields, the board names, and the offset of the points."""
    end = data.find(b"\nend_header\n") + 1
    if not data.startswith(b"ply") or end <= 0:
        raise InputError(f"'{source}' is not a PLY file, or its header is cut off; give a file written by rigkit")
    lines = data[:end].decode("utf-8", errors="replace").splitlines()
    if "format binary_little_endian 1.0" not in lines:
        raise InputError(f"'{source}': only binary little-endian PLY is read; convert it, for example with Open3D")
    try:
        count, fields, boards = _declared(lines, source)
    except (IndexError, ValueError) as error:
        raise InputError(f"'{source}': the PLY header is damaged ({error}); write or copy it again") from error
    if count < 0 or not fields:
        raise InputError(f"'{source}': the PLY declares no points; give a point cloud")
    return count, fields, tuple(boards[i] for i in sorted(boards)), end + len(b"end_header\n")


def _declared(lines: list[str], source: Path) -> tuple[int, list[tuple[str, str]], dict[int, str]]:
    """Return the number of points (-1 if undeclared), their fields, and the boards named in comments."""
    count = -1
    fields: list[tuple[str, str]] = []
    boards: dict[int, str] = {}
    for line in lines:
        words = line.split()
        if line.startswith(f"comment {BOARD_COMMENT}") and len(words) > 3 and words[2].isdigit():
            boards[int(words[2])] = " ".join(words[3:])
        elif words[:2] == ["element", "vertex"]:
            count = int(words[2])
        elif words[:1] == ["element"] and count < 0:
            raise InputError(f"'{source}': the points must be the first element of the PLY; convert it with Open3D")
        elif words[:1] == ["element"]:
            break
        elif words[:1] == ["property"]:
            if words[1] not in PLY_TYPES:
                raise InputError(f"'{source}': properties of type '{words[1]}' are not read; convert it with Open3D")
            if words[2] in dict(fields):
                raise InputError(f"'{source}': property '{words[2]}' is declared twice; write or copy the file again")
            fields.append((words[2], PLY_TYPES[words[1]]))
    return count, fields, boards
