"""Sizes of images in words."""

from __future__ import annotations

import re

from rigkit.core.errors import InputError

IMAGE_SIZE = re.compile(r"([0-9]{1,6})[xX]([0-9]{1,6})")


def size_of_words(text: str) -> tuple[int, int]:
    """Return (width, height) of "1280x960"; raises InputError for anything else."""
    match = IMAGE_SIZE.fullmatch(text)
    if match is None:
        raise InputError(f"--size {text}: give width and height in px, such as 1280x960")
    return int(match[1]), int(match[2])
