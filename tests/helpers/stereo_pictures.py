"""Ray-traced JPEGs of a board by two cameras side by side, as a new user takes them; for the fixture `pictures`."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np

from rigkit.cameras.brown import Brown
from rigkit.core.boards import Board
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3
from rigkit.synthetic.photometry import Photometry
from rigkit.synthetic.render import Optics, render
from rigkit.synthetic.scene import place_board, sees_paper

CAMERA = Brown((640, 480), np.array([520.0, 521.0, 322.3, 236.1, -0.21, 0.06, 4e-4, -3e-4, 0.0]))
RIGHT_FROM_LEFT = Rigid3(exp_so3(np.array([0.01, -0.04, 0.02])), [-90.0, 1.0, 2.0])
BOARD = Board("board", 9, 6, 30.0, 30.0)
FRAMES = 7


def write_pictures(folder: Path) -> None:
    """Write left01.jpg, right01.jpg, ... of the rig."""
    rng = np.random.default_rng(11)
    optics, photometry = Optics(0.7, supersample=2), Photometry(noise_levels=2.0)
    count = 0
    while count < FRAMES:
        spot = np.array([320.0, 240.0]) + rng.uniform(-1.0, 1.0, 2) * np.array([90.0, 60.0])
        placed = place_board(BOARD, CAMERA, spot, rng.uniform(26.0, 34.0), 40.0, rng)
        poses = {"left": Rigid3.identity(), "right": RIGHT_FROM_LEFT}
        if placed is None or not sees_paper(placed, CAMERA, (0.0, 0.0), CAMERA.size_px):
            continue
        if not all(placed.see(CAMERA, pose)[1].all() for pose in poses.values()):
            continue
        count += 1
        for name, pose in poses.items():
            image = render([placed], CAMERA, pose, optics=optics, photometry=photometry, rng=rng)
            cv2.imwrite(str(folder / f"{name}{count:02d}.jpg"), image, [cv2.IMWRITE_JPEG_QUALITY, 97])


def of_two_cameras(pictures: Path, folder: Path, count: int = FRAMES) -> list[Path]:
    """Return the folders left and right in `folder`, with the first `count` images of each camera under equal names."""
    for side in ("left", "right"):
        (folder / side).mkdir()
        for path in sorted(pictures.glob(f"{side}*.jpg"))[:count]:
            shutil.copy(path, folder / side / path.name.replace(side, "IMG"))
    return [folder / "left", folder / "right"]


def of_one_camera(pictures: Path, folder: Path, count: int = FRAMES) -> Path:
    """Return a folder with the first `count` images of one camera, named as cameras do."""
    folder.mkdir(parents=True)
    for k, path in enumerate(sorted(pictures.glob("left*.jpg"))[:count]):
        shutil.copy(path, folder / f"DSC_{k:04d}.JPG")
    return folder
