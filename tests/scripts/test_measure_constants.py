"""How far a constant can be changed before results do."""

from __future__ import annotations

import sys
from pathlib import Path
from types import ModuleType

import measure_constants
import numpy as np
import pytest
from measure_constants import Found, Look, changed, constants_of, effect, margin, readers_of, value_of

from rigkit.detection import doubtful
from rigkit.detection.checks import discontinuity, evidence, validate
from rigkit.detection.subpixel import edge_fit


def test_a_constant_is_changed_wherever_it_is_used_and_comes_back() -> None:
    names = constants_of(evidence)
    assert "OFFSET" in names and "SCORE" not in names and {"OF_EXPECTED_SIZE", "MIN_EXPECTED_CORNERS"} <= set(names)
    users = [module for module in (evidence, doubtful) if hasattr(module, "OFFSET")]
    before = evidence.OFFSET
    with changed(evidence, "OFFSET", 2.0) as differs:
        assert differs and all(2.0 * before == module.OFFSET for module in users)
    assert all(before == module.OFFSET for module in users)


def test_a_constant_of_another_module_with_the_same_name_and_number_is_not_changed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Equal small integers are one object.
    modules = []
    for name in ("one", "two"):
        file = tmp_path / f"{name}.py"
        file.write_text("FEWEST = 3\n")
        module = ModuleType(name)
        module.__dict__.update(FEWEST=3, __file__=str(file))
        monkeypatch.setitem(sys.modules, f"rigkit.detection.{name}", module)
        modules.append(module)
    with changed(modules[0], "FEWEST", 2.0):
        assert [vars(module)["FEWEST"] for module in modules] == [6, 3]
    assert [vars(module)["FEWEST"] for module in modules] == [3, 3]


def test_numbers_in_tuples_are_constants_too() -> None:
    assert {"OFFSET_PARTS[0]", "OFFSET_PARTS[2]"} <= set(constants_of(validate))
    before = validate.OFFSET_PARTS
    assert value_of(validate, "OFFSET_PARTS[1]") == before[1]
    with changed(validate, "OFFSET_PARTS[1]", 0.5):
        assert (before[0], 0.5 * before[1], before[2]) == validate.OFFSET_PARTS
    assert before == validate.OFFSET_PARTS


def test_what_functions_keep_is_computed_again_with_another_constant() -> None:
    before = discontinuity._rules().jump
    with changed(discontinuity, "JUMP", 2.0):
        assert discontinuity._rules().jump == pytest.approx(2.0 * before)
    assert discontinuity._rules().jump == before


def test_the_functions_that_read_a_constant_are_found_through_imports_too() -> None:
    names = {code.co_name for code in readers_of(edge_fit, "MAX_MOVE_PX")}
    assert "fit_whole_board" in names and "fit_edges" not in names


def found(corners: int, false: int = 0, *, off: float = 0.0, sigma: float = 1.0) -> Found:
    return Found({("board", k, 0): (off, 0.0, sigma) for k in range(corners)}, false)


def test_an_effect_is_lost_corners_false_boards_moved_corners_or_other_sigmas() -> None:
    usual = [found(1000)]
    assert effect(usual, [found(1000)], 1000) == "same"
    assert effect(usual, [found(995)], 1000) == "-"
    assert effect(usual, [found(980, 1)], 1000) == "20 corners lost and 1 false boards"
    # A corner that is found in another image does not make up for it.
    assert effect([found(500), found(0)], [found(0), found(500)], 500) == "500 corners lost"
    assert effect(usual, [found(1000, off=2.0)], 1000) == "corners move by 1.4 sigmas"
    assert effect(usual, [found(1000, sigma=np.exp(0.5))], 1000) == "sigmas change by 50%"
    assert effect(usual, [found(1000, off=0.1, sigma=1.01)], 1000) == "-"


class _ByOffset(Look):
    """A look that loses corners when `evidence.OFFSET` is larger, and finds a false board when it is much smaller."""

    def found(self) -> Found:
        by = evidence.OFFSET / BEFORE
        return found(1000 - (20 if by > 3.0 else 5 if by > 1.5 else 0), 1 if by < 0.3 else 0)


BEFORE = evidence.OFFSET


def test_the_margin_is_the_first_factor_that_has_an_effect() -> None:
    looks = [_ByOffset((), (), True)]

    def of(*factors: float) -> str:
        return margin(evidence, "OFFSET", looks, [found(1000)], factors, 1000)

    assert of(1.25, 2.0, 4.0) == "4: 20 corners lost"
    assert of(0.8, 0.5, 0.25) == "0.25: 1 false boards"
    assert of(0.8, 0.5) == "same"
    assert of(1.25, 2.0) == "-"


def test_the_rendered_images_show_boards_of_every_kind_and_none() -> None:
    looks = list(measure_constants.rendered(1))
    told = {look.boards[0].board_id for look in looks if look.shown and look.boards}
    assert told == {b.board_id for b in measure_constants.BOARDS}
    assert {(bool(look.boards), look.shown) for look in looks} == {(a, b) for a in (True, False) for b in (True, False)}


def test_the_functions_that_a_look_calls_are_noted() -> None:
    looks = [look for look in measure_constants.rendered(1) if look.shown and look.boards]
    result, calls = measure_constants.called_by(looks[0])
    assert len(result.corners) > 20
    (reader,) = (code for code in readers_of(edge_fit, "MAX_MOVE_PX") if code.co_name == "edge_rules")
    assert (reader.co_filename, reader.co_firstlineno) in calls
