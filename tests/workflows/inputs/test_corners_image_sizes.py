"""Sessions with images of several sizes: messages that name the cause, for folders too."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from helpers.board_scenes import detection

from rigkit.core.boards import Board
from rigkit.core.errors import InputError
from rigkit.io.corners.corner_cache import FoundCorners
from rigkit.io.manifests.session import Session
from rigkit.workflows.inputs.corners import SessionCorners, _common_size, session_views

BOARD = Board("a", 9, 6, 30.0, 30.0)
SESSION = Session(path=Path("photos"), images=(), boards=(BOARD,), model="auto", degree=None, board_shape="auto")


def refusal(other: tuple[int, int]) -> str:
    """Return what is said where half of the images have the size `other`."""
    found = {f"{k}.jpg": FoundCorners(other if k % 2 else (640, 480), ()) for k in range(6)}
    with pytest.raises(InputError) as raised:
        _common_size(SESSION, found)
    return str(raised.value)


def test_images_turned_by_a_quarter_are_called_that() -> None:
    text = refusal((480, 640))
    assert "640x480 px (3, such as '0.jpg') and 480x640 px (3, such as '1.jpg')" in text
    assert "turned part of them by a quarter" in text and "folder of their own" in text


def test_other_sizes_are_not_called_turned() -> None:
    text = refusal((320, 240))
    assert "turned" not in text and "one setting" in text and "folder of their own" in text


def test_an_image_that_cannot_be_read_is_named_once() -> None:
    """By who says that it is left out."""
    session = replace(SESSION, images=tuple(Path(f"/far/{k}.jpg") for k in range(4)))
    found = {f"{k}.jpg": FoundCorners((640, 480), (detection(BOARD, BOARD.grid() * 30.0 + 40.0),)) for k in range(3)}
    why = "image '/far/3.jpg' cannot be decoded; convert it"
    corners = SessionCorners(found=found, unreadable={"3.jpg": why}, source="")
    assert session_views(session, corners)[2] == [("3.jpg", "it cannot be decoded; convert it")]


@pytest.mark.parametrize(("other", "turned"), [((320, 240), ""), ((480, 640), ", turned by some program")])
def test_one_image_of_another_size_is_left_out(other: tuple[int, int], turned: str) -> None:
    one = detection(BOARD, BOARD.grid() * [30.0, 31.0] + 40.0)
    found = {f"{k}.jpg": FoundCorners(other if k == 3 else (640, 480), (one,)) for k in range(5)}
    views, size_px, dropped = session_views(SESSION, SessionCorners(found=found, unreadable={}, source=""))
    assert size_px == (640, 480) and [view.image for view in views] == ["0.jpg", "1.jpg", "2.jpg", "4.jpg"]
    assert dropped == [("3.jpg", f"{other[0]}x{other[1]} px{turned}, most images with boards have 640x480")]
