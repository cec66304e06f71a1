"""Verdicts: each fault that is simulated in the views is named, and good views get no finding."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.calibration_scenes import BOARD, SIZE, lens, random_views

from rigkit.calibration.calibrate import calibrate
from rigkit.calibration.diagnosis import verdicts
from rigkit.calibration.diagnosis.captured import stretched_images
from rigkit.calibration.diagnosis.changing import CHANGES
from rigkit.calibration.diagnosis.two_kinds import ImageScores
from rigkit.calibration.diagnosis.verdicts import diagnose_session
from rigkit.calibration.result import Calibration
from rigkit.calibration.solving.fit import Fit, fit_model, identifiable
from rigkit.calibration.solving.linearise import normal_equations
from rigkit.calibration.solving.normal_equations import NormalEquations
from rigkit.calibration.solving.solver import with_priors
from rigkit.calibration.solving.state import State
from rigkit.calibration.views.observations import Observations
from rigkit.calibration.views.usable import OTHER_GRIDS
from rigkit.cameras.eucm import EUCM
from rigkit.core.boards import Board
from rigkit.core.errors import DegenerateError
from rigkit.core.findings import Finding, Severity, worst
from rigkit.io.manifests.session import Session
from rigkit.workflows.calibration.calibrate import with_new_verdicts


def printed(result: Calibration, words: str) -> bool:
    return any(words in str(verdict) for verdict in result.verdicts)


def test_sound_views_are_called_good(rng: np.random.Generator) -> None:
    views, _, _ = random_views(lens("reg"), 20, rng, reach_deg=33.0)
    result = calibrate(views, SIZE, model="brown")
    assert str(result.verdicts[0]).startswith("good: held-out RMS")
    assert worst(result.verdicts) is not Severity.BAD
    assert not printed(result, "neighbouring") and not printed(result, "inconsistent") and not printed(result, "retake")


def test_too_few_tilts_and_empty_corners(rng: np.random.Generator) -> None:
    views, _, _ = random_views(lens("reg"), 12, rng, reach_deg=12.0, tilt_deg=(0.0, 3.0))
    result = calibrate(views, SIZE, model="brown", board="flat")
    assert printed(result, "tilted by more than") and result.verdicts[0].severity is Severity.BAD
    assert printed(result, "where boards were seen, most in the")
    assert printed(result, "no corners in the left quarter, the right quarter")


@pytest.mark.parametrize(("tilt_deg", "reported"), [((0.0, 3.0), False), ((10.0, 45.0), True)])
def test_boards_all_alike_tell_no_motion(
    tilt_deg: tuple[float, float], reported: bool, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They leave a lens open whose misfit looks like a motion, or a zoom, of each image."""
    monkeypatch.setattr(verdicts, "changing", lambda *_: [CHANGES["rows"]])
    views, _, _ = random_views(lens("reg"), 12, rng, reach_deg=20.0, tilt_deg=tilt_deg)
    assert printed(calibrate(views, SIZE, model="brown", board="flat"), "rolling shutter") == reported


def test_boards_that_face_a_fisheye_from_all_sides_are_tilted_enough(rng: np.random.Generator) -> None:
    views, _, _ = random_views(lens("fish"), 40, rng, reach_deg=92.5, tilt_deg=(0.0, 5.0))
    assert calibrate(views, SIZE, model="kannala_brandt", board="flat").verdicts[0].severity is Severity.GOOD


def test_moved_lens(rng: np.random.Generator) -> None:
    first = lens("reg")
    second = first.with_parameters(first.parameters * np.array([1.02, 1.02, *[1.0] * 7]))
    views, _, _ = random_views(first, 10, rng, reach_deg=33.0)
    later, _, _ = random_views(second, 10, rng, reach_deg=33.0)
    views += [replace(v, image=f"later{v.image}") for v in later]
    assert printed(calibrate(views, SIZE, model="brown", board="flat"), "at image 'later000.png'")


def test_equal_places_are_not_split_in_the_order_of_the_images() -> None:
    """Otherwise a split by place is one in time, which then explains the change of a lens."""
    number = np.arange(14)
    score = np.where(number < 7, 1.0, -1.0)[:, None]
    scores = ImageScores(np.ones((14, 1, 1)), score, np.full((1, 1), 1e-9), 3)
    assert (scores.split_by((number % 2).astype(np.float64)) == (number % 2 == 1)).all()
    assert (scores.split_by(number.astype(np.float64)) == (number >= 7)).all()
    assert not scores.split_by(np.zeros(14)).any()


def test_the_chance_of_a_lens_that_moved_counts_every_model(rng: np.random.Generator) -> None:
    """Where a split is as good in three of 200 orders, that is 0.015 for one model, but 0.03 for two."""
    clusters, ones = np.arange(12), np.ones((12, 1, 1))
    for _ in range(400):
        score = rng.standard_normal((12, 1))
        scores = ImageScores(ones, score, np.full((1, 1), 1e-9), 3)
        once = scores.chance(clusters, clusters)
        if 0.01 < once <= 0.02:
            break
    assert 0.01 < once <= 0.02
    assert scores.chance(clusters, clusters, 2) == 1.0


def test_a_lens_that_moved_is_looked_for_with_two_models(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The chosen one, and that with the least scatter, on the same images."""
    asked: list[Fit] = []

    def moved(observations: Observations, fit: Fit, *, tests: int) -> tuple[Finding, ...]:
        assert tests == 2
        asked.append(fit)
        return (Finding.bad("moved"),) if len(asked) == 2 else ()

    monkeypatch.setattr("rigkit.calibration.calibrate.moved_lens", moved)
    views, _, _ = random_views(lens("reg"), 10, rng, reach_deg=33.0)
    result = calibrate(views, SIZE, model="auto", board="flat")
    assert len(asked) == 2 and printed(result, "moved")
    assert asked[0].state.camera.model == result.camera.model
    assert asked[1].sigma_px < asked[0].sigma_px
    assert (asked[0].kept == asked[1].kept).all()


def test_a_bent_board_shown_in_order_is_no_moved_lens(rng: np.random.Generator) -> None:
    bent = BOARD.points()
    bent[:, 2] = 1.0 - ((bent[:, 0] - 120.0) / 120.0) ** 2
    views, rotation, _ = random_views(lens("reg"), 40, rng, reach_deg=33.0, points_mm=bent)
    for order in (rotation[:, 0, 2], np.array([view.pixels[:, 0].mean() for view in views])):
        shown = [replace(views[i], image=f"{k:02d}.png") for k, i in enumerate(np.argsort(order))]
        result = calibrate(shown, SIZE, model="brown", board="flat")
        assert printed(result, "neighbouring corners are correlated") and not printed(
            result, "another camera, focus, zoom or mount, or images"
        )


def test_wrong_aspect_and_bent_board(rng: np.random.Generator) -> None:
    views, _, _ = random_views(lens("reg"), 20, rng, reach_deg=33.0, points_mm=Board("b", 9, 6, 30.2, 30.0).points())
    assert printed(calibrate(views, SIZE, model="brown", board="warp"), "longer in x relative to y than declared")
    bent = BOARD.points()
    bent[:, 2] = 2.0 * (1.0 - ((bent[:, 0] - 120.0) / 120.0) ** 2)
    views, _, _ = random_views(lens("reg"), 20, rng, reach_deg=33.0, points_mm=bent)
    flat = calibrate(views, SIZE, model="brown", board="flat")
    assert printed(flat, "neighbouring corners are correlated")
    shaped = calibrate(views, SIZE, model="brown")
    assert shaped.boards[0].kind != "flat" and printed(shaped, "is not flat")
    assert not printed(shaped, "neighbouring corners are correlated")


@pytest.mark.parametrize(
    ("scale", "words"), [((0.97, 1.0), "% smaller along x"), ((1.0, 0.97), "% smaller along y"), ((1, 1), "")]
)
def test_stretched_images_are_told(scale: tuple[float, float], words: str, rng: np.random.Generator) -> None:
    views, _, _ = random_views(lens("reg"), 12, rng, reach_deg=33.0, noise_px=0.05)
    views = [replace(view, pixels=view.pixels * np.array(scale)) for view in views]
    result = calibrate(views, SIZE, model="brown", board="flat")
    assert printed(result, words or "held-out") and printed(result, "stretched the images") == bool(words)
    # A turned board tells it from squares that are longer one way.
    assert not printed(result, "or the board's squares are longer")
    assert all("or the board's squares are longer" in str(f) for f in stretched_images(result, upright=True))


@pytest.mark.parametrize(("cut", "side"), [((150, 0), "left"), ((0, -150), "bottom"), ((0, 0), "")])
def test_cropped_images_are_told_with_the_side(cut: tuple[int, int], side: str, rng: np.random.Generator) -> None:
    """By 150 of 1624 px at one side, filled up at the other: the axis is 9 % off the middle."""
    views = [
        replace(view, pixels=view.pixels - np.array(cut))
        for view in random_views(lens("reg"), 12, rng, reach_deg=20.0, noise_px=0.05)[0]
    ]
    inside = [view for view in views if lens("reg").on_image(view.pixels).all()]
    result = calibrate(inside, SIZE, model="brown", board="flat")
    assert len(inside) > 5 and printed(result, "the optical axis is") == bool(side)
    assert printed(result, f"all images seem cropped, most at the {side}") == bool(side)


def test_what_was_done_to_all_images_comes_before_one_of_them(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    odd = Finding.look("image '003.png' is odd", "retake it")
    monkeypatch.setattr(verdicts, "_views", lambda _: ([odd], []))
    views, _, _ = random_views(lens("reg"), 12, rng, reach_deg=33.0, noise_px=0.05)
    views = [replace(view, pixels=view.pixels * np.array([1.0, 0.9])) for view in views]
    found = calibrate(views, SIZE, model="brown", board="flat").verdicts
    assert "stretched the images" in found[0].message and odd in found[1:]


def test_few_images_and_one_bad_view(rng: np.random.Generator) -> None:
    views, _, _ = random_views(lens("reg"), 6, rng, reach_deg=33.0)
    shaken = replace(views[2], pixels=views[2].pixels + 0.8 * rng.normal(size=(54, 2)))
    result = calibrate([*views[:2], shaken, *views[3:]], SIZE, model="brown", board="flat")
    assert printed(result, "6 images") and printed(result, "'002.png' has a median residual")


def test_a_board_that_moved_during_the_exposure(rng: np.random.Generator) -> None:
    views, _, _ = random_views(lens("reg"), 20, rng, reach_deg=33.0)
    jump = np.where(np.arange(54) > 26, 2.0, 0.0)[:, None]
    views[7] = replace(views[7], pixels=np.clip(views[7].pixels + jump, 0.0, np.array(SIZE) - 1.0))
    result = calibrate(views, SIZE, model="brown", board="flat")
    assert printed(result, "image '007.png' has") and printed(result, "retake it")
    assert [v.image for v in result.verdicts if v.image] == ["007.png"]


def test_more_scatter_at_the_rim_is_not_a_bad_view(rng: np.random.Generator) -> None:
    camera = lens("fish")
    views, _, _ = random_views(camera, 40, rng, reach_deg=92.5, noise_px=0.1)
    middle = camera.project(np.array([0.0, 0.0, 1.0]))[0]
    rough = []
    for view in views:
        share = np.clip((np.linalg.norm(view.pixels - middle, axis=1) - 250.0) / 350.0, 0.0, 1.0)
        noise = 0.3 * share[:, None] * rng.normal(size=view.pixels.shape)
        rough.append(replace(view, pixels=np.clip(view.pixels + noise, 0.0, np.array(SIZE) - 1.0)))
    result = calibrate(rough, SIZE, model="kannala_brandt", board="flat")
    assert not printed(result, "retake it")


def test_a_lens_that_no_model_tried_fits(rng: np.random.Generator) -> None:
    views, _, _ = random_views(lens("fish"), 20, rng, reach_deg=92.5)
    brown = calibrate(views, SIZE, model="brown")
    assert printed(brown, 'try model = "auto"')
    # A camera's file of a rig has its own verdicts.
    asked: dict[str, Any] = {"path": Path("s.toml"), "images": (), "boards": (), "degree": None, "board_shape": "auto"}
    of_a_rig = [with_new_verdicts(brown, Session(model=model, **asked)) for model in ("brown", "auto")]
    assert [printed(one, 'try model = "auto"') for one in of_a_rig] == [True, False]
    assert printed(of_a_rig[1], "no lens model or board shape explains it")


def test_images_left_out_are_named(rng: np.random.Generator) -> None:
    views, _, _ = random_views(lens("reg"), 12, rng, reach_deg=33.0)
    wrong = replace(views[3], pixels=np.clip(views[3].pixels + 30.0 * rng.normal(size=(54, 2)), 0.0, [1623.0, 1239.0]))
    result = calibrate([*views[:3], wrong, *views[4:]], SIZE, model="brown", board="flat")
    assert printed(result, "image '003.png' is left out: only")
    session = diagnose_session(result, [("a.png", "800x600 px, most images with boards have 1624x1240")])
    assert session[0] == result.verdicts[0] and "'a.png' is left out: 800x600 px" in session[1].message
    many = diagnose_session(result, [(f"{i}.png", "no board found") for i in range(5)])
    assert "5 images are left out, the first of them '0.png': no board found" in many[1].message
    # Of an image that is used only something is left out; what lies beside the board is no cause to look.
    assert diagnose_session(result, [("000.png", OTHER_GRIDS)]) == result.verdicts
    assert "image '000.png' is partly left out: bent" in diagnose_session(result, [("000.png", "bent")])[1].message
    assert result.images_left_out == 1 and replace(result, dropped=(("000.png", OTHER_GRIDS),)).images_left_out == 0


def test_hundredths_of_a_pixel_are_no_reason_to_retake(rng: np.random.Generator) -> None:
    views, _, _ = random_views(lens("reg"), 20, rng, reach_deg=33.0, noise_px=0.01)
    for i, some in ((3, np.full(54, 0.025)), (4, np.where(np.arange(54) % 3 == 0, 0.06, 0.0))):
        rough = views[i].pixels + some[:, None] * rng.choice([-1.0, 1.0], size=(54, 2))
        views[i] = replace(views[i], pixels=np.clip(rough, 0.0, np.array(SIZE) - 1.0))
    result = calibrate(views, SIZE, model="brown", board="flat")
    assert len(result.outliers) > 10 and not printed(result, "retake") and not printed(result, "outliers")


def test_repeated_images_count_as_one(rng: np.random.Generator) -> None:
    views, _, _ = random_views(lens("reg"), 10, rng, reach_deg=33.0, noise_px=0.1)
    noisy = [replace(v, image=f"again {v.image}", pixels=v.pixels + 0.02 * rng.normal(size=(54, 2))) for v in views]
    once = calibrate(views, SIZE, model="brown", board="flat")
    twice = calibrate([*views, *noisy], SIZE, model="brown", board="flat")
    assert printed(twice, "show the board at the pose of another image") and not printed(
        once, "at the pose of another image"
    )
    # The same images again say nothing new: independent corners would promise a factor of 0.7.
    assert np.median(twice.parameter_sigmas / once.parameter_sigmas) > 0.85


def test_repeated_images_are_held_out_together(rng: np.random.Generator) -> None:
    """Else those that are left out would be known from their copies, and the headline would praise the copying."""
    views, _, _ = random_views(lens("reg"), 6, rng, reach_deg=33.0, noise_px=0.0)
    # What the corners of an image have in common is what another image of the same place does not tell.
    bent = [v.pixels + 0.2 * np.sin(v.pixels / 150.0 + rng.uniform(0.0, 6.0, 2)) for v in views]
    views = [replace(v, pixels=px + 0.02 * rng.normal(size=(54, 2))) for v, px in zip(views, bent, strict=True)]
    copies = [
        [v, *(replace(v, image=f"{k} {v.image}", pixels=v.pixels + 0.02 * rng.normal(size=(54, 2))) for k in range(2))]
        for v in views
    ]
    once = calibrate(views, SIZE, model="brown", board="flat").heldout_rms_px
    thrice = calibrate([one for own in copies for one in own], SIZE, model="brown", board="flat").heldout_rms_px
    assert once is not None and thrice is not None and thrice > 0.9 * once


def test_an_image_of_another_camera_is_named_first(rng: np.random.Generator) -> None:
    """Of a lens that bends the board a little otherwise."""
    views, *_ = random_views(lens("reg"), 12, rng, reach_deg=33.0, noise_px=0.05)
    bent = views[5].pixels + 0.25 * np.sin(views[5].pixels / 60.0)
    foreign = replace(views[5], image="of another.png", pixels=bent)
    own, mixed = (
        calibrate(some, SIZE, model="brown", board="flat") for some in (views, [*views[:5], foreign, *views[6:]])
    )
    assert not any(finding.image for finding in own.verdicts)
    assert mixed.verdicts[0].image == "of another.png" and "of another.png" in mixed.verdicts[0].message
    assert "another camera" in (mixed.verdicts[0].remedy or "")


def test_two_images_are_not_good(rng: np.random.Generator) -> None:
    views, _, _ = random_views(lens("reg"), 3, rng, reach_deg=33.0)
    result = calibrate(views, SIZE, model="brown", board="flat")
    assert result.verdicts[0].severity is not Severity.GOOD
    assert diagnose_session(result, [])[0].severity is not Severity.GOOD


def test_the_part_of_the_image_is_named(rng: np.random.Generator) -> None:
    views, _, _ = random_views(lens("reg"), 15, rng, reach_deg=15.0)
    result = calibrate(views, SIZE, model="brown", board="flat")
    assert "% of the image where boards were seen" in result.verdicts[0].message


@pytest.mark.parametrize("alpha", [0.0, 0.4])
def test_numbers_that_no_image_tells(alpha: float, rng: np.random.Generator) -> None:
    """Without any bend (alpha is zero) nothing in an image depends on EUCM's beta."""
    camera = EUCM(SIZE, np.array([1364.0, 1365.0, 808.0, 615.0, alpha, 1.0]))
    views, rotation, translation = random_views(camera, 15, rng, reach_deg=33.0, noise_px=0.0)
    observations = Observations.from_views(views)
    state = State.start(camera, rotation, translation, observations)
    normal = with_priors(normal_equations(observations, state), state, 0.1)
    assert normal.identifiable == (alpha > 0.0)


def test_numbers_without_effect_are_not_told_by_each_other(rng: np.random.Generator) -> None:
    """Where alpha and beta both vanish, each has hardly an effect, but of one size: only the sigmas are absurd."""
    views, _, _ = random_views(EUCM(SIZE, np.array([1364.0, 1365.0, 808.0, 615.0, 0.4, 1.0])), 15, rng, reach_deg=33.0)
    observations = Observations.from_views(views)
    fit = fit_model(observations, SIZE, EUCM, None)
    assert identifiable(fit)
    camera = EUCM(SIZE, np.array([*fit.state.camera.parameters[:4], 1e-5, 1e-4]))
    state = replace(fit.state, camera=camera)
    there = replace(fit, state=state, data=normal_equations(observations, state, fit.weight(observations)))
    assert with_priors(there.data, state, fit.sigma_px).identifiable
    assert not identifiable(there)


def test_a_model_that_is_not_identifiable_is_not_taken(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    views, _, _ = random_views(lens("reg"), 12, rng, reach_deg=33.0)
    monkeypatch.setattr(NormalEquations, "identifiable", property(lambda normal: len(normal.g) != 6))
    with pytest.raises(DegenerateError, match="not identifiable"):
        calibrate(views, SIZE, model="eucm", board="flat")
    result = calibrate(views, SIZE, model="auto", board="flat", folds=0)
    assert any(c.name == "eucm" and "not identifiable" in c.reason for c in result.candidates)
