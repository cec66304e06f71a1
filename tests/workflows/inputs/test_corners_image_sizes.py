"""Sessions with images of several sizes: messages that name the cause, for folders too."""

from __future__ import annotations

from pathlib import Path

import pytest

from rigkit.core.boards import Board
from rigkit.core.errors import InputError
from rigkit.io.corners.corner_cache import FoundCorners
from rigkit.io.manifests.session import Session
from rigkit.workflows.inputs.corners import _common_size


def refusal(other: tuple[int, int]) -> str:
    """Return what is said where half of the images have the size `other`."""
    board = Board("a", 9, 6, 30.0, 30.0)
    session = Session(path=Path("photos"), images=(), boards=(board,), model="auto", degree=None, board_shape="auto")
    found = {f"{k}.jpg": FoundCorners(other if k % 2 else (640, 480), ()) for k in range(6)}
    with pytest.raises(InputError) as raised:
        _common_size(session, found)
    return str(raised.value)


def test_images_turned_by_a_quarter_are_called_that() -> None:
    text = refusal((480, 640))
    assert "640x480 px (3, such as '0.jpg') and 480x640 px (3, such as '1.jpg')" in text
    assert "turned part of them by a quarter" in text and "folder of their own" in text


def test_other_sizes_are_not_called_turned() -> None:
    text = refusal((320, 240))
    assert "turned" not in text and "one setting" in text and "folder of their own" in text
