"""Clouds as LAS, read back by laspy."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest

from rigkit.cli.main import main
from rigkit.core.cloud import OrientedCloud
from rigkit.core.errors import InputError
from rigkit.geometry.rotation import unit
from rigkit.interop.las import las_bytes
from rigkit.io.ply import ply_bytes, read_ply, write_ply

laspy = pytest.importorskip("laspy")
ROUNDED = 2.0**-30
"""Of the size of the cloud."""


def cloud(count: int, rng: np.random.Generator) -> OrientedCloud:
    return OrientedCloud(
        points_mm=np.array([1e5, 0.0, 2000.0]) + rng.normal(0.0, 300.0, (count, 3)),
        normals=unit(rng.normal(size=(count, 3))),
        colours=rng.integers(0, 256, (count, 3)).astype(np.uint8),
        board_index=np.full(count, -1),
        grid=np.zeros((count, 2), dtype=np.int64),
        sigma_mm=rng.uniform(0.1, 3.0, count),
        normal_sigma_rad=np.full(count, 0.01),
        board_ids=(),
    )


def test_a_ply_becomes_las(tmp_path: Path, rng: np.random.Generator, capsys: pytest.CaptureFixture[str]) -> None:
    given, source, out = cloud(500, rng), tmp_path / "scene.ply", tmp_path / "scene.las"
    write_ply(source, given)
    assert main(["export", str(source), "-o", str(out)]) == 0
    assert "500 points" in capsys.readouterr().out
    las = laspy.read(out)
    size = np.ptp(given.points_mm, axis=0).max()
    np.testing.assert_allclose(las.xyz, given.points_mm, rtol=0.0, atol=ROUNDED * size)
    np.testing.assert_array_equal(np.stack([las.red, las.green, las.blue], axis=1) // 257, given.colours)
    normals = np.stack([las["NormalX"], las["NormalY"], las["NormalZ"]], axis=1)
    np.testing.assert_allclose(normals, given.normals, atol=1e-6)
    np.testing.assert_allclose(las["sigma_mm"], given.sigma_mm, rtol=1e-6)
    assert main(["export", str(source), "-o", str(out)]) == 2
    assert "--force" in capsys.readouterr().err


def test_the_file_states_its_unit(rng: np.random.Generator) -> None:
    header = laspy.open(io.BytesIO(las_bytes(cloud(3, rng)))).header
    assert header.global_encoding.wkt and header.system_identifier == "units mm"
    (record,) = header.vlrs.get("WktCoordinateSystemVlr")
    # PROJ reads it as a system of three axes in this unit.
    assert record.string.startswith("LOCAL_CS[") and 'UNIT["millimetre",0.001]' in record.string


def test_baselines_of_unknown_length_have_no_unit(rng: np.random.Generator) -> None:
    header = laspy.open(io.BytesIO(las_bytes(cloud(3, rng), "baselines"))).header
    assert header.system_identifier == "units baselines"
    assert not header.global_encoding.wkt and not header.vlrs.get("WktCoordinateSystemVlr")


def test_what_cannot_be_is_said(tmp_path: Path, rng: np.random.Generator, capsys: pytest.CaptureFixture[str]) -> None:
    source = tmp_path / "scene.ply"
    write_ply(source, cloud(3, rng))
    assert main(["export", str(source), "--to", "colmap", "-o", str(tmp_path / "model")]) == 2
    assert "a PLY is written as ply, npz, las" in capsys.readouterr().err
    source.write_bytes(ply_bytes(cloud(3, rng), unit="baselines"))
    assert main(["export", str(source), "-o", str(tmp_path / "scene.npz")]) == 0
    arrays, stored = np.load(tmp_path / "scene.npz"), read_ply(source)
    assert np.array_equal(arrays["points_baselines"], stored.points_mm)
    assert np.array_equal(arrays["normals"], stored.normals)
    assert "pixels1" not in arrays and "points_mm" not in arrays
    with pytest.raises(InputError, match="no points"):
        las_bytes(cloud(3, rng).select(np.zeros(3, dtype=bool)))
