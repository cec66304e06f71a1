"""Captures that are not in the repository."""

from __future__ import annotations

import os
from pathlib import Path

import cv2
import numpy as np
import pytest

REPOSITORY = Path(__file__).resolve().parents[2]

CAPTURES = Path(os.environ.get("RIGKIT_DATA", REPOSITORY.parent / "shared" / "data"))


def shared_data(sub: str) -> Path:
    """Return the folder `sub` of the captures kept outside the repository, or skip the test with the reason."""
    folder = CAPTURES / sub
    if not folder.exists():
        pytest.skip(f"needs captures outside the repository: {folder} is not there (set RIGKIT_DATA)")
    return folder


def read_grey(path: Path) -> np.ndarray:
    """Return the image in grey levels as OpenCV reads it; fails where it is missing."""
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    assert image is not None, path
    return image
