"""Images that hold the pictures of two cameras, as many stereo cameras write them: side by side, or one above the
other."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import numpy as np

from rigkit.core.arrays import Pixels
from rigkit.core.boards import Board
from rigkit.io.corners.corner_cache import FoundCorners

MIN_SHARE = 0.5
"""Part of the images with boards that show the board twice, once in either half. In the others one camera misses it."""
MIN_IMAGES = 3

HALVES = (("left", "right"), ("top", "bottom"))


def side_by_side_pictures(found: Mapping[str, FoundCorners], boards: Collection[Board]) -> str | None:
    """Return in words that images hold the pictures of two cameras, or None.

    The only board is then seen twice, once in either half, never across the middle, and at about the same distance.
    One camera in front of two boards of one kind has some across the middle as soon as it, or they, are moved; where it
    keeps what is between them in its middle, they are farther from each other where they look larger.
    """
    shown = [item for item in found.values() if item.detections]
    if len(boards) != 1 or not shown:
        return None
    for axis, (one, other) in enumerate(HALVES):
        twice: list[tuple[Pixels, Pixels]] = []
        for item in shown:
            middle = 0.5 * (item.size_px[axis] - 1)
            spans = [(d.pixels[:, axis].min(), d.pixels[:, axis].max()) for d in item.detections]
            if any(low < middle < high for low, high in spans):
                break
            first, last = (item.detections[spans.index(end)].pixels for end in (min(spans), max(spans)))
            if min(spans)[1] < middle < max(spans)[0]:
                twice.append((first, last))
        else:
            if len(twice) >= max(MIN_IMAGES, MIN_SHARE * len(shown)) and _at_one_distance(twice):
                return (
                    f"the images hold the pictures of two cameras, in the {one} and the {other} half: {len(twice)} of "
                    f"{len(shown)} show the board in both; cut them into a folder '{one}' and a folder '{other}', and "
                    "give both"
                )
    return None


def _at_one_distance(pairs: Sequence[tuple[Pixels, Pixels]]) -> bool:
    """Return whether the distance of two boards in images varies less than its ratio to their size: 0.01 to 0.5 times
    as much (standard deviations of logarithms) for SIMULATED stereo cameras, 0.2 for bouguet-stereo (REAL); two or more
    times as much for two boards (SIMULATED)."""
    distance = np.log([np.linalg.norm(first.mean(axis=0) - last.mean(axis=0)) for first, last in pairs])
    size = np.log([np.sqrt(np.var(np.concatenate([p - p.mean(axis=0) for p in pair]), axis=0).sum()) for pair in pairs])
    return bool(np.std(distance) < np.std(distance - size))
