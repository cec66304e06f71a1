"""How many pixels an image file announces, before a decoder makes room for them.

A file of a kilobyte may announce a thousand megapixels of one colour. Sizes stand in the heads of the files: PNG
(IHDR), JPEG (SOF), BMP, GIF, WebP (VP8, VP8L, VP8X), Netpbm (P1 to P7), TIFF (tags 256 and 257), JPEG 2000 (ihdr, SIZ),
AVIF (ispe), Sun raster, Radiance and PFM.
"""

from __future__ import annotations

import re
from collections.abc import Callable

from rigkit.io.tiff import page_sizes

Size = tuple[int, int]

JPEG_SEGMENT = re.compile(rb"\xff([\x01-\xfe])")
JPEG_FRAMES = {*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC}
"""Starts of frame; the other three hold tables."""
JPEG_BARE = {0x01, *range(0xD0, 0xD9)}
"""Markers without a length."""
NETPBM = re.compile(rb"P[1-6](?:\s|#[^\n]*\n)+(\d{1,10})(?:\s|#[^\n]*\n)+(\d{1,10})")
PAM = re.compile(rb"P7\n(?:(?!ENDHDR)[^\n]*\n)*")
PFM = re.compile(rb"P[Ff]\s+(\d{1,10})\s+(\d{1,10})")
RADIANCE = re.compile(rb"[-+][XY] (\d{1,10}) [-+][XY] (\d{1,10})")
HEAD_BYTES = 65_536
"""Radiance and PAM have words of any length in front."""


def announced_size(data: bytes) -> Size | None:
    """Return the largest (width, height) that the file announces; None where its kind is not known."""
    for start, read in _READERS:
        if data.startswith(start):
            return read(data)
    return _of_boxes(data) if data[4:8] in (b"ftyp", b"jP  ") else None


def _big(data: bytes, at: int, count: int = 4) -> int:
    return int.from_bytes(data[at : at + count], "big")


def _little(data: bytes, at: int, count: int = 4) -> int:
    return int.from_bytes(data[at : at + count], "little")


def _of_png(data: bytes) -> Size:
    return _big(data, 16), _big(data, 20)


def _of_jpeg(data: bytes) -> Size | None:
    """Walk the segments to the first start of frame."""
    at = 2
    while (found := JPEG_SEGMENT.search(data, at)) is not None:
        code, at = found[1][0], found.end()
        if code in JPEG_FRAMES:
            return _big(data, at + 5, 2), _big(data, at + 3, 2)
        at += 0 if code in JPEG_BARE else max(_big(data, at, 2), 2)
    return None


def _of_bmp(data: bytes) -> Size:
    if _little(data, 14) == 12:
        return _little(data, 18, 2), _little(data, 20, 2)
    height = _little(data, 22)
    # Rows from the top down have a negative height.
    return _little(data, 18), min(height, 2**32 - height)


def _of_gif(data: bytes) -> Size:
    return _little(data, 6, 2), _little(data, 8, 2)


def _of_riff(data: bytes) -> Size | None:
    kind = data[12:16]
    if kind == b"VP8X":
        return _little(data, 24, 3) + 1, _little(data, 27, 3) + 1
    if kind == b"VP8L":
        bits = _little(data, 21)
        return (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
    if kind == b"VP8 ":
        return _little(data, 26, 2) & 0x3FFF, _little(data, 28, 2) & 0x3FFF
    return None


def _of_words(*patterns: re.Pattern[bytes]) -> Callable[[bytes], Size | None]:
    def read(data: bytes) -> Size | None:
        found = next((m for p in patterns if (m := p.search(data[:HEAD_BYTES])) is not None), None)
        return None if found is None else (int(found[1]), int(found[2]))

    return read


def _of_pam(data: bytes) -> Size | None:
    head = PAM.match(data[:HEAD_BYTES])
    words = dict(re.findall(rb"(WIDTH|HEIGHT) +(\d{1,10})", head[0] if head else b""))
    return (int(words[b"WIDTH"]), int(words[b"HEIGHT"])) if len(words) == 2 else None


def _of_tiff(data: bytes) -> Size | None:
    return max(page_sizes(data), key=lambda size: size[0] * size[1], default=None)


def _of_raster(data: bytes) -> Size:
    return _big(data, 4), _big(data, 8)


def _of_codestream(data: bytes) -> Size:
    """SIZ of JPEG 2000: the reference grid less the offset of the image on it."""
    return _big(data, 8) - _big(data, 16), _big(data, 12) - _big(data, 20)


def _of_boxes(data: bytes) -> Size | None:
    """Return the largest size among the boxes of JPEG 2000 (ihdr) and of AVIF and HEIF (ispe)."""
    head = data[: 16 * HEAD_BYTES]
    sizes = [(_big(head, m.end() + 4), _big(head, m.end())) for m in re.finditer(rb"ihdr", head)]
    sizes += [(_big(head, m.end() + 4), _big(head, m.end() + 8)) for m in re.finditer(rb"ispe", head)]
    return max(sizes, key=lambda size: size[0] * size[1], default=None)


_READERS: tuple[tuple[tuple[bytes, ...], Callable[[bytes], Size | None]], ...] = (
    ((b"\x89PNG\r\n\x1a\n",), _of_png),
    ((b"\xff\xd8",), _of_jpeg),
    ((b"BM",), _of_bmp),
    ((b"GIF8",), _of_gif),
    ((b"RIFF",), _of_riff),
    ((b"P1", b"P2", b"P3", b"P4", b"P5", b"P6"), _of_words(NETPBM)),
    ((b"P7",), _of_pam),
    ((b"PF", b"Pf"), _of_words(PFM)),
    ((b"#?",), _of_words(RADIANCE)),
    ((b"II*\0", b"II+\0", b"MM\0*", b"MM\0+"), _of_tiff),
    ((b"\x59\xa6\x6a\x95",), _of_raster),
    ((b"\xff\x4f\xff\x51",), _of_codestream),
)
