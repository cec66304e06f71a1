"""The images on which `measure_constants.py` tries constants: rendered and real, with boards and without.

Each look is as small as what it exercises allows, so that all constants can be tried in about an hour. Real images
are those of `rigkit fetch` and of the folder `--data`; images that are not there are left out.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from detectors.degradations import degraded, shadowed
from numpy.typing import NDArray

from detection_bench.blanks import blank
from detection_bench.scenes import LENSES, SCENES, BenchScene, bench_camera, one_board
from rigkit.core.boards import Board
from rigkit.core.patterns.aprilgrid import AprilGrid
from rigkit.core.patterns.charuco import Charuco
from rigkit.core.patterns.circles import Circles
from rigkit.detection.detect import detect_boards
from rigkit.detection.saddles.response import GreyImage, grey_image
from rigkit.detection.unknown import guess_board
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3
from rigkit.io.boards.board_words import board_of_words, words_of_board
from rigkit.io.media.images import read_image
from rigkit.synthetic.scene import PlacedBoard

Corners = dict[tuple[str, int, int], tuple[float, float, float]]
"""Board, column and row of corners, and their u, v and sigma."""

DATA = Path(__file__).parents[2] / "../shared/data"
BOARDS = (
    Board("chessboard", 8, 6, 60.0, 60.0),
    Board("charuco", 8, 6, 60.0, 60.0, pattern=Charuco("DICT_5X5_100", 45.0)),
    Board("aprilgrid", 8, 6, 60.0, 60.0, pattern=AprilGrid(0.3)),
    Board("circles", 9, 7, 60.0, 60.0, pattern=Circles()),
)
RENDERED_SIZE_PX, BLANK_SIZE_PX = (480, 360), (320, 240)
CONDITIONS = (("as it is", 0.0), ("blur", 2.0), ("noise", 15.0), ("faint", 0.15))
"""Degradations of rendered boards (`detectors/degradations.py`): the odd ones through a fisheye."""
PATTERNS = ("calculator", "facade", "gingham", "packed", "shirt", "text", "keyboard", "tiles")
SLOW_PATTERNS, EMPTY_UNTOLD = ("keyboard", "tiles"), ("calculator", "tiles")
"""Rendered pictures without boards, those of them that take long, and those in which an untold board is searched."""
QUICK_TARGETS = ("chessboard", "aprilgrid")
"""Searched in some 0.03 s an image or less; the others take up to 0.5 s."""
WIDTH_PX, UNTOLD_WIDTH_PX = 640, 400
"""Wider real images are reduced by the mean of the pixels: what a camera of fewer pixels sees. Where the board is to be
found out, the search takes far longer."""

APRILGRID = "aprilgrid:6x6x88,spacing=0.3"
LIFECAM = "charuco:7x7x25.4,dictionary=DICT_4X4_50,marker_mm=19.05"
STRONG_BLUR_PX = 3.0
WORSE = (
    ("chessboard", "one", "fisheye", "salt", 2.0),
    ("chessboard", "one", "regular", "mosaic", 0.0),
    ("chessboard", "one", "regular", "blur", STRONG_BLUR_PX),
    ("chessboard", "one", "regular", "lopsided", 2.0),
    ("chessboard", "one", "regular", "shadow", 0.25),
    ("chessboard", "one", "regular", "run over", 1.0),
    ("chessboard", "one", "regular", "covered", 0.15),
    ("chessboard", "one", "regular", "motion", 6.0),
    ("chessboard", "one", "regular", "glare", 150.0),
    ("chessboard", "partial", "fisheye", "noise", 5.0),
    ("charuco", "one", "regular", "lopsided", 2.0),
    ("charuco", "one", "fisheye", "covered", 0.15),
    ("charuco", "partial", "regular", "noise", 2.0),
    ("charuco", "one", "regular", "blur", 3.0),
    ("aprilgrid", "one", "fisheye", "covered", 0.15),
    ("aprilgrid", "partial", "regular", "noise", 5.0),
    ("aprilgrid", "one", "regular", "blur", 1.5),
    ("circles", "one", "fisheye", "covered", 0.15),
    ("circles", "partial", "regular", "noise", 5.0),
    ("circles", "one", "regular", "faint", 0.035),
)
"""Rendered boards that take special parts of the search: target, scene, lens, degradation and how much."""
SEVERAL = (("three", "regular", 2.0), ("three", "fisheye", 2.0), ("room", "regular", 2.0), ("room", "fisheye", 10.0))
"""Scenes of several chessboards, lens, noise."""
TOUCHING = {
    "touching": (((8, 6), (7, 6)), 0.0, 1.06, 0.01),
    "half hidden": (((7, 5), (8, 5)), 0.5, -2.43, 0.048),
    "a square hidden": (((8, 6), (7, 6)), 1.1, -2.02, 0.034),
    "a border taken for a row": (((9, 6), (6, 6)), 1.47, 0.9, 0.037),
    "a border beside a row": (((9, 6), (6, 6)), 0.84, -0.92, -0.037),
}
"""Boards without margins side by side: their sizes, columns of the first that the second covers, shift in squares, and
turn in rad."""
REAL = {
    "9x6x25": (
        *(f"public/hard/small-in-hand/{name}.png" for name in ("left5", "right14")),
        "public/hard/unsynchronised/left18.jpg",
        *(f"real/bouguet-stereo/{name}.jpg" for name in ("left01", "left08")),
        "real/camodocal-fisheye/img110.png",
    ),
    "9x7x25": ("public/hard/screen/1.jpg",),
    "8x6x25": ("public/hard/motion-blur/1.jpg", "public/hard/thermal16/5003_000000029.pgm"),
    "7x5x25": ("public/hard/strong-lens/04.png", "public/hard/strong-lens/03.png"),
    "4x6x30": ("public/fisheye-chess/1.jpg", "public/bumblebee2/left01.jpg"),
    "16x10x15": ("public/caliper-board/Image__2018-09-17__16-38-56.png",),
    APRILGRID: (
        *(f"public/aprilgrid/{name}.png" for name in ("EuRoC", "right", "two_boards")),
        "public/aprilgrid-mocap/cam0/data/1606153950890122890.jpg",
    ),
    LIFECAM: ("public/charuco-lifecam/*T080500613.jpg",),
    f"{LIFECAM},legacy_pattern=true": ("public/charuco-lifecam-legacy/*T02005125.jpg",),
    "circles:10x8x25,diameter_mm=15": ("public/circles-regular/image00003.jpg",),
    "circles:14x24x12,layout=hexagonal,stagger=left,diameter_mm=10": ("public/circles-hexagonal/image01.jpg",),
}
UNTOLD = (
    "public/aprilgrid/TUM_VI.png",
    "public/charuco-lifecam/*T080500613.jpg",
    "public/circles-regular/image00000.jpg",
    "public/hard/screen/1.jpg",
)
WITHOUT = tuple(f"public/hard/no-board/{k}.jpg" for k in (108036, 15088, 210088, 35008, 61086))
"""Photographs without boards."""
SLOW = ("circles", "thermal16")
"""Folders of real images that take long."""


@dataclass(frozen=True, slots=True)
class Found:
    """What a look finds."""

    corners: Corners
    false: int


@dataclass(frozen=True, eq=False, slots=True)
class Look:
    """Images, the boards that are looked for (none: the board is to be found out), whether they are shown, and whether
    the search is quick."""

    name: str
    images: tuple[GreyImage, ...]
    boards: tuple[Board, ...]
    shown: bool
    quick: bool

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
        seen.sort(key=lambda one: float(one.pixels[:, 0].mean()))
        if not self.shown:
            return Found({}, len(seen))
        corners = {
            (f"{k} {one.board_id}", column, row): (u, v, sigma)
            for k, one in enumerate(seen)
            for (column, row), (u, v), sigma in zip(
                one.grid.tolist(), one.pixels.tolist(), one.sigma_px.tolist(), strict=True
            )
        }
        return Found(corners, 0)


def every_look(data: Path) -> Iterator[Look]:
    """Yield the real images, those with boards first, and the rendered ones."""
    yield from real(data)
    yield from rendered()
    yield from special()


def rendered(seed: int = 0) -> Iterator[Look]:
    """Yield rendered boards of every kind, told and untold, and pictures without boards."""
    for board in BOARDS:
        for k, (what, amount) in enumerate(CONDITIONS if board.board_id in QUICK_TARGETS else CONDITIONS[:2]):
            rng = np.random.default_rng(seed)
            scene = one_board(rng, lens=LENSES[k % 2], board=board, size_px=RENDERED_SIZE_PX)
            image = scene.render(noise_levels=2.0, rng=rng).astype(np.uint8)
            worse = grey_image(degraded(what, amount, image, rng)[0] if amount else image)
            yield Look(f"RENDERED {board.board_id}, {what}", (worse,), (board,), True, board.board_id in QUICK_TARGETS)
            if not k:
                yield Look(f"RENDERED {board.board_id}, untold", (worse,), (), True, False)
    for name in PATTERNS:
        empty = (grey_image(blank(name, np.random.default_rng(seed), BLANK_SIZE_PX)),)
        yield Look(f"RENDERED {name}", empty, BOARDS, False, name not in SLOW_PATTERNS)
        if name in EMPTY_UNTOLD:
            yield Look(f"RENDERED {name}, untold", empty, (), False, False)


def special(seed: int = 1) -> Iterator[Look]:
    """Yield rendered boards seen in ways that only parts of the search are for."""
    of = {board.board_id: board for board in BOARDS}
    for target, kind, lens, what, amount in WORSE:
        rng = np.random.default_rng(seed)
        scene = SCENES[kind](rng, lens=lens, board=of[target], size_px=RENDERED_SIZE_PX)
        image = scene.render(noise_levels=2.0, rng=rng).astype(np.uint8)
        worse = OTHERS[what](image, amount) if what in OTHERS else degraded(what, amount, image, rng)[0]
        name = f"RENDERED {target}, {kind}, {what}"
        quick = target in QUICK_TARGETS and amount != STRONG_BLUR_PX
        yield Look(name, (grey_image(worse),), (of[target],), True, quick)
    for kind, lens, noise in SEVERAL:
        rng = np.random.default_rng(seed)
        scene = SCENES[kind](rng, lens=lens, size_px=(640, 480))
        grey = grey_image(scene.render(noise_levels=noise, rng=rng))
        yield Look(f"RENDERED {kind} {lens}", (grey,), tuple(placed.board for placed in scene.boards), True, True)
    for name, (sizes, overlap, shift, turn) in TOUCHING.items():
        yield _pair(name, sizes, overlap, shift, turn, seed)
    # Its corners are found, and it is not the declared board.
    larger = one_board(np.random.default_rng(seed), board=Board("larger", 10, 7, 30.0, 30.0), size_px=RENDERED_SIZE_PX)
    grey = grey_image(larger.render(noise_levels=2.0, rng=np.random.default_rng(seed)))
    yield Look("RENDERED larger than declared", (grey,), (Board("smaller", 8, 6, 30.0, 30.0),), True, True)


def _pair(name: str, sizes: Sequence[tuple[int, int]], overlap: float, shift: float, turn: float, seed: int) -> Look:
    side, view = 20.0, exp_so3(np.array([0.2, -0.25, 0.3]))
    boards = tuple(Board(n, c, r, side, side) for n, (c, r) in zip("ab", sizes, strict=True))
    apart = np.array([0.5 * (boards[0].columns + boards[1].columns) + 1.0 - overlap, shift, -1.0 / side])
    placed = []
    for board, sign in zip(boards, (-0.5, 0.5), strict=True):
        rotation = view @ exp_so3(np.array([0.0, 0.0, (sign > 0.0) * turn]))
        middle = np.array([0.0, 0.0, 560.0]) + sign * side * view @ apart
        half = 0.5 * np.array([board.columns - 1, board.rows - 1, 0.0]) * side
        placed.append(PlacedBoard(board, Rigid3(rotation, middle - rotation @ half), 0.0))
    scene = BenchScene(name, tuple(placed), (), bench_camera("regular"))
    image = scene.render(noise_levels=2.0, rng=np.random.default_rng(seed))
    return Look(f"RENDERED {name}", (grey_image(image),), boards, True, True)


def _mosaic(image: NDArray[np.uint8], _: float) -> NDArray[np.uint8]:
    """Return what a sensor with coloured pixels stores."""
    height, width = image.shape
    return (0.9 * image * np.tile([[0.45, 1.0], [1.0, 0.6]], (height // 2, width // 2))).astype(np.uint8)


def _lopsided(image: NDArray[np.uint8], sigma_px: float) -> NDArray[np.uint8]:
    """Return the image of a lens that leaves a part of the light to one side, out of focus."""
    tail = np.array([[0.0, 0.0, 0.0, 0.0, 0.7, 0.12, 0.08, 0.06, 0.04]])
    return np.asarray(cv2.GaussianBlur(cv2.filter2D(image, -1, tail), (0, 0), sigma_px), np.uint8)


def _shadow(image: NDArray[np.uint8], left: float) -> NDArray[np.uint8]:
    """Return the image with the edge of a shadow across its middle."""
    return shadowed(image, 0.5 * np.array(image.shape[::-1]), 0.5, 4.0, left)


OTHERS = {"mosaic": _mosaic, "lopsided": _lopsided, "shadow": _shadow}


def real(data: Path) -> Iterator[Look]:
    """Yield the real images that are there."""
    for words, patterns in REAL.items():
        for pattern in patterns:
            for path in sorted(data.glob(pattern)):
                yield _real(data, path, (board_of_words(words),), WIDTH_PX)
    for pattern in WITHOUT:
        for path in sorted(data.glob(pattern)):
            yield replace(_real(data, path, BOARDS, WIDTH_PX), shown=False)
    for pattern in UNTOLD:
        for path in sorted(data.glob(pattern)):
            yield _real(data, path, (), UNTOLD_WIDTH_PX)


def _real(data: Path, path: Path, boards: tuple[Board, ...], width_px: int) -> Look:
    image = grey_image(read_image(path))
    factor = width_px / image.shape[1]
    if factor < 1.0:
        image = grey_image(cv2.resize(image, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA))
    quick = bool(boards) and not any(word in str(path.relative_to(data)) for word in SLOW)
    return Look(f"REAL {path.relative_to(data)}", (image,), boards, True, quick)
