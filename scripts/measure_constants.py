"""Measure how far each constant of rigkit's detection can be changed before boards are lost or false ones found.

    python scripts/measure_constants.py [MODULE ...] [--boards BOARD=DIR ...] [--without DIR ...] [--seeds 2]

Each number among the constants of `rigkit.detection` (or of the MODULEs given, such as rigkit.detection.checks.border)
is multiplied and divided by FACTORS, one constant at a time, in all modules that import it. Rendered boards of every
kind, in focus, blurred, noisy, faint and through a fisheye, and rendered pictures without boards are searched, and the
real images given (BOARD as in `rigkit detect --board`).

Prints for each constant, on both sides, the first factor at which corners are lost (more than MAX_LOST_SHARE of them)
or a false board is found; "-" if there is none up to the last factor. A constant with "-" on both sides decides nothing
in these images. Not reached: numbers in tuples, those that C code or other constants were made from, and defaults of
arguments.
"""

from __future__ import annotations

import argparse
import importlib
import os
import pkgutil
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from detection_bench.blanks import BLANKS, blank
from detection_bench.scenes import LENSES, one_board
from detectors.degradations import degraded

import rigkit.detection
from rigkit.core.boards import Board
from rigkit.core.errors import RigkitError
from rigkit.core.patterns.aprilgrid import AprilGrid
from rigkit.core.patterns.charuco import Charuco
from rigkit.core.patterns.circles import Circles
from rigkit.detection.detect import detect_boards
from rigkit.detection.saddles.response import GreyImage, grey_image
from rigkit.io.boards.board_words import board_of_words
from rigkit.io.media.images import images_of_folder, read_image

FACTORS = (1.25, 2.0, 4.0)
MAX_LOST_SHARE = 0.01
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


@dataclass(frozen=True, eq=False, slots=True)
class Look:
    """An image, the boards that are looked for, and whether it shows one of them."""

    image: GreyImage
    boards: tuple[Board, ...]
    shown: bool


@dataclass(frozen=True, slots=True)
class Outcome:
    """The corners of boards in images that show them, and the number of boards found in others."""

    corners: int
    false: int


def constants_of(module: ModuleType) -> list[str]:
    """Return the names of the numbers among a module's own constants."""
    source = Path(str(module.__file__)).read_text(encoding="utf-8")
    own = re.findall(r"^(_?[A-Z][A-Z0-9_]*)\s*(?::[^=\n]+)?=", source, re.MULTILINE)
    values = vars(module)
    return [name for name in own if isinstance(values.get(name), int | float) and not isinstance(values[name], bool)]


@contextmanager
def changed(module: ModuleType, name: str, factor: float) -> Iterator[bool]:
    """Multiply a constant in its module and all that import it; yields whether that is another number."""
    value = vars(module)[name]
    new = value * factor if isinstance(value, float) else round(value * factor)
    alike = [one for key, one in sys.modules.items() if key.startswith("rigkit.") and vars(one).get(name) is value]
    # Another module may have an own constant of the same name and integer.
    users = [one for one in alike if one is module or name not in constants_of(one)]
    for user in users:
        setattr(user, name, new)
    try:
        yield bool(new != value)
    finally:
        for user in users:
            setattr(user, name, value)


def margin(
    module: ModuleType, name: str, outcome: Callable[[], Outcome], usual: Outcome, factors: Sequence[float]
) -> str:
    """Return the first factor at which corners are lost or false boards found, and what happens; "-" if none."""
    for factor in factors:
        with changed(module, name, factor) as differs:
            try:
                now = outcome() if differs else usual
            except (RigkitError, ArithmeticError, ValueError, IndexError, np.linalg.LinAlgError) as error:
                return f"{factor:.2g}: {type(error).__name__}"
        words = []
        if now.corners < (1.0 - MAX_LOST_SHARE) * usual.corners:
            words.append(f"{usual.corners - now.corners} corners lost")
        if now.false > usual.false:
            words.append(f"{now.false - usual.false} false boards")
        if words:
            return f"{factor:.2g}: {' and '.join(words)}"
    return "-"


def searched(looks: Sequence[Look]) -> Outcome:
    corners, false = 0, 0
    for look in looks:
        found = detect_boards(look.image, look.boards)
        names = [board.board_id for board in look.boards]
        corners += sum(len(one.grid) for one in found if look.shown and one.board_id in names)
        false += 0 if look.shown else len(found)
    return Outcome(corners, false)


def rendered(seeds: int) -> Iterator[Look]:
    """Yield rendered boards of every kind, and pictures without boards."""
    for seed in range(seeds):
        for board in BOARDS:
            for k, lens in enumerate(LENSES):
                rng = np.random.default_rng(seed)
                image = one_board(rng, lens=lens, board=board).render(noise_levels=2.0, rng=rng).astype(np.uint8)
                for what, amount in CONDITIONS[k::2]:
                    worse = degraded(what, amount, image, rng)[0] if amount else image
                    yield Look(grey_image(worse), (board,), True)
        for name in BLANKS:
            if name not in COUNTED_PATTERNS:
                yield Look(grey_image(blank(name, np.random.default_rng(seed))), BOARDS, False)


def real(folders: Sequence[Path], boards: tuple[Board, ...], *, shown: bool) -> list[Look]:
    paths = [path for folder in folders for path in images_of_folder(folder)]
    return [Look(grey_image(read_image(path)), boards, shown) for path in paths]


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
    package = rigkit.detection
    every = [info.name for info in pkgutil.walk_packages(package.__path__, f"{package.__name__}.") if not info.ispkg]
    usual = searched(looks)
    print(f"{len(looks)} images: {usual.corners} corners of boards, {usual.false} false boards\n")
    print("| constant | value | smaller by | larger by |\n| :-- | --: | :-- | :-- |")
    for path in args.modules or every:
        module = importlib.import_module(path)
        for name in constants_of(module):
            sides = [
                margin(module, name, lambda: searched(looks), usual, factors)
                for factors in ([1.0 / factor for factor in FACTORS], FACTORS)
            ]
            value = vars(module)[name]
            print(f"| {path.removeprefix('rigkit.detection.')}.{name} | {value:g} | {' | '.join(sides)} |", flush=True)


if __name__ == "__main__":
    main()
