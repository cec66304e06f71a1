"""What every class of options promises."""

from __future__ import annotations

from dataclasses import MISSING, fields
from pathlib import Path
from typing import Any

import pytest

import rigkit

KINDS = [getattr(rigkit, name) for name in rigkit.__all__ if name.endswith("Options")]


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
def test_a_path_may_be_given_as_text(kind: Any) -> None:
    """It would fail where it is used, which of a page is after everything was computed."""
    paths = {field.name: "folder/file" for field in fields(kind) if str(field.type).startswith("Path")}
    needed = {field.name: "x" for field in fields(kind) if field.default is field.default_factory is MISSING}
    options = kind(**needed | paths)
    assert all(getattr(options, name) == Path("folder/file") for name in paths)
    assert kind(**needed | {name: Path("folder/file") for name in paths}) == options


def test_paths_in_lists_may_be_words() -> None:
    options = rigkit.SceneOptions(images=["a.png", Path("b.png")])  # type: ignore[arg-type]
    assert options.images == (Path("a.png"), Path("b.png")) and options.name == "a"
