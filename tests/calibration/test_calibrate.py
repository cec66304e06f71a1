"""calibrate(): from views without an initial guess to the right camera, or to a message with the reason."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from helpers.calibration_scenes import (
    BOARD,
    REACH_DEG,
    SIZE,
    heldout,
    lens,
    projection_difference,
    random_views,
    with_outliers,
)
from helpers.session_scenes import disturbed

from rigkit.calibration.calibrate import _largest_size_chosen, calibrate
from rigkit.calibration.certainty.uncertainty import FarProjection
from rigkit.calibration.result import Calibration, Candidate
from rigkit.calibration.solving.fit import fit_model, robust_sigma
from rigkit.calibration.solving.initialise import initialise
from rigkit.calibration.solving.poses import find_poses
from rigkit.calibration.solving.state import State, evaluate
from rigkit.calibration.views.observations import Observations
from rigkit.cameras.double_sphere import DoubleSphere
from rigkit.cameras.registry import MODELS
from rigkit.cameras.scaramuzza import Scaramuzza
from rigkit.core.boards import Board
from rigkit.core.detections import BoardView
from rigkit.core.errors import DegenerateError, InputError

NOISE_PX = 0.2
START_PX = 2.0
"""Median error of the start before any iteration: measured 0.2 to 0.6 px; a wrong sign of one tilt gives tens."""
DIFFERENCE_PX = {"reg": 3.0, "wide": 1.5, "fish": 0.6, "fish200": 0.6}
"""Largest RMS difference to the true lens over its field, 12 views, 0.2 px noise: three times the median."""
MODEL = {"reg": "brown", "wide": "kannala_brandt", "fish": "kannala_brandt", "fish200": "kannala_brandt"}


@pytest.mark.parametrize("count", [1, 2, 12])
@pytest.mark.parametrize("name", ["reg", "wide", "fish", "fish200"])
def test_start_needs_no_guess(name: str, count: int, rng: np.random.Generator) -> None:
    views, _, _ = random_views(lens(name), count, rng, reach_deg=REACH_DEG[name])
    observations = Observations.from_views(views)
    best, *_ = initialise(observations, SIZE, MODELS[MODEL[name]], None)
    norm = np.where(observations.present, np.linalg.norm(evaluate(best, observations).px, axis=-1), np.nan)
    assert np.median(norm[observations.present]) < START_PX


def test_pixels_of_no_board_are_refused_or_badly_explained() -> None:
    grid, refused = BOARD.grid(), 0
    for seed in range(4):
        pixels = np.random.default_rng(seed).uniform(0.0, 600.0, (3, *grid.shape))
        views = [BoardView(f"{k}", BOARD, grid, own, np.full(len(grid), 0.1)) for k, own in enumerate(pixels)]
        observations = Observations.from_views(views)
        try:
            assert robust_sigma(fit_model(observations, (640, 480), MODELS["brown"], None), observations) > 100.0
        except DegenerateError as error:
            assert "no brown camera fits the views, even roughly" in str(error)
            refused += 1
    assert refused


@pytest.mark.parametrize("name", ["reg", "wide", "fish", "fish200"])
def test_recovers_the_lens(name: str, rng: np.random.Generator) -> None:
    views, rotation, translation = random_views(lens(name), 12, rng, reach_deg=REACH_DEG[name])
    result = calibrate(views, SIZE, model=MODEL[name], board="flat")
    difference = projection_difference(result.camera, lens(name), REACH_DEG[name])
    assert np.sqrt((difference**2).mean()) < DIFFERENCE_PX[name]
    assert result.sigma_px == pytest.approx(NOISE_PX, rel=0.08)
    assert result.heldout_rms_px is not None
    assert result.heldout_rms_px > result.rms_px
    assert result.dropped == () and len(result.views) == 12
    for view, r, t in zip(result.views, rotation, translation, strict=True):
        assert np.abs(view.cam_from_board.rotation - r).max() < 0.02
        assert np.linalg.norm(view.cam_from_board.translation_mm - t) < 0.02 * np.linalg.norm(t)


def test_scaramuzza_degree_by_heldout_error(rng: np.random.Generator) -> None:
    """Degree 4 cannot follow 185 degrees; the choice must see that, and not take more than it needs."""
    views, _, _ = random_views(lens("fish"), 15, rng, reach_deg=92.5, noise_px=0.05)
    result = calibrate(views, SIZE, board="flat")
    tried = {c.name: c for c in result.candidates}
    assert heldout(tried["scaramuzza 4"]) > 1.2 * heldout(result)
    assert result.camera.model == "scaramuzza"
    assert sum(c.chosen for c in result.candidates) == 1
    assert np.sqrt((projection_difference(result.camera, lens("fish"), 90.0) ** 2).mean()) < 0.2


def test_a_lens_of_220_degrees_takes_the_largest_degree_and_is_told_so(rng: np.random.Generator) -> None:
    """f = rho cot(theta) has a pole at 180 degrees: no polynomial follows the rim of such a lens."""
    camera = DoubleSphere(SIZE, np.array([330.0, 330.0, 808.0, 615.0, -0.2, 0.6]))
    views, _, _ = random_views(camera, 20, rng, reach_deg=108.0, noise_px=0.01)
    result = calibrate(views, SIZE, board="flat")
    eight = calibrate(views, SIZE, degree=8, board="flat")
    off, before = (
        float(np.sqrt((projection_difference(c.camera, camera, 105.0) ** 2).mean())) for c in (result, eight)
    )
    assert off < 0.5 * before
    assert any("scaramuzza 10, the largest size of this model" in verdict.message for verdict in result.verdicts)
    assert not any("the largest size" in verdict.message for verdict in eight.verdicts)


@pytest.mark.parametrize("chosen", [False, True])
def test_the_largest_size_of_a_model_is_named_where_it_is_chosen(chosen: bool) -> None:
    beyond = [("scaramuzza 8", Scaramuzza, 8), ("scaramuzza 10", Scaramuzza, 10)]
    tried = Candidate("scaramuzza 10", 14, 0.1, 0.1, chosen, "")
    result = cast(Calibration, SimpleNamespace(candidates=(tried,)))
    said = [finding.message for finding in _largest_size_chosen(beyond, result, ())]
    assert ["scaramuzza 10, the largest size of this model" in words for words in said] == [True] * chosen
    assert not [*_largest_size_chosen(beyond, result, ("model",)), *_largest_size_chosen([], result, ())]


def test_rational_brown_converges(rng: np.random.Generator) -> None:
    """Numerator and denominator of the rational distortion must not run away together."""
    views, _, _ = random_views(lens("reg"), 20, rng, reach_deg=33.0)
    result = calibrate(views, SIZE, model="brown", degree=8, board="flat")
    assert result.convergence.converged
    assert np.abs(result.camera.parameters[4:]).max() < 10.0
    five = calibrate(views, SIZE, model="brown", degree=5, board="flat")
    assert heldout(result) < 1.02 * heldout(five)


def test_exact_corners_give_the_exact_lens(rng: np.random.Generator) -> None:
    views, _, _ = random_views(lens("fish"), 6, rng, reach_deg=92.5, noise_px=0.0)
    result = calibrate(views, SIZE, model="kannala_brandt", board="flat", folds=0)
    assert projection_difference(result.camera, lens("fish"), 90.0).max() < 1e-5


def test_outliers_are_found_listed_and_harmless(rng: np.random.Generator) -> None:
    clean, _, _ = random_views(lens("fish"), 10, rng, reach_deg=92.5)
    views = with_outliers(clean, 0.05, 40.0, rng)
    moved = {
        (a.image, *cell)
        for a, b in zip(views, clean, strict=True)
        for cell in a.grid[np.linalg.norm(a.pixels - b.pixels, axis=1) > 5.0].tolist()
    }
    assert len(moved) > 10
    result = calibrate(views, SIZE, model="kannala_brandt", board="flat", folds=0)
    assert {(o.image, o.column, o.row) for o in result.outliers} == moved
    assert np.sqrt((projection_difference(result.camera, lens("fish"), 90.0) ** 2).mean()) < DIFFERENCE_PX["fish"]


def test_view_that_disagrees_is_dropped_with_the_reason(rng: np.random.Generator) -> None:
    views, _, _ = random_views(lens("wide"), 8, rng, reach_deg=55.0)
    scrambled = replace(views[3], pixels=views[3].pixels[rng.permutation(54)])
    result = calibrate([*views[:3], scrambled, *views[4:]], SIZE, model="kannala_brandt", board="flat", folds=0)
    assert [image for image, _ in result.dropped] == ["003.png"]
    assert "agree" in result.dropped[0][1]
    assert len(result.views) == 7


def test_partial_views_and_unequal_sigmas(rng: np.random.Generator) -> None:
    views, _, _ = random_views(lens("fish"), 10, rng, reach_deg=92.5, noise_px=0.1)
    some = []
    for k, view in enumerate(views):
        seen = rng.permutation(54)[: 20 + 3 * k]
        extra = np.where(np.arange(len(seen)) % 2 == 0, 0.0, 0.5)
        pixels = view.pixels[seen] + extra[:, None] * rng.normal(size=(len(seen), 2))
        some.append(BoardView(view.image, BOARD, view.grid[seen], pixels, np.hypot(0.1, extra)))
    weighted = calibrate(some, SIZE, model="kannala_brandt", board="flat", folds=0)
    blind = [BoardView(v.image, BOARD, v.grid, v.pixels, np.full(len(v.grid), 0.3)) for v in some]
    unweighted = calibrate(blind, SIZE, model="kannala_brandt", board="flat", folds=0)
    errors = [
        np.sqrt((projection_difference(c.camera, lens("fish"), 90.0) ** 2).mean()) for c in (weighted, unweighted)
    ]
    assert errors[0] < errors[1]


def test_blurred_views_say_no_more_of_the_headline_than_they_are_worth(rng: np.random.Generator) -> None:
    truth = lens("fish")
    views, _, _ = random_views(truth, 12, rng, reach_deg=REACH_DEG["fish"])
    blurred = 10.0 * NOISE_PX
    poor = [
        replace(
            v, pixels=v.pixels + blurred * rng.standard_normal(v.pixels.shape), sigma_px=np.full(len(v.grid), blurred)
        )
        for v in views[:4]
    ]
    sharp = calibrate(views[4:], SIZE, model="kannala_brandt", board="flat")
    both = calibrate([*poor, *views[4:]], SIZE, model="kannala_brandt", board="flat")
    assert len(both.views) == 12
    # Not weighted, the four would make it six times as large.
    assert heldout(both) == pytest.approx(heldout(sharp), rel=0.15)


def test_input_is_not_modified(rng: np.random.Generator) -> None:
    views, _, _ = random_views(lens("wide"), 6, rng, reach_deg=55.0)
    before = [v.pixels.copy() for v in views]
    calibrate(views, SIZE, model="kannala_brandt", board="warp")
    assert all((v.pixels == b).all() for v, b in zip(views, before, strict=True))


def test_views_of_any_length(rng: np.random.Generator) -> None:
    """Each view of the result has its own corners, residuals against its own pose, and cannot be written to."""
    views, _, _ = random_views(lens("wide"), 8, rng, reach_deg=55.0)
    seen = [np.sort(rng.choice(54, 20 + 4 * k, replace=False)) for k in range(len(views))]
    parts = [
        BoardView(v.image, v.board, v.grid[s], v.pixels[s], v.sigma_px[s]) for v, s in zip(views, seen, strict=True)
    ]
    result = calibrate(parts, SIZE, model="kannala_brandt", board="flat")
    for part, view in zip(parts, result.views, strict=True):
        projected, _ = result.camera.project(view.cam_from_board.apply(part.points()))
        assert np.abs(view.residuals_px - (part.pixels - projected)).max() < 1e-9
        assert (view.grid == part.grid).all() and view.kept.all() and view.rms_px < 2.0 * NOISE_PX
        for array in (view.grid, view.pixels, view.residuals_px, view.kept):
            assert not array.flags.writeable
    assert result.corner_count == sum(len(s) for s in seen)


def test_uncertainty_at_corners_from_pixels_or_points(rng: np.random.Generator) -> None:
    """The way back from the pixels gives what the solved points give, but for the residuals."""
    views, _, _ = random_views(lens("reg"), 8, rng, reach_deg=33.0)
    result = calibrate(views, SIZE, model="brown", board="flat", folds=0)
    there = FarProjection.of(result, from_boards=True).at_corners_px
    assert there == pytest.approx(FarProjection.of(result).at_corners_px, rel=0.01)


def test_few_images_are_left_out_one_at_a_time(rng: np.random.Generator) -> None:
    views, _, _ = random_views(lens("wide"), 3, rng, reach_deg=55.0)
    assert heldout(calibrate(views, SIZE, model="kannala_brandt")) > 0.0
    assert calibrate(views[:2], SIZE, model="kannala_brandt").heldout_rms_px is None


def test_a_board_is_not_bent_to_what_corners_of_an_image_have_in_common() -> None:
    """To single corners that is what a bent board would be (by BIC in all six); to other images it is not."""
    kinds = []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        views, _, _ = random_views(lens("wide"), 4, rng, reach_deg=REACH_DEG["wide"], noise_px=0.0)
        kinds.append(calibrate(disturbed(views, rng, 0.1), SIZE, model="kannala_brandt").boards[0].kind)
    assert kinds.count("flat") >= 3


def test_bad_input_says_what_to_do(rng: np.random.Generator) -> None:
    views, _, _ = random_views(lens("wide"), 3, rng, reach_deg=55.0)
    with pytest.raises(InputError, match="no views"):
        calibrate([], SIZE)
    with pytest.raises(InputError, match="corners outside 640x480"):
        calibrate(views, (640, 480))
    with pytest.raises(InputError, match="unknown; known"):
        calibrate(views, SIZE, model="thin_lens")
    with pytest.raises(InputError, match="board shape 'bent'"):
        calibrate(views, SIZE, board="bent")
    row = BoardView("row.png", BOARD, views[0].grid[:9], views[0].pixels[:9], views[0].sigma_px[:9])
    with pytest.raises(InputError, match="one line"):
        calibrate([row], SIZE)
    few = BoardView("few.png", BOARD, views[0].grid[:4], views[0].pixels[:4], views[0].sigma_px[:4])
    assert calibrate([*views, few], SIZE, model="kannala_brandt").dropped[0][0] == "few.png"
    other = BoardView("other.png", Board("9x6", 9, 6, 25.0, 25.0), views[0].grid, views[0].pixels, views[0].sigma_px)
    with pytest.raises(InputError, match="another size in another view"):
        calibrate([*views, other], SIZE)


def test_boards_parallel_to_the_image_leave_the_focal_length_open(rng: np.random.Generator) -> None:
    camera = MODELS["pinhole"](SIZE, np.array([1364.0, 1364.0, 808.0, 615.0]))
    views = []
    for k in range(8):
        points = BOARD.points() + np.array([rng.uniform(-250, 0), rng.uniform(-150, 0), 600.0 + 40.0 * k])
        pixels = camera.project(points)[0] + 0.1 * rng.normal(size=(54, 2))
        views.append(BoardView(f"{k}.png", BOARD, BOARD.grid(), pixels, np.full(54, 0.1)))
    with pytest.raises(DegenerateError, match="tilted"):
        calibrate(views, SIZE, model="pinhole", board="flat")


@pytest.mark.parametrize("reach_deg", [30.0, 50.0, 70.0, 92.5])
def test_auto_is_as_good_as_the_best_model(rng: np.random.Generator, reach_deg: float) -> None:
    camera = lens("wide" if reach_deg < 60.0 else "fish")
    views, _, _ = random_views(camera, 20, rng, reach_deg=reach_deg)
    result = calibrate(views, SIZE, model="auto", board="flat")
    held = [c.heldout_rms_px for c in result.candidates if c.heldout_rms_px is not None]
    assert len(held) >= 10 and heldout(result) < 1.02 * min(held)
    known = calibrate(views, SIZE, model="kannala_brandt", board="flat")
    covered = np.concatenate([v.pixels for v in views])
    off, least = (
        float(np.sqrt(np.mean(projection_difference(c.camera, camera, 0.95 * reach_deg, covered=covered) ** 2)))
        for c in (result, known)
    )
    # The true model is one of those tried: what another costs in the lens is chance.
    assert off < 1.5 * least + 0.05
    assert all(c.reason for c in result.candidates)
    assert not any("only one" in c.reason for c in result.candidates)
    assert any("only one" in c.reason for c in known.candidates)


def test_poses_of_views_that_hardly_project_raise_nothing(rng: np.random.Generator) -> None:
    views, rotation, translation = random_views(lens("fish"), 12, rng, reach_deg=92.5)
    observations = Observations.from_views(views)
    # Behind the camera and facing away: at most a corner or two project, if any.
    away = State.start(lens("fish"), rotation @ np.diag([1.0, -1.0, -1.0]), -translation, observations)
    found = find_poses(observations, away, observations.weight, 0.5)
    assert np.median(np.linalg.norm(evaluate(found, observations).px, axis=-1)) < 1.0


@pytest.mark.parametrize("seed", [1, 2])
def test_lens_and_board_are_chosen_together(seed: int) -> None:
    """On a bent board that counts as flat another lens than the true one predicts the images best."""
    x, y = (BOARD.grid() / (np.array(BOARD.size) - 1.0) * 2.0 - 1.0).T
    rng = np.random.default_rng(seed)
    bent = BOARD.points()
    bent[:, 2] += 0.5 * (1.0 - x * x) * rng.choice([-1.0, 1.0]) + 0.15 * x * y
    views, _, _ = random_views(lens("reg"), 20, rng, reach_deg=33.0, noise_px=0.05, points_mm=bent)
    assert calibrate(views, SIZE, model="auto", board="flat").camera.model != "brown"
    together = calibrate(views, SIZE, model="auto")
    assert together.camera.model == "brown" and together.boards[0].kind != "flat"
    chosen = [candidate.name for candidate in together.candidates if candidate.chosen]
    assert chosen[0] == "brown 5" and len(chosen) == 2
