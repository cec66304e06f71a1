"""Detection on captures outside the repository: exact truth of the ray-traced lab, and public images."""

from __future__ import annotations

import json

import numpy as np
import pytest
from detectors.degradations import degraded
from helpers.data import read_grey, shared_data
from helpers.detection_scenes import errors_by_position, match

from rigkit.core.boards import Board
from rigkit.core.patterns.aprilgrid import AprilGrid
from rigkit.core.patterns.circles import Circles
from rigkit.detection.detect import detect_boards
from rigkit.detection.unknown import guess_board
from rigkit.optim.robust_scale import MEDIAN_OF_RAYLEIGH

pytestmark = pytest.mark.real

PATH_TRACED = ("regular-general", "regular-planar")
LAB_RMS_PX = {True: 0.05, False: 0.02}
"""Of path-traced images, whose noise is four times as strong, and of the others: a fifth to a half above the noise."""

POSTER_PX = 8.0
"""Squares of a poster on the wall, and not of the board in hand, are smaller than this."""


@pytest.mark.parametrize("lens", ["regular", "fisheye"])
@pytest.mark.parametrize("pose", ["general", "planar", "standard", "forward"])
def test_lab_captures(lens: str, pose: str) -> None:
    folder = shared_data(f"lab-a/captures/{lens}-{pose}")
    truth = json.loads((folder / "truth.json").read_text())
    for view in ("view1", "view2"):
        found = detect_boards(read_grey(folder / f"{view}.jpg"))
        assert [(d.columns, d.rows, d.complete) for d in found] == [(8, 6, True)] * 3
        exact = [(np.zeros((0, 2)), np.array(board["uv_px"])) for board in truth[view].values()]
        matched = match(found, exact)
        assert len({id(d) for d in matched}) == 3
        errors = [errors_by_position(d, pixels) for d, (_, pixels) in zip(matched, exact, strict=True)]
        assert np.sqrt((np.concatenate(errors) ** 2).sum(axis=1).mean()) < LAB_RMS_PX[f"{lens}-{pose}" in PATH_TRACED]


@pytest.mark.parametrize("name, count", [("e1", 1), ("e2", 3), ("e3", 7), ("e5", 12), ("e6", 0)])
def test_rooms_with_many_boards(name: str, count: int) -> None:
    image = read_grey(shared_data("real/multi-board") / f"{name}.png")
    found = detect_boards(image)
    assert len(found) == count
    assert sum(d.complete for d in found) >= count - (name == "e3")


@pytest.mark.parametrize("number, size", [*[(k, (7, 5)) for k in range(1, 8)], (8, (6, 4)), (9, (21, 19))])
def test_public_single_boards(number: int, size: tuple[int, int]) -> None:
    image = read_grey(shared_data("real/opencv-detector") / f"chess{number}.png")
    (found,) = detect_boards(image)
    assert found.complete
    assert sorted((found.columns, found.rows)) == sorted(size)


@pytest.mark.parametrize("number", [1, 2, 3])
def test_boards_with_a_corner_missing_are_not_whole(number: int) -> None:
    image = read_grey(shared_data("real/opencv-detector") / f"negative_{number}.png")
    assert not any(found.complete for found in detect_boards(image))


@pytest.mark.parametrize(
    "folder, pattern, size, count",
    [
        ("bouguet-stereo", "*.jpg", (9, 6), 28),
        ("ocam-fisheye1", "*.jpg", (8, 6), 15),
        ("camodocal-fisheye", "*.png", (9, 6), 20),
    ],
)
def test_public_calibration_sets(folder: str, pattern: str, size: tuple[int, int], count: int) -> None:
    board = Board("b", *size, 30.0, 30.0)
    images = sorted(shared_data(f"real/{folder}").glob(pattern))
    assert len(images) == count
    for path in images:
        found = detect_boards(read_grey(path), [board])
        named = [d for d in found if d.board_id == "b"]
        assert len(named) == 1, path.name
        assert named[0].complete, path.name
        # A poster on the wall of the bouguet-stereo images shows boards, too, in squares of 5 px.
        others = [d for d in found if d.board_id is None]
        assert all(np.nanmedian(np.linalg.norm(np.diff(d.lattice(), axis=1), axis=2)) < POSTER_PX for d in others)


def test_boards_cut_by_the_frame_are_not_whole() -> None:
    for number in (1, 2, 3):
        path = shared_data("real/opencv-detector") / f"negative_{number}.png"
        for found in detect_boards(read_grey(path), [Board("b", 7, 6, 30.0, 30.0)]):
            assert not found.complete


@pytest.mark.parametrize(("every", "corners"), [(2, 5050), pytest.param(1, 9587, marks=pytest.mark.thorough)])
def test_a_board_with_markers_in_its_squares(every: int, corners: int) -> None:
    """Published corners of a 22x22 board, much of it at the rim of a fisheye."""
    found, published = 0, 0
    for path in sorted(shared_data("real/ov-plane/corners").glob("*/*.orpc"))[::every]:
        lines = path.read_text().splitlines()
        start = next(i for i, line in enumerate(lines) if line.startswith("encoding")) + 1
        places = np.array([[float(x) for x in line.split(",")[3:5]] for line in lines[start:] if line.strip()])
        boards = detect_boards(read_grey(path.with_suffix(".png")))
        pixels = np.concatenate([board.pixels for board in boards])
        found += int((np.linalg.norm(places[:, None] - pixels, axis=2).min(axis=1) < 3.0).sum())
        published += len(places)
    assert published == corners
    assert found >= 0.993 * published


@pytest.mark.parametrize("gain", [2.0, 2.5])
def test_overexposed_tags(gain: float) -> None:
    """Bright parts run over into dark ones: corners lie where they are in the images as they were taken, and the print
    is told, not what it looks like."""
    paths = sorted((shared_data("public/aprilgrid-mocap") / "cam0" / "data").glob("*.jpg"))[::3]
    images = [read_grey(path) for path in paths]
    bright = [np.clip(np.rint(gain * image.astype(np.float64)), 0, 255).astype(np.uint8) for image in images]
    guess = guess_board(bright)
    assert guess is not None and guess.determined
    assert guess.board.pattern == AprilGrid(0.3)
    board = Board("grid", 12, 12, 88.0, 88.0, pattern=AprilGrid(0.3))
    seen, off = 0, []
    for before, after in zip(images, bright, strict=True):
        one, other = (next(iter(detect_boards(image, [board])), None) for image in (before, after))
        if one is None or other is None:
            continue
        seen += 1
        here, there = ({tuple(c): k for k, c in enumerate(item.grid.tolist())} for item in (one, other))
        both = [(here[c], there[c]) for c in there if c in here]
        a, b = (list(part) for part in zip(*both, strict=True))
        sigma = np.hypot(one.sigma_px[a], other.sigma_px[b])
        off += (np.linalg.norm(one.pixels[a] - other.pixels[b], axis=1) / sigma).tolist()
    # Of ten; the finest level alone shows two and none.
    assert seen >= (6 if gain == 2.0 else 3)
    assert np.median(off) < 1.5 * MEDIAN_OF_RAYLEIGH


def test_circles_that_a_webcam_sharpens() -> None:
    """Steps of the fit go to and fro where edges are steeper than any blur: none of these two grids was found."""
    paths = sorted(shared_data("public/circles-regular").glob("*.jpg"))[:2]
    board = Board("dots", 10, 8, 2.5, 2.5, pattern=Circles(diameter_mm=1.5))
    for path in paths:
        grey = read_grey(path)
        sharper = degraded("sharpened", 3.0, grey, np.random.default_rng(0))[0]
        (clear,), (found,) = detect_boards(grey, [board]), detect_boards(sharper, [board])
        assert clear.complete and found.complete
        off = np.linalg.norm(found.pixels[:, None] - clear.pixels, axis=2).min(axis=1)
        assert off.max() < 0.2


def test_a_wide_board_is_not_taken_for_a_square_one() -> None:
    """A few of its tags lie where the square board has them, and all its corners fit."""
    image = read_grey(shared_data("public/aprilgrid") / "iphone.png")
    (found,) = detect_boards(image, [Board("wide", 22, 12, 88.0, 88.0, pattern=AprilGrid(0.3))])
    assert len(found.grid) > 200
    assert detect_boards(image, [Board("square", 12, 12, 88.0, 88.0, pattern=AprilGrid(0.3))]) == ()


def test_a_single_aprilgrid_in_white_on_black_is_no_chessboard() -> None:
    """The squares between its tags look like one of 5 x 5 corners."""
    guess = guess_board([255 - read_grey(shared_data("public/aprilgrid") / "r45.png")])
    assert guess is not None and isinstance(guess.board.pattern, AprilGrid)
    assert guess.board.pattern.inverted and guess.board.size == (12, 12)
