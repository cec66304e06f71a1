"""Where the tests of a module are: in the same folder below tests/, in files that begin with its name."""

from __future__ import annotations

import re

from helpers.data import REPOSITORY

TESTS, PACKAGE, SCRIPTS = REPOSITORY / "tests", REPOSITORY / "rigkit", REPOSITORY / "scripts"

ACROSS = {"agreement", "architecture", "contracts", "docs", "fuzz", "real", "recovery"}
"""Tests of several parts together; CONTRIBUTING.md says what is in each folder."""


def names_in(folder: str) -> set[str]:
    """Return the modules, C files and folders of a folder of the package or of scripts, and the folder's own name."""
    home = SCRIPTS if folder == "scripts" else PACKAGE / folder
    inside = {path.stem for path in home.glob("*") if path.suffix in {".py", ".c"} or path.is_dir()}
    return {home.name, *inside} - {"__init__", "__pycache__"}


def test_a_test_file_begins_with_the_name_of_what_it_tests() -> None:
    misplaced = []
    for path in TESTS.rglob("test_*.py"):
        folder = path.relative_to(TESTS).parent.as_posix()
        if folder in ACROSS:
            continue
        tested = path.stem.removeprefix("test_")
        if not any(tested == name or tested.startswith(f"{name}_") for name in names_in(folder)):
            misplaced.append(path.relative_to(TESTS).as_posix())
    assert not misplaced


def test_no_test_file_imports_another() -> None:
    """What several files need is in tests/helpers: an imported test file would run its module twice."""
    pattern = re.compile(r"^\s*(?:from|import) [\w.]*\btest_\w+", re.MULTILINE)
    assert not [path.name for path in TESTS.rglob("*.py") if pattern.search(path.read_text(encoding="utf-8"))]


def test_contributing_explains_every_folder_of_tests_across_parts() -> None:
    text = (REPOSITORY / "CONTRIBUTING.md").read_text(encoding="utf-8")
    assert not {folder for folder in ACROSS if f"`tests/{folder}/`" not in text}
    assert all((TESTS / folder).is_dir() for folder in ACROSS)
