"""Identical boards are distinguished by measured angles, where these are decisive."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rigkit.cameras.kannala_brandt import KannalaBrandt
from rigkit.cameras.pinhole import Pinhole
from rigkit.core.boards import Board
from rigkit.core.detections import BoardDetection
from rigkit.core.errors import InputError
from rigkit.core.patterns.circles import Circles
from rigkit.core.posetype import PoseType
from rigkit.core.truth import MeasuredAngle
from rigkit.identification.identify import identify_pair
from rigkit.reconstruction.pairing import MatchedPair, match_pair
from rigkit.synthetic.pairs import StereoScene, trihedral_pair

CAMERA = Pinhole((1624, 1240), np.array([1350.0, 1352.0, 805.0, 622.0]))
FISHEYE = KannalaBrandt((960, 720), np.array([352.0, 351.0, 484.0, 356.0, -0.02, 0.001, 0.0, 0.0]))
BOARDS = tuple(Board(name, 8, 6, 50.0, 50.0) for name in ("front", "floor", "right"))


def scene(rng: np.random.Generator, angles: tuple[float, float, float]) -> StereoScene:
    return trihedral_pair(BOARDS, CAMERA, PoseType.GENERAL, rng, angles_deg=angles)


def measured(angles: tuple[float, float, float]) -> list[MeasuredAngle]:
    """The angles between the faces of a scene, for `trihedral` takes those between the planes' normals."""
    names = (("front", "floor"), ("front", "right"), ("floor", "right"))
    return [MeasuredAngle(a, b, 180.0 - v, 0.3, "protractor") for (a, b), v in zip(names, angles, strict=True)]


def matched(made: StereoScene, **options: object) -> MatchedPair:
    first, second = ([replace(d, board_id=None) for d in found] for found in made.detections())
    return match_pair("pair", CAMERA, CAMERA, first, second, BOARDS, **options)  # type: ignore[arg-type]


def names_are_right(pair: MatchedPair, made: StereoScene) -> bool:
    truth = {d.board_id: d.pixels.mean(axis=0) for d in made.detections()[0]}
    return all(np.allclose(d.pixels.mean(axis=0), truth[d.board_id], atol=1e-6) for d in pair.identity.detections1)


@pytest.mark.parametrize("seed", range(4))
def test_other_walls_than_right_angles_tell_equal_boards_apart(seed: int) -> None:
    angles = (75.0, 90.0, 100.0)
    made = scene(np.random.default_rng(seed), angles)
    assert not names_are_right(matched(made), made)
    pair = matched(made, angles=measured(angles))
    assert names_are_right(pair, made)
    assert any("look alike and were identified by the measured angles" in words for words in pair.notes)


@pytest.mark.parametrize("seed", range(4))
def test_where_angles_fit_several_names_the_fewest_change_and_it_is_said(seed: int) -> None:
    """Front and floor may be either way round to an angle between them; the floor keeps the name that it has."""
    angles = (75.0, 90.0, 90.0)
    made = scene(np.random.default_rng(seed), angles)
    for printed in (measured(angles), measured(angles)[:1]):
        pair = matched(made, angles=printed)
        assert names_are_right(pair, made)
        (words,) = [words for words in pair.notes if "measured angles" in words]
        assert "2 orders of the names fit" in words


@pytest.mark.parametrize(("third", "words"), [(90.0, "2 orders of the names fit"), (100.0, "by the measured angles;")])
def test_names_that_fit_the_measured_angles(third: float, words: str) -> None:
    angles = (75.0, 90.0, third)
    made = scene(np.random.default_rng(2), angles)
    first, second = ([replace(d, board_id=None) for d in found] for found in made.detections())
    identity = identify_pair(first, second, BOARDS, CAMERA, CAMERA, angles=measured(angles))
    assert [d.board_id for d in identity.detections1] == [d.board_id for d in made.detections()[0]]
    assert words in identity.notes[-1]


def test_boards_of_almost_the_same_squares_look_alike_too() -> None:
    """Each measured on its own: they are one kind to `rigkit.identification.identify`, and so to the angles."""
    angles = (75.0, 90.0, 100.0)
    boards = tuple(replace(b, square_x_mm=s, square_y_mm=s) for b, s in zip(BOARDS, (50.0, 50.1, 49.9), strict=True))
    made = trihedral_pair(boards, CAMERA, PoseType.GENERAL, np.random.default_rng(0), angles_deg=angles)
    first, second = ([replace(d, board_id=None) for d in found] for found in made.detections())
    pair = match_pair("pair", CAMERA, CAMERA, first, second, boards, angles=measured(angles))
    assert names_are_right(pair, made)


@pytest.mark.parametrize("angles", [(90.0, 90.0, 90.0), (88.0, 90.0, 90.0)])
def test_angles_that_say_nothing_or_that_fit_no_names_change_nothing(
    rng: np.random.Generator, angles: tuple[float, float, float]
) -> None:
    made = scene(rng, angles)
    plain = matched(made)
    for printed in ((90.0, 90.0, 90.0), (70.0, 80.0, 110.0)):
        pair = matched(made, angles=measured(printed))
        assert pair.notes == plain.notes
        assert [d.board_id for d in pair.identity.detections1] == [d.board_id for d in plain.identity.detections1]
        np.testing.assert_array_equal(pair.matches.pixels1, plain.matches.pixels1)


def test_a_layout_stands_above_the_angles(rng: np.random.Generator) -> None:
    angles = (75.0, 90.0, 100.0)
    made = scene(rng, angles)
    layout = {"front": "right", "floor": "floor", "right": "left"}
    assert not names_are_right(matched(made, angles=measured(angles), layout=layout), made)


def test_the_joint_covariance_of_directions_is_one() -> None:
    made = trihedral_pair(BOARDS, FISHEYE, PoseType.GENERAL, np.random.default_rng(5))
    rng = np.random.default_rng(6)
    # Corners of unequal accuracy, as near the end of a board in perspective, make what directions share lopsided.
    first, second = (
        [replace(d, board_id=None, sigma_px=rng.uniform(0.005, 0.1, len(d.grid))) for d in found]
        for found in made.detections()
    )
    pair = match_pair("pair", FISHEYE, FISHEYE, first, second, BOARDS)
    for covariance in (pair.noise.covariance1, pair.noise.covariance2):
        eigenvalues = np.linalg.eigvalsh(covariance)
        assert (eigenvalues[:, 0] > -1e-12 * eigenvalues[:, -1]).all()


def covered(found: BoardDetection, columns: int, rows: int) -> BoardDetection:
    seen = (found.grid[:, 0] < columns) & (found.grid[:, 1] < rows)
    return BoardDetection(None, columns, rows, found.grid[seen], found.pixels[seen], found.sigma_px[seen])


@pytest.mark.parametrize("size", [(7, 6), (8, 4)])
def test_one_board_covered_alike_in_both_images_keeps_its_size_and_the_cameras_their_distance(
    size: tuple[int, int],
) -> None:
    for seed in range(3):
        made = scene(np.random.default_rng(seed), (90.0, 90.0, 90.0))
        first, second = ([covered(found[0], *size)] for found in made.detections())
        pair = match_pair("pair", CAMERA, CAMERA, first, second, BOARDS[:1])
        shift_mm = pair.identity.cam2_from_cam1.translation_mm - made.cam2_from_cam1.translation_mm
        assert np.linalg.norm(shift_mm) < 0.01 * np.linalg.norm(made.cam2_from_cam1.translation_mm)
        assert any(f"the same {size[0]}x{size[1]} of its 8x6 corners" in note for note in pair.notes)


def test_grids_that_no_listed_board_has_room_for_are_refused_with_their_size() -> None:
    made = scene(np.random.default_rng(0), (90.0, 90.0, 90.0))
    first, second = ([replace(found[0], board_id=None)] for found in made.detections())
    with pytest.raises(InputError, match="have 7x6 inner corners, but 2 complete grids of 8x6 were found"):
        match_pair("pair", CAMERA, CAMERA, first, second, [replace(BOARDS[0], columns=7)])
    circles = replace(BOARDS[0], columns=9, pattern=Circles())
    with pytest.raises(InputError, match="have 9x6 inner corners, but 2 complete grids of 8x6 were found"):
        match_pair("pair", CAMERA, CAMERA, first, second, [circles])
