"""Views with little information: a message or a sound result, never a crash or a sigma of zero."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from helpers.calibration_scenes import BOARD, SIZE, lens, random_views

from rigkit.calibration import assemble
from rigkit.calibration.calibrate import calibrate
from rigkit.calibration.choosing.candidate_fits import CandidateFits, ModelChoice, choose_lenses
from rigkit.calibration.choosing.choice import FittedModel
from rigkit.calibration.choosing.models_tried import ModelOutcome
from rigkit.calibration.solving.fit import Fit
from rigkit.calibration.solving.shape import shape_model
from rigkit.calibration.views.observations import Observations
from rigkit.core.boards import Board
from rigkit.core.detections import BoardView
from rigkit.core.errors import DegenerateError, InputError


def reg_views(count: int, rng: np.random.Generator) -> list[BoardView]:
    return random_views(lens("reg"), count, rng, reach_deg=33.0)[0]


def part_of(view: BoardView, corners: int, rng: np.random.Generator) -> BoardView:
    """Return the view with so many of its corners, anywhere on the board."""
    rows = rng.choice(len(view.grid), corners, replace=False)
    return replace(view, grid=view.grid[rows], pixels=view.pixels[rows], sigma_px=view.sigma_px[rows])


@pytest.mark.parametrize("model", ["brown", "kannala_brandt"])
def test_as_many_unknowns_as_corners_leave_no_camera(model: str, rng: np.random.Generator) -> None:
    """Whatever the camera, residuals are then next to nothing: they say nothing about how good it is."""
    (view,) = reg_views(1, rng)
    with pytest.raises(DegenerateError, match="as many unknowns"):
        calibrate([part_of(view, 7, rng)], SIZE, model=model, board="flat")


def test_a_degree_that_has_an_unknown_for_every_corner_is_not_chosen(rng: np.random.Generator) -> None:
    few = [part_of(view, 6, rng) for view in reg_views(2, rng)]
    result = calibrate(few, SIZE, model="scaramuzza", board="flat")
    assert result.sigma_px > 0.01
    reasons = {c.name: c.reason for c in result.candidates}
    assert "as many unknowns" in reasons["scaramuzza 8"]


IN_THE_IMAGE: dict[str, Callable[[BoardView], np.ndarray]] = {
    "on one spot": lambda view: np.full(view.pixels.shape, 500.0),
    "on the middle": lambda view: np.full(view.pixels.shape, (np.array(SIZE) - 1.0) / 2.0),
    "on a line": lambda view: view.pixels[:, :1] * [1.0, 0.5] + [0.0, 20.0],
}


@pytest.mark.parametrize("where", IN_THE_IMAGE)
def test_corners_on_one_line_of_the_image(where: str, rng: np.random.Generator) -> None:
    """One such view is left out, with words; a session of them is refused."""
    views = reg_views(9, rng)
    flat = [replace(view, pixels=IN_THE_IMAGE[where](view)) for view in views]
    result = calibrate([flat[0], *views[1:]], SIZE, model="brown")
    assert [image for image, _ in result.dropped] == [views[0].image]
    assert "one line of the image" in result.dropped[0][1]
    assert len(result.views) == 8
    with pytest.raises(InputError, match="one line of the image"):
        calibrate(flat, SIZE, model="brown")


@pytest.mark.parametrize("noise_px", [0.0, 0.2])
def test_the_same_image_many_times(noise_px: float, rng: np.random.Generator) -> None:
    """Nothing tells a bent board from another lens; which of the refusals comes first is a matter of rounding."""
    view = random_views(lens("reg"), 1, rng, reach_deg=33.0, noise_px=noise_px)[0][0]
    with pytest.raises(DegenerateError, match="all 8 images show the board at the same pose and count as one"):
        calibrate([replace(view, image=f"{k}.png") for k in range(8)], SIZE, model="brown")


def test_corners_anywhere_are_refused(rng: np.random.Generator) -> None:
    views = [replace(v, pixels=rng.uniform(0.0, 1200.0, v.pixels.shape)) for v in reg_views(5, rng)]
    with pytest.raises(DegenerateError):
        calibrate(views, SIZE, model="brown", board="flat")


def test_one_name_for_squares_of_two_sizes_is_an_error(rng: np.random.Generator) -> None:
    views = reg_views(2, rng)
    for other in (Board("9x6", 9, 6, 30.0, 31.0), Board("9x6", 9, 6, 31.0, 30.0), Board("9x6", 6, 9, 30.0, 30.0)):
        with pytest.raises(InputError, match="another size"):
            Observations.from_views([views[0], replace(views[1], board=other)])


def test_parts_of_boards_cost_no_more_than_their_corners(rng: np.random.Generator) -> None:
    """A part of a board that nothing names is a board of its own: only those often seen have corners to release."""
    bumps = rng.normal(size=(BOARD.corner_count, 3)) * [0.03, 0.03, 0.15]
    views = random_views(lens("reg"), 40, rng, reach_deg=33.0, noise_px=0.1, points_mm=BOARD.points() + bumps)[0]
    parts = [replace(v, board=replace(BOARD, board_id=f"part of {v.image}")) for v in views[20:]]
    observations = Observations.from_views([*views[:20], *parts])
    shape = shape_model("released", observations)
    assert shape.count == 11 + 3 * BOARD.corner_count
    result = calibrate([*views[:20], *parts], SIZE, model="brown", board="released")
    assert result.boards[0].kind == "released"
    found = {b.board_id: b.points_mm for b in result.boards}
    assert np.abs(found["9x6"] - BOARD.points()).max() > 0.1
    for part in parts:
        assert np.array_equal(found[part.board.board_id], BOARD.points())


def test_a_covariance_that_is_none_is_no_result(rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch) -> None:
    """Equations that were sound while models were compared may have no inverse once corners are left out."""
    views, _, _ = random_views(lens("reg"), 8, rng, reach_deg=33.0)
    sound = assemble._covariance

    def singular(observations: Observations, fit: Fit) -> Any:
        inverse, *rest = fit.normal.covariance
        inverse = inverse.copy()
        inverse[0, 0] = -1e10
        fit.normal.__dict__["covariance"] = (inverse, *rest)
        return sound(observations, fit)

    monkeypatch.setattr(assemble, "_covariance", singular)
    with pytest.raises(DegenerateError, match="brown camera is not identifiable"):
        calibrate(views, SIZE, model="brown", board="flat")


def test_a_better_model_that_its_own_images_do_not_determine_is_not_taken(
    monkeypatch: pytest.MonkeyPatch, rng: np.random.Generator
) -> None:
    """Of images that contradict each other, few agree with it."""
    bowed = BOARD.points() + 0.5 * np.outer(np.cos(BOARD.points()[:, 0] / 50.0), [0.0, 0.0, 1.0])
    views = random_views(lens("reg"), 8, rng, reach_deg=30.0, noise_px=0.05, points_mm=bowed)[0]
    outcome_of, found = CandidateFits.outcome_of, list[str]()

    def choose(cameras: Sequence[Sequence[FittedModel]]) -> list[ModelChoice]:
        (choice,) = choose_lenses(cameras)
        # At first the best on flat boards, then another one.
        found.append(choice.model if not found else "eucm" if found[0] == "ucm" else "ucm")
        return [replace(choice, model=found[-1])]

    def outcome(fits: CandidateFits, model: str) -> ModelOutcome:
        if model == found[0]:
            return outcome_of(fits, model)
        raise DegenerateError("not identifiable")

    monkeypatch.setattr("rigkit.calibration.calibrate.choose_lenses", choose)
    monkeypatch.setattr(CandidateFits, "outcome_of", outcome)
    assert calibrate(views, SIZE, model="auto", board="warp", folds=2).camera.model == found[0] != found[1]
