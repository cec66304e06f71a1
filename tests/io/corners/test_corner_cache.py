"""The hash of the source code that cached corners and results depend on."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest

from rigkit.io.corners.corner_cache import source_hash
from rigkit.io.disk.toml_reader import toml_text
from rigkit.kernels import building


def test_lock_files_of_editors_do_not_change_the_source_hash(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Editors put links that lead nowhere beside the files that they change."""
    monkeypatch.setattr("rigkit.__path__", [str(tmp_path)])
    for name in ("module.py", "kernel.c", "kernel.h"):
        (tmp_path / name).write_text("content")
    before = source_hash.__wrapped__(), building.source_hash(tmp_path)
    for name in ("module.py", "kernel.c", "kernel.h"):
        (tmp_path / f".#{name}").symlink_to("person@machine.1")
    assert (source_hash.__wrapped__(), building.source_hash(tmp_path)) == before
    assert building.sources(tmp_path) == [tmp_path / "kernel.c"]
    for name in ("module.py", "kernel.h"):
        (tmp_path / name).write_text("other content")
    assert source_hash.__wrapped__() != before[0] and building.source_hash(tmp_path) != before[1]


def test_a_table_goes_into_a_line_of_toml() -> None:
    printed = {"a": 1, "words": ["x", "y"]}
    assert tomllib.loads(f"one = {toml_text(printed)}") == {"one": printed}
