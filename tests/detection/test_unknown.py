"""Undescribed boards: everything but their scale is identified from images."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from detection_bench.scenes import BenchScene, bench_camera, bench_field_deg, one_board

from rigkit.cameras.pinhole import Pinhole
from rigkit.core.boards import Board
from rigkit.core.patterns.aprilgrid import AprilGrid
from rigkit.core.patterns.base import Pattern
from rigkit.core.patterns.charuco import Charuco
from rigkit.core.patterns.chessboard import Chessboard
from rigkit.core.patterns.circles import Circles
from rigkit.detection.saddles.response import GreyImage, grey_image
from rigkit.detection.tags import unknown_tags
from rigkit.detection.tags.codes import Codes, TagCode
from rigkit.detection.tags.unknown_charuco import MarkerObservations, guessed_charuco
from rigkit.detection.tags.unknown_tags import TagObservations
from rigkit.detection.unknown import LOOKING, difference, guess_board
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3
from rigkit.synthetic.render import Optics, render
from rigkit.synthetic.scene import PlacedBoard

PLACES = (0.01, 0.02)
"""How well spacing and side of markers are read, in tags and squares."""


@pytest.mark.parametrize(
    ("size", "pattern"),
    [
        ((10, 8), AprilGrid(0.25)),
        ((8, 6), AprilGrid(0.5, "tag25h9", 1, 4, "opencv")),
        ((8, 6), AprilGrid(0.3, inverted=True)),
        ((8, 6), AprilGrid(0.4, corner_squares=False)),
        ((10, 14), AprilGrid(0.2, "DICT_6X6_50", 1, 3, "opencv", corner_squares=False)),
        ((10, 8), AprilGrid(0.3, "DICT_4X4_50", 1, numbering="opencv")),
        ((8, 5), Charuco("DICT_5X5_50", 45.0)),
        ((8, 5), Charuco("DICT_4X4_50", 45.0, legacy=True)),
        ((8, 6), Chessboard()),
        ((9, 7), Circles(diameter_mm=30.0)),
        ((4, 11), Circles("asymmetric", diameter_mm=24.0)),
        ((8, 7), Circles("hexagonal", diameter_mm=30.0, inverted=True)),
    ],
    ids=[
        "kalibr",
        "opencv",
        "white",
        "alone",
        "aruco",
        "aruco with squares",
        "charuco",
        "legacy",
        "chessboard",
        "circles",
        "asymmetric",
        "hexagonal",
    ],
)
def test_everything_but_the_scale_is_identified(size: tuple[int, int], pattern: Pattern) -> None:
    board = Board("b", *size, 60.0, 60.0, pattern=pattern)
    images = []
    for seed in range(2):
        rng = np.random.default_rng(seed)
        scene = one_board(rng, board=board, max_tilt_deg=35.0)
        images.append(grey_image(scene.render(optics=Optics(0.5), noise_levels=2.0, rng=rng)))
    guess = guess_board(images)
    assert guess is not None
    assert guess.images == (0, 1)
    assert guess.board.size == size
    found = guess.board.pattern
    if isinstance(pattern, AprilGrid):
        assert isinstance(found, AprilGrid)
        assert abs(found.spacing - pattern.spacing) <= PLACES[0] + 1e-9
        assert (found.family, found.border, found.numbering) == (pattern.family, pattern.border, pattern.numbering)
        assert (found.corner_squares, found.first_tag) == (pattern.corner_squares, pattern.first_tag)
        assert found.inverted == pattern.inverted
    elif isinstance(pattern, Charuco):
        assert isinstance(found, Charuco)
        assert abs(found.marker_mm - 0.75) <= PLACES[1] + 1e-9
        assert (found.dictionary, found.legacy, found.inverted) == (pattern.dictionary, pattern.legacy, False)
    elif isinstance(pattern, Circles):
        assert isinstance(found, Circles)
        assert (found.layout, found.inverted, found.stagger) == (pattern.layout, pattern.inverted, pattern.stagger)
        assert found.diameter_mm == pytest.approx((pattern.diameter_mm or 0.0) / 60.0, abs=PLACES[1])
    else:
        assert found == pattern


@pytest.mark.parametrize("mosaic", [False, True])
def test_empty_squares_are_a_chessboard_without_reading_marks(mosaic: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ten dictionaries in two polarities take longer than the board."""

    def asked(*_: object) -> bool:
        raise AssertionError("marks are read")

    monkeypatch.setattr(TagObservations, "look", asked)
    monkeypatch.setattr(MarkerObservations, "look", asked)
    image = shown(Board("b", 8, 6, 60.0, 60.0))
    if mosaic:
        image = image.copy()
        image[::2, ::2] //= 2
    determined: list[tuple[str, int, int]] = []
    guess = guess_board([image, image], lambda *what: determined.append(what))
    assert guess is not None and guess.board.size == (8, 6)
    assert determined == [(LOOKING, 0, 2), (LOOKING, 1, 2), (LOOKING, 2, 2)]


@pytest.mark.parametrize("pattern", [AprilGrid(0.3), Charuco("DICT_5X5_50", 45.0), Chessboard()])
def test_a_board_in_a_room_with_tiles(pattern: Pattern) -> None:
    """Of the tiles every image shows another, larger part: no grid of one size is seen often, but the board's is."""
    board = Board("b", 8, 6, 60.0, 60.0, pattern=pattern)
    camera = Pinhole((700, 300), np.array([400.0, 400.0, 349.5, 149.5]))
    images = []
    for k, size in enumerate(((9, 8), (10, 9), (11, 8))):
        tiles = PlacedBoard(Board("tiles", *size, 50.0, 50.0), Rigid3(np.eye(3), [80.0, -200.0, 800.0 + k]))
        held = PlacedBoard(board, Rigid3(np.eye(3), [-520.0 - 5.0 * k, -150.0, 700.0]))
        images.append(grey_image(render([tiles, held], camera, Rigid3.identity(), optics=Optics(0.5))))
    guess = guess_board(images)
    assert guess is not None and type(guess.board.pattern) is type(pattern)
    assert guess.board.size == (8, 6) and sorted(guess.images) == [0, 1, 2]


def framed(board: Board, width: int, height: int, shift: tuple[float, float], slant_deg: float = 0.0) -> GreyImage:
    """Return an image of a board 800 mm away, moved by so many mm, as much of it as the frame shows."""
    turn = np.array(cv2.Rodrigues(np.array([0.0, np.deg2rad(slant_deg), 0.1]))[0])
    camera = Pinhole((width, height), np.array([400.0, 400.0, width / 2.0, height / 2.0]))
    middle = np.array([(board.columns - 1) * 30.0, (board.rows - 1) * 30.0, 0.0])
    place = Rigid3(turn, np.array([*shift, 800.0]) - turn @ middle)
    return grey_image(render([PlacedBoard(board, place)], camera, Rigid3.identity(), optics=Optics(0.5)))


CUT = Board("b", 10, 7, 60.0, 60.0)
"""600 px wide and 420 px high where it is 800 mm away, with its outermost squares 60 px more."""


def test_a_board_that_the_frame_cuts_in_every_image() -> None:
    """Two images show one side from end to end, two the other."""
    images = [framed(CUT, 560, 250, (0.0, 200.0), s) for s in (0.0, 8.0)]
    images += [framed(CUT, 300, 480, (x, 0.0)) for x in (150.0, 160.0)]
    guess = guess_board(images)
    assert guess is not None and guess.determined
    assert guess.board.size == (10, 7) and guess.images == (0, 1, 2, 3)


def test_images_that_do_not_tell_how_large_a_board_is() -> None:
    """No image shows the shorter side from end to end: it may be longer than what is seen."""
    guess = guess_board([framed(CUT, 560, 250, (0.0, y)) for y in (250.0, 200.0, 140.0)])
    assert guess is not None and not guess.determined
    assert guess.board.columns == 10 and guess.board.rows in (5, 6)


def dimmed(columns: int, count: int) -> list[GreyImage]:
    """Return images of a board, of which the rim of a lens hides all but so many columns."""
    images = []
    for k in range(count):
        image = framed(CUT, 800, 560, (2.0 * k, 5.0 * k))
        right = round(400 + k + 30.0 * (columns - 0.5 * CUT.columns))
        image[:, right:] = 12.0 + 0.01 * (image[:, right:] - 128.0)
        images.append(image)
    return images


def test_columns_at_the_rim_of_a_lens_are_of_the_board() -> None:
    """Three images show eight columns and two all ten: what is seen is there."""
    guess = guess_board([*dimmed(8, 3), *dimmed(11, 2)])
    assert guess is not None and guess.determined
    assert guess.board.size == (10, 7) and guess.images == (3, 4)


def test_images_that_do_not_decide_how_large_a_board_is() -> None:
    guess = guess_board([*dimmed(8, 5), *dimmed(11, 2)])
    assert guess is not None and set(guess.sizes) == {(8, 7), (10, 7)}


def test_a_board_with_hidden_corners_is_as_large_as_its_grid() -> None:
    """A sticker hides four corners of two images; the third shows a part only, without a gap."""
    images = []
    for slant in (0.0, 15.0):
        image = framed(CUT, 560, 400, (0.0, 0.0), slant)
        image[190:215, 270:300] = 128.0
        images.append(image)
    images.append(framed(CUT, 300, 480, (150.0, 0.0)))
    guess = guess_board(images)
    assert guess is not None and guess.board.size == (10, 7) and guess.images == (0, 1)


def test_markers_far_into_a_dictionary_are_identified() -> None:
    board = Board("b", 8, 5, 60.0, 60.0, pattern=Charuco("DICT_5X5_1000", 45.0, first_marker=600))
    guess = guess_board([shown(board)])
    assert guess is not None and isinstance(guess.board.pattern, Charuco)
    assert guess.board.pattern.first_marker == 600 and guess.board.size == (8, 5)


def test_markers_of_a_blurred_board_are_read() -> None:
    """Edges as wide as modules: OpenCV reads none."""
    image = shown(Board("b", 8, 5, 60.0, 60.0, pattern=Charuco("DICT_4X4_1000", 45.0, first_marker=600)))
    seen = MarkerObservations()
    assert seen.look(0, cv2.GaussianBlur(np.asarray(image), (0, 0), 2.0).astype(np.uint8))
    (kind, (numbers, _, _)) = seen.markers[0]
    assert kind == ("DICT_4X4_1000", False)
    assert len(numbers) >= 6 and numbers.min() >= 600 and numbers.max() < 627


def test_a_misread_marker_does_not_make_the_board_larger() -> None:
    pattern = Charuco("DICT_4X4_50", 0.75)
    places = np.array(pattern.places(8, 5))
    numbers = np.arange(len(places))
    misread = numbers.copy()
    misread[5] = 900
    seen, kind = MarkerObservations(images=[0, 1]), ("DICT_4X4_1000", False)
    seen.kinds[kind] = len(places)
    # No image shows its whole height.
    for part in (places[:, 1] < 4, places[:, 1] > 2):
        seen.markers.append((kind, (misread[part], places[part], 0.75)))
    (board,) = guessed_charuco(seen)
    assert board.size == (8, 5) and board.pattern == pattern


@pytest.mark.parametrize(
    ("numbers", "places"),
    [
        ([10, 19, 500, 900], [[0, 0], [0, 2], [2, 0], [2, 2]]),
        # Two of three fit a board of 189 squares a row, as any two would.
        ([197, 334, 523], [[0, 0], [-1, -1], [-1, 1]]),
    ],
)
def test_markers_without_order_are_no_board(numbers: list[int], places: list[list[int]]) -> None:
    """Chance reads numbers of which none is where another has it."""
    seen, kind = MarkerObservations(images=[0]), ("DICT_4X4_1000", False)
    seen.kinds[kind] = len(numbers)
    seen.markers.append((kind, (np.array(numbers), np.array(places), 0.75)))
    assert guessed_charuco(seen) == []


def of_nine_squares_a_row(legacy: bool) -> tuple[GreyImage, float, float]:
    """Return an image of a board of either pattern, which are numbered alike but for one column, at either end, and the
    middles of the squares there, px from the left."""
    board = Board("b", 8, 5, 60.0, 60.0, pattern=Charuco("DICT_4X4_50", 45.0, legacy=legacy))
    camera = Pinhole((900, 700), np.array([800.0, 800.0, 449.5, 349.5]))
    facing = Rigid3(np.eye(3), np.array([-210.0, -120.0, 600.0]))
    image = grey_image(render([PlacedBoard(board, facing)], camera, Rigid3.identity(), optics=Optics(0.5)))
    left, right = camera.project(facing.apply(np.array([[-30.0, 0.0, 0.0], [450.0, 0.0, 0.0]])))[0][:, 0]
    return image, left, right


@pytest.mark.parametrize("legacy", [False, True])
def test_half_markers_tell_the_pattern_where_those_read_fit_both(legacy: bool) -> None:
    paper, left, right = of_nine_squares_a_row(legacy)
    paper[:, : int(left)] = paper[:, int(right) :] = 200.0
    seen = MarkerObservations()
    assert seen.look(0, paper)
    assert len(guessed_charuco(seen)) == 2
    guess = guess_board([paper])
    assert guess is not None and isinstance(guess.board.pattern, Charuco)
    assert guess.board.pattern.legacy is legacy and not guess.either_pattern


@pytest.mark.parametrize("legacy", [False, True])
def test_markers_too_blurred_to_be_read_tell_the_pattern_by_their_place(legacy: bool) -> None:
    image, left, right = of_nine_squares_a_row(legacy)
    blurred = np.asarray(cv2.GaussianBlur(image, (0, 0), 6.0), np.float32)
    for end in (slice(0, int(left) + 50), slice(int(right) - 50, None)):
        image[:, end] = blurred[:, end]
    seen = MarkerObservations()
    assert seen.look(0, image)
    boards = guessed_charuco(seen)
    assert len(boards) == 2
    guess = guess_board([image])
    assert guess is not None and isinstance(guess.board.pattern, Charuco)
    assert guess.board.pattern.legacy is legacy and not guess.either_pattern


def test_images_that_do_not_show_which_pattern_it_is() -> None:
    image, left, right = of_nine_squares_a_row(legacy=True)
    guess = guess_board([image[:, int(left) + 50 : int(right) - 50].copy()])
    assert guess is not None and guess.board.size == (8, 5) and guess.either_pattern


def test_numbers_that_repeat_in_a_lattice_are_chance(monkeypatch: pytest.MonkeyPatch) -> None:
    def repeated(_: GreyImage, quads: np.ndarray, codes: Codes) -> TagCode:
        count = len(quads)
        return TagCode(codes.numbers[4 * (np.arange(count) % 3)], np.zeros(count, np.int64), np.ones(count))

    monkeypatch.setattr(unknown_tags, "read_tags", repeated)
    monkeypatch.setattr(TagObservations, "read_lone_tags", lambda *_: False)
    assert not TagObservations().look(0, shown(Board("b", 8, 6, 60.0, 60.0)))


def test_circle_grids_are_identified() -> None:
    board = Board("b", 5, 4, 60.0, 60.0, pattern=Circles(diameter_mm=30.0))
    guess = guess_board([shown(board)])
    assert guess is not None and guess.board.pattern.type == "circles" and sorted(guess.board.size) == [4, 5]


def test_rows_cut_off_by_the_image_do_not_make_a_smaller_board() -> None:
    """Two images show all rows but one, one image the whole board."""
    board = Board("b", 6, 5, 60.0, 60.0, pattern=Circles(diameter_mm=30.0))
    camera = bench_camera("regular")
    turn = exp_so3(np.radians([5.0, 3.0, 2.0]))
    place = Rigid3(turn, np.array([0.0, 0.0, 800.0]) - turn @ board.points().mean(axis=0))
    scene = BenchScene("c", (PlacedBoard(board, place),), (), camera, bench_field_deg("regular"))
    whole, rows = grey_image(scene.render()), scene.truth()[0].lattice()[..., 1]
    cut = whole[: int(0.5 * (rows[-2].max() + rows[-1].min()))]
    guess = guess_board([cut, whole, cut])
    assert guess is not None
    assert sorted(guess.board.size) == [5, 6]


def shown(board: Board) -> GreyImage:
    rng = np.random.default_rng(0)
    scene = one_board(rng, board=board, max_tilt_deg=35.0)
    return grey_image(scene.render(optics=Optics(0.5), noise_levels=2.0, rng=rng))


def test_two_aprilgrids_beside_each_other_are_two() -> None:
    boards = [Board("a", 8, 6, 40.0, 40.0, pattern=AprilGrid(0.3))]
    boards.append(Board("b", 6, 8, 40.0, 40.0, pattern=AprilGrid(0.3, first_tag=20)))
    camera = Pinhole((900, 600), np.array([800.0, 800.0, 449.5, 299.5]))
    facing = [Rigid3(np.eye(3), np.array([x, -100.0, 520.0])) for x in (-270.0, 30.0)]
    placed = [PlacedBoard(board, pose) for board, pose in zip(boards, facing, strict=True)]
    image = render(placed, camera, Rigid3.identity(), optics=Optics(0.5))
    guess = guess_board([grey_image(image)])
    assert guess is not None
    found = {board.pattern.first_tag: board.size for board in (guess.board, *guess.beside)}  # type: ignore[attr-defined]
    assert found == {0: (8, 6), 20: (6, 8)}


def test_aprilgrids_with_the_same_tags_in_rows_of_other_lengths_are_two() -> None:
    boards = [Board("b", columns, 6, 60.0, 60.0, pattern=AprilGrid(0.3)) for columns in (8, 10)]
    guess = guess_board([shown(board) for board in boards])
    assert guess is not None
    assert {board.size for board in (guess.board, *guess.beside)} == {(8, 6), (10, 6)}
    assert guess.board.size == (10, 6) and guess.images == (1,)


def test_faults_of_an_identified_board_are_reported() -> None:
    def board(columns: int, rows: int, pattern: Pattern) -> Board:
        return Board("b", columns, rows, 30.0, 30.0, pattern=pattern)

    old, new = (board(8, 5, Charuco("DICT_4X4_50", 20.0, legacy=legacy)) for legacy in (True, False))
    assert difference(old, new) == "this is the legacy pattern: set legacy_pattern = true"
    assert difference(new, new) is None
    white = board(8, 5, Charuco("DICT_4X4_50", 20.0, inverted=True))
    assert difference(new, white) == "black and white are not exchanged: set inverted = false"
    assert difference(white, new) == "black and white are exchanged: set inverted = true"
    assert difference(board(9, 6, Chessboard()), board(8, 6, Chessboard())) == (
        "9 x 6 inner corners are seen, 8 x 6 are declared"
    )
    dark, bright = (board(9, 7, Circles(inverted=inverted)) for inverted in (False, True))
    assert difference(dark, bright) == "inverted is true in the board file, false in the images: set inverted = false"
    assert difference(dark, dark) is None
    grids = [board(12, 10, AprilGrid(spacing)) for spacing in (0.3, 0.2)]
    assert difference(*grids) == "spacing is 0.2 in the board file, 0.3 in the images: set spacing = 0.3"
    assert difference(grids[0], new) == 'an aprilgrid board of 6 x 5 tags is seen; set type = "aprilgrid"'


def test_random_modules_of_large_markers_are_no_board_of_small_tags() -> None:
    """Four consecutive numbers of tag16h5, beside 35 markers."""
    board = Board("b", 9, 6, 60.0, 60.0, pattern=Charuco("DICT_7X7_50", 45.0, inverted=True))
    rng = np.random.default_rng(52)
    guess = guess_board([grey_image(one_board(rng, board=board).render(blur_px=0.8, noise_levels=2.0, rng=rng))])
    assert guess is not None and isinstance(guess.board.pattern, Charuco)
    assert (guess.board.size, guess.board.pattern.dictionary) == ((9, 6), "DICT_7X7_50")
