"""Poses by time: an image gets the pose interpolated between the rows around it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rigkit.core.errors import InputError
from rigkit.geometry.rotation import exp_so3
from rigkit.io.manifests.robot_poses import read_robot_poses

HEAD = "timestamp_ns,x_m,y_m,z_m,rx_deg,ry_deg,rz_deg\n"
START = 1606153907000000000


@pytest.fixture
def table(tmp_path: Path) -> Path:
    path = tmp_path / "poses.csv"
    rows = [f"{START + k * 50_000_000},{0.1 * k},0,1,0,0,{10 * k}" for k in (2, 0, 1)]
    path.write_text(HEAD + "\n".join(rows) + "\n")
    return path


def test_the_pose_between_two_moments(table: Path) -> None:
    image = f"{START + 62_500_000}.png"
    found = read_robot_poses(table, [image])
    assert list(found) == [image]
    np.testing.assert_allclose(found[image].translation_mm, [125.0, 0.0, 1000.0])
    np.testing.assert_allclose(found[image].rotation, exp_so3(np.radians([0.0, 0.0, 12.5])), atol=1e-12)
    last = f"{START + 100_000_000}.jpg"
    np.testing.assert_allclose(read_robot_poses(table, [last])[last].translation_mm, [200.0, 0.0, 1000.0])


@pytest.mark.parametrize("image", ["left01.png", f"{START - 1}.png", f"{START + 100_000_001}.png", f"{'9' * 40}.png"])
def test_images_of_no_moment_are_named(table: Path, image: str) -> None:
    with pytest.raises(InputError, match=image[:12]):
        read_robot_poses(table, [image])


def test_a_gap_in_the_table_says_nothing(tmp_path: Path) -> None:
    path = tmp_path / "poses.csv"
    path.write_text(HEAD + f"{START},0,0,1,0,0,0\n{START + 300_000_000},0,0,1,0,0,0\n")
    with pytest.raises(InputError, match="no poses just before and after"):
        read_robot_poses(path, [f"{START + 1000}.png"])


@pytest.mark.parametrize("moment", ["1.5", "now", "9" * 40])
def test_moments_are_whole_nanoseconds(tmp_path: Path, moment: str) -> None:
    path = tmp_path / "poses.csv"
    path.write_text(HEAD + f"{moment},0,0,1,0,0,0\n")
    with pytest.raises(InputError, match="nanoseconds"):
        read_robot_poses(path, [])
