"""Images that hold the pictures of two cameras, as many stereo cameras write them: side by side, or one above the
other."""

from __future__ import annotations

from collections.abc import Collection, Mapping

from rigkit.core.boards import Board
from rigkit.io.corners.corner_cache import FoundCorners

MIN_SHARE = 0.5
"""Part of the images with boards that show the board twice, once in either half. In the others one camera misses it."""
MIN_IMAGES = 3

HALVES = (("left", "right"), ("top", "bottom"))


def two_pictures(found: Mapping[str, FoundCorners], boards: Collection[Board]) -> str | None:
    """Return in words that images hold the pictures of two cameras, or None.

    The only board is then seen twice, once in either half, and never across the middle. One camera in front of two
    boards of one kind has some across the middle as soon as it, or they, are moved.
    """
    shown = [item for item in found.values() if item.detections]
    if len(boards) != 1 or not shown:
        return None
    for axis, (one, other) in enumerate(HALVES):
        twice = 0
        for item in shown:
            middle = 0.5 * (item.size_px[axis] - 1)
            spans = [(d.pixels[:, axis].min(), d.pixels[:, axis].max()) for d in item.detections]
            if any(low < middle < high for low, high in spans):
                break
            twice += min(spans)[1] < middle < max(spans)[0]
        else:
            if twice >= max(MIN_IMAGES, MIN_SHARE * len(shown)):
                return (
                    f"the images hold the pictures of two cameras, in the {one} and the {other} half: {twice} of "
                    f"{len(shown)} show the board in both; cut them into a folder '{one}' and a folder '{other}', and "
                    "give both"
                )
    return None
