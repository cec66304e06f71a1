"""Equal cameras of a rig share a lens model, and the uncertainty between models is part of the sigmas."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.calibration_scenes import BOARD, REACH_DEG, SIZE, lens, projection_difference, random_views

from rigkit.calibration import calibrate as module
from rigkit.calibration.calibrate import calibrate, calibrate_together
from rigkit.calibration.certainty import uncertainty
from rigkit.calibration.certainty.uncertainty import (
    Along,
    FarProjection,
    projection_design,
    step_to_lens,
    worst_direction,
)
from rigkit.calibration.choosing.between_models import rival_fits, rival_shapes
from rigkit.calibration.choosing.candidate_fits import choose_lenses, like_cameras
from rigkit.calibration.choosing.choice import FittedModel, HeldOut, choose, converged_ones, described
from rigkit.calibration.choosing.models_tried import ModelOutcome, Request
from rigkit.calibration.result import Rival
from rigkit.calibration.solving.fit import Fit, fit_model
from rigkit.calibration.solving.solver import Convergence
from rigkit.calibration.views.observations import Observations
from rigkit.cameras.kannala_brandt import KannalaBrandt
from rigkit.cameras.registry import camera_model
from rigkit.core.progress import silent
from rigkit.geometry.rotation import exp_so3

IMAGES = 12
FOLLOWED_PX = 1e-4
"""A lens that another model can show is followed to second order of a difference of a tenth of a pixel."""


@pytest.fixture(scope="module")
def fits() -> dict[str, tuple[Observations, Fit]]:
    """Return fits of three models to one set of views."""
    views, *_ = random_views(lens("reg"), IMAGES, np.random.default_rng(3), reach_deg=REACH_DEG["reg"])
    observations = Observations.from_views(views)
    return {name: (observations, fit_model(observations, SIZE, camera_model(name), None)) for name in ("ucm", "eucm")}


def lenses(fits: dict[str, tuple[Observations, Fit]], eucm_better_by: np.ndarray) -> list[FittedModel]:
    """Return two models, of which eucm errs by so much less in each image."""
    base = 1.0 + 0.1 * np.sin(np.arange(IMAGES))
    return [FittedModel("ucm", fits["ucm"][1], base), FittedModel("eucm", fits["eucm"][1], base - eucm_better_by)]


def scatter(mean: float, size: float) -> np.ndarray:
    way = np.where(np.arange(IMAGES) % 2, 1.0, -1.0)
    return mean + size * way


def test_twins_share_the_model_that_their_images_together_support(fits: dict[str, tuple[Observations, Fit]]) -> None:
    # Each alone is within a standard error, both together are not.
    unsure = lenses(fits, scatter(0.03, 0.14))
    sure = lenses(fits, scatter(0.06, 0.1))
    assert [c.model for c in choose_lenses([unsure])] == ["ucm"]
    assert [c.model for c in choose_lenses([sure])] == ["eucm"]
    together = choose_lenses([unsure, sure])
    assert [c.model for c in together] == ["eucm", "eucm"]
    assert together[0].likely == together[1].likely


def test_a_camera_that_clearly_contradicts_its_twins_keeps_a_lens_of_its_own(
    fits: dict[str, tuple[Observations, Fit]],
) -> None:
    against = lenses(fits, scatter(-0.2, 0.05))
    sure = lenses(fits, scatter(0.6, 0.1))
    assert [c.model for c in choose_lenses([sure, against, sure])] == ["eucm", "ucm", "eucm"]


def test_likely_is_how_often_images_drawn_anew_choose_a_model() -> None:
    rng = np.random.default_rng(0)
    same, worse = 1.0 + 0.1 * rng.normal(size=(2, 40))
    even = HeldOut(["a", "b"], [1, 1], np.stack([same, worse - worse.mean() + same.mean()])).likely()
    assert 0.4 < even["a"] < 0.6
    clear = HeldOut(["a", "b"], [1, 1], np.stack([same, same + 0.01])).likely()
    assert clear == {"a": 1.0, "b": 0.0}


def test_models_that_err_alike_but_for_rounding_share() -> None:
    """Order that images are sure of says nothing of lenses where it is a thousandth of a pixel; a model of many numbers
    more is no rival by that."""
    same = np.random.default_rng(0).uniform(0.9, 1.1, 20)
    rows = np.stack([same, same + 0.001, same + 0.001, same + 0.03])
    names = ["kannala_brandt", "brown 5", "scaramuzza 8", "ucm"]
    assert HeldOut(names, [8, 9, 12, 5], rows).likely()["kannala_brandt"] == 1.0
    shared = HeldOut(names, [8, 9, 12, 5], rows, alike=0.01).likely()
    assert [shared[name] for name in names] == pytest.approx([0.5, 0.5, 0.0, 0.0])


def test_twins_have_images_of_one_size_and_nearly_one_focal_length() -> None:
    reg, wide = lens("reg"), lens("wide")
    near = reg.with_parameters(reg.parameters * np.array([1.03, 1.03, *[1.0] * 7]))
    assert like_cameras([reg, wide, near]) == [[0, 2], [1]]
    small = KannalaBrandt((800, 600), wide.parameters)
    assert like_cameras([wide, small]) == [[0], [1]]


def test_a_model_that_did_not_converge_is_not_chosen_beside_one_that_did(
    fits: dict[str, tuple[Observations, Fit]],
) -> None:
    """Of a lens without distortion on bent boards a double sphere was taken, and called bad as it did not converge."""
    one, other = lenses(fits, np.zeros(IMAGES))
    stopped = Convergence(iterations=60, converged=False, reason="stopped after 60 iterations")
    creeping = replace(other, fit=replace(other.fit, convergence=stopped))
    assert converged_ones([creeping, one]) == [one]
    assert converged_ones([creeping]) == [creeping]
    assert creeping.heldout is not None
    better = replace(creeping, heldout=0.5 * creeping.heldout)
    assert choose([better, one]) is one
    assert HeldOut.of([[better, one]]).names == [one.name]
    assert described([better, one], one)[0].reason == "its solver was stopped before it converged"


def test_another_lens_is_followed_where_the_model_can() -> None:
    camera = lens("wide")
    rng = np.random.default_rng(1)
    rays = np.stack([*rng.uniform(-0.7, 0.7, (2, 300)), np.ones(300)], axis=-1)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    step = 1e-4 * camera.parameters
    turn = exp_so3(np.array([0.002, -0.001, 0.003]))
    other = camera.with_parameters(camera.parameters + step)
    found, rotation = step_to_lens(camera, other, rays @ turn.T, np.abs(step))
    pixels = camera.project(rays @ turn.T)[0]
    there = other.project(rays @ turn.T @ rotation.T)[0]
    design = projection_design(camera, rays @ turn.T)[:, : camera.parameters.size]
    assert np.abs(pixels + np.einsum("ipm,p->mi", design, found) - there).max() < FOLLOWED_PX


def test_where_one_model_is_clearly_the_best_the_choice_adds_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    views, *_ = random_views(lens("reg"), 20, np.random.default_rng(3), reach_deg=REACH_DEG["reg"], noise_px=0.02)
    found = calibrate(views, SIZE, model="auto", board="flat")
    assert found.camera.model == "brown"
    assert found.rivals == ()
    monkeypatch.setattr(module, "rival_fits", lambda *_: [])
    np.testing.assert_array_equal(calibrate(views, SIZE, model="auto", board="flat").covariance, found.covariance)


def test_models_in_doubt_widen_the_sigmas_by_their_difference(monkeypatch: pytest.MonkeyPatch) -> None:
    # Few and noisy images in a narrow part of the view: many models show them as well.
    views, *_ = random_views(lens("reg"), 8, np.random.default_rng(5), reach_deg=REACH_DEG["reg"], noise_px=0.4)
    found = calibrate(views, SIZE, model="auto", board="flat")
    monkeypatch.setattr(module, "rival_fits", lambda *_: [])
    alone = calibrate(views, SIZE, model="auto", board="flat")
    assert found.rivals
    assert any("bootstrap samples" in c.reason for c in found.candidates)
    np.testing.assert_array_equal(found.camera.parameters, alone.camera.parameters)
    more = np.linalg.eigvalsh(found.frame_covariance - alone.frame_covariance)
    assert more.max() > 0.0
    assert more.min() > -1e-9 * more.max()
    corners = np.concatenate([view.pixels for view in found.views])
    differ = max(
        projection_difference(rival.camera, found.camera, 90.0, covered=corners).max() for rival in found.rivals
    )
    widened = np.sqrt(
        np.nanmax(FarProjection.of(found).at_corners_px ** 2 - FarProjection.of(alone).at_corners_px ** 2)
    )
    assert 0.0 < widened < differ


def test_a_richer_rival_counts_its_own_uncertainty_where_no_board_was() -> None:
    views, *_ = random_views(lens("reg"), 12, np.random.default_rng(1), reach_deg=20.0)
    found = calibrate(views, SIZE, model="eucm", board="flat", folds=0)
    richer = calibrate(views, SIZE, model="scaramuzza", degree=6, board="flat", folds=0)
    unsure = replace(found, rivals=(Rival("scaramuzza 6", richer.camera, 0.5),))
    alone, both, own = (FarProjection.of(one) for one in (found, unsure, richer))
    rim, _ = found.camera.unproject(np.array([[208.0, 615.0], [1408.0, 615.0], [808.0, 40.0], [400.0, 200.0]]))
    known, open_ = (
        worst_direction(one.covariance(rim) - one.beyond_model(Along.of(one.camera, rim))) for one in (alone, own)
    )
    assert (open_ > 1.5 * known).all()
    away = np.array([np.outer(d, d) for d in both.shifts_px(Along.of(found.camera, rim))[0]])
    added = worst_direction(both.covariance(rim) - alone.covariance(rim) - away) ** 2
    assert added == pytest.approx(0.5 * (open_**2 - known**2), rel=0.3)
    # Where boards were it knows nearly as much.
    there = both.corners.rays
    sizes = [np.trace(one.covariance(there), axis1=1, axis2=2).mean() for one in (alone, both)]
    assert sizes[0] <= sizes[1] < 1.5 * sizes[0]


def test_errors_name_the_camera_of_a_rig() -> None:
    views, *_ = random_views(lens("reg"), 6, np.random.default_rng(3), reach_deg=REACH_DEG["reg"])
    request = Request(size_px=SIZE, model="nonsense", degree=None, board="flat", folds=0, progress=silent)
    with pytest.raises(Exception, match=r"camera 'left': .*nonsense"):
        calibrate_together([("left", views, request)])


def test_cameras_of_a_rig_come_in_their_order() -> None:
    rng = np.random.default_rng(2)
    request = Request(size_px=SIZE, model="auto", degree=None, board="flat", folds=0, progress=silent)
    asked = [
        (name, random_views(lens(name), 8, rng, reach_deg=REACH_DEG[name])[0], request)
        for name in ("reg", "wide", "reg")
    ]
    found = calibrate_together(asked)
    focal = [lens(name).focal_px for name in ("reg", "wide", "reg")]
    np.testing.assert_allclose([c.camera.focal_px for c in found], focal, rtol=0.05)


def test_the_chosen_lens_in_another_size_is_no_rival(fits: dict[str, tuple[Observations, Fit]]) -> None:
    observations, eucm = fits["eucm"]
    small, large = (fit_model(observations, SIZE, camera_model("scaramuzza"), order) for order in (4, 6))
    options = [FittedModel("scaramuzza 6", large), FittedModel("eucm", eucm)]
    likely = {"scaramuzza 6": 0.7, "eucm": 0.3}
    assert [one.rival.name for one in rival_fits(observations, small, options, likely)] == ["eucm"]
    both = [*options, FittedModel("scaramuzza 4", small)]
    assert [one.rival.name for one in rival_fits(observations, small, both, likely)] == ["scaramuzza 6", "eucm"]


def test_a_shape_of_the_board_that_predicts_about_as_well_is_a_rival(fits: dict[str, tuple[Observations, Fit]]) -> None:
    flat, bent = lenses(fits, scatter(0.0, 0.1))
    shapes = [replace(flat, name="scaramuzza 5"), replace(bent, name="board warp")]
    for chosen, other in (shapes, shapes[::-1]):
        (rival,) = rival_shapes(chosen, shapes)
        assert rival.rival.name == "board flat" and 0.3 < rival.rival.likely < 0.7
        assert rival.state is other.fit.state
    worse = replace(shapes[1], heldout=1.0 + np.asarray(bent.heldout))
    assert rival_shapes(shapes[0], [shapes[0], worse]) == []
    unknown = [replace(one, heldout=None) for one in shapes]
    assert rival_shapes(unknown[0], unknown) == []


def test_boards_in_doubt_widen_the_sigmas_by_what_they_make_of_the_lens(monkeypatch: pytest.MonkeyPatch) -> None:
    # A board bowed by half a millimetre, in five noisy images: flat or not, they do not tell.
    x, y = (BOARD.points()[:, :2] / BOARD.points()[:, :2].max(axis=0)).T
    bowed = BOARD.points() + np.stack([0.0 * x, 0.0 * x, 2.0 * x * (1.0 - x) + 0.0 * y], axis=-1)
    rng = np.random.default_rng(0)
    views, *_ = random_views(lens("reg"), 5, rng, reach_deg=REACH_DEG["reg"], noise_px=0.4, points_mm=bowed)
    found = calibrate(views, SIZE, model="kannala_brandt")
    (in_rig,) = calibrate_together(
        [
            (
                "left",
                views,
                Request(size_px=SIZE, model="kannala_brandt", degree=None, board="auto", folds=5, progress=silent),
            )
        ]
    )
    assert not in_rig.rivals  # All cameras of a rig together ask what shape its boards have.
    monkeypatch.setattr(module, "rival_shapes", lambda *_: [])
    alone = calibrate(views, SIZE, model="kannala_brandt")
    assert any(rival.name.startswith("board") for rival in found.rivals)
    np.testing.assert_array_equal(found.camera.parameters, alone.camera.parameters)
    more = np.linalg.eigvalsh(found.frame_covariance - alone.frame_covariance)
    assert more.max() > 0.0 and more.min() > -1e-9 * more.max()
    assert FarProjection.of(found).typical_px > 1.1 * FarProjection.of(alone).typical_px


def test_solutions_that_left_out_other_images_are_compared_on_those_of_both(
    fits: dict[str, tuple[Observations, Fit]],
) -> None:
    observations, fit = fits["ucm"]

    def found(images: np.ndarray, squares: np.ndarray) -> ModelOutcome:
        return ModelOutcome(
            observations=observations.subset(images),
            used=np.isin(np.arange(len(observations.views)), images),
            reasons=(),
            chosen=FittedModel("ucm", fit, squares[images]),
            candidates=[],
            beyond=[],
            sizes=[],
            shapes=[],
        )

    every, ripple = np.arange(IMAGES), 1.0 + 0.1 * np.sin(np.arange(IMAGES))
    # The image that one of them left out is bad for the other.
    ripple[3] = 40.0
    before, better = found(every, ripple), found(np.delete(every, 3), 0.8 * ripple)
    worse = found(np.delete(every, 3), 1.2 * ripple)
    assert module._better([before], [better]) and not module._better([before], [worse])
    assert module._better([before, before], [better, better]) and not module._better([before] * 2, [worse] * 2)
    assert not module._better([before], [found(every[:1], ripple)])
    # Without folds nothing was held out.
    before, again = (replace(one, chosen=replace(one.chosen, heldout=None)) for one in (before, better))
    assert not module._better([before] * 2, [again] * 2)


def test_a_rival_with_indefinite_information_gives_finite_uncertainty(monkeypatch: pytest.MonkeyPatch) -> None:
    """As five images of a board of other squares have shown one: by rounding it was told less than nothing."""
    views, *_ = random_views(lens("reg"), 6, np.random.default_rng(3), reach_deg=REACH_DEG["reg"])
    found = calibrate(views, SIZE, model="pinhole", board="flat")
    far = FarProjection.of(replace(found, rivals=(Rival("pinhole", found.camera, 0.1),)))
    monkeypatch.setattr(uncertainty, "information_of_lens", lambda *_: np.diag([4e2, 7e7, -8e10, -3e14]))
    with np.errstate(over="raise", invalid="raise"):
        assert np.isfinite(far.covariance(far.corners.rays)).all()
