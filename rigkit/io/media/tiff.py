"""Orientation and page sizes of TIFF files: decoders apply the one and silently drop further pages.

TIFF 6.0 and BigTIFF have a header of 8 (16) bytes, then a chain of directories, each a list of entries (tag, type,
count, value).
"""

from __future__ import annotations

from typing import Literal, NamedTuple

NEW_SUBFILE_TYPE, IMAGE_WIDTH, IMAGE_LENGTH, ORIENTATION = 254, 256, 257, 274
REDUCED_OR_MASK = 1 | 4
"""Bits of NewSubfileType: a reduced copy of another page, or a transparency mask."""
AS_STORED = 1
TIFF_STARTS = (b"II*\0", b"II+\0", b"MM\0*", b"MM\0+")
VALUE_BYTES = {1: 1, 3: 2, 4: 4, 16: 8}
"""Sizes of the integer types."""


class _Tag(NamedTuple):
    """An integer entry: its value, and offset and size of the value in the file."""

    value: int
    at: int
    size: int


def as_stored(data: bytes) -> bytes:
    """Return a TIFF with its orientation reset, because OpenCV always applies it; other data unchanged."""
    order = _byte_order(data)
    if order is None:
        return data
    for page in _pages(data, order):
        entry = page.get(ORIENTATION)
        if entry is not None and entry.value != AS_STORED:
            data = data[: entry.at] + AS_STORED.to_bytes(entry.size, order) + data[entry.at + entry.size :]
    return data


def page_sizes(data: bytes) -> list[tuple[int, int]]:
    """Return (width, height) of every image in a TIFF, without previews and masks; [] for other data."""
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
    """Return the integer entries by tag of every directory, up to the first damaged one."""

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
