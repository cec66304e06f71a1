"""Every file that we write: read back equal, not overwritten without force, whole or absent."""

from __future__ import annotations

import os
import stat
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from helpers.reconstructions import make_reconstruction

from rigkit.core.cloud import OrientedCloud
from rigkit.core.errors import InputError
from rigkit.io.disk.writing import ensure_folder_writable, ensure_writable, write_atomic, write_together
from rigkit.io.ply import read_ply, write_ply

ANGLE_REL = 1e-15
"""Radians to degrees and back: one rounding each way."""


def assert_clouds_equal(a: OrientedCloud, b: OrientedCloud) -> None:
    for name in ("points_mm", "normals", "colours", "board_index", "grid", "sigma_mm"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)
    np.testing.assert_allclose(a.normal_sigma_rad, b.normal_sigma_rad, rtol=ANGLE_REL)
    assert a.board_ids == b.board_ids


def write_cloud(path: Path, force: bool) -> None:
    write_ply(path, make_reconstruction().cloud, force=force)


def write_text(path: Path, force: bool) -> None:
    write_atomic(path, "text\n", force=force)


WRITERS = pytest.mark.parametrize("write", [write_cloud, write_text])


def test_cloud_comes_back_equal(tmp_path: Path) -> None:
    cloud = make_reconstruction().cloud
    write_ply(tmp_path / "cloud.ply", cloud)
    assert_clouds_equal(read_ply(tmp_path / "cloud.ply"), cloud)


def test_text_is_utf8_and_bytes_are_bytes(tmp_path: Path) -> None:
    write_atomic(tmp_path / "a.txt", "90°\n")
    write_atomic(tmp_path / "b.bin", b"\x00\xff")
    assert (tmp_path / "a.txt").read_bytes() == "90°\n".encode()
    assert (tmp_path / "b.bin").read_bytes() == b"\x00\xff"


@WRITERS
def test_an_existing_file_is_left_as_it_is_without_force(tmp_path: Path, write: Callable[[Path, bool], None]) -> None:
    target = tmp_path / "out"
    target.write_text("mine")
    with pytest.raises(InputError, match="--force"):
        write(target, False)
    assert target.read_text() == "mine"
    write(target, True)
    assert target.read_bytes() != b"mine"
    assert os.listdir(tmp_path) == ["out"]


@WRITERS
def test_folders_are_made_and_the_file_has_ordinary_permissions(
    tmp_path: Path, write: Callable[[Path, bool], None]
) -> None:
    target = tmp_path / "new" / "folder" / "out"
    write(target, False)
    plain = tmp_path / "plain"
    plain.touch()
    assert stat.S_IMODE(target.stat().st_mode) == stat.S_IMODE(plain.stat().st_mode)


@WRITERS
def test_a_write_that_fails_half_way_leaves_the_old_file_and_no_rubbish(
    tmp_path: Path, write: Callable[[Path, bool], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    target = tmp_path / "out"
    target.write_text("old")

    def full(handle: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("rigkit.io.disk.writing.os.fsync", full)
    with pytest.raises(InputError, match="No space left"):
        write(target, True)
    assert target.read_text() == "old"
    assert os.listdir(tmp_path) == ["out"]


@pytest.mark.parametrize("fault", [OSError(28, "No space left on device"), KeyboardInterrupt()])
def test_of_several_files_none_changes_where_one_cannot_be_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fault: BaseException
) -> None:
    (tmp_path / "first").write_text("old")
    count = 0

    def full(handle: int) -> None:
        nonlocal count
        count += 1
        if count == 3:
            raise fault

    monkeypatch.setattr("rigkit.io.disk.writing.os.fsync", full)
    together = {tmp_path / name: "new" for name in ("first", "made/deep/second", "made/third")}
    with pytest.raises(InputError if isinstance(fault, OSError) else KeyboardInterrupt):
        write_together(together, force=True)
    assert (tmp_path / "first").read_text() == "old"
    assert os.listdir(tmp_path) == ["first"]
    write_together(together, force=True)
    assert [path.read_text() for path in together] == ["new"] * 3


def test_a_file_that_appears_meanwhile_is_not_replaced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    target = tmp_path / "out"
    monkeypatch.setattr("rigkit.io.disk.writing.os.fsync", lambda handle: target.write_text("somebody else's"))
    with pytest.raises(InputError, match="appeared"):
        write_atomic(target, "ours")
    assert target.read_text() == "somebody else's"
    assert os.listdir(tmp_path) == ["out"]


def test_of_several_new_files_none_stays_where_one_appears_meanwhile(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "rigkit.io.disk.writing.os.fsync", lambda handle: (tmp_path / "second").write_text("somebody else's")
    )
    with pytest.raises(InputError, match="appeared"):
        write_together({tmp_path / name: "ours" for name in ("made/first", "second", "third")})
    assert (tmp_path / "second").read_text() == "somebody else's"
    assert os.listdir(tmp_path) == ["second"]


def test_what_was_replaced_before_the_system_refused_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    together = {tmp_path / name: "new" for name in ("first", "second")}
    for path in together:
        path.write_text("old")
    replace = Path.replace

    def refused(path: Path, target: Path) -> Path:
        if target.name == "second":
            raise PermissionError(1, "Operation not permitted")
        return replace(path, target)

    monkeypatch.setattr(Path, "replace", refused)
    with pytest.raises(InputError, match="1 of 2 files were replaced"):
        write_together(together, force=True)
    assert [path.read_text() for path in together] == ["new", "old"]
    assert sorted(os.listdir(tmp_path)) == ["first", "second"]


def test_no_folder_stays_where_one_below_it_cannot_be_made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    make = Path.mkdir

    def full(path: Path, **options: bool) -> None:
        if path.name == "deep":
            raise OSError(28, "No space left on device")
        make(path, **options)

    monkeypatch.setattr(Path, "mkdir", full)
    with pytest.raises(InputError, match="No space left"):
        write_atomic(tmp_path / "made" / "deep" / "file", "new")
    assert os.listdir(tmp_path) == []


def test_nothing_is_written_over_what_is_read_nor_twice(tmp_path: Path) -> None:
    (tmp_path / "image.png").write_text("x")
    (tmp_path / "link.png").symlink_to(tmp_path / "image.png")
    for name in ("image.png", "link.png", "../" + tmp_path.name + "/image.png"):
        with pytest.raises(InputError, match="it would be lost"):
            ensure_writable(tmp_path / name, force=True, inputs=[tmp_path / "other.png", tmp_path / "image.png"])
    with pytest.raises(InputError, match="twice"):
        ensure_writable([tmp_path / "a", tmp_path / "b" / ".." / "a"], force=True)
    ensure_writable(tmp_path / "image.png", force=True, inputs=[tmp_path / "other.png"])


def test_what_cannot_be_written_is_known_before_the_work(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    ensure_writable([tmp_path / "a", tmp_path / "deep" / "b"])
    ensure_writable(tmp_path / "file", force=True)
    with pytest.raises(InputError, match="--force"):
        ensure_writable([tmp_path / "a", tmp_path / "file"])
    with pytest.raises(InputError, match="is a file, not a folder"):
        ensure_writable(tmp_path / "file" / "below")
    with pytest.raises(InputError, match="a folder of that name"):
        ensure_writable(tmp_path, force=True)
    ensure_folder_writable(tmp_path / "new" / "folder")
    with pytest.raises(InputError, match="is a file, not a folder"):
        ensure_folder_writable(tmp_path / "file")
    assert sorted(os.listdir(tmp_path)) == ["file"]
