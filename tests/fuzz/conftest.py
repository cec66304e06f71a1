"""A folder with one good file of each kind."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "scripts"))

from fuzzing.seeds import write_seeds


@pytest.fixture(scope="session")
def seeds(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The good files, which every case of `fuzz.case_of` links to: a program that writes into one of them is found."""
    folder = tmp_path_factory.mktemp("fuzz") / "seeds"
    write_seeds(folder)
    good = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    yield folder
    assert [path.name for path, data in good.items() if path.read_bytes() != data] == []


@pytest.fixture
def place(seeds: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy that a test may spoil, and stands in."""
    folder = tmp_path / "place"
    shutil.copytree(seeds, folder)
    monkeypatch.chdir(folder)
    return folder
