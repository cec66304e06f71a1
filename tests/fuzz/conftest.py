"""A folder with one good file of each kind."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "scripts"))

import fuzz
from fuzzing.seeds import write_seeds


@pytest.fixture(scope="session")
def seeds(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    folder = tmp_path_factory.mktemp("fuzz") / "seeds"
    write_seeds(folder)
    before = _contents(folder)
    yield folder
    # Cases are links to them: whatever writes into a file that is there, instead of replacing it, spoils all others.
    assert _contents(folder) == before


def _contents(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.fixture
def case_place(seeds: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with the same files, into none of which a test may write, and that it stands in."""
    folder = tmp_path / "place"
    shutil.copytree(seeds, folder, copy_function=fuzz.linked)
    monkeypatch.chdir(folder)
    return folder


@pytest.fixture
def place(seeds: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy that a test may spoil, and stands in."""
    folder = tmp_path / "place"
    shutil.copytree(seeds, folder)
    monkeypatch.chdir(folder)
    return folder
