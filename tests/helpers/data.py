"""Captures that are not in the repository."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[2]

CAPTURES = Path(os.environ.get("RIGKIT_DATA", REPOSITORY.parent / "shared" / "data"))


def shared_data(sub: str) -> Path:
    """Return the folder `sub` of the captures kept outside the repository, or skip the test with the reason."""
    folder = CAPTURES / sub
    if not folder.exists():
        pytest.skip(f"needs captures outside the repository: {folder} is not there (set RIGKIT_DATA)")
    return folder
