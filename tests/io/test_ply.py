"""PLY files in other programs, and files of other programs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers.depth_edge import square_before_wall
from helpers.reconstructions import make_reconstruction

from rigkit.cli.main import main
from rigkit.core.cloud import OrientedCloud
from rigkit.core.errors import InputError
from rigkit.io.ply import ply_bytes, read_ply, write_ply


@pytest.fixture
def cloud_file(tmp_path: Path) -> Path:
    write_ply(tmp_path / "cloud.ply", make_reconstruction().cloud, comments=["pair 'made',\n3SDIR"])
    return tmp_path / "cloud.ply"


def test_open3d_reads_it_unchanged(cloud_file: Path) -> None:
    import open3d

    cloud = make_reconstruction().cloud
    seen = open3d.io.read_point_cloud(cloud_file)
    np.testing.assert_array_equal(np.asarray(seen.points), cloud.points_mm)
    np.testing.assert_array_equal(np.asarray(seen.normals), cloud.normals)
    np.testing.assert_array_equal(np.rint(np.asarray(seen.colors) * 255.0), cloud.colours)
    tensor = open3d.t.io.read_point_cloud(cloud_file)
    np.testing.assert_array_equal(tensor.point["board"].numpy().ravel(), cloud.board_index)
    np.testing.assert_array_equal(tensor.point["sigma_mm"].numpy().ravel(), cloud.sigma_mm)


def test_a_scene_without_boards_has_no_places_on_them() -> None:
    cloud = square_before_wall()
    data = ply_bytes(cloud, single_precision=True)
    header, rest = data.split(b"end_header\n", 1)
    named = [line.split()[-1] for line in header.decode().splitlines() if line.startswith("property")]
    assert named == [*"xyz", "nx", "ny", "nz", "red", "green", "blue", "sigma_mm", "normal_sigma_deg"]
    assert len(rest) == 35 * len(cloud)


def test_single_precision_for_programs_that_know_no_other(tmp_path: Path) -> None:
    cloud = make_reconstruction().cloud
    write_ply(tmp_path / "small.ply", cloud, single_precision=True)
    np.testing.assert_array_equal(read_ply(tmp_path / "small.ply").points_mm, cloud.points_mm.astype(np.float32))


def test_export_of_a_ply_keeps_its_unit_and_writes_32_bit_numbers(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cloud = make_reconstruction().cloud
    (tmp_path / "a.ply").write_bytes(ply_bytes(cloud, unit="baselines"))
    assert main(["export", str(tmp_path / "a.ply"), "-o", str(tmp_path / "b.ply"), "--float"]) == 0
    header = (tmp_path / "b.ply").read_bytes().split(b"end_header\n")[0].decode().splitlines()
    assert "comment units baselines" in header
    assert not any("double" in line for line in header) and "property float x" in header
    np.testing.assert_array_equal(read_ply(tmp_path / "b.ply").points_mm, cloud.points_mm.astype(np.float32))
    assert main(["export", str(tmp_path / "a.ply"), "-o", str(tmp_path / "b.las"), "--float"]) == 2
    assert "--float is for clouds written as PLY, not as 'las'" in capsys.readouterr().err


def test_header_says_units_frame_boards_and_comments(cloud_file: Path) -> None:
    header = cloud_file.read_bytes().split(b"end_header\n")[0].decode().splitlines()
    assert header[:2] == ["ply", "format binary_little_endian 1.0"]
    for line in ("units mm", "frame camera 1: x right, y down, z forward", "board 2 plane3", "pair 'made', 3SDIR"):
        assert f"comment {line}" in header
    properties = [line.split()[2] for line in header if line.startswith("property")]
    assert properties[:9] == ["x", "y", "z", "nx", "ny", "nz", "red", "green", "blue"]


def test_files_of_other_programs(tmp_path: Path) -> None:
    import open3d

    cloud = make_reconstruction().cloud
    plain = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(np.array(cloud.points_mm)))
    target = tmp_path / "other.ply"
    open3d.io.write_point_cloud(target, plain)
    with pytest.raises(InputError, match="no nx, ny, nz"):
        read_ply(target)
    plain.normals = open3d.utility.Vector3dVector(np.array(cloud.normals))
    open3d.io.write_point_cloud(target, plain)
    other = read_ply(target)
    np.testing.assert_array_equal(other.points_mm, cloud.points_mm)
    assert (other.board_index == -1).all()
    assert np.isnan(other.sigma_mm).all()
    open3d.io.write_point_cloud(target, plain, write_ascii=True)
    with pytest.raises(InputError, match="binary little-endian"):
        read_ply(target)


def test_what_is_not_a_whole_cloud_is_refused(cloud_file: Path) -> None:
    data = cloud_file.read_bytes()
    cloud_file.write_bytes(data[:-100])
    with pytest.raises(InputError, match="cut off: 142 of 144 points"):
        read_ply(cloud_file)
    cloud_file.write_bytes(data[:80])
    with pytest.raises(InputError, match="header is cut off"):
        read_ply(cloud_file)
    with pytest.raises(InputError, match="does not exist"):
        read_ply(cloud_file.with_name("none.ply"))
    for old, new in (
        (b"property double sigma_mm", b"property list uchar int i"),
        (b"element vertex 144", b"element v 1"),
        (b"element vertex 144", b"element vertex many"),
        (b"property double x", b"property double"),
    ):
        cloud_file.write_bytes(data.replace(old, new))
        with pytest.raises(InputError):
            read_ply(cloud_file)
    with pytest.raises(InputError, match="no points"):
        ply_bytes(
            OrientedCloud(
                points_mm=np.zeros((0, 3)),
                normals=np.zeros((0, 3)),
                colours=np.zeros((0, 3), np.uint8),
                board_index=np.zeros(0, int),
                grid=np.zeros((0, 2), int),
                sigma_mm=np.zeros(0),
                normal_sigma_rad=np.zeros(0),
                board_ids=(),
            )
        )
