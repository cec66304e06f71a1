"""The examples in docstrings run. (ruff and mypy run once, before the tests: .ci/run.)"""

from __future__ import annotations

import doctest
import importlib

import pytest


@pytest.mark.parametrize("module", ["rigkit", "rigkit.core.boards", "rigkit.geometry.rigid3"])
def test_doctests(module: str) -> None:
    result = doctest.testmod(importlib.import_module(module))
    assert result.attempted > 0
    assert result.failed == 0
