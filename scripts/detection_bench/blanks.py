"""Pictures without a chessboard, on which a detector must find nothing and should not lose time: noise, a page of
dots, text, texture, cloth, codes, patterns that have something of a chessboard, and the things of
`detection_bench.things`.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from detection_bench.things import THINGS
from rigkit.core.arrays import FloatArray
from rigkit.core.errors import InputError

BLANK_NOISE_LEVELS = 2.0
BLANK_BLUR_PX = 0.7
WORDS = "of the lens and a board that no one can see from here while it is not there but every corner counts"


def blank(
    name: str,
    rng: np.random.Generator,
    size_px: tuple[int, int] = (640, 480),
    *,
    noise_levels: float = BLANK_NOISE_LEVELS,
) -> NDArray[np.uint8]:
    """Return the picture `name` of `BLANKS` as a camera sees it: blurred, with sensor noise, uint8 (height, width).

    Raises InputError for other names.
    """
    if name not in BLANKS:
        raise InputError(f"blank picture: '{name}' is unknown; known: {', '.join(BLANKS)}")
    levels = cv2.GaussianBlur(BLANKS[name](rng, size_px), (0, 0), BLANK_BLUR_PX)
    levels = levels + noise_levels * rng.standard_normal(levels.shape, dtype=np.float32)
    return np.asarray(np.clip(np.rint(levels), 0, 255), dtype=np.uint8)


def _noise(rng: np.random.Generator, size_px: tuple[int, int]) -> FloatArray:
    """Nothing but strong noise: the lens cap is on and the gain is up."""
    return np.asarray(60.0 + 40.0 * rng.standard_normal(size_px[::-1]))


def _dots(rng: np.random.Generator, size_px: tuple[int, int]) -> FloatArray:
    """A page of discs in rows and columns, a calibration target of another kind."""
    x, y = _turned(rng, size_px)
    pitch = min(size_px) / rng.uniform(10.0, 24.0)
    radius = np.hypot(*(np.mod(part, pitch) - 0.5 * pitch for part in (x, y)))
    return np.asarray(np.where(radius < 0.3 * pitch, 25.0, 205.0))


def _text(rng: np.random.Generator, size_px: tuple[int, int]) -> FloatArray:
    """A page of lines of words."""
    width, height = size_px
    page = np.full((height, width), 210, np.uint8)
    scale = min(size_px) / 900.0
    step = round(30 * scale)
    for line in range(2 * step, height, step):
        words = " ".join(rng.choice(WORDS.split(), 40))
        cv2.putText(page, words, (step, line), cv2.FONT_HERSHEY_SIMPLEX, scale, 30, max(round(2 * scale), 1))
    return page.astype(np.float64)


def _texture(rng: np.random.Generator, size_px: tuple[int, int]) -> FloatArray:
    """Natural texture: a spectrum that falls as 1 / frequency."""
    height, width = size_px[::-1]
    fx, fy = np.meshgrid(np.fft.rfftfreq(width), np.fft.fftfreq(height))
    spectrum = np.fft.rfft2(rng.standard_normal((height, width))) / np.maximum(np.hypot(fx, fy), 1.0 / width)
    field = np.fft.irfft2(spectrum, s=(height, width))
    return np.asarray(np.clip(110.0 + 45.0 * (field - field.mean()) / field.std(), 0.0, 255.0))


def _gingham(rng: np.random.Generator, size_px: tuple[int, int]) -> FloatArray:
    """Checkered cloth: dark and light stripes both ways, middle grey where they cross."""
    x, y = _turned(rng, size_px)
    pitch = min(size_px) / rng.uniform(6.0, 16.0)
    dark = [(np.mod(part, 2.0 * pitch) < pitch).astype(np.float64) for part in (x, y)]
    return np.asarray(210.0 - 85.0 * (dark[0] + dark[1]))


def _triangles(rng: np.random.Generator, size_px: tuple[int, int]) -> FloatArray:
    """Black and white triangles, six to a corner."""
    x, y = _turned(rng, size_px)
    pitch = min(size_px) / rng.uniform(6.0, 14.0)
    stripes = [np.floor((x * np.cos(a) + y * np.sin(a)) / pitch) for a in np.radians([0.0, 60.0, 120.0])]
    # The third family runs through the crossings of the other two: v2 = v1 - v0.
    odd = np.mod(stripes[0] + stripes[1] + stripes[2], 2.0) > 0.5
    return np.asarray(np.where(odd, 30.0, 205.0))


def _tiles(rng: np.random.Generator, size_px: tuple[int, int]) -> FloatArray:
    """Floor tiles of one colour with joints."""
    x, y = _turned(rng, size_px)
    pitch = min(size_px) / rng.uniform(6.0, 16.0)
    joint = np.minimum(*(np.abs(np.mod(part, pitch) - 0.5 * pitch) for part in (x, y))) < 0.05 * pitch
    return np.asarray(np.where(joint, 60.0, 180.0))


def _staggered(rng: np.random.Generator, size_px: tuple[int, int]) -> FloatArray:
    """A page of discs that nearly touch, every second row moved by half a step: between four of them is a saddle."""
    x, y = _turned(rng, size_px)
    pitch = min(size_px) / rng.uniform(10.0, 24.0)
    radius = rng.uniform(0.42, 0.5) * np.sqrt(0.5) * pitch
    moved = [_to_nearest(x + shift, pitch) ** 2 + _to_nearest(y + shift, pitch) ** 2 for shift in (0.0, 0.5 * pitch)]
    return np.asarray(np.where(np.minimum(*moved) < radius**2, 25.0, 205.0))


def _weave(rng: np.random.Generator, size_px: tuple[int, int]) -> FloatArray:
    """Cloth of light and dark threads that pass over and under each other, each rounded."""
    x, y = _turned(rng, size_px)
    pitch = min(size_px) / rng.uniform(12.0, 30.0)
    above = np.mod(np.floor(x / pitch) + np.floor(y / pitch), 2.0) < 0.5
    across, along = (np.cos(0.9 * np.pi * _to_nearest(part, pitch) / pitch) for part in (x, y))
    return np.asarray(np.where(above, 60.0 + 130.0 * across * np.sqrt(along), 40.0 + 60.0 * along * np.sqrt(across)))


def _tartan(rng: np.random.Generator, size_px: tuple[int, int]) -> FloatArray:
    """Checkered cloth of many stripes of different widths and shades both ways."""
    x, y = _turned(rng, size_px)
    pitch = min(size_px) / rng.uniform(3.0, 6.0)
    shade = rng.choice([0.0, 0.3, 0.6, 1.0], 16)
    both = [shade[(np.mod(part, pitch) * (len(shade) / pitch)).astype(np.int64) % len(shade)] for part in (x, y)]
    return np.asarray(40.0 + 80.0 * (both[0] + both[1]))


def _mosaic(rng: np.random.Generator, size_px: tuple[int, int]) -> FloatArray:
    """Black and white squares at random, as in codes: one corner in eight is a chessboard's."""
    x, y = _turned(rng, size_px)
    return _squares(rng, x, y, rng.uniform(5.0, 14.0))


def _codes(rng: np.random.Generator, size_px: tuple[int, int]) -> FloatArray:
    """A page of square codes, seen straight, small and in even light."""
    u, v = np.meshgrid(np.arange(size_px[0], dtype=np.float64), np.arange(size_px[1], dtype=np.float64))
    square, count = float(rng.integers(4, 8)), float(rng.integers(21, 40))
    cell_u, cell_v = (np.mod(np.floor(part / square), count + 4.0) for part in (u, v))
    inside = (cell_u < count) & (cell_v < count)
    return np.asarray(np.where(inside, _squares(rng, u, v, square), 205.0))


def _windows(rng: np.random.Generator, size_px: tuple[int, int]) -> FloatArray:
    """The front of a house: rows of dark windows with a light cross in each."""
    x, y = _turned(rng, size_px)
    pitch = min(size_px) / rng.uniform(8.0, 16.0)
    across, along = (np.abs(_to_nearest(part, step * pitch)) / pitch for part, step in ((x, 1.0), (y, 1.3)))
    shade = rng.uniform(20.0, 80.0, 997)
    number = np.floor(x / pitch) * 37.0 + np.floor(y / (1.3 * pitch)) * 101.0
    glass = shade[np.mod(number, len(shade)).astype(np.int64)]
    cross = np.minimum(across, along) < 0.03
    return np.asarray(np.where((across < 0.25) & (along < 0.3), np.where(cross, 220.0, glass), 170.0))


def _packed(rng: np.random.Generator, size_px: tuple[int, int]) -> FloatArray:
    """Strong noise after strong compression: blocks of 8 pixels with edges."""
    noise = np.clip(np.rint(_noise(rng, size_px)), 0.0, 255.0).astype(np.uint8)
    _, packed = cv2.imencode(".jpg", noise, [cv2.IMWRITE_JPEG_QUALITY, 10])
    return np.asarray(cv2.imdecode(packed, cv2.IMREAD_GRAYSCALE), dtype=np.float64)


def _squares(rng: np.random.Generator, x: FloatArray, y: FloatArray, side: float) -> FloatArray:
    """Return squares of `side`, each dark or bright at random, at the places x and y (height, width)."""
    column, row = ((part - part.min()) // side for part in (x, y))
    bright = rng.random((int(row.max()) + 1, int(column.max()) + 1)) < 0.5
    return np.asarray(np.where(bright[row.astype(np.int64), column.astype(np.int64)], 205.0, 30.0))


def _to_nearest(position: FloatArray, pitch: float) -> FloatArray:
    """Return how far from the middle of its step of `pitch` each position lies."""
    return np.asarray(np.mod(position, pitch) - 0.5 * pitch)


def _turned(rng: np.random.Generator, size_px: tuple[int, int]) -> tuple[FloatArray, FloatArray]:
    """Return coordinates (height, width) of a plane seen turned and aslant, px."""
    u, v = np.meshgrid(np.arange(size_px[0]) - 0.5 * size_px[0], np.arange(size_px[1]) - 0.5 * size_px[1])
    angle, tilt = rng.uniform(0.0, np.pi), rng.uniform(-0.4, 0.4) / max(size_px)
    depth = 1.0 + tilt * u
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.asarray((cosine * u + sine * v) / depth), np.asarray((cosine * v - sine * u) / depth)


BLANKS: dict[str, Callable[[np.random.Generator, tuple[int, int]], FloatArray]] = {
    "noise": _noise,
    "dots": _dots,
    "text": _text,
    "texture": _texture,
    "gingham": _gingham,
    "triangles": _triangles,
    "tiles": _tiles,
    "staggered": _staggered,
    "weave": _weave,
    "tartan": _tartan,
    "mosaic": _mosaic,
    "codes": _codes,
    "windows": _windows,
    "packed": _packed,
    **THINGS,
}
"""Pictures by name; each draws grey levels (height, width) from (rng, size_px), before lens and sensor."""
