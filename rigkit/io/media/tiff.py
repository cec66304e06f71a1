"""What decoders get wrong in TIFF files: an orientation that they apply unasked, pages that they leave out unsaid.

TIFF 6.0 and BigTIFF: a header of 8 (16) bytes, then a chain of directories, each a list of entries (tag, type, count,
value).
"""

from __future__ import annotations

from typing import Literal, NamedTuple

NEW_SUBFILE_TYPE, IMAGE_WIDTH, IMAGE_LENGTH, ORIENTATION = 254, 256, 257, 274
REDUCED_OR_MASK = 1 | 4
"""Bits of NewSubfileType: a smaller copy of another page, or its transparency."""
AS_STORED = 1
TIFF_STARTS = (b"II*\0", b"II+\0", b"MM\0*", b"MM\0+")
VALUE_BYTES = {1: 1, 3: 2, 4: 4, 16: 8}
"""Sizes of the integer types."""


class _Tag(NamedTuple):
    """The value of an integer entry, and where it stands in the file."""

    value: int
    at: int
    size: int


def as_stored(data: bytes) -> bytes:
    """Return the TIFF with its pixels declared to be upright as they are stored; other data come back as they are.

    OpenCV turns and mirrors TIFF images by their orientation, whatever it is asked for.
    """
    order = _byte_order(data)
    if order is None:
        return data
    for page in _pages(data, order):
        entry = page.get(ORIENTATION)
        if entry is not None and entry.value != AS_STORED:
            data = data[: entry.at] + AS_STORED.to_bytes(entry.size, order) + data[entry.at + entry.size :]
    return data


def page_sizes(data: bytes) -> list[tuple[int, int]]:
    """Return the (width, height) of every image in a TIFF, without previews and masks; none for other data."""
    order = _byte_order(data)
    if order is None:
        return []
    pages = [p for p in _pages(data, order) if not _value(p, NEW_SUBFILE_TYPE) & REDUCED_OR_MASK]
    return [(_value(p, IMAGE_WIDTH), _value(p, IMAGE_LENGTH)) for p in pages]


def _value(page: dict[int, _Tag], tag: int) -> int:
    return page[tag].value if tag in page else 0


def _byte_order(data: bytes) -> Literal["little", "big"] | None:
    if not data.startswith(TIFF_STARTS):
        return None
    return "little" if data.startswith(b"II") else "big"


def _pages(data: bytes, order: Literal["little", "big"]) -> list[dict[int, _Tag]]:
    """Return the integer entries of every directory by tag, as far as the file is whole."""

    def number(at: int, size: int) -> int:
        return int.from_bytes(data[at : at + size], order)

    big = number(2, 2) == 43
    word, count_bytes, entry_bytes = (8, 8, 20) if big else (4, 2, 12)
    at = number(8 if big else 4, word)
    pages: list[dict[int, _Tag]] = []
    visited: set[int] = set()
    while at and at + count_bytes <= len(data) and at not in visited:
        visited.add(at)
        first = at + count_bytes
        end = first + entry_bytes * number(at, count_bytes)
        if end > len(data):
            break
        page = {}
        for entry in range(first, end, entry_bytes):
            size = VALUE_BYTES.get(number(entry + 2, 2))
            if size is not None and number(entry + 4, word) == 1:
                page[number(entry, 2)] = _Tag(number(entry + 4 + word, size), entry + 4 + word, size)
        pages.append(page)
        at = number(end, word)
    return pages
