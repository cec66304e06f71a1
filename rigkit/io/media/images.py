"""Reading images; truncated and damaged files are refused.

Decoders silently fill the missing part of a truncated JPEG with grey, so the structure of the file is checked first.
"""

from __future__ import annotations

import io
import logging
import os
import re
import struct
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from fnmatch import fnmatch
from pathlib import Path
from typing import Any, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from rigkit.core.errors import InputError
from rigkit.io.disk.reading import is_file_or_broken_link, read_bytes, refuse_archive
from rigkit.io.media.tiff import TIFF_STARTS, as_stored, page_sizes

_log = logging.getLogger(__name__)

Image = NDArray[np.uint8] | NDArray[np.uint16]
"""(H, W) grey or (H, W, 3) RGB."""

IMAGE_ENDINGS = (".bmp", ".jpeg", ".jpg", ".pgm", ".png", ".ppm", ".tif", ".tiff", ".webp")
UNREAD_ENDINGS = (".arw", ".avif", ".cr2", ".cr3", ".dng", ".exr", ".fits", ".gif",
                  ".heic", ".heif", ".jp2", ".jxl", ".nef", ".orf", ".raf", ".rw2")  # fmt: skip
"""Image formats that are not read."""
MAX_PIXELS = 200_000_000
"""The largest sensors have 150 million; detection takes 4 GB for these."""
JPEG_START = b"\xff\xd8"
JPEG_END = 0xD9
JPEG_SCAN = 0xDA
JPEG_STANDALONE = {0x01, *range(0xD0, 0xD8)}
JPEG_MARKER = re.compile(rb"\xff[^\x00\xd0-\xd7\xff]")
"""In entropy-coded data 0xff is followed by 0 (stuffing), a restart marker or 0xff (fill); all else is a marker."""
BMP_START = b"BM"
PNG_START = b"\x89PNG\r\n\x1a\n"


def read_image(path: str | Path) -> Image:
    """Return the image as uint8 or uint16, (H, W) or (H, W, 3) in RGB order.

    Orientation tags (EXIF, TIFF) are not applied, because a calibration belongs to the sensor. An alpha channel is
    dropped.

    Raises InputError: no such file, not an image, several images in one file, truncated or damaged, more than
    MAX_PIXELS, or a pixel type other than 8 or 16 bits.
    """
    source = Path(path)
    data = read_bytes(source, "image")
    name = unread_format(data)
    if name is None and data.startswith(TIFF_STARTS) and source.suffix.lower() in UNREAD_ENDINGS:
        # DNG, NEF and ARW are TIFFs whose first picture is a thumbnail.
        name = f"a raw image ({source.suffix[1:].upper()})"
    if name is not None:
        raise InputError(
            f"image '{source}' is {name}, which is not read; convert it to PNG or TIFF without changing pixels"
        )
    refuse_archive(data, f"image '{source}'")
    fault = _fault(data)
    if fault:
        raise InputError(f"image '{source}' is {fault}; copy it again from the camera")
    sizes = announced_sizes(data)
    if not sizes:
        raise InputError(f"image '{source}' is damaged or not an image that is read; convert it to PNG or JPEG")
    require_pixels(max(sizes, key=lambda size: size[0] * size[1]), f"image '{source}'")
    if (count := sizes.count(sizes[0])) > 1:
        what = f"holds {count} pages" if data.startswith(TIFF_STARTS) else f"is an animation of {count} frames"
        raise InputError(f"image '{source}' {what}; save each as a file of its own")
    try:
        with quiet_opencv():
            raw = cv2.imdecode(np.frombuffer(as_stored(data), np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise InputError(f"image '{source}' cannot be decoded ({error.err}); convert it to PNG or JPEG") from error
    if raw is None:
        raise InputError(f"image '{source}' is damaged or not an image that OpenCV knows; convert it to PNG or JPEG")
    if raw.dtype not in (np.uint8, np.uint16):
        raise InputError(f"image '{source}' has {raw.dtype} pixels; save it with 8 or 16 bits")
    return cast(Image, np.ascontiguousarray(raw if raw.ndim == 2 else raw[..., 2::-1]))


UNREAD_CONTAINERS = {
    b"ftypheic": "HEIC",
    b"ftypheix": "HEIC",
    b"ftypmif1": "HEIC",
    b"ftypavif": "AVIF",
    b"ftypcrx ": "a raw image (CR3)",
    b"ftypisom": "a video (MP4)",
    b"ftypmp42": "a video (MP4)",
    b"ftypqt  ": "a video (MOV)",
}
"""Formats by bytes 4 to 11 (ISO/IEC 14496-12)."""

UNREAD_STARTS = {
    b"II*\x00\x10\x00\x00\x00CR": "a raw image (CR2)",
    b"FUJIFILMCCD-RAW": "a raw image (RAF)",
    b"IIU\x00": "a raw image (RW2)",
    b"IIRO": "a raw image (ORF)",
    b"SIMPLE  =": "FITS",
    b"v/1\x01": "OpenEXR",
    b"\xff\x0a": "JPEG XL",
    b"\x00\x00\x00\x0cJXL ": "JPEG XL",
    b"%PDF": "a PDF",
    b"8BPS": "a Photoshop file",
    b"\x1aE\xdf\xa3": "a video (MKV)",
}


def unread_format(data: bytes) -> str | None:
    """Return the name of the known but unsupported format that `data` begins with, or None."""
    container = UNREAD_CONTAINERS.get(data[4:12])
    return container or next((name for start, name in UNREAD_STARTS.items() if data.startswith(start)), None)


def announced_sizes(data: bytes) -> list[tuple[int, int]]:
    """Return (width, height) of every image or frame by the headers of a file, without decoding it.

    A kilobyte may announce a thousand megapixels, and OpenCV silently returns the first frame of an animation. The list
    is empty if Pillow cannot read the headers.
    """
    if data.startswith(TIFF_STARTS):
        return page_sizes(data)
    from PIL import Image as Pillow

    limit = Pillow.MAX_IMAGE_PIXELS
    try:
        Pillow.MAX_IMAGE_PIXELS = None
        with Pillow.open(io.BytesIO(data)) as picture:
            return [picture.size] * getattr(picture, "n_frames", 1)
    except (OSError, SyntaxError, ValueError, TypeError, LookupError, ArithmeticError, EOFError, struct.error):
        return []
    finally:
        Pillow.MAX_IMAGE_PIXELS = limit


def is_image(path: Path) -> bool:
    """Return whether a file is an image by its name. Hidden ones are none: Macs write ._NAME beside NAME."""
    return path.suffix.lower() in IMAGE_ENDINGS and not path.name.startswith(".")


def images_of_folder(folder: Path, pattern: str = "*") -> list[Path]:
    """Return the images of a folder whose names match `pattern`, sorted by name."""
    return sorted(p for p in folder.iterdir() if is_image(p) and fnmatch(p.name, pattern) and is_file_or_broken_link(p))


def images_below(folder: Path) -> list[Path]:
    """Return the images of a folder and its subfolders, sorted; hidden subfolders are skipped, unreadable ones with a
    warning, and links to folders are followed unless these are below, too."""
    if not folder.is_dir():
        return []
    out, walked = list[Path](), set[Path]()

    def warn(error: OSError) -> None:
        _log.warning(
            "folder '%s' cannot be read and is left out: %s; check its permissions", error.filename, error.strerror
        )

    for place, inside, names in os.walk(folder, onerror=warn, followlinks=True):
        here = Path(place)
        if here.resolve() in walked:  # A link may lead to a folder above.
            inside.clear()
            continue
        walked.add(here.resolve())
        shown = sorted(((here / name).is_symlink(), name) for name in inside if not name.startswith("."))
        inside[:] = [name for _, name in shown]
        out += [path for name in names if is_image(path := here / name) and path.is_file()]
    return sorted(out)


def folder_of_images(folder: Path) -> Path:
    """Return the folder if it has images, else the only one below it that has: cam0/data of EuRoC for cam0.

    Raises InputError if none or several have.
    """
    if images_of_folder(folder):
        return folder
    below = list(dict.fromkeys(path.parent for path in images_below(folder)))
    if len(below) != 1 or _unread(folder):
        raise InputError(no_images(folder))
    return below[0]


def further_images(folder: Path) -> Path | None:
    """Return the first folder with images below a folder that has images itself; None without one."""
    if not folder.is_dir() or not images_of_folder(folder):
        return None
    return next((image.parent for image in images_below(folder) if image.parent != folder), None)


def require_folder(folder: Path) -> None:
    """Raise InputError for what is not a folder, such as an image."""
    if is_image(folder) and folder.is_file():
        raise InputError(f"'{folder}' is an image; give the folder that holds it instead, '{folder.parent}'")
    if not folder.is_dir():
        raise InputError(f"'{folder}' is not a folder; give folders of images, or one session file")


def no_images(folder: Path) -> str:
    """Return the message that a folder has no images, with the unsupported images or subfolders that it has instead."""
    words = f"folder '{folder}' has no images ({' '.join(IMAGE_ENDINGS)})"
    unread = _unread(folder)
    if unread:
        return (
            f"{words}, but pictures of formats that are not read, '{unread[0]}' the first; convert them to PNG or JPEG"
        )
    inside = images_below(folder)
    if not inside:
        return f"{words}; give another"
    first, others = inside[0].parent, len({path.parent for path in inside}) - 1
    return f"the images of '{folder}' are in '{first}' and {others} more below it; give one folder a camera"


def warn_of_unread_formats(folder: Path) -> None:
    """Warn of images of unsupported formats in a folder, except where a readable one has the same name."""
    read = {path.stem for path in images_of_folder(folder)}
    lost = [name for name in _unread(folder) if Path(name).stem not in read]
    if lost:
        count = f"{len(lost)} pictures, '{lost[0]}' the first, are" if len(lost) > 1 else f"picture '{lost[0]}' is"
        _log.warning("'%s': %s of a format that is not read, and left out: convert to PNG or JPEG", folder, count)


def _unread(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir() if path.suffix.lower() in UNREAD_ENDINGS)


def to_grey(image: Image) -> Image:
    """Return the image as grey (H, W), of the same type."""
    if image.ndim == 2:
        return image
    if image.ndim != 3 or image.shape[2] != 3:
        raise InputError(f"image: expected (H, W) or (H, W, 3), got shape {image.shape}")
    return cast(Image, cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))


def require_pixels(size_px: tuple[int, int], what: str) -> None:
    """Raise InputError, which begins with `what`, for more than MAX_PIXELS."""
    width, height = size_px
    if width * height > MAX_PIXELS:
        raise InputError(
            f"{what} has {width} x {height} px, more than {MAX_PIXELS // 10**6} million; use a smaller image"
        )


def read_image_of(path: str | Path, size_px: tuple[int, int], calibration: str | Path) -> Image:
    """Return an image of a camera; raises InputError as `read_image`, and as `require_size`."""
    image = read_image(path)
    require_size((image.shape[1], image.shape[0]), f"image '{path}'", size_px, calibration)
    return image


def require_size(given_px: tuple[int, int], what: str, size_px: tuple[int, int], calibration: str | Path) -> None:
    """Raise InputError if `what` has another size than the camera; `calibration` is the camera's file."""
    if given_px != size_px:
        raise InputError(
            f"{what} is {given_px[0]}x{given_px[1]} px, but '{calibration}' is of a camera of "
            f"{size_px[0]}x{size_px[1]}; give images of that size, or calibrate at this one"
        )


@contextmanager
def quiet_opencv() -> Iterator[None]:
    """Silence OpenCV's log in the block, and that of its FFmpeg, which reads its level once: rigkit reports errors."""
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    # OpenCV 5 moved the two functions; level 0 is silent in both.
    log: Any = cv2.utils.logging if hasattr(cv2.utils, "logging") else cv2
    level = log.getLogLevel()
    log.setLogLevel(0)
    try:
        yield
    finally:
        log.setLogLevel(level)


def _fault(data: bytes) -> str | None:
    """Return the fault of a file's structure, in words that follow "is"; None if there is none."""
    if not data:
        return "empty"
    if data.startswith(JPEG_START):
        return _jpeg_fault(data)
    if data.startswith(PNG_START):
        return _png_fault(data)
    if data.startswith(BMP_START) and len(data) >= 6:
        size = int.from_bytes(data[2:6], "little")
        return f"cut off ({len(data)} of {size} bytes)" if len(data) < size else None
    return None


def _jpeg_fault(data: bytes) -> str | None:
    """Check the segments up to the end-of-image marker, skipping thumbnails inside segments."""
    at = len(JPEG_START)
    while at + 1 < len(data):
        if data[at] != 0xFF:
            return f"damaged (byte {at} should start a JPEG segment)"
        code = data[at + 1]
        if code == 0xFF:  # fill byte
            at += 1
            continue
        if code == JPEG_END:
            return None
        if code in JPEG_STANDALONE:
            at += 2
            continue
        length = int.from_bytes(data[at + 2 : at + 4], "big")
        if length < 2:
            break
        at += 2 + length
        if code == JPEG_SCAN:
            marker = JPEG_MARKER.search(data, at)
            at = marker.start() if marker else len(data)
    return f"cut off (the JPEG ends without its end marker, after {len(data)} bytes)"


def _png_fault(data: bytes) -> str | None:
    """Check every chunk's length and checksum up to IEND."""
    at = len(PNG_START)
    while at + 12 <= len(data):
        length = int.from_bytes(data[at : at + 4], "big")
        end = at + 8 + length
        if end + 4 > len(data):
            break
        if zlib.crc32(data[at + 4 : end]) != int.from_bytes(data[end : end + 4], "big"):
            return f"damaged (wrong checksum in the PNG chunk at byte {at})"
        if data[at + 4 : at + 8] == b"IEND":
            return None
        at = end + 4
    return f"cut off (the PNG ends without its end chunk, after {len(data)} bytes)"
