"""Distractors with rows and columns: keys, puzzles, tables, cloth, floors, walls, codes.

Each is drawn on a sheet and rendered rotated and slanted; `detection_bench.blanks` adds lens and sensor.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from rigkit.core.arrays import FloatArray

SHEET = 1200
"""Sides of the sheets that things are drawn on, px."""

HOUNDSTOOTH = (
    "11110100",
    "11111000",
    "11110001",
    "11110010",
    "01000000",
    "10000000",
    "00010000",
    "00100000",
)
"""One repeat of the weave."""

Sheet = NDArray[np.uint8]


def _keyboard(rng: np.random.Generator) -> Sheet:
    """Rows of keys with letters, each row moved by a part of a key."""
    keys, ground = (30, 90) if rng.random() < 0.5 else (215, 120)
    sheet, pitch = _blank(ground), int(rng.uniform(60, 110))
    for row, top in enumerate(range(0, SHEET, pitch)):
        for left in range(-pitch + row % 4 * pitch // 4, SHEET, pitch):
            _key(sheet, (left, top), (pitch, pitch), keys, chr(int(rng.integers(65, 91))))
    return sheet


def _calculator(rng: np.random.Generator) -> Sheet:
    """Keys of different shades in straight rows, close together, with digits."""
    sheet, pitch = _blank(60), int(rng.uniform(80, 150))
    for top in range(0, SHEET, pitch):
        for left in range(0, SHEET, pitch):
            _key(sheet, (left, top), (pitch, pitch), int(rng.choice([25, 110, 200, 230])), str(rng.integers(10)))
    return sheet


def _crossword(rng: np.random.Generator) -> Sheet:
    """White squares within thin lines, every fifth black."""
    sheet, pitch = _blank(225), int(rng.uniform(50, 90))
    for top in range(0, SHEET, pitch):
        for left in range(0, SHEET, pitch):
            if rng.random() < 0.2:
                cv2.rectangle(sheet, (left, top), (left + pitch, top + pitch), 20, -1)
            elif rng.random() < 0.5:
                _word(sheet, chr(int(rng.integers(65, 91))), (left, top), pitch, 40)
    return _ruled(sheet, (pitch, pitch), 30, 3)


def _table(rng: np.random.Generator) -> Sheet:
    """A spreadsheet: lines, every second row shaded, numbers in the cells."""
    sheet, wide, high = _blank(245), int(rng.uniform(90, 170)), int(rng.uniform(35, 60))
    for row, top in enumerate(range(0, SHEET, high)):
        if row % 2:
            sheet[top : top + high] = 205
        for left in range(0, SHEET, wide):
            _word(sheet, str(rng.integers(1000)), (left, top), high, 50)
    return _ruled(sheet, (wide, high), 150, 2)


def _parquet(rng: np.random.Generator) -> Sheet:
    """Squares of staves that lie along and across in turn, each of its own shade."""
    sheet, pitch, staves = _blank(100), int(rng.uniform(80, 160)), int(rng.integers(3, 6))
    for row, top in enumerate(range(0, SHEET, pitch)):
        for column, left in enumerate(range(0, SHEET, pitch)):
            square = np.repeat(rng.uniform(70, 190, staves), -(-pitch // staves))[:pitch]
            block = np.broadcast_to(square if (row + column) % 2 else square[:, None], (pitch, pitch))
            part = sheet[top : top + pitch, left : left + pitch]
            part[...] = block[: part.shape[0], : part.shape[1]]
            cv2.rectangle(sheet, (left, top), (left + pitch, top + pitch), 50, 2)
    return sheet


def _bricks(rng: np.random.Generator) -> Sheet:
    """A wall of bricks of different shades."""
    sheet, high = _blank(190), int(rng.uniform(35, 70))
    for row, top in enumerate(range(0, SHEET, high)):
        for left in range(-high * (row % 2), SHEET, 2 * high):
            shade = int(rng.uniform(60, 140))
            cv2.rectangle(sheet, (left + 4, top + 4), (left + 2 * high - 4, top + high - 4), shade, -1)
    return sheet


def _houndstooth(rng: np.random.Generator) -> Sheet:
    """Broken checks, woven of dark and light yarns in fours."""
    repeat = np.array([[float(sign) for sign in row] for row in HOUNDSTOOTH])
    return _tiled(40.0 + 170.0 * repeat, int(rng.uniform(6, 16)))


def _shirt(rng: np.random.Generator) -> Sheet:
    """A checkered shirt with folds: woven stripes both ways, their crossings between both shades."""
    v, u = np.mgrid[:SHEET, :SHEET].astype(np.float64)
    folds = [sum(rng.uniform(5, 25) * np.sin((u * a + v * b) / 60.0 + c) for a, b, c in rng.normal(0, 0.4, (3, 3)))]
    pitch = rng.uniform(50, 110)
    dark = [np.mod(np.floor((part + folds[0]) / pitch), 2.0) for part in (u, v)]
    light = 1.0 + 0.2 * np.tanh(folds[0] / 20.0)
    return _grey((215.0 - rng.uniform(60, 90) * (dark[0] + dark[1])) * light)


def _code(rng: np.random.Generator) -> Sheet:
    """A large square code with the three marks in its corners."""
    count = int(rng.choice([21, 25, 29, 33]))
    cells = np.where(rng.random((count, count)) < 0.5, 225.0, 25.0)
    for row, column in ((0, 0), (0, count - 7), (count - 7, 0)):
        cells[max(row - 1, 0) : row + 8, max(column - 1, 0) : column + 8] = 225.0
        for ring, shade in ((0, 25.0), (1, 225.0), (2, 25.0)):
            cells[row + ring : row + 7 - ring, column + ring : column + 7 - ring] = shade
    return np.pad(_tiled(cells, 0), 60, constant_values=225)


def _stones(rng: np.random.Generator) -> Sheet:
    """A board of thin lines with black and white stones on its crossings."""
    sheet, pitch = _blank(160), int(rng.uniform(50, 80))
    _ruled(sheet, (pitch, pitch), 40, 2)
    for v in range(0, SHEET, pitch):
        for u in range(0, SHEET, pitch):
            if rng.random() < 0.5:
                cv2.circle(sheet, (u, v), round(0.47 * pitch), int(rng.choice([25, 235])), -1, cv2.LINE_AA)
    return sheet


def _trellis(rng: np.random.Generator) -> Sheet:
    """Slats one way over slats the other way, the ground dark between them."""
    pitch = rng.uniform(50, 120)
    v, u = np.mgrid[:SHEET, :SHEET].astype(np.float64)
    over, under = (np.mod(part, pitch) < rng.uniform(0.3, 0.6) * pitch for part in (u + v, u - v))
    return _grey(np.where(over, 200.0, np.where(under, rng.uniform(120, 180), 40.0)))


def _panels(rng: np.random.Generator) -> Sheet:
    """Dark cells with their corners cut off, between light lines."""
    sheet, pitch = _blank(200), int(rng.uniform(60, 120))
    cut = round(rng.uniform(0.1, 0.3) * pitch)
    for top in range(0, SHEET, pitch):
        for left in range(0, SHEET, pitch):
            low, high = 3, pitch - 3
            ring = [(low + cut, low), (high - cut, low), (high, low + cut), (high, high - cut)]
            ring += [(high - cut, high), (low + cut, high), (low, high - cut), (low, low + cut)]
            cv2.fillPoly(sheet, [np.add(ring, (left, top))], int(rng.uniform(30, 60)))
    return sheet


def _facade(rng: np.random.Generator) -> Sheet:
    """A tower of glass: panes without frames to speak of, each mirroring something else."""
    wide, high = int(rng.uniform(40, 90)), int(rng.uniform(50, 110))
    two = np.array([rng.uniform(30.0, 90.0), rng.uniform(120.0, 220.0)])
    shades = two[rng.integers(2, size=(-(-SHEET // high), -(-SHEET // wide)))]
    shades = shades + rng.normal(0.0, 15.0, shades.shape)
    panes = np.repeat(np.repeat(shades, high, axis=0), wide, axis=1)[:SHEET, :SHEET]
    return _ruled(_grey(panes), (wide, high), 90, int(rng.integers(1, 5)))


def _seen(sheet: Sheet, rng: np.random.Generator, size_px: tuple[int, int]) -> FloatArray:
    """Return a part of `sheet` as it is seen turned and aslant, (height, width)."""
    side = rng.uniform(0.35, 0.75) * SHEET
    turn, middle = rng.uniform(0.0, 2.0 * np.pi), 0.5 * SHEET
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * (0.5 * side * np.array([1.0, size_px[1] / size_px[0]]))
    corners = corners @ np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    corners *= rng.uniform(0.75, 1.25, (4, 1))
    width, height = size_px
    image = np.array([[0, 0], [width, 0], [width, height], [0, height]], np.float32) - np.float32(0.5)
    to_image = cv2.getPerspectiveTransform((corners + middle).astype(np.float32), image)
    # Where the sheet is finer than the image, its detail is below a pixel.
    fine = max(side / width, 1e-3)
    smooth = cv2.GaussianBlur(sheet, (0, 0), 0.5 * fine) if fine > 1.0 else sheet
    seen = cv2.warpPerspective(smooth, to_image, size_px, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
    return seen.astype(np.float64)


def _blank(grey: int) -> Sheet:
    return np.full((SHEET, SHEET), grey, np.uint8)


def _grey(levels: FloatArray) -> Sheet:
    return np.asarray(np.clip(levels, 0.0, 255.0), np.uint8)


def _tiled(cells: FloatArray, side: int) -> Sheet:
    """Return `cells` of `side` px over the whole sheet; 0: once, as large as the sheet."""
    if side == 0:
        return np.asarray(cv2.resize(_grey(cells), (SHEET, SHEET), interpolation=cv2.INTER_NEAREST), np.uint8)
    block = np.repeat(np.repeat(_grey(cells), side, axis=0), side, axis=1)
    times = -(-SHEET // len(block))
    return np.ascontiguousarray(np.tile(block, (times, times))[:SHEET, :SHEET])


def _ruled(sheet: Sheet, pitch: tuple[int, int], grey: int, width: int) -> Sheet:
    """Draw lines every `pitch` (across, down) on `sheet` and return it."""
    for u in range(0, SHEET, pitch[0]):
        cv2.line(sheet, (u, 0), (u, SHEET), grey, width)
    for v in range(0, SHEET, pitch[1]):
        cv2.line(sheet, (0, v), (SHEET, v), grey, width)
    return sheet


def _key(sheet: Sheet, at: tuple[int, int], size: tuple[int, int], grey: int, sign: str) -> None:
    gap = max(size[0] // 14, 2)
    left, top = at
    cv2.rectangle(sheet, (left + gap, top + gap), (left + size[0] - gap, top + size[1] - gap), grey, -1)
    _word(sheet, sign, at, size[1], 235 if grey < 128 else 30)


def _word(sheet: Sheet, word: str, at: tuple[int, int], high: int, grey: int) -> None:
    """Write into the cell of height `high` whose first corner is `at`."""
    place = (at[0] + high // 4, at[1] + 3 * high // 4)
    cv2.putText(sheet, word, place, cv2.FONT_HERSHEY_SIMPLEX, high / 50.0, grey, max(high // 25, 1), cv2.LINE_AA)


def _thing(
    draw: Callable[[np.random.Generator], Sheet],
) -> Callable[[np.random.Generator, tuple[int, int]], FloatArray]:
    return lambda rng, size_px: _seen(draw(rng), rng, size_px)


THINGS: dict[str, Callable[[np.random.Generator, tuple[int, int]], FloatArray]] = {
    "keyboard": _thing(_keyboard),
    "calculator": _thing(_calculator),
    "crossword": _thing(_crossword),
    "table": _thing(_table),
    "parquet": _thing(_parquet),
    "bricks": _thing(_bricks),
    "houndstooth": _thing(_houndstooth),
    "shirt": _thing(_shirt),
    "code": _thing(_code),
    "stones": _thing(_stones),
    "trellis": _thing(_trellis),
    "panels": _thing(_panels),
    "facade": _thing(_facade),
}
"""Things by name; each draws grey levels (height, width) from (rng, size_px), before lens and sensor."""
