"""Every file that a command writes is of its published schema: each test of a command is a test of that too."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from helpers.once import once_a_run
from helpers.schemas import faults
from helpers.trihedral_captures import write_capture

from rigkit.io.disk import writing
from rigkit.synthetic.pairs import StereoScene

SHOWN, NUMBERS_SHOWN = 6, 2
"""Of a long list so many of its first and last: there is more of the same between, which takes a checker seconds."""


@pytest.fixture(scope="session")
def trihedral(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, StereoScene]]:
    """A folder of `helpers.trihedral_captures`, read-only, and the scenes of its pairs."""

    def make() -> tuple[Path, dict[str, StereoScene]]:
        folder = tmp_path_factory.mktemp("trihedral")
        return folder, write_capture(folder)

    return once_a_run(tmp_path_factory, "trihedral", make)


@pytest.fixture(autouse=True)
def _files_are_of_their_schemas(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    found: list[str] = []
    fill = writing._fill

    def checked(handle: int, data: bytes) -> None:
        fill(handle, data)
        for document in _documents(data):
            found.extend(faults(_shortened(document)))

    monkeypatch.setattr(writing, "_fill", checked)
    yield
    assert not found, found[:3]


def _shortened(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _shortened(one) for key, one in value.items()}
    if isinstance(value, list):
        if len(value) > 2 * SHOWN:
            shown = NUMBERS_SHOWN if all(isinstance(one, float) for one in value) else SHOWN
            value = value[:shown] + value[-shown:]
        return [_shortened(one) for one in value]
    return value


def _documents(data: bytes) -> Iterator[Any]:
    """Yield what a file says, if it is JSON, JSON lines or TOML with a schema."""
    if b"rigkit." not in data[:400] or data[:1] not in b"{#s\n":
        return
    text = data.decode()
    if not text.lstrip().startswith("{"):
        try:
            yield tomllib.loads(text)
        except tomllib.TOMLDecodeError:
            return
        return
    try:
        yield json.loads(text)
    except json.JSONDecodeError:
        yield from map(json.loads, filter(None, text.splitlines()))
