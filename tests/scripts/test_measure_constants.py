"""How far a constant can be changed before results do."""

from __future__ import annotations

import measure_constants
from measure_constants import Outcome, changed, constants_of, margin

from rigkit.detection import doubtful
from rigkit.detection.checks import evidence, validate
from rigkit.detection.subpixel import whole_board


def test_a_constant_is_changed_wherever_it_is_used_and_comes_back() -> None:
    names = constants_of(evidence)
    assert "OFFSET" in names and "SCORE" not in names
    users = [module for module in (evidence, doubtful) if hasattr(module, "OFFSET")]
    before = evidence.OFFSET
    with changed(evidence, "OFFSET", 2.0) as differs:
        assert differs and all(2.0 * before == module.OFFSET for module in users)
    assert all(before == module.OFFSET for module in users)
    # Equal small integers are one object, and two constants of one name may be equal.
    own = whole_board.MIN_ROWS
    with changed(validate, "MIN_ROWS", 2.0):
        assert own == validate.MIN_ROWS // 2 == whole_board.MIN_ROWS


def test_the_margin_is_the_first_factor_that_loses_corners_or_finds_false_boards() -> None:
    usual, before = Outcome(1000, 0), evidence.OFFSET

    def outcome() -> Outcome:
        by = evidence.OFFSET / before
        return Outcome(1000 - (20 if by > 3.0 else 10 if by > 1.5 else 0), 1 if by < 0.3 else 0)

    assert margin(evidence, "OFFSET", outcome, usual, (1.25, 2.0, 4.0)) == "4: 20 corners lost"
    assert margin(evidence, "OFFSET", outcome, usual, (0.8, 0.5, 0.25)) == "0.25: 1 false boards"
    assert margin(evidence, "OFFSET", outcome, usual, (0.8, 0.5)) == "-"


def test_the_rendered_images_show_boards_of_every_kind_and_none() -> None:
    looks = list(measure_constants.rendered(1))
    assert {look.boards[0].board_id for look in looks if look.shown} == {b.board_id for b in measure_constants.BOARDS}
    assert any(not look.shown for look in looks)
