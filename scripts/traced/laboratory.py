"""Three perpendicular chessboards in the corner of a room, and pairs of views of them.

The floor is z = 0, the right wall x = 0 and the left wall y = 0; the room is x, y, z > 0. Lengths are in mm.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rigkit.core.arrays import FloatArray
from rigkit.core.boards import Board
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3
from traced.captures import FISHEYE, NARROW, PAPER_MARGIN, looking_along
from traced.lenses import Lens

CLEARANCE_MM = 12.0
"""From the edge of a paper to the next wall."""
OFF_WALL_MM = 2.0
AXES = {
    "plane1": ("right", [[0, 0, -1], [1, 0, 0], [0, -1, 0]]),
    "plane2": ("floor", [[0, 1, 0], [1, 0, 0], [0, 0, -1]]),
    "plane3": ("left", [[-1, 0, 0], [0, 0, -1], [0, -1, 0]]),
}
"""Where each board lies, and the rotation world_from_board."""
BOARDS = {name: Board(name, 8, 6, 50.0, 50.0) for name in AXES}
LENSES: dict[str, Lens] = {"narrow": NARROW, "fisheye": FISHEYE}
MIDDLE = [210.0, 210.0, 200.0]


@dataclass(frozen=True, eq=False, slots=True)
class Pair:
    """Two views: which lens, how the cameras stand to each other, and where they are."""

    lens: str
    pose_type: str
    world_from_cam1: Rigid3
    world_from_cam2: Rigid3

    @property
    def baseline_mm(self) -> float:
        return float(np.linalg.norm(self.world_from_cam1.translation_mm - self.world_from_cam2.translation_mm))


def places() -> dict[str, Rigid3]:
    """Return world_from_board of the three boards, their papers in the corner of the room."""
    out = {}
    for name, board in BOARDS.items():
        low, high = board.pattern.outline(*board.size)
        low, high = (low - PAPER_MARGIN) * board.squares_mm, (high + PAPER_MARGIN) * board.squares_mm
        axes = np.array(AXES[name][1], dtype=np.float64)
        paper = np.array([[x, y] for x in (low[0], high[0]) for y in (low[1], high[1])]) @ axes[:, :2].T
        origin = np.where(np.abs(axes[:, 2]) > 0.5, OFF_WALL_MM, CLEARANCE_MM - paper.min(axis=0))
        out[name] = Rigid3(axes, origin)
    return out


def _standing(eye: list[float], target: list[float], roll: float = 0.0) -> Rigid3:
    rotation = looking_along(np.subtract(target, eye), np.array([0.0, 0.0, -1.0]))
    return Rigid3(rotation @ exp_so3(np.array([0.0, 0.0, roll])), eye)


def _moved(pose: Rigid3, shift_mm: list[float], yaw: float = 0.0) -> Rigid3:
    """Return the pose after a motion within the camera's own frame."""
    rotation: FloatArray = exp_so3(np.array([0.0, yaw, 0.0]))
    return pose @ Rigid3(rotation, shift_mm)


def pairs() -> dict[str, Pair]:
    far, near = _standing([790.0, 815.0, 640.0], MIDDLE), _standing([450.0, 465.0, 380.0], [230.0, 230.0, 210.0])
    return {
        "narrow-standard": Pair("narrow", "standard", _moved(far, [-150.0, 0.0, 0.0]), _moved(far, [150.0, 0.0, 0.0])),
        "narrow-forward": Pair("narrow", "forward", _moved(far, [0.0, 0.0, -150.0]), far),
        "narrow-planar": Pair(
            "narrow", "planar", _moved(far, [-140.0, 0.0, 20.0], 0.12), _moved(far, [150.0, 0.0, -30.0], -0.1)
        ),
        "narrow-general": Pair(
            "narrow",
            "general",
            _standing([970.0, 620.0, 540.0], MIDDLE, 0.1),
            _standing([640.0, 930.0, 730.0], MIDDLE, -0.15),
        ),
        "fisheye-general": Pair(
            "fisheye",
            "general",
            _standing([500.0, 310.0, 290.0], MIDDLE, 0.2),
            _standing([310.0, 480.0, 400.0], MIDDLE, -0.1),
        ),
        "fisheye-forward": Pair("fisheye", "forward", _moved(near, [0.0, 0.0, -90.0]), _moved(near, [0.0, 0.0, 60.0])),
    }


def manifest() -> str:
    """Return the data set's file, with what is true of the rendering as if somebody had measured it."""
    lines = ['schema = "rigkit.dataset/1"', 'name = "laboratory"', 'images = "rendered"']
    for name, board in BOARDS.items():
        lines += ["", "[[boards]]", f'id = "{name}"', f"columns = {board.columns}", f"rows = {board.rows}"]
        lines += [f"square_mm = {board.square_x_mm}"]
    for name in LENSES:
        lines += ["", "[[cameras]]", f'id = "{name}"', f'calibration = "../{name}/images/calibration.json"']
    layout = ", ".join(f'{name} = "{wall}"' for name, (wall, _) in AXES.items())
    how = 'how = "of the rendering"'
    for name, pair in pairs().items():
        lines += ["", "[[pairs]]", f'id = "{name}"', f'camera1 = "{pair.lens}"', f'camera2 = "{pair.lens}"']
        lines += [f'image{k} = "images/{name}/view{k}.png"' for k in (1, 2)]
        lines += [f'pose_type = "{pair.pose_type}"', f"boards = {list(BOARDS)!r}".replace("'", '"')]
        lines += [f"layout = {{ {layout} }}", "", "[pairs.truth]"]
        lines += [f"baseline = {{ value_mm = {pair.baseline_mm:.4f}, sigma_mm = 0.5, {how} }}", "angles = ["]
        for a, b in (("plane1", "plane2"), ("plane1", "plane3"), ("plane2", "plane3")):
            lines.append(f'    {{ a = "{a}", b = "{b}", value_deg = 90.0, sigma_deg = 0.05, {how} }},')
        lines.append("]")
    return "\n".join(lines) + "\n"
