"""The black and white modules of ArUco markers and AprilTags, by the names of OpenCV's dictionaries."""

from __future__ import annotations

import functools

import numpy as np

from rigkit.core.arrays import BoolArray
from rigkit.core.errors import InputError

SIZES = (50, 100, 250, 1000)
"""Numbers of markers of OpenCV's dictionaries of a kind; the smaller ones are the first markers of the largest."""


@functools.cache
def dictionary_modules(name: str) -> BoolArray:
    """Return which modules of every marker of a dictionary are black, without the border: (N, S, S).

    Raises InputError where OpenCV has no dictionary of that name.
    """
    import cv2

    known = getattr(cv2.aruco, name, None)
    if known is None or not name.startswith("DICT_"):
        raise InputError(
            f"dictionary '{name}' is unknown; give a name of OpenCV's such as DICT_4X4_50, DICT_5X5_100 or "
            "DICT_APRILTAG_36h11"
        )
    dictionary = cv2.aruco.getPredefinedDictionary(known)
    side = int(dictionary.markerSize)
    rows = [
        cv2.aruco.Dictionary.getBitsFromByteList(dictionary.bytesList[k : k + 1], side)
        for k in range(dictionary.bytesList.shape[0])
    ]
    out: BoolArray = np.array(rows) == 0
    out.flags.writeable = False
    return out


def marker_count(name: str) -> int:
    """Return the number of markers of a dictionary; raises InputError like `dictionary_modules`."""
    return len(dictionary_modules(name))


def smallest_dictionary(name: str, count: int) -> str:
    """Return the smallest dictionary of the kind of `name` with so many markers; `name` if the kind has only one."""
    kind, _, size = name.rpartition("_")
    if not kind or size != str(SIZES[-1]):
        return name
    return next((f"{kind}_{n}" for n in SIZES if count <= n), name)


def largest_dictionary(name: str) -> str:
    """Return the largest dictionary of the kind of `name`, which begins with the same markers."""
    kind, _, size = name.rpartition("_")
    return f"{kind}_{SIZES[-1]}" if size in map(str, SIZES) else name
