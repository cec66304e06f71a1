"""Captures of one camera each, and what their images show."""

from __future__ import annotations

import hashlib
import pickle
from dataclasses import dataclass, replace
from pathlib import Path

from truth.cameras import published_corners

from rigkit.calibration.views.usable import views_of_image
from rigkit.core.boards import Board
from rigkit.core.detections import BoardView
from rigkit.detection.detect import detect_boards
from rigkit.io.boards.board_words import board_in_words
from rigkit.io.corners.corner_cache import source_hash
from rigkit.io.media.images import read_image

Views = dict[str, list[BoardView]]
"""What each image shows, by its name."""
Loaded = tuple[Views, tuple[int, int]]
"""What the images of a set show, and their size."""


@dataclass(frozen=True, slots=True)
class Capture:
    """Images of one unchanged camera: where they are, and the board on them."""

    folder: str
    pattern: str
    board: Board
    rendered: bool = False


def identified(words: str) -> Board:
    board = board_in_words(words)
    assert board is not None
    return board


CHARUCO_STEREO = "charuco:30x15x49.33,dictionary=DICT_4X4_250,marker_mm=38.46"
CAPTURES = {
    "bouguet-left": Capture("real/bouguet-stereo", "left*.jpg", Board("b", 9, 6, 30.0, 30.0)),
    "bouguet-right": Capture("real/bouguet-stereo", "right*.jpg", Board("b", 9, 6, 30.0, 30.0)),
    "camodocal": Capture("real/camodocal-fisheye", "*.png", Board("b", 9, 6, 30.0, 30.0)),
    "ocam": Capture("real/ocam-fisheye1", "*.jpg", Board("b", 8, 6, 32.5, 32.5)),
    "ov-plane": Capture("real/ov-plane/corners", "*/*.orpc", Board("ov", 22, 22, 7.5, 7.5)),
    "caliper": Capture("public/caliper-board", "*.png", Board("b", 16, 10, 15.0, 15.0)),
    "fisheye-chess": Capture("public/fisheye-chess", "*.jpg", Board("b", 4, 6, 30.0, 30.0)),
    "cylinder": Capture("public/cylinder/201", "*", Board("b", 19, 14, 10.0, 10.0)),
    "cylinder-202": Capture("public/cylinder/202", "*", Board("b", 19, 14, 10.0, 10.0)),
    "bumblebee-left": Capture("public/bumblebee2", "left*.jpg", Board("b", 4, 6, 30.0, 30.0)),
    "bumblebee-right": Capture("public/bumblebee2", "right*.jpg", Board("b", 4, 6, 30.0, 30.0)),
    "charuco-stereo-left": Capture("public/charuco-stereo", "left*", identified(CHARUCO_STEREO)),
    "charuco-stereo-right": Capture("public/charuco-stereo", "right*", identified(CHARUCO_STEREO)),
    "charuco-lifecam": Capture(
        "public/charuco-lifecam", "*.jpg", identified("charuco:7x7x25.4,dictionary=DICT_4X4_50,marker_mm=19.05")
    ),
    "aprilgrid-mocap": Capture("public/aprilgrid-mocap/cam0/data", "*", identified("aprilgrid:6x6x88,spacing=0.3")),
    "lab-regular": Capture("lab-a/calibration/regular", "*.jpg", Board("b", 9, 6, 30.0, 30.0), True),
    "lab-fisheye": Capture("lab-a/calibration/fisheye", "*.jpg", Board("b", 9, 6, 30.0, 30.0), True),
}


OTHERS = [
    ("bouguet-left", "bouguet-right"),
    ("bumblebee-left", "bumblebee-right"),
    ("charuco-stereo-left", "charuco-stereo-right"),
    ("cylinder", "cylinder-202"),
    ("lab-regular", "lab-fisheye"),
]
"""Different cameras with images of one size."""

PUBLISHED_SIZE_PX = (1280, 800)
"""Of the images of published corners."""


def views_of(path: Path, board: Board, cache: Path) -> tuple[list[BoardView], tuple[int, int]]:
    """Return what an image shows and its size, from the images or from the cache."""
    if path.suffix == ".orpc":
        return [published_corners(path, board)], PUBLISHED_SIZE_PX
    digest = hashlib.sha256(path.read_bytes() + repr((board, source_hash())).encode()).hexdigest()[:20]
    kept = cache / f"{digest}.pickle"
    if not kept.is_file():
        image = read_image(path)
        views, _ = views_of_image(path.name, detect_boards(image, [board]), [board])
        kept.write_bytes(pickle.dumps((views[:1], (image.shape[1], image.shape[0]))))
    views, size = pickle.loads(kept.read_bytes())
    return [replace(view, image=path.name) for view in views], size


def load(name: str, data: Path, cache: Path) -> Loaded:
    """Return what the images of a set show, and their size."""
    capture = CAPTURES[name]
    found: Views = {}
    size = (0, 0)
    for path in sorted((data / capture.folder).glob(capture.pattern)):
        views, size = views_of(path, capture.board, cache)
        if views:
            found[path.name] = views
    return found, size
