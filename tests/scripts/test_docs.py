"""The pages of the documentation that are made of the code leave nothing out."""

from __future__ import annotations

import re

import pytest
from helpers.data import REPOSITORY

import docs


def test_every_module_is_in_the_list_of_modules(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(docs, "_first_line", lambda path: "what it is about")  # reading all of them takes a second
    listed: list[str] = []
    for part in docs.code_page().split("\n## ")[1:]:
        folder = part.partition("\n")[0]
        listed += [f"{folder}/{name}.py" for name in re.findall(r"^- `(\w+)`: \S", part, re.MULTILINE)]
    package = REPOSITORY / "rigkit"
    modules = (path.relative_to(package).as_posix() for path in package.rglob("*.py") if not path.stem.startswith("__"))
    assert sorted(listed) == sorted(name for name in modules if "/" in name)
