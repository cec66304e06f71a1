"""Frames put together from images of different moments are named; correct ones are not."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest
from helpers.calibration_scenes import BOARD, lens
from helpers.rig_scenes import Views

from rigkit.calibration.calibrate import calibrate
from rigkit.calibration.rig.calibrate import calibrate_rig
from rigkit.calibration.rig.joint import early_disagreement
from rigkit.calibration.rig.result import RigCalibration
from rigkit.calibration.rig.views.mispaired import mixup_of_all_frames
from rigkit.calibration.rig.views.observations import RigViews, frame_observations
from rigkit.core.arrays import FloatArray
from rigkit.core.boards import Board
from rigkit.core.detections import BoardView
from rigkit.core.errors import DegenerateError, InputError
from rigkit.core.findings import Severity
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3

NOISE_PX = 0.1
FRAMES = 10
LENS = lens("reg")
RIGHT_FROM_LEFT = Rigid3(exp_so3(np.array([0.01, -0.05, 0.02])), [-100.0, 2.0, 1.0])


def pair(rng: np.random.Generator, board: Board = BOARD) -> Views:
    """Return frames that two cameras of one lens see."""
    views: Views = {"left": [], "right": []}
    while len(views["left"]) < FRAMES:
        rotation = exp_so3(rng.normal(size=3) * np.array([0.4, 0.4, 0.3]))
        place = np.array([rng.uniform(-80, 150), rng.uniform(-90, 90), rng.uniform(400, 700)])
        left_from_board = Rigid3(rotation, place - rotation @ board.points().mean(axis=0))
        shown: list[FloatArray] = []
        for pose in (left_from_board, RIGHT_FROM_LEFT @ left_from_board):
            pixels, valid = LENS.project(pose.apply(board.points()))
            if valid.all() and LENS.on_image(pixels).all():
                shown.append(np.clip(pixels + NOISE_PX * rng.normal(size=pixels.shape), 0, np.array(LENS.size_px) - 1))
        if len(shown) < 2:
            continue
        frame = f"{len(views['left']) + 1}"
        for name, pixels in zip(views, shown, strict=True):
            sigma = np.full(len(pixels), NOISE_PX)
            views[name].append((frame, BoardView(f"{name}{frame}.png", board, board.grid(), pixels, sigma)))
    return views


def calibrated(views: Views) -> RigCalibration:
    return calibrate_rig(views, dict.fromkeys(views, LENS.size_px), model="brown", degree=4, folds=0)


def cause(views: Views) -> str:
    """Return what is said first where hardly any frame agrees: an error, or a rig that is bad."""
    try:
        rig = calibrated(views)
    except DegenerateError as error:
        return str(error)
    assert rig.verdicts[0].severity is Severity.BAD
    return rig.verdicts[0].message


def exchanged(views: Views) -> Views:
    frames = ("3", "10")
    both = dict(views["left"]), dict(views["right"])
    return {
        name: [(f, replace((both[1 - k] if f in frames else both[k])[f], image=f"{name}{f}.png")) for f, _ in own]
        for k, (name, own) in enumerate(views.items())
    }


def one_missing(views: Views) -> Views:
    """The seventh image of the right camera is missing, and those after it were numbered anew."""
    right = [(f, view) for f, view in views["right"] if f != "7"]
    return views | {"right": [(str(k + 1), view) for k, (_, view) in enumerate(right)]}


def turned(view: BoardView) -> BoardView:
    grid = np.array(view.board.size) - 1 - view.grid if (view.board.columns + view.board.rows) % 2 == 0 else view.grid
    return replace(view, pixels=np.array(LENS.size_px) - 1 - view.pixels, grid=grid)


def half_a_turn(views: Views) -> Views:
    return views | {"right": [(f, turned(view) if f in ("2", "9") else view) for f, view in views["right"]]}


@pytest.mark.parametrize(
    ("mistake", "words"),
    [
        (exchanged, r"the images of 'left' and 'right' are exchanged in frames '3', '10':"),
        (one_missing, r"the images of 'right' in frames '7', '8', '9' belong to one frame later:"),
        (half_a_turn, r"the images of 'right' are rotated by 180 degrees in frames '2', '9':"),
    ],
)
def test_the_mistake_is_the_first_thing_that_is_said(
    mistake: Callable[[Views], Views], words: str, rng: np.random.Generator
) -> None:
    rig = calibrated(mistake(pair(rng)))
    assert rig.verdicts[0].severity is Severity.BAD
    assert words in rig.verdicts[0].message
    assert rig.verdicts[0].remedy
    others = " ".join(str(finding) for finding in rig.verdicts[1:])
    assert not any(word in others for word in ("exchanged", "turned", "counted"))


def test_a_board_that_was_moved_is_no_such_mistake(rng: np.random.Generator) -> None:
    views = pair(rng)
    moved = {f: view.pixels + 30.0 * rng.uniform(0.5, 1.0, 2) for f, view in views["right"] if f in ("2", "6")}
    views["right"] = [(f, replace(v, pixels=np.clip(moved.get(f, v.pixels), 0, 1e4))) for f, v in views["right"]]
    views["right"] = [
        (f, replace(v, pixels=np.minimum(v.pixels, np.array(LENS.size_px) - 1.0))) for f, v in views["right"]
    ]
    rig = calibrated(views)
    assert {"2", "6"} <= {frame for frame, _, _ in rig.left_out}
    words = " ".join(map(str, rig.verdicts))
    assert not any(word in words for word in ("exchanged", "rotated", "belong to", "identical"))


ONE_OFF = "the images of 'right' belong to one frame earlier in all frames:"


def one_off(views: Views) -> Views:
    return views | {"right": [(str(int(f) + 1), view) for f, view in views["right"]]}


def test_one_off_in_all_frames(rng: np.random.Generator) -> None:
    """Six frames: with so few the joint solution first believes some of them, and leaves out others."""
    assert ONE_OFF in cause(one_off({name: own[:6] for name, own in pair(rng).items()}))


@pytest.mark.parametrize("board", [BOARD, Board("even", 8, 6, 30.0, 30.0)])
def test_one_camera_mirrored(board: Board, rng: np.random.Generator) -> None:
    """A chessboard's mirror image is one: its rows or its columns are counted from the other end."""
    views = pair(rng, board)
    width, side = LENS.size_px[0] - 1.0, 0 if board.columns % 2 == 0 else 1
    far = board.size[side] - 1
    flipped = []
    for frame, view in views["right"]:
        pixels, grid = view.pixels.copy(), view.grid.copy()
        pixels[:, 0], grid[:, side] = width - pixels[:, 0], far - grid[:, side]
        flipped.append((frame, replace(view, pixels=pixels, grid=grid)))
    views["right"] = flipped
    assert "the images of 'left' or those of 'right' are mirrored:" in cause(views)


HALF_TURNED = "rotated by 180 degrees in frames '[12]', '[34]', '[56]' and 2 more"


def half_turned(views: Views) -> Views:
    return views | {"right": [(f, turned(view) if int(f) % 2 else view) for f, view in views["right"]]}


HALF_EXCHANGED = "'left' and 'right' are exchanged in frames '[12]', '[34]', '[56]' and 2 more"


def half_exchanged(views: Views) -> Views:
    both = dict(views["left"]), dict(views["right"])
    return {
        name: [(f, replace(both[k if int(f) % 2 else 1 - k][f], image=f"{name}{f}.png")) for f, _ in own]
        for k, (name, own) in enumerate(views.items())
    }


def test_half_of_one_camera_turned(rng: np.random.Generator) -> None:
    assert re.search(HALF_TURNED, cause(half_turned(pair(rng))))


@pytest.mark.parametrize(
    ("mistake", "words"), [(half_turned, HALF_TURNED), (half_exchanged, HALF_EXCHANGED), (one_off, ONE_OFF)]
)
def test_mistakes_in_half_of_the_frames_or_all_before_the_rig_is_solved(
    mistake: Callable[[Views], Views], words: str, rng: np.random.Generator
) -> None:
    views = mistake(pair(rng))
    alone = [calibrate([v for _, v in own], LENS.size_px, model="brown", degree=4, folds=0) for own in views.values()]
    seen = [frame_observations(own, one) for own, one in zip(views.values(), alone, strict=True)]
    found = mixup_of_all_frames(RigViews(tuple(views), seen, tuple(alone), {}))
    assert found is not None and re.search(words, found.message)


def test_one_picture_under_two_names(rng: np.random.Generator) -> None:
    views = pair(rng)
    left = dict(views["left"])

    def instead(frames: set[str]) -> Views:
        """The left camera's pictures, saved again with other noise of the corners, as the right one's."""
        return views | {
            "right": [
                (f, replace(left[f], image=v.image, pixels=left[f].pixels + 0.02) if f in frames else v)
                for f, v in views["right"]
            ]
        }

    with pytest.raises(InputError, match="'left' and 'right' have identical images in all 10 frames"):
        calibrated(instead(set(left)))
    rig = calibrated(instead({"4", "5"}))
    assert rig.verdicts[0].severity is Severity.BAD
    assert "'left' and 'right' have identical images in frames '4', '5' of 10 frames" in rig.verdicts[0].message
    assert not any("identical images" in str(finding) for finding in calibrated(views).verdicts)


def test_one_picture_of_a_camera_in_two_frames(rng: np.random.Generator) -> None:
    """A board that nobody moved looks the same to both cameras, which is no mistake."""
    views = pair(rng)
    left = dict(views["left"])
    again = replace(left["2"], image="left8.png", pixels=left["2"].pixels + 0.02)
    views["left"] = [(f, again if f == "8" else view) for f, view in views["left"]]
    rig = calibrated(views)
    assert rig.verdicts[0].severity is Severity.BAD
    assert "the images of 'left' in frames '2' and '8' are copies of one image" in rig.verdicts[0].message
    right = dict(views["right"])
    views["right"] = [(f, replace(right["2"], image=v.image) if f == "8" else v) for f, v in views["right"]]
    assert not any("copies" in str(finding) for finding in calibrated(views).verdicts)


def test_half_of_the_pictures_exchanged(rng: np.random.Generator) -> None:
    assert re.search(HALF_EXCHANGED, cause(half_exchanged(pair(rng))))


@pytest.mark.parametrize(
    ("order", "words"),
    [
        (range(FRAMES), None),
        ([3, 8, 0, 6, 1, 9, 5, 2, 7, 4], r"disagree by \d+ px on the boards' poses \(boards are \d+ px large\)"),
        ([*range(1, FRAMES), 0], "the images of 'right' belong to"),
    ],
)
def test_images_of_other_moments_show_before_the_rig_is_solved(
    order: Sequence[int], words: str | None, rng: np.random.Generator
) -> None:
    views = pair(rng)
    frames = [frame for frame, _ in views["right"]]
    views["right"] = [(frames[order[k]], view) for k, (_, view) in enumerate(views["right"])]
    alone = [calibrate([v for _, v in own], LENS.size_px, model="brown", degree=4, folds=0) for own in views.values()]
    seen = [frame_observations(own, one) for own, one in zip(views.values(), alone, strict=True)]
    found = early_disagreement(RigViews(tuple(views), seen, tuple(alone), {}))
    assert found is None if words is None else found is not None and re.search(words, found)
