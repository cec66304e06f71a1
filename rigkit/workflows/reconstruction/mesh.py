"""`rigkit mesh`: a triangle mesh from an oriented cloud."""

from __future__ import annotations

from pathlib import Path

from rigkit.core.errors import InputError
from rigkit.core.progress import Progress, silent
from rigkit.interop.open3d import Mesh, poisson_mesh
from rigkit.io.disk.reading import about
from rigkit.io.disk.writing import ensure_writable, write_atomic
from rigkit.io.ply import mesh_bytes, read_ply
from rigkit.reconstruction.lines_of_sight import with_lines_of_sight
from rigkit.workflows.options.clouds import MeshOptions

MAX_OCTREE_DEPTH = 12
"""Each further level takes four times the memory; this one takes several GB."""


def mesh_cloud(cloud: str | Path, options: MeshOptions, *, progress: Progress = silent) -> Mesh:
    """Write the screened Poisson surface of the oriented cloud in a PLY file, and return it.

    Raises InputError: the cloud cannot be read or has no normals, the file cannot be written, an option is out of
    range; DegenerateError: nothing is left of the surface.
    """
    if not 3 <= options.depth <= MAX_OCTREE_DEPTH:
        raise InputError(f"mesh: the depth of the octree must be 3 to {MAX_OCTREE_DEPTH}, got {options.depth}")
    if not 0.0 <= options.cut < 1.0:
        raise InputError(f"mesh: the share that is cut off must be from 0 to below 1, got {options.cut}")
    ensure_writable(options.output, force=options.force, inputs=[Path(cloud)])
    points = read_ply(cloud)
    if points.from_origin if options.one_view is None else options.one_view:
        points = with_lines_of_sight(points)
    progress("fitting the surface", 0, 1)
    with about(cloud):
        mesh = poisson_mesh(points, depth=options.depth, cut=options.cut)
    progress("fitting the surface", 1, 1)
    write_atomic(options.output, mesh_bytes(*mesh), force=options.force)
    return mesh
