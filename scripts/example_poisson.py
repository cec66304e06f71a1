"""Screened Poisson reconstruction of an exported cloud, through Open3D alone: the PLY is all that it needs.

rigkit reconstruct datasets/lab-a -p fisheye-general -o out/clouds
python scripts/example_poisson.py out/clouds/fisheye-general/3SDIR.ply mesh.ply
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import open3d

DEPTH = 6
"""Of the octree: 64 cells along the longest side, about a square each."""
MIN_DENSITY_QUANTILE = 0.15
"""Poisson closes the surface far from any point; what has few points near it is cut off again."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("cloud", type=Path)
    parser.add_argument("mesh", type=Path)
    args = parser.parse_args()
    cloud = open3d.io.read_point_cloud(str(args.cloud))
    if not cloud.has_normals():
        raise SystemExit(f"{args.cloud}: no normals")
    mesh, density = open3d.geometry.TriangleMesh.create_from_point_cloud_poisson(cloud, depth=DEPTH, n_threads=1)
    mesh.remove_vertices_by_mask(np.asarray(density) < np.quantile(density, MIN_DENSITY_QUANTILE))
    open3d.io.write_triangle_mesh(str(args.mesh), mesh)
    distances = np.asarray(cloud.compute_point_cloud_distance(mesh.sample_points_uniformly(200_000)))
    print(f"{args.mesh}: {len(mesh.triangles)} triangles, {np.median(distances):.2f} mm from the points (median)")


if __name__ == "__main__":
    main()
