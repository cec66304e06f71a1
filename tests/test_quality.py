"""ruff, mypy --strict and the doctests are part of the tests."""

from __future__ import annotations

import doctest
import importlib
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


def run(*command: str) -> None:
    done = subprocess.run([sys.executable, "-m", *command], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr


def test_ruff_lint() -> None:
    run("ruff", "check", "rigkit", "tests", "scripts")


def test_ruff_format() -> None:
    run("ruff", "format", "--check", "rigkit", "tests", "scripts")


def test_mypy_strict() -> None:
    run("mypy")


@pytest.mark.parametrize("module", ["rigkit", "rigkit.core.boards", "rigkit.geometry.rigid3"])
def test_doctests(module: str) -> None:
    result = doctest.testmod(importlib.import_module(module))
    assert result.attempted > 0
    assert result.failed == 0
