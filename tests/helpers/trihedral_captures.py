"""Rendered pairs of three boards in the corner of a room, as data sets; for the fixture `trihedral`."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np

from rigkit.cameras.base import Camera
from rigkit.cameras.brown import Brown
from rigkit.cameras.kannala_brandt import KannalaBrandt
from rigkit.core.boards import Board
from rigkit.core.posetype import PoseType
from rigkit.io.calibrations.calibration_file import save_camera
from rigkit.synthetic.pairs import StereoScene, trihedral_pair
from rigkit.synthetic.photometry import Photometry
from rigkit.synthetic.render import Optics

SIZE = (640, 480)
BOARDS = (Board("plane1", 8, 6, 50.0, 50.0), Board("plane2", 7, 6, 50.0, 50.0), Board("plane3", 6, 9, 50.0, 50.0))
CAMERAS: dict[str, Camera] = {
    "regular": Brown(SIZE, np.array([534.0, 535.0, 323.5, 233.5, -0.15, 0.08, 2e-4, -1e-4, 0.0])),
    "fisheye": KannalaBrandt(SIZE, np.array([235.0, 235.0, 322.7, 237.0, -0.021, 0.0012, 0.0, 0.0])),
}
PHOTOMETRY = Photometry(vignetting=0.3, gradient=(0.1, -0.06), noise_levels=1.5)
SCENES: dict[str, tuple[str, str, tuple[float, float, float]]] = {
    "same": ("regular", "regular", (90.0, 90.0, 90.0)),
    "mixed": ("regular", "fisheye", (90.0, 90.0, 90.0)),
    "leaning": ("regular", "regular", (90.0, 91.6, 90.0)),
}
"""Name of a pair: its two cameras and how its boards really stand."""


def write_capture(root: Path) -> dict[str, StereoScene]:
    """Write the images of all pairs, boards and calibrations, and no manifest; return what the pairs show."""
    rng = np.random.default_rng(11)
    scenes = {}
    for name, (first, second, angles) in SCENES.items():
        scene = trihedral_pair(
            BOARDS,
            CAMERAS[first],
            PoseType.GENERAL,
            rng,
            camera2=CAMERAS[second],
            angles_deg=angles,
            distance=(0.8, 1.1),
            parallax_deg=(15.0, 40.0),
        )
        images = scene.images(optics=Optics(0.6, supersample=2), photometry=PHOTOMETRY, rng=rng)
        for number, image in enumerate(images, start=1):
            cv2.imwrite(str(root / f"{name}{number}.png"), image)
        scenes[name] = scene
    for board in BOARDS:
        (root / f"{board.board_id}.toml").write_text(
            f'schema = "rigkit.board/1"\nid = "{board.board_id}"\ncolumns = {board.columns}\nrows = {board.rows}\n'
            "square_mm = 50.0\n"
        )
    for name, camera in CAMERAS.items():
        save_camera(root / f"{name}.json", camera)
    return scenes


def pair_toml(scene: StereoScene, name: str, cameras: tuple[str, str], baseline_factor: float = 1.0) -> str:
    """Return the part of a manifest about a pair, which declares right angles and the baseline."""
    ids = ", ".join(f'"{b.board_id}"' for b in BOARDS)
    lines = ["[[pairs]]", f'id = "{name}"', 'pose_type = "general"', f"boards = [{ids}]"]
    lines += [f'camera{k} = "{camera}"\nimage{k} = "{name}{k}.png"' for k, camera in enumerate(cameras, start=1)]
    baseline = f'value_mm = {baseline_factor * scene.baseline_mm:.1f}, sigma_mm = 1.0, how = "rule"'
    lines += ["[pairs.truth]", f"baseline = {{ {baseline} }}", "angles = ["]
    for a, b in ((1, 2), (1, 3), (2, 3)):
        lines += [f'  {{ a = "plane{a}", b = "plane{b}", value_deg = 90.0, sigma_deg = 0.3, how = "set square" }},']
    return "\n".join([*lines, "]", ""])


def write_manifest(root: Path, *pairs: str, cameras: Iterable[str] = tuple(CAMERAS), name: str = "made") -> None:
    lines = ['schema = "rigkit.dataset/1"', f'name = "{name}"']
    for board in BOARDS:
        lines += ["[[boards]]", f'id = "{board.board_id}"', f'file = "{board.board_id}.toml"']
    for camera in cameras:
        lines += ["[[cameras]]", f'id = "{camera}"', f'calibration = "{camera}.json"']
    (root / "dataset.toml").write_text("\n".join([*lines, *pairs]))
