"""Triangle meshes as binary PLY files that Open3D, CloudCompare and MeshLab read."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rigkit.core.arrays import Normals, Points


def mesh_bytes(points: Points, normals: Normals, colours: NDArray[np.uint8], triangles: NDArray[np.int32]) -> bytes:
    """Return the PLY of vertices (V, 3) with normals and colours, single precision, and triangles (T, 3)."""
    places = [(name, "<f4") for name in ("x", "y", "z", "nx", "ny", "nz")]
    vertices = np.empty(len(points), dtype=[*places, *((name, "u1") for name in ("red", "green", "blue"))])
    for k, axis in enumerate("xyz"):
        vertices[axis], vertices[f"n{axis}"] = points[:, k], normals[:, k]
    for k, name in enumerate(("red", "green", "blue")):
        vertices[name] = colours[:, k]
    faces = np.empty(len(triangles), dtype=[("count", "u1"), ("corners", "<i4", 3)])
    faces["count"], faces["corners"] = 3, triangles
    header = ["ply", "format binary_little_endian 1.0", "comment rigkit mesh", f"element vertex {len(vertices)}"]
    header += [f"property float {name}" for name, _ in places]
    header += [f"property uchar {name}" for name in ("red", "green", "blue")]
    header += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header"]
    return ("\n".join(header) + "\n").encode() + vertices.tobytes() + faces.tobytes()
