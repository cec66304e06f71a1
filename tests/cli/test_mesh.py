"""`rigkit mesh` end to end: a cloud in, a mesh out that other programs read; bad input in one line."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.depth_edge import square_before_wall
from helpers.reconstructions import make_reconstruction

from rigkit.cli.main import main
from rigkit.core.errors import DegenerateError
from rigkit.interop.open3d import poisson_mesh
from rigkit.io.ply import ply_bytes, read_ply, write_ply

SQUARE_MM = 50.0


def test_the_surface_goes_through_the_points(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    import open3d

    cloud = make_reconstruction().cloud
    write_ply(tmp_path / "cloud.ply", cloud)
    assert main(["mesh", str(tmp_path / "cloud.ply"), "--depth", "6", "--cut", "0.15", "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    mesh = open3d.io.read_triangle_mesh(printed["mesh"])
    assert len(mesh.triangles) == printed["triangles"] > 100
    assert len(mesh.vertices) == printed["vertices"]
    assert mesh.has_vertex_normals() and mesh.has_vertex_colors()
    # Normals that pointed to the wrong side would turn the surface inside out and far away from the points.
    surface = np.asarray(mesh.sample_points_uniformly(10_000).points)
    nearest = np.array([np.linalg.norm(surface - p, axis=1).min() for p in cloud.points_mm])
    assert np.median(nearest) < 0.25 * SQUARE_MM


def test_a_cloud_of_one_view_is_closed_along_lines_of_sight(tmp_path: Path) -> None:
    cloud = square_before_wall(31)
    meshes = {}
    for from_origin in (False, True):
        write_ply(tmp_path / "cloud.ply", replace(cloud, from_origin=from_origin), force=True)
        assert read_ply(tmp_path / "cloud.ply").from_origin == from_origin
        for option in ("", "--no-one-view" if from_origin else "--one-view"):
            options = ["--depth", "4", "--cut", "0", "--force", *option.split()]
            assert main(["mesh", str(tmp_path / "cloud.ply"), *options]) == 0
            meshes[from_origin, option] = (tmp_path / "cloud-mesh.ply").read_bytes()
    # What the command says holds; else what the file says.
    assert meshes[False, "--one-view"] == meshes[True, ""]
    assert meshes[True, "--no-one-view"] == meshes[False, ""]
    assert meshes[True, ""] != meshes[False, ""]


def test_clouds_that_cannot_be_meshed_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_ply(tmp_path / "cloud.ply", make_reconstruction().cloud)
    cloud, taken = str(tmp_path / "cloud.ply"), str(tmp_path / "taken.ply")
    (tmp_path / "taken.ply").write_text("mine")
    for arguments, words in (
        (["gone.ply"], "gone.ply"),
        ([cloud, "--depth", "40"], "depth"),
        ([cloud, "--cut", "2"], "cut off"),
        ([cloud, "-o", taken], "--force"),
        ([cloud, "-o", cloud, "--force"], "cloud.ply"),
    ):
        assert main(["mesh", *arguments]) == 2
        assert words in capsys.readouterr().err
    assert (tmp_path / "taken.ply").read_text() == "mine"


@pytest.mark.parametrize(
    ("factor", "words"),
    [(0.0, "in one place"), (1e-60, "in one place"), (1e60, "far away"), (1e300, "far away")],
)
def test_an_extent_that_no_octree_bears_is_refused(
    factor: float, words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Open3D dies of these by a signal: nothing of the sort reaches it."""
    cloud = make_reconstruction().cloud
    write_ply(tmp_path / "cloud.ply", replace(cloud, points_mm=cloud.points_mm * factor))
    assert main(["mesh", str(tmp_path / "cloud.ply"), "--depth", "3"]) == 3
    printed = capsys.readouterr().err.splitlines()[-1]
    assert words in printed and "cloud.ply" in printed


@pytest.mark.parametrize("factor", [1e-20, 1e20])
def test_the_surface_does_not_depend_on_the_unit(factor: float) -> None:
    cloud = make_reconstruction().cloud
    typical = poisson_mesh(cloud, depth=5, cut=0.1)
    scaled = poisson_mesh(replace(cloud, points_mm=cloud.points_mm * factor), depth=5, cut=0.1)
    assert len(scaled.triangles) == pytest.approx(len(typical.triangles), rel=0.05)
    extent, other = np.ptp(typical.points, axis=0), np.ptp(scaled.points, axis=0) / factor
    np.testing.assert_allclose(other, extent, rtol=0.05)


def test_normals_as_long_as_numbers_are_become_unit_ones(tmp_path: Path) -> None:
    cloud = make_reconstruction().cloud
    for factor in (1e-200, 1e200):
        write_ply(tmp_path / "cloud.ply", replace(cloud, normals=cloud.normals * factor), force=True)
        np.testing.assert_allclose(read_ply(tmp_path / "cloud.ply").normals, cloud.normals, atol=1e-12)


def test_points_without_a_normal_are_left_out() -> None:
    cloud = make_reconstruction().cloud
    normals = cloud.normals.copy()
    normals[2:] = 0.0
    with pytest.raises(DegenerateError, match="2 points have a normal"):
        poisson_mesh(replace(cloud, normals=normals), depth=3, cut=0.0)


def test_normals_scaled_by_confidence_are_normalised(tmp_path: Path) -> None:
    cloud = make_reconstruction().cloud
    (tmp_path / "sure.ply").write_bytes(ply_bytes(cloud, confidence=True, single_precision=True))
    np.testing.assert_allclose(read_ply(tmp_path / "sure.ply").normals, cloud.normals, atol=1e-6)
    import open3d

    length = np.linalg.norm(np.asarray(open3d.io.read_point_cloud(tmp_path / "sure.ply").normals), axis=1)
    sigma = cloud.normal_sigma_rad
    assert np.median(length) == pytest.approx(1.0, rel=0.05)
    np.testing.assert_allclose(length * sigma / np.median(sigma), 1.0, rtol=1e-5)
