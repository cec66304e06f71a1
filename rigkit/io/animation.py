"""Animations as far as decoders hide them: of GIF, APNG and WebP files they return the first frame and say nothing.

GIF89a: blocks after the header, each an extension or an image. APNG: an acTL chunk with the number of frames before the
data. WebP: ANMF chunks in the RIFF container.
"""

from __future__ import annotations

GIF_STARTS = (b"GIF87a", b"GIF89a")
PNG_START = b"\x89PNG\r\n\x1a\n"
GIF_EXTENSION, GIF_IMAGE, GIF_END = 0x21, 0x2C, 0x3B


def frame_count(data: bytes) -> int:
    """Return how many frames a GIF, PNG or WebP has, as far as it is whole; 1 for other data."""
    if data.startswith(GIF_STARTS):
        return _of_gif(data)
    if data.startswith(PNG_START):
        return _of_png(data)
    if data[:4] == b"RIFF" and data[8:12] == b"WEBP":
        return _of_webp(data)
    return 1


def _of_gif(data: bytes) -> int:
    frames, at = 0, 13 + _colours(data, 10)
    while at < len(data) and data[at] != GIF_END:
        if data[at] == GIF_IMAGE:
            frames += 1
            at = _after_blocks(data, at + 11 + _colours(data, at + 9))
        elif data[at] == GIF_EXTENSION:
            at = _after_blocks(data, at + 2)
        else:
            break
    return max(frames, 1)


def _colours(data: bytes, at: int) -> int:
    """Return the bytes of the colour table that the flags at `at` announce."""
    flags = data[at] if at < len(data) else 0
    return 3 << ((flags & 7) + 1) if flags & 0x80 else 0


def _after_blocks(data: bytes, at: int) -> int:
    """Return the place behind a chain of blocks, each with its length in front, the last one empty."""
    while at < len(data) and data[at]:
        at += data[at] + 1
    return at + 1


def _of_png(data: bytes) -> int:
    at = len(PNG_START)
    while at + 12 <= len(data):
        length, kind = int.from_bytes(data[at : at + 4], "big"), data[at + 4 : at + 8]
        if kind == b"acTL":
            return max(int.from_bytes(data[at + 8 : at + 12], "big"), 1)
        if kind == b"IDAT":
            break
        at += 12 + length
    return 1


def _of_webp(data: bytes) -> int:
    frames, at = 0, 12
    while at + 8 <= len(data):
        length = int.from_bytes(data[at + 4 : at + 8], "little")
        frames += data[at : at + 4] == b"ANMF"
        at += 8 + length + length % 2
    return max(frames, 1)
