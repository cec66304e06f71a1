from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
from helpers.data import REPOSITORY
from helpers.reconstructions import make_reconstruction

from rigkit.io.ply import write_ply

SQUARE_MM = 50.0


def test_screened_poisson_runs_on_an_exported_cloud(tmp_path: Path) -> None:
    cloud = make_reconstruction().cloud
    write_ply(tmp_path / "cloud.ply", cloud)
    script = REPOSITORY / "scripts" / "example_poisson.py"
    subprocess.run(
        [sys.executable, str(script), str(tmp_path / "cloud.ply"), str(tmp_path / "mesh.ply")], check=True, timeout=120
    )
    import open3d

    mesh = open3d.io.read_triangle_mesh(str(tmp_path / "mesh.ply"))
    assert len(mesh.triangles) > 100
    # Normals that pointed to the wrong side would turn the surface inside out and far away from the points.
    surface = np.asarray(mesh.sample_points_uniformly(50_000).points)
    nearest = np.array([np.linalg.norm(surface - p, axis=1).min() for p in cloud.points_mm])
    assert np.median(nearest) < 0.25 * SQUARE_MM
