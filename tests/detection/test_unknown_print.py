"""Undescribed boards whose edges were moved by light or ink, or whose rows of markers were not read."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from detection_bench.scenes import one_board

from rigkit.cameras.pinhole import Pinhole
from rigkit.core.boards import Board
from rigkit.core.patterns.aprilgrid import AprilGrid
from rigkit.core.patterns.charuco import Charuco
from rigkit.detection.saddles.response import GreyImage, grey_image
from rigkit.detection.tags import unknown_tags
from rigkit.detection.tags.unknown_charuco import MarkerObservations
from rigkit.detection.tags.unknown_tags import TagObservations
from rigkit.detection.unknown import guess_board
from rigkit.detection.whole_charuco import has_first_row, has_next_row
from rigkit.geometry.rigid3 import Rigid3
from rigkit.synthetic.render import Optics, render
from rigkit.synthetic.scene import PlacedBoard

SURE_PLACES, SPREAD_PLACES = 0.01, 0.06
"""How well spacing is read between squares, and where edges have moved by up to a third of the gap."""


@pytest.mark.parametrize(
    ("pattern", "moved_px", "rough"),
    [
        (AprilGrid(0.3), 1, False),
        (AprilGrid(0.3, border=1, numbering="opencv", corner_squares=False), 1, True),
        (AprilGrid(0.4, corner_squares=False), 1, True),
    ],
    ids=["squares", "one", "two"],
)
def test_tags_whose_edges_have_moved(pattern: AprilGrid, moved_px: int, rough: bool) -> None:
    """Bright parts run over into dark ones, or dark ones into bright ones: the print is told, not what it looks like,
    or that it is not known; between squares corners stay where they were."""
    board = Board("b", 8, 6, 60.0, 60.0, pattern=pattern)
    images = []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        seen = one_board(rng, board=board, max_tilt_deg=35.0).render(
            optics=Optics(0.6, supersample=2), noise_levels=2.0, rng=rng
        )
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * abs(moved_px) + 1,) * 2)
        run = (cv2.dilate if moved_px > 0 else cv2.erode)(np.asarray(seen, np.uint8), disc)
        images.append(grey_image(cv2.GaussianBlur(run, (0, 0), 0.6)))
    guess = guess_board(images)
    assert guess is not None and isinstance(guess.board.pattern, AprilGrid)
    found = guess.board.pattern
    assert (found.border, found.corner_squares) == (pattern.border, pattern.corner_squares)
    assert abs(found.spacing - pattern.spacing) <= (SPREAD_PLACES if rough else SURE_PLACES)
    assert (guess.edges_moved, guess.determined) == (rough, not rough)


@pytest.mark.parametrize("sure", [False, True])
def test_edges_that_have_moved_too_far_for_the_border(sure: bool) -> None:
    """Both borders are named, with modules as large and tags as far apart; one image that is sure is enough."""
    seen = TagObservations()
    row, column = np.divmod(np.arange(12), 4)
    for image, either in enumerate((True, not sure)):
        own = unknown_tags._SeenTags(
            image=image,
            kind=("tag36h11", 2, True),
            numbers=np.arange(12),
            places=np.stack([column, row], axis=-1),
            steps=np.full(17, 1.45),
            edges_moved=either,
            border_ambiguous=either,
        )
        seen.kinds[own.kind] += 1
        seen.seen.append(own)
    (grid,) = unknown_tags.guessed_grids(seen)
    assert grid.board.size == (8, 6) and grid.edges_moved is not sure
    if sure:
        assert grid.other_border is None
    else:
        assert grid.other_border is not None and isinstance(grid.other_border.pattern, AprilGrid)
        assert (grid.other_border.pattern.border, grid.other_border.pattern.spacing) == (1, 0.81)


@pytest.mark.parametrize("step", [1.1, 3.5])
def test_tags_that_another_border_would_let_overlap_have_none(step: float) -> None:
    """Of narrow borders read as wide ones, and of tags far apart, which are no grid: neither ends in an error."""
    row, column = np.divmod(np.arange(12), 4)
    own = unknown_tags._SeenTags(
        image=0,
        kind=("tag36h11", 1, True),
        numbers=np.arange(12),
        places=np.stack([column, row], axis=-1),
        steps=np.full(17, step),
        edges_moved=True,
        border_ambiguous=True,
    )
    seen = TagObservations()
    seen.kinds[own.kind] += 1
    seen.seen.append(own)
    grids = unknown_tags.guessed_grids(seen)
    assert len(grids) == (step < 2.0)
    assert all(grid.other_border is None for grid in grids)


MARKED = Board("b", 10, 7, 60.0, 60.0, pattern=Charuco("DICT_4X4_50", 45.0))
LEGACY = replace(MARKED, pattern=Charuco("DICT_4X4_50", 45.0, legacy=True))


def straight(board: Board) -> list[GreyImage]:
    """Return images of 720 x 520 px of a board with squares of 50 px, corners from row 110 on."""
    camera = Pinhole((720, 520), np.array([500.0, 500.0, 110.0, 110.0]))
    places = [PlacedBoard(board, Rigid3(np.eye(3), [shift, 0.0, 600.0])) for shift in (0.0, 30.0)]
    return [
        grey_image(render([place], camera, Rigid3.identity(), optics=Optics(0.6, supersample=2))) for place in places
    ]


@pytest.mark.parametrize("board", [MARKED, LEGACY], ids=["today", "legacy"])
def test_whether_a_board_has_one_more_row_of_markers(board: Board) -> None:
    whole = straight(board)
    assert has_next_row(board, whole) is False
    assert has_next_row(replace(MARKED, rows=6), whole) is True
    # Below the row of squares before the fifth row of corners the frame ends.
    assert has_next_row(replace(MARKED, rows=4), [image[:330].copy() for image in whole]) is None


@pytest.mark.parametrize(
    ("level", "determined"), [(235.0, False), (0.0, None)], ids=["paper", "outside of a corrected picture"]
)
def test_bare_paper_ends_a_board_and_what_is_black_does_not(level: float, determined: bool | None) -> None:
    noise = np.random.default_rng(0).normal(0.0, 1.0, (520, 720)).astype(np.float32)
    whole = [image + noise * (level > 0.0) for image in straight(MARKED)]
    for image in whole:
        # Seven rows of corners, and the squares beyond the last, end 460 px down.
        image[461:] = level + noise[461:] * (level > 0.0)
    assert has_next_row(MARKED, whole) is determined


def test_paper_that_covers_a_part_of_a_row_does_not_end_a_board() -> None:
    whole = straight(MARKED)
    for image in whole:
        image[311:, 200:] = 235.0
    assert has_next_row(replace(MARKED, rows=4), whole) is not False


@pytest.mark.parametrize(("below", "determined"), [(5.0, False), (1.0, None)])
def test_the_frame_may_end_soon_after_a_board(below: float, determined: bool | None) -> None:
    assert has_next_row(MARKED, [image[: int(461 + below)].copy() for image in straight(MARKED)]) is determined


@pytest.mark.parametrize("first", [295, 325])
@pytest.mark.parametrize("board", [MARKED, LEGACY], ids=["today", "legacy"])
def test_paper_laid_along_rows_does_not_end_a_board(board: Board, first: int) -> None:
    """The fifth row of squares ends 310 px down."""
    whole = straight(board)
    for image in whole:
        image[first:] = 235.0
    assert has_next_row(replace(board, rows=4), whole) is not False


def test_a_textured_cover_does_not_end_a_board() -> None:
    whole = straight(MARKED)
    for image in whole:
        image[311:] = np.random.default_rng(0).uniform(20.0, 235.0, image[311:].shape)
    assert has_next_row(replace(MARKED, rows=4), whole) is None


def test_a_board_cut_out_along_its_squares_ends_in_front_of_anything() -> None:
    """Black squares end where a dark room begins a tenth of a square later."""
    whole = straight(MARKED)
    for image in whole:
        image[465:] = np.random.default_rng(0).uniform(20.0, 60.0, image[465:].shape)
    assert has_next_row(MARKED, whole) is False


def test_paper_laid_aslant_over_a_board_does_not_end_it() -> None:
    row, column = np.indices((520, 720))
    whole = straight(MARKED)
    for image in whole:
        image[row > 300 + 0.05 * (column - 60)] = 235.0
    assert has_next_row(replace(MARKED, rows=4), whole) is not False


def test_a_marked_board_that_the_frame_cuts_has_more_rows() -> None:
    guess = guess_board([image[:330].copy() for image in straight(MARKED)])
    assert guess is not None and guess.board.pattern.type == "charuco" and not guess.determined
    assert guess.sizes == ((10, 4),)


def test_whether_a_board_begins_with_the_first_row_read() -> None:
    """Four rows of squares have 22 markers."""
    numbered = replace(MARKED, rows=4, pattern=Charuco("DICT_4X4_50", 45.0, first_marker=20))
    assert has_first_row(numbered, straight(numbered)) and has_first_row(MARKED, [])
    later = replace(MARKED, rows=3, pattern=Charuco("DICT_4X4_50", 45.0, first_marker=22))
    assert not has_first_row(later, straight(MARKED))


def test_a_board_whose_first_rows_are_hidden_has_more() -> None:
    images = straight(MARKED)
    for image in images:
        image[:240] = 235.0
    guess = guess_board(images)
    assert guess is not None and guess.board.pattern.type == "charuco" and not guess.determined


def test_rows_that_were_not_read_are_added(monkeypatch: pytest.MonkeyPatch) -> None:
    """Blur hides markers, not where they are."""
    read = MarkerObservations.look

    def upper(self: MarkerObservations, index: int, image: GreyImage) -> bool:
        return read(self, index, image[:380].copy())

    monkeypatch.setattr(MarkerObservations, "look", upper)
    guess = guess_board(straight(MARKED))
    assert guess is not None and guess.determined and guess.board.size == (10, 7)
