"""The hash of the source code that cached corners and results depend on."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest

from rigkit.core.boards import Board
from rigkit.core.errors import InputError
from rigkit.io.corners.corner_cache import CornerCache, FoundCorners, source_hash
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


def test_a_file_that_is_no_cache_is_left_as_it_is(tmp_path: Path) -> None:
    """A damaged cache is written anew."""
    path = tmp_path / "corners.json"
    for content, ours in (('{"mine": 1}', False), ('{"schema": "rigkit.corners/1", "ima', True)):
        path.write_text(content)
        cache = CornerCache(path, [Board("a", 9, 6, 30.0, 30.0)])
        assert cache.images == []
        cache.put("image.png", "0123", FoundCorners((640, 480), ()))
        if ours:
            cache.save()
            assert CornerCache(path, [Board("a", 9, 6, 30.0, 30.0)]).images == ["image.png"]
        else:
            with pytest.raises(InputError, match="left as it is"):
                cache.save()
            assert path.read_text() == content
