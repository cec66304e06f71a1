"""Scenes to measure corner detectors on: one board, three, a room full of them, boards cut by the frame.

Each function draws one scene from `rng`, for a regular or a fisheye lens, at any image size. `BenchScene.render`
returns its image, `BenchScene.truth` every corner, and `BenchScene.clear` those that a detector must find.
Pictures without any board are in `detection_bench.blanks`, pairs of views in `detection_bench.pairs`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rigkit.cameras.base import Camera, image_center
from rigkit.cameras.kannala_brandt import KannalaBrandt
from rigkit.cameras.pinhole import Pinhole
from rigkit.core.arrays import BoolArray, FloatArray
from rigkit.core.boards import Board
from rigkit.core.detections import BoardDetection
from rigkit.core.errors import DegenerateError, InputError
from rigkit.core.posetype import PoseType
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3
from rigkit.synthetic.pairs import StereoScene, trihedral_pair
from rigkit.synthetic.photometry import Photometry, Shadow, develop
from rigkit.synthetic.render import Optics, radiance
from rigkit.synthetic.scene import Panel, PlacedBoard, exact_detection, place_board, sees_paper

LENSES = ("regular", "fisheye")
"""A 6.1 mm lens without distortion and a 2.7 mm, 185 degree lens, both over a 1/1.8 inch sensor."""
FISHEYE_FIELD_DEG = 185.0
BENCH_PHOTOMETRY = Photometry(exposure=0.95, vignetting=0.25, gradient=(0.12, -0.08))
"""Contrast of about 15 to 205 grey levels under uneven light, before noise."""
CONDITIONS: dict[str, tuple[Optics, Photometry]] = {
    "plain": (Optics(0.7), BENCH_PHOTOMETRY),
    "defocus": (Optics(0.3, defocus_px=1.6), BENCH_PHOTOMETRY),
    "motion": (Optics(0.5, motion_px=(2.6, 1.5)), BENCH_PHOTOMETRY),
    "dark": (Optics(0.7), replace(BENCH_PHOTOMETRY, exposure=0.15, noise_levels=2.0)),
    "low contrast": (Optics(0.7), replace(BENCH_PHOTOMETRY, exposure=0.3, gamma=0.5, noise_levels=2.0)),
    "saturated": (Optics(0.7), replace(BENCH_PHOTOMETRY, exposure=1.8, noise_levels=2.0)),
    "gamma": (Optics(0.7), replace(BENCH_PHOTOMETRY, gamma=1.0 / 2.2, noise_levels=2.0)),
    "sharpened": (Optics(0.7), replace(BENCH_PHOTOMETRY, sharpen=0.8, noise_levels=2.0)),
    "shadow": (Optics(0.7), replace(BENCH_PHOTOMETRY, shadow=Shadow(), noise_levels=2.0)),
    "vignetted": (Optics(0.7), replace(BENCH_PHOTOMETRY, vignetting=0.9, noise_levels=2.0)),
    "jpeg 75": (Optics(0.7), replace(BENCH_PHOTOMETRY, jpeg_quality=75)),
    "16 bit": (Optics(0.7), replace(BENCH_PHOTOMETRY, bits=16, noise_levels=2.0)),
}
"""Light, lens and sensor by name, for `BenchScene.render(optics=, photometry=)`."""
SCENE_TRIES = 500
CLEAR_SQUARES = 0.6
"""A corner is clear of what covers the board if it lies this far from it: then all of its cell is seen."""


@dataclass(frozen=True, eq=False, slots=True)
class BenchScene:
    """A scene for one image.

    Attributes
    ----------
    name : kind of scene and lens.
    boards, panels, occluders : in the frame of the camera; occluders lie in front of the boards.
    camera : the lens.
    field_deg : its field of view, None for a regular lens.
    """

    name: str
    boards: tuple[PlacedBoard, ...]
    panels: tuple[Panel, ...]
    camera: Camera
    field_deg: float | None = None
    occluders: tuple[Panel, ...] = ()

    def truth(self) -> tuple[BoardDetection, ...]:
        """Return the exact corners of every board of which any are in the image, hidden by an occluder or not."""
        found = (exact_detection(b, self.camera, Rigid3.identity()) for b in self.boards)
        return tuple(d for d in found if len(d.grid))

    def clear(self) -> tuple[BoolArray, ...]:
        """Return for each board of `truth` which of its corners (N,) lie well beside all occluders."""
        out = []
        for board in self.boards:
            found = exact_detection(board, self.camera, Rigid3.identity())
            if not len(found.grid):
                continue
            clear = np.ones(len(found.grid), bool)
            for occluder in self.occluders:
                panel_from_board = occluder.world_from_panel.inverse() @ board.world_from_board
                points = np.abs(panel_from_board.apply(board.board.points(found.grid))[:, :2])
                margin = CLEAR_SQUARES * board.board.square_x_mm
                half = 0.5 * np.array([occluder.width_mm, occluder.height_mm])
                clear &= (points > half + margin).any(axis=1)
            out.append(clear)
        return tuple(out)

    def radiance(self, optics: Optics) -> FloatArray:
        """Return the picture (height, width) before light and sensor (`rigkit.synthetic.photometry.develop`)."""
        return radiance(
            self.boards,
            self.camera,
            Rigid3.identity(),
            panels=self.panels,
            occluders=self.occluders,
            optics=replace(optics, field_deg=self.field_deg),
        )

    def render(
        self,
        *,
        blur_px: float = 0.7,
        noise_levels: float = 0.0,
        rng: np.random.Generator | None = None,
        photometry: Photometry | None = None,
        optics: Optics | None = None,
        supersample: int = 4,
    ) -> NDArray[np.uint8] | NDArray[np.uint16]:
        """Return the image; `optics` wins over `blur_px` and `supersample`, `photometry` over `noise_levels`."""
        photometry = photometry or replace(BENCH_PHOTOMETRY, noise_levels=noise_levels)
        return develop(self.radiance(optics or Optics(blur_px, supersample=supersample)), photometry, rng)


def bench_camera(lens: str, size_px: tuple[int, int] = (640, 480)) -> Camera:
    """Return the camera of a `LENSES` entry at an image size; raises InputError for other names."""
    width = size_px[0]
    centre = image_center(size_px) + np.array([0.37, -0.61]) * width / 100.0
    if lens == "regular":
        return Pinhole(size_px, np.array([0.835 * width, 0.835 * width, *centre]))
    if lens == "fisheye":
        return KannalaBrandt(size_px, np.array([0.37 * width, 0.37 * width, *centre, -0.022, 0.0015, 0.0, 0.0]))
    raise InputError(f"bench camera: lens '{lens}' is unknown; known: {', '.join(LENSES)}")


def one_board(
    rng: np.random.Generator,
    *,
    lens: str = "regular",
    size_px: tuple[int, int] = (640, 480),
    board: Board | None = None,
    max_tilt_deg: float = 50.0,
    square_px: float | None = None,
) -> BenchScene:
    """Return one whole board, 10 x 10 corners by default, tilted up to `max_tilt_deg`.

    `square_px` fixes the size of a square in the image (before foreshortening); by default the board fills about
    two thirds of the image.
    """
    camera = bench_camera(lens, size_px)
    board = board or Board("board", 10, 10, 30.0, 30.0)
    for _ in range(SCENE_TRIES):
        target = rng.uniform(0.3, 0.7, 2) * size_px
        share = square_px or 0.66 * min(size_px) / (max(board.size) + 2)
        placed = place_board(board, camera, target, share, max_tilt_deg, rng)
        if placed is not None and sees_paper(placed, camera, (0.0, 0.0), size_px):
            return _scene("one", lens, camera, [placed])
    raise DegenerateError(f"one board: {board.columns}x{board.rows} corners do not fit a {size_px} image")


def small_board(
    rng: np.random.Generator, *, lens: str = "regular", size_px: tuple[int, int] = (640, 480), square_px: float = 5.0
) -> BenchScene:
    """Return one whole board of 8 x 6 corners whose squares are `square_px` wide where seen straight on, tilt to 20
    degrees."""
    board = Board("board", 8, 6, 30.0, 30.0)
    scene = one_board(rng, lens=lens, size_px=size_px, board=board, max_tilt_deg=20.0, square_px=square_px)
    return replace(scene, name=f"small {lens}")


def three_boards(
    rng: np.random.Generator,
    *,
    lens: str = "regular",
    size_px: tuple[int, int] = (640, 480),
    boards: Sequence[Board] | None = None,
) -> BenchScene:
    """Return three perpendicular boards in the corner of a room, 8 x 6, 7 x 6 and 6 x 8 corners by default."""
    camera = bench_camera(lens, size_px)
    chosen = boards or [Board("plane1", 8, 6, 40.0, 40.0), Board("plane2", 7, 6, 40.0, 40.0)]
    if boards is None:
        chosen = [*chosen, Board("plane3", 6, 8, 40.0, 40.0)]
    pair = trihedral_pair(chosen, camera, PoseType.GENERAL, rng, distance=(0.75, 1.2), parallax_deg=(0.0, 180.0))
    return _first_view("three", lens, pair)


def room(
    rng: np.random.Generator,
    *,
    lens: str = "regular",
    size_px: tuple[int, int] = (1280, 960),
    count: int = 12,
) -> BenchScene:
    """Return `count` (up to 12) boards of several sizes all over the image, at any distance, tilt and roll."""
    if not 1 <= count <= 12:
        raise InputError(f"room: 1 to 12 boards, got {count}")
    camera = bench_camera(lens, size_px)
    sizes = ((8, 6), (7, 6), (9, 6), (6, 5), (7, 5), (8, 5))
    cells = [(c, r) for r in range(3) for c in range(4)]
    placed = []
    for index, k in enumerate(rng.permutation(len(cells))[:count]):
        columns, rows = sizes[index % len(sizes)]
        board = Board(f"board{index + 1}", columns, rows, 30.0, 30.0)
        cell = np.array(size_px) / (4, 3)
        low = np.array(cells[k]) * cell
        placed.append(_place_in_cell(board, camera, low, low + cell, rng))
    return _scene("room", lens, camera, placed)


def partial_board(
    rng: np.random.Generator,
    *,
    lens: str = "regular",
    size_px: tuple[int, int] = (640, 480),
    board: Board | None = None,
) -> BenchScene:
    """Return a board cut by the frame, a third to nine tenths of its corners visible."""
    camera = bench_camera(lens, size_px)
    board = board or Board("board", 11, 8, 30.0, 30.0)
    for _ in range(SCENE_TRIES):
        target = rng.uniform(0.0, 1.0, 2) * size_px
        placed = place_board(board, camera, target, 0.07 * min(size_px) * rng.uniform(0.8, 1.4), 45.0, rng)
        if placed is None:
            continue
        _, valid = placed.see(camera, Rigid3.identity())
        if 0.33 < valid.mean() < 0.9 and (placed.points()[:, 2] > 0.0).all():
            return _scene("partial", lens, camera, [placed])
    raise DegenerateError("partial board: no view cuts the board as asked for")


def covered_board(
    rng: np.random.Generator, *, lens: str = "regular", size_px: tuple[int, int] = (640, 480)
) -> BenchScene:
    """Return one whole board with a ruler lying across it, about a row of corners hidden."""
    scene = one_board(rng, lens=lens, size_px=size_px)
    placed = scene.boards[0]
    board = placed.board
    # Beside the middle, at any angle, a millimetre above the paper.
    spot = np.array([board.columns, board.rows]) * board.square_x_mm * rng.uniform(0.3, 0.6, 2)
    turn = exp_so3(np.array([0.0, 0.0, rng.uniform(-np.pi, np.pi)]))
    ruler = placed.world_from_board @ Rigid3(turn, np.array([*spot, -1.0]))
    occluder = Panel(ruler, 1.6 * max(board.size) * board.square_x_mm, 0.8 * board.square_x_mm, 0.5)
    return BenchScene(f"covered {lens}", (placed,), (), scene.camera, scene.field_deg, (occluder,))


def empty(
    rng: np.random.Generator, *, lens: str = "regular", size_px: tuple[int, int] = (640, 480), count: int = 60
) -> BenchScene:
    """Return a scene without a chessboard: rectangles of every size and grey."""
    camera = bench_camera(lens, size_px)
    panels = []
    for _ in range(count):
        rays, valid = camera.unproject(rng.uniform(0.0, 1.0, 2) * size_px)
        if valid:
            rotation = exp_so3(rng.normal(0.0, 0.6, 3))
            width, height = np.exp(rng.uniform(np.log(20.0), np.log(500.0), 2))
            grey = float(rng.uniform(0.05, 0.9))
            panels.append(Panel(Rigid3(rotation, rays * rng.uniform(600.0, 1500.0)), width, height, grey))
    return BenchScene(f"empty {lens}", (), tuple(panels), camera, bench_field_deg(lens))


SCENES: dict[str, Callable[..., BenchScene]] = {
    "one": one_board,
    "three": three_boards,
    "room": room,
    "partial": partial_board,
    "covered": covered_board,
    "small": small_board,
    "empty": empty,
}
"""Every kind of scene by name; each takes (rng, lens=, size_px=)."""


def bench_field_deg(lens: str) -> float | None:
    """Return the field of view of a `LENSES` entry, None for the regular one."""
    return FISHEYE_FIELD_DEG if lens == "fisheye" else None


def _scene(kind: str, lens: str, camera: Camera, placed: Sequence[PlacedBoard]) -> BenchScene:
    return BenchScene(f"{kind} {lens}", tuple(placed), (), camera, bench_field_deg(lens))


def _first_view(kind: str, lens: str, pair: StereoScene) -> BenchScene:
    move = pair.cam1_from_world
    boards = tuple(
        PlacedBoard(b.board, move @ b.world_from_board, b.margin_squares, b.white, b.black, b.first_black)
        for b in pair.boards
    )
    panels = tuple(Panel(move @ p.world_from_panel, p.width_mm, p.height_mm, p.reflectance) for p in pair.panels)
    return BenchScene(f"{kind} {lens}", boards, panels, pair.camera1, bench_field_deg(lens))


def _place_in_cell(
    board: Board, camera: Camera, low: FloatArray, high: FloatArray, rng: np.random.Generator
) -> PlacedBoard:
    """Return the board somewhere in a part of the image, smaller the longer it takes to fit."""
    for attempt in range(SCENE_TRIES):
        target = low + (high - low) * rng.uniform(0.4, 0.6, 2)
        share = float((high - low).min()) / (max(board.size) + 1.5) * (1.0 - 0.6 * attempt / SCENE_TRIES)
        placed = place_board(board, camera, target, share, 45.0, rng)
        if placed is not None and sees_paper(placed, camera, low, high):
            return placed
    raise DegenerateError(f"room: board '{board.board_id}' fits nowhere between {low} and {high} px")
