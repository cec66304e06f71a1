"""Fixtures shared by all tests."""

from __future__ import annotations

import zlib

import numpy as np
import pytest


@pytest.fixture
def rng(request: pytest.FixtureRequest) -> np.random.Generator:
    """A generator seeded by the test's own name: fixed for the test, different from every other test's."""
    return np.random.default_rng(zlib.crc32(request.node.name.encode()))
