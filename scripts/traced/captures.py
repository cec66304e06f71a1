"""Define the captures to render: cameras, boards, poses of the boards, and exposure."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

import numpy as np

from rigkit.core.arrays import FloatArray
from rigkit.core.boards import Board
from rigkit.core.patterns.aprilgrid import AprilGrid
from rigkit.core.patterns.charuco import Charuco
from rigkit.core.patterns.circles import Circles
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3
from traced.lenses import Lens, polynomial_lens

PAPER_MARGIN = 0.5
"""White beyond the printed part, in squares."""
MAX_ROLL_DEG = 25.0
TURNED = 0.25
"""Part of the pictures on which the board is held turned by quarter turns as well."""
EDGE_PX = 6.0
"""Corners nearer to the picture's edge, or beyond it, do not count as seen."""
MIN_FACING = 0.2
"""Least cosine between the line of sight and the board's normal."""
TRIES = 4000

NARROW = Lens("perspective", (800, 600), 692.8, (6, -4))
FISHEYE = Lens("polynomial", (800, 640), 192.0, (-5, 7), 185.0, (1.0 / 192.0,))
EQUISOLID = Lens("equisolid", (800, 640), 311.0, (4, 6), 172.0)
WIDE = polynomial_lens((800, 600), lambda t: 426.0 * (t + 0.1 * t**3), 68.0, (-7, 3))
LEFT = polynomial_lens(
    (640, 480), lambda t: 417.0 * (np.tan(t) - 0.10 * np.tan(t) ** 3 + 0.020 * np.tan(t) ** 5), 48.0, (3, -5)
)
RIGHT = polynomial_lens(
    (640, 480), lambda t: 421.0 * (np.tan(t) - 0.11 * np.tan(t) ** 3 + 0.024 * np.tan(t) ** 5), 48.0, (-6, 2)
)
RIGHT_FROM_LEFT = Rigid3(
    exp_so3(np.radians([0.0, 2.0, 0.0])) @ exp_so3(np.radians([0.0, 0.0, 0.8])), [-119.8, 1.3, 2.4]
)
SMALL = Lens("perspective", (640, 480), 560.0, (5, -3))
SMALL_WIDE = polynomial_lens((640, 480), lambda t: 340.0 * (t + 0.1 * t**3), 68.0, (-6, 3))
CHESSBOARD = Board("chessboard", 9, 6, 25.0, 25.0)
GRID = Board("grid", 10, 8, 30.0, 30.0, pattern=AprilGrid(spacing=0.3))
CIRCLES_BEFORE_MM = 0.002
"""Circles are drawn so far before the paper (rectangles are cut out of it): shadows of 0.02 mm move them by 0.02 px."""
CIRCLES = Board("circles", 4, 11, 36.0, 36.0, pattern=Circles(layout="asymmetric", diameter_mm=15.0))
SYMMETRIC = Board("chessboard", 8, 6, 25.0, 25.0)
THIN = Board("chessboard", 14, 3, 18.0, 18.0)
SYMMETRIC_CIRCLES = Board("circles", 8, 6, 26.0, 26.0, pattern=Circles(diameter_mm=14.0))
LEGACY = Board("charuco", 8, 5, 28.0, 28.0, pattern=Charuco(dictionary="DICT_4X4_100", marker_mm=21.0, legacy=True))
CHARUCO = Board("charuco", 8, 5, 28.0, 28.0, pattern=Charuco(dictionary="DICT_5X5_100", marker_mm=21.0))


@dataclass(frozen=True, slots=True, kw_only=True)
class Exposure:
    """How a picture is taken.

    Attributes
    ----------
    samples, background_samples : rays a pixel in the box about the boards, and elsewhere. Powers of four are spread
        best; with 16 the edges are as uncertain as by 9 grey levels of noise, which flat parts do not show.
    filter_px : width of the Blackman-Harris pixel filter; 0: a box of one pixel.
    full_well, read_electrons : of the sensor: shot noise and read noise; the picture is then 8 bit, sRGB.
    gloss, roughness : part of the light that the board mirrors, and how blurred.
    aperture_mm, focus_mm : diameter of the lens's opening (0: sharp at any distance), distance of what is sharp.
    motion, motion_px : "", "blur" or "rolling", and from how many to how many pixels the board moves while the shutter
        is open, or while the rows of a rolling shutter are read one after another.
    vignetting, glare : part of the light that is missing in the picture's corners, and what a lamp adds in the middle
        of its glare, in parts of white.
    webcam : a Bayer mosaic, demosaiced, sharpened and kept as JPEG.
    """

    samples: int = 64
    background_samples: int = 2
    filter_px: float = 1.5
    full_well: float = 9000.0
    read_electrons: float = 12.0
    gloss: float = 0.03
    roughness: float = 0.25
    aperture_mm: float = 0.0
    focus_mm: float = 0.0
    motion: str = ""
    motion_px: tuple[float, float] = (0.0, 0.0)
    vignetting: float = 0.0
    glare: float = 0.0
    webcam: bool = False

    @property
    def suffix(self) -> str:
        return ".jpg" if self.webcam else ".png"


@dataclass(frozen=True, slots=True, kw_only=True)
class Capture:
    """A set of pictures of a board in hand.

    Attributes
    ----------
    lenses : by the camera's name; the first is the rig's frame.
    board, bend_mm : and by how much its middle lies behind its left and right edges.
    angles_deg : the angle under which the board's diagonal is seen, from ... to.
    seed : of all that is drawn.
    cam_from_rig : of further cameras.
    tilts_deg : between the line of sight and the board's normal, from ... to.
    stretch : the printer made the board so many times as wide.
    hands : fingers hold the board and cover some of it.
    partial : part of the pictures on which four tenths of the corners may lie outside.
    """

    lenses: dict[str, Lens]
    board: Board
    angles_deg: tuple[float, float]
    seed: int
    cam_from_rig: dict[str, Rigid3] = field(default_factory=dict)
    bend_mm: float = 0.0
    partial: float = 0.15
    count: int = 14
    tilts_deg: tuple[float, float] = (8.0, 45.0)
    stretch: float = 1.0
    hands: bool = False
    exposure: Exposure = field(default_factory=Exposure)

    @property
    def printed(self) -> Board:
        """The board as it came out of the printer."""
        return replace(self.board, square_x_mm=self.stretch * self.board.square_x_mm)

    @property
    def mounts(self) -> dict[str, tuple[Lens, Rigid3]]:
        return {name: (lens, self.cam_from_rig.get(name, Rigid3.identity())) for name, lens in self.lenses.items()}

    def printed_mm(self) -> tuple[FloatArray, FloatArray]:
        """Return the lower and upper end of the printed part."""
        low, high = self.board.pattern.outline(*self.board.size)
        return low * self.printed.squares_mm, high * self.printed.squares_mm

    def depth_mm(self, xy_mm: FloatArray) -> FloatArray:
        """Return how far behind its edges' plane the bent board lies at (N, 2)."""
        low, high = self.printed_mm()
        return np.asarray(self.bend_mm * (1.0 - ((2.0 * xy_mm[:, 0] - low[0] - high[0]) / (high[0] - low[0])) ** 2))

    def points_mm(self) -> FloatArray:
        """Return the board's points as they are, bent, (N, 3)."""
        points, before = self.printed.points(), CIRCLES_BEFORE_MM if len(self.board.ink().circles) else 0.0
        return np.column_stack([points[:, :2], self.depth_mm(points[:, :2]) - before])


def _narrow(seed: int, *, lens: Lens = NARROW, bend_mm: float = 0.0, **exposure: object) -> Capture:
    how = replace(Exposure(), **exposure)  # type: ignore[arg-type]
    return Capture(
        lenses={"camera": lens}, board=CHESSBOARD, angles_deg=(20, 42), seed=seed, bend_mm=bend_mm, exposure=how
    )


def _small(seed: int, board: Board, *, lens: Lens = SMALL, **more: Any) -> Capture:
    wanted: dict[str, Any] = {"angles_deg": (20, 42), "count": 12, **more}
    return Capture(lenses={"camera": lens}, board=board, seed=seed, **wanted)


def _pair(seed: int, board: Board, count: int = 14) -> Capture:
    return Capture(
        lenses={"left": LEFT, "right": RIGHT},
        board=board,
        angles_deg=(26, 44),
        seed=seed,
        cam_from_rig={"right": RIGHT_FROM_LEFT},
        partial=0.5 if board.pattern.identified else 0.0,
        count=count,
    )


CAPTURES: dict[str, Capture] = {
    "narrow": _narrow(1),
    "fisheye": Capture(lenses={"camera": FISHEYE}, board=CHESSBOARD, angles_deg=(40, 85), seed=2),
    "equisolid": Capture(lenses={"camera": EQUISOLID}, board=GRID, angles_deg=(45, 80), seed=3),
    "circles": Capture(lenses={"camera": WIDE}, board=CIRCLES, angles_deg=(35, 60), seed=4),
    "stereo": _pair(5, CHARUCO),
    "bent": _narrow(6, bend_mm=1.0),
    "defocus": _narrow(7, aperture_mm=6.0, focus_mm=450.0),
    "moving": _narrow(8, motion="blur", motion_px=(2.0, 9.0)),
    "rolling": _narrow(9, motion="rolling", motion_px=(6.0, 24.0)),
    "refocused": _narrow(10, lens=replace(NARROW, focal_px=1.003 * NARROW.focal_px)),
    "again": _narrow(11),
    "glossy": Capture(
        lenses={"camera": WIDE},
        board=CHESSBOARD,
        angles_deg=(32, 60),
        seed=12,
        exposure=Exposure(gloss=0.25, roughness=0.12),
    ),
    "grid-pair": _pair(13, GRID, 8),
    "circle-pair": _pair(14, SYMMETRIC_CIRCLES, 8),
    "symmetric-pair": _pair(15, SYMMETRIC, 8),
    "webcam": _small(16, CHESSBOARD, hands=True, exposure=Exposure(motion="blur", motion_px=(0.0, 3.0), webcam=True)),
    "slanted": _small(17, LEGACY, tilts_deg=(30.0, 65.0)),
    "glare": _small(18, CHESSBOARD, lens=SMALL_WIDE, angles_deg=(32, 60), exposure=Exposure(vignetting=0.7, glare=0.5)),
    "thin": _small(19, THIN),
    "stretched": _small(20, CHESSBOARD, stretch=1.01),
}


def held_poses(capture: Capture, rng: np.random.Generator) -> list[Rigid3]:
    """Return rig_from_board of all pictures, as a person holds a board: all over the image, near and far, tilted, some
    turned, some only in part in the picture."""
    side = int(np.ceil(np.sqrt(capture.count)))
    cells = (np.stack(np.divmod(np.arange(side**2), side)[::-1], axis=-1) + 0.5) / side
    rng.shuffle(cells)
    out = []
    for cell in cells[: capture.count]:
        least = 0.6 if rng.random() < capture.partial else 0.97
        for attempt in range(TRIES):
            pose = _held(capture, cell, side, attempt / TRIES, rng)
            if pose is not None and _seen(capture, pose) >= least:
                out.append(pose)
                break
        else:
            raise RuntimeError(f"no pose of the board about {cell} can be seen")
    return out


def _held(capture: Capture, cell: FloatArray, side: int, inwards: float, rng: np.random.Generator) -> Rigid3 | None:
    """Return a pose with the board's middle in a cell of the image, the more attempts failed the farther inside."""
    lens, points = next(iter(capture.lenses.values())), capture.board.points()
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    part = np.clip(cell + rng.uniform(-0.6, 0.6, 2) / side, 0.05, 0.95)
    pixel = lens.centre_px + (part * lens.size_px - lens.centre_px) * (1.0 - inwards)
    angle = np.radians(rng.uniform(*capture.angles_deg))
    about, tilt = rng.uniform(0.0, 2.0 * np.pi), np.radians(rng.uniform(*capture.tilts_deg))
    roll = rng.uniform(-MAX_ROLL_DEG, MAX_ROLL_DEG) + (90.0 * rng.integers(0, 4) if rng.random() < TURNED else 0.0)
    if lens.angle(np.hypot(*(pixel - lens.centre_px))) > np.radians(lens.field_deg) / 2.0 - 0.1:
        return None
    ray = lens.unproject(pixel)
    turned = exp_so3(tilt * np.array([np.cos(about), np.sin(about), 0.0])) @ exp_so3(np.radians([0.0, 0.0, roll]))
    rotation = looking_along(ray, np.array([0.0, 1.0, 0.0])) @ turned
    distance = 0.5 * float(np.linalg.norm(np.ptp(points, axis=0))) / np.tan(0.5 * angle)
    return Rigid3(rotation, distance * ray - rotation @ middle)


def _seen(capture: Capture, rig_from_board: Rigid3) -> float:
    """Return the part of the corners that the camera that sees the fewest sees."""
    parts = []
    for lens, cam_from_rig in capture.mounts.values():
        cam_from_board = cam_from_rig @ rig_from_board
        points = cam_from_board.apply(capture.board.points())
        pixels, valid = lens.project(points)
        facing = points @ cam_from_board.rotation[:, 2] > MIN_FACING * np.linalg.norm(points, axis=1)
        inside = ((pixels > EDGE_PX) & (pixels < np.array(lens.size_px) - EDGE_PX)).all(axis=-1)
        parts.append(float((valid & facing & inside).mean()))
    return min(parts)


def looking_along(ray: FloatArray, down: FloatArray) -> FloatArray:
    """Return the rotation with z along the ray and y as far down as that leaves it."""
    z = ray / np.linalg.norm(ray)
    x = np.cross(down, z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)


def paper_edge_px(board: Board, lens: Lens, cam_from_board: Rigid3) -> FloatArray:
    """Return pixels (N, 2) within the picture along the edge of the paper."""
    low, high = board.pattern.outline(*board.size)
    low, high = (low - PAPER_MARGIN) * board.squares_mm, (high + PAPER_MARGIN) * board.squares_mm
    t = np.linspace(0.0, 1.0, 40)[:, None]
    corners = np.array([low, [high[0], low[1]], high, [low[0], high[1]], low])
    edge = np.concatenate([a + t * (b - a) for a, b in pairwise(corners)])
    pixels, valid = lens.project(cam_from_board.apply(np.column_stack([edge, np.zeros(len(edge))])))
    return np.clip(pixels[valid], 0.0, np.array(lens.size_px) - 1.0)
