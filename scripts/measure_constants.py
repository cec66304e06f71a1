"""Measure how far each constant of rigkit's detection can be changed before boards are lost or false ones found.

    python scripts/measure_constants.py [MODULE ...] [--boards BOARD=DIR ...] [--without DIR ...] [--seeds 2]

Each number among the constants of `rigkit.detection` (or of the MODULEs given, such as rigkit.detection.checks.border),
and each number in a tuple, is multiplied and divided by FACTORS, one at a time, in all modules that import it. Rendered
boards of every kind, in focus, blurred, noisy, faint and through a fisheye, and rendered pictures without boards are
searched; some of the boards also for a board that nobody described; and the real images given (BOARD as in `rigkit
detect --board`). A constant is tried only on the images in which a function that reads it is called.

Prints for each constant, on both sides, the first factor that has an effect, and the effect: corners lost (more than
MAX_LOST_SHARE of them), false boards found, corners moved (more than MAX_MOVED of their sigmas, rms), or sigmas changed
(more than MAX_SIGMA_CHANGE, rms of the logarithm). "-" if there is none at the largest factor; "same" if not even a
digit of any result changes then: in these images the constant decides nothing. "not read" are constants that no
function reads when called, such as defaults of arguments.
"""

from __future__ import annotations

import argparse
import importlib
import os
import pkgutil
import re
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import CodeType, FrameType, ModuleType
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from detection_bench.blanks import BLANKS, blank
from detection_bench.scenes import LENSES, one_board
from detectors.degradations import degraded

import rigkit.detection
from rigkit.core.arrays import FloatArray
from rigkit.core.boards import Board
from rigkit.core.errors import RigkitError
from rigkit.core.patterns.aprilgrid import AprilGrid
from rigkit.core.patterns.charuco import Charuco
from rigkit.core.patterns.circles import Circles
from rigkit.detection.detect import detect_boards
from rigkit.detection.saddles.response import GreyImage, grey_image
from rigkit.detection.unknown import guess_board
from rigkit.io.boards.board_words import board_of_words, words_of_board
from rigkit.io.media.images import images_of_folder, read_image

FACTORS = (1.25, 2.0, 4.0)
MAX_LOST_SHARE, MAX_MOVED, MAX_SIGMA_CHANGE = 0.01, 0.3, 0.1
BOARDS = (
    Board("chessboard", 8, 6, 60.0, 60.0),
    Board("charuco", 8, 6, 60.0, 60.0, pattern=Charuco("DICT_5X5_100", 45.0)),
    Board("aprilgrid", 8, 6, 60.0, 60.0, pattern=AprilGrid(0.3)),
    Board("circles", 9, 7, 60.0, 60.0, pattern=Circles()),
)
CONDITIONS = (("as it is", 0.0), ("blur", 2.5), ("noise", 15.0), ("faint", 0.15))
"""Degradations of rendered boards; see `detectors/degradations.py`."""
COUNTED_PATTERNS = ("codes", "mosaic", "code", "dots", "staggered")
"""Rendered pictures that contain pieces of real chessboards or grids of circles."""
IMAGES_OF_UNKNOWN = 3
"""Images of a board that nobody described which are searched together."""

Corners = dict[tuple[str, int, int], tuple[float, float, float]]
"""Board, column and row of corners, and their u, v and sigma."""


@dataclass(frozen=True, eq=False, slots=True)
class Look:
    """Images, the boards that are looked for (none: the board is to be found out), and whether they are shown."""

    images: tuple[GreyImage, ...]
    boards: tuple[Board, ...]
    shown: bool

    def found(self) -> Found:
        """Return the corners of the boards that are shown, and the number of false boards."""
        if not self.boards:
            guess = guess_board(self.images)
            if guess is None or not self.shown:
                return Found({}, int(guess is not None))
            # Any other board, or another state of knowledge, is a loss.
            words = f"{words_of_board(guess.board)} {guess.determined}"
            return Found({(words, k, 0): (0.0, 0.0, 1.0) for k in range(guess.board.corner_count)}, 0)
        seen = [one for image in self.images for one in detect_boards(image, self.boards)]
        if not self.shown:
            return Found({}, len(seen))
        names = {board.board_id for board in self.boards}
        return Found(
            {
                (str(one.board_id), column, row): (u, v, sigma)
                for one in seen
                if one.board_id in names
                for (column, row), (u, v), sigma in zip(
                    one.grid.tolist(), one.pixels.tolist(), one.sigma_px.tolist(), strict=True
                )
            },
            0,
        )


@dataclass(frozen=True, eq=False, slots=True)
class Found:
    """What a look finds."""

    corners: Corners
    false: int


def constants_of(module: ModuleType) -> list[str]:
    """Return the names of the numbers among a module's own constants, those in tuples as NAME[k]."""
    source = Path(str(module.__file__)).read_text(encoding="utf-8")
    names = []
    for left in re.findall(r"^((?:_?[A-Z][A-Z0-9_]*(?:, )?)+)\s*(?::[^=\n]+)?=", source, re.MULTILINE):
        for name in left.split(", "):
            value = vars(module).get(name)
            if _number(value):
                names.append(name)
            elif isinstance(value, tuple) and all(map(_number, value)):
                names += [f"{name}[{k}]" for k in range(len(value))]
    return names


def _number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def value_of(module: ModuleType, constant: str) -> float:
    """Return the number of a name of `constants_of`."""
    name, _, k = constant.rstrip("]").partition("[")
    value = vars(module)[name]
    return value[int(k)] if k else value


@contextmanager
def changed(module: ModuleType, constant: str, factor: float) -> Iterator[bool]:
    """Multiply a constant in its module and all that import it; yields whether that is another number."""
    name, _, k = constant.rstrip("]").partition("[")
    value, number = vars(module)[name], value_of(module, constant)
    new: Any = number * factor if isinstance(number, float) else round(number * factor)
    differs = bool(new != number)
    if k:
        new = (*value[: int(k)], new, *value[int(k) + 1 :])
    users = users_of(module, name)
    for user in users:
        setattr(user, name, new)
    forget()
    try:
        yield differs
    finally:
        for user in users:
            setattr(user, name, value)
        forget()


def users_of(module: ModuleType, name: str) -> list[ModuleType]:
    """Return the modules of rigkit that have a module's constant."""
    value = vars(module)[name]
    alike = [one for key, one in sys.modules.items() if key.startswith("rigkit.") and vars(one).get(name) is value]
    # Another module may have an own constant of the same name and integer.
    return [one for one in alike if one is module or name not in {own.partition("[")[0] for own in constants_of(one)}]


def forget() -> None:
    """Clear the caches of functions of rigkit.detection, whose results may contain constants."""
    for key, module in list(sys.modules.items()):
        if key.startswith("rigkit.detection."):
            for value in vars(module).values():
                if hasattr(value, "cache_clear"):
                    value.cache_clear()


def readers_of(module: ModuleType, constant: str) -> set[CodeType]:
    """Return the functions that read a constant when they are called."""
    name = constant.partition("[")[0]
    out: set[CodeType] = set()
    for user in users_of(module, name):
        file, parts = str(user.__file__), [compile(Path(str(user.__file__)).read_text(), str(user.__file__), "exec")]
        while parts:
            part = parts.pop()
            inner = [code for code in part.co_consts if isinstance(code, CodeType)]
            # Bodies of modules and classes run once, at the import.
            if name in part.co_names and part.co_flags & 1 and part.co_filename == file:
                out.add(part)
            parts += inner
    return out


def called_by(look: Look) -> tuple[Found, set[tuple[str, int]]]:
    """Return what a look finds, and the functions of rigkit.detection that it calls (file and line)."""
    calls: set[tuple[str, int]] = set()

    def note(frame: FrameType, event: str, _: object) -> None:
        if event == "call" and "detection" in frame.f_code.co_filename:
            calls.add((frame.f_code.co_filename, frame.f_code.co_firstlineno))

    forget()
    threading.setprofile(note)
    sys.setprofile(note)
    try:
        return look.found(), calls
    finally:
        sys.setprofile(None)
        threading.setprofile(None)


def effect(usual: Sequence[Found], now: Sequence[Found], corners: int) -> str:
    """Return what another value of a constant does, of `corners` in all images: "same", "-", or the loss in words."""
    lost = sum(len(one.corners.keys() - other.corners.keys()) for one, other in zip(usual, now, strict=True))
    false = sum(max(other.false - one.false, 0) for one, other in zip(usual, now, strict=True))
    off, ratio = _moves(usual, now)
    words = [f"{lost} corners lost"] if lost > MAX_LOST_SHARE * corners else []
    words += [f"{false} false boards"] if false else []
    words += [f"corners move by {off:.2g} sigmas"] if off > MAX_MOVED else []
    words += [f"sigmas change by {ratio:.0%}"] if ratio > MAX_SIGMA_CHANGE else []
    if not words:
        alike = all(a.corners == b.corners and a.false == b.false for a, b in zip(usual, now, strict=True))
        return "same" if alike else "-"
    return " and ".join(words)


def _moves(usual: Sequence[Found], now: Sequence[Found]) -> tuple[float, float]:
    """Return how far corners that are found both times move, in sigmas, and the change of log sigma; rms."""
    both = [
        (a.corners[key], b.corners[key])
        for a, b in zip(usual, now, strict=True)
        for key in a.corners
        if key in b.corners
    ]
    if not both:
        return 0.0, 0.0
    first, second = (np.array([pair[k] for pair in both]) for k in (0, 1))
    moves: FloatArray = np.linalg.norm(second[:, :2] - first[:, :2], axis=1) / first[:, 2]
    change = np.log(second[:, 2] / first[:, 2])
    return float(np.sqrt(np.mean(moves**2) / 2.0)), float(np.sqrt(np.mean(change**2)))


def margin(
    module: ModuleType,
    constant: str,
    looks: Sequence[Look],
    usual: Sequence[Found],
    factors: Sequence[float],
    corners: int,
) -> str:
    """Return the first factor that has an effect on `looks`, and the effect. The last one is tried first: if that has
    none, the others are not tried."""
    last = _with(module, constant, looks, usual, factors[-1], corners)
    if last in ("same", "-"):
        return last
    for factor in factors[:-1]:
        words = _with(module, constant, looks, usual, factor, corners)
        if words not in ("same", "-"):
            return f"{factor:.2g}: {words}"
    return f"{factors[-1]:.2g}: {last}"


def _with(
    module: ModuleType, constant: str, looks: Sequence[Look], usual: Sequence[Found], factor: float, corners: int
) -> str:
    with changed(module, constant, factor) as differs:
        if not differs:
            return "same"
        try:
            return effect(usual, [look.found() for look in looks], corners)
        except (RigkitError, ArithmeticError, ValueError, IndexError, AssertionError, np.linalg.LinAlgError) as error:
            return type(error).__name__


def rendered(seeds: int) -> Iterator[Look]:
    """Yield rendered boards of every kind, told and untold, and pictures without boards."""
    for seed in range(seeds):
        for board in BOARDS:
            images: list[GreyImage] = []
            for k, lens in enumerate(LENSES):
                rng = np.random.default_rng(seed)
                image = one_board(rng, lens=lens, board=board).render(noise_levels=2.0, rng=rng).astype(np.uint8)
                for what, amount in CONDITIONS[k::2]:
                    worse = degraded(what, amount, image, rng)[0] if amount else image
                    images.append(grey_image(worse))
                    yield Look((images[-1],), (board,), True)
            yield Look(tuple(images[:IMAGES_OF_UNKNOWN]), (), True)
        for name in BLANKS:
            if name not in COUNTED_PATTERNS:
                empty = (grey_image(blank(name, np.random.default_rng(seed))),)
                yield from (Look(empty, boards, False) for boards in (BOARDS, ()))


def real(folders: Sequence[Path], boards: tuple[Board, ...], *, shown: bool) -> list[Look]:
    paths = [path for folder in folders for path in images_of_folder(folder)]
    return [Look((grey_image(read_image(path)),), boards, shown) for path in paths]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("modules", nargs="*")
    parser.add_argument("--boards", nargs="*", default=[], metavar="BOARD=DIR")
    parser.add_argument("--without", type=Path, nargs="*", default=[], help="folders of images without boards")
    parser.add_argument("--seeds", type=int, default=2, help="rendered pictures of each kind")
    args = parser.parse_args()
    looks = list(rendered(args.seeds))
    for words in args.boards:
        board, folder = words.rsplit("=", 1)
        looks += real([Path(folder)], (board_of_words(board),), shown=True)
    looks += real(args.without, BOARDS, shown=False)
    measure(looks, args.modules)


def measure(looks: Sequence[Look], modules: Sequence[str]) -> None:
    """Print the table of the constants of some modules, or of all."""
    package = rigkit.detection
    every = [info.name for info in pkgutil.walk_packages(package.__path__, f"{package.__name__}.") if not info.ispkg]
    for path in every:
        importlib.import_module(path)
    usual, calls = zip(*map(called_by, looks), strict=True)
    corners, false = sum(len(one.corners) for one in usual), sum(one.false for one in usual)
    print(f"{sum(len(look.images) for look in looks)} images: {corners} corners of boards, {false} false boards\n")
    print("| constant | value | looks | smaller by | larger by |\n| :-- | --: | --: | :-- | :-- |")
    for path in modules or every:
        module = sys.modules[path]
        for name in constants_of(module):
            readers = {(code.co_filename, code.co_firstlineno) for code in readers_of(module, name)}
            of = [k for k, called in enumerate(calls) if called & readers]
            sides = ["not called" if readers else "not read"] * 2
            if of:
                sides = [
                    margin(module, name, [looks[k] for k in of], [usual[k] for k in of], factors, corners)
                    for factors in ([1.0 / factor for factor in FACTORS], FACTORS)
                ]
            print(
                f"| {path.removeprefix('rigkit.detection.')}.{name} | {value_of(module, name):g} | {len(of)} "
                f"| {' | '.join(sides)} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
