"""Moving entrance pupils: detected, not confused with other faults, solved for, and their effect on distant points."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.calibration_scenes import REACH_DEG, SIZE, lens, random_views

from rigkit.calibration.calibrate import calibrate
from rigkit.calibration.certainty.coverage import covered_by_boards
from rigkit.calibration.certainty.uncertainty import FarProjection, projection_uncertainty
from rigkit.calibration.compare import compare_calibrations
from rigkit.calibration.diagnosis.changing import changing
from rigkit.calibration.diagnosis.pupil import (
    PUPIL_SIGNIFICANCE,
    MovingPupil,
    may_move,
    moving_pupil,
    pupil_is_significant,
    solved_again,
)
from rigkit.calibration.diagnosis.verdicts import diagnose
from rigkit.calibration.diagnosis.view_evidence import view_evidence
from rigkit.calibration.pupil import SolvedPupil
from rigkit.calibration.result import Calibration
from rigkit.calibration.with_pupil import CENTRAL, MOVING
from rigkit.cameras.compare import best_rotation, grid_pixels
from rigkit.cameras.moving_pupil import NearCamera
from rigkit.core.arrays import FloatArray, Points
from rigkit.core.boards import Board
from rigkit.core.detections import BoardView
from rigkit.core.errors import DegenerateError, InputError
from rigkit.core.findings import Severity
from rigkit.kernels.departures import DISPLACEMENTS, displacements

NEAR, FAR = Board("near", 9, 6, 12.0, 12.0), Board("far", 9, 6, 120.0, 120.0)
"""They fill the image at 90 to 210 mm, and at ten times that."""
MM_PER_RAD2, NOISE_PX = 1.5, 0.03
MESSAGE = "the lens is not central"


def from_the_pupil(points_mm: Points, mm_per_rad2: float) -> Points:
    """Return points as they lie before a pupil that moves forward by so much times the squared angle at which it sees
    them."""
    seen = np.array(points_mm, dtype=np.float64)
    for _ in range(20):
        angle = np.arctan2(np.hypot(seen[..., 0], seen[..., 1]), seen[..., 2])
        seen[..., 2] = points_mm[..., 2] - mm_per_rad2 * angle**2
    return seen


def views_of_session(board: Board, mm_per_rad2: float, seed: int) -> list[BoardView]:
    """Return 20 views of a fisheye with such a pupil."""
    rng, camera = np.random.default_rng(seed), lens("fish")
    views, turns, shifts = random_views(camera, 20, rng, reach_deg=80.0, board=board, noise_px=0.0)
    noisy = []
    for view, turn, shift in zip(views, turns, shifts, strict=True):
        pixels, valid = camera.project(from_the_pupil(board.points() @ turn.T + shift, mm_per_rad2))
        assert valid.all()
        pixels = np.clip(pixels + NOISE_PX * rng.normal(size=pixels.shape), -0.5, np.array(SIZE) - 0.5)
        noisy.append(replace(view, pixels=pixels, sigma_px=np.full(len(pixels), NOISE_PX)))
    return noisy


def session(board: Board, mm_per_rad2: float, seed: int, shape: str = "flat", pupil: str = "central") -> Calibration:
    """Return a calibration from them."""
    views = views_of_session(board, mm_per_rad2, seed)
    return calibrate(views, SIZE, model="kannala_brandt", board=shape, folds=0, pupil=pupil)


def pupil_of(found: Calibration) -> MovingPupil:
    pupil = MovingPupil.of(found)
    assert pupil is not None
    return pupil


def off_far_away(found: Calibration) -> float:
    """Return by how much (rms px where boards were) the lens projects what is far away elsewhere than it should."""
    pixels = grid_pixels(SIZE, (24, 18)).reshape(-1, 2)
    rays, valid = lens("fish").unproject(pixels)
    inside = valid & covered_by_boards(found, pixels)
    rays, pixels = rays[inside], pixels[inside]
    turn = best_rotation(rays, pixels, np.ones(len(rays)), found.camera)
    error: FloatArray = found.camera.project(rays @ turn.T)[0] - pixels
    return float(np.sqrt((error**2).sum(axis=-1).mean()))


@pytest.mark.parametrize("shape", ["flat", "released"])
def test_a_pupil_that_moves_is_found_and_what_it_does_far_away(shape: str) -> None:
    """Half of it, and no more than there is: corners that fit least are left out, and boards of free shape follow."""
    found = session(NEAR, MM_PER_RAD2, 0, shape)
    assert found.verdicts[0].message.startswith("training RMS") and MESSAGE in found.verdicts[0].message
    # The images all say the same: that something differs between them would be another cause.
    printed = diagnose(found, in_force=("model", "board_shape"))
    assert not any("something changes between images" in one.message for one in printed)
    pupil, true = pupil_of(found), off_far_away(found)
    assert 0.4 * MM_PER_RAD2 < pupil.mm_per_rad2 < 1.1 * MM_PER_RAD2
    assert true > 1.0
    assert 0.35 * true < pupil.far_px(FarProjection.of(found)) < 1.1 * true


def test_a_central_lens_has_no_finding_about_its_pupil() -> None:
    for seed in range(4):
        found = session(NEAR, 0.0, seed, pupil="auto")
        assert found.pupil is None
        assert MESSAGE not in str(found.verdicts)
        pupil = pupil_of(found)
        assert pupil.chance > PUPIL_SIGNIFICANCE
        assert abs(pupil.mm_per_rad2) < 0.1


@pytest.mark.parametrize("model", ["pinhole", "ucm"])
def test_a_lens_unlike_its_model_is_no_pupil_that_moves(model: str, rng: np.random.Generator) -> None:
    """What no parameter follows is there at all distances alike."""
    views = random_views(lens("reg"), 20, rng, reach_deg=REACH_DEG["reg"], noise_px=0.05)[0]
    found = calibrate(views, SIZE, model=model, board="flat", folds=0)
    assert found.rms_px > 0.1
    assert MESSAGE not in str(found.verdicts)


def test_a_moving_pupil_is_not_reported_as_a_change_between_images() -> None:
    """A pupil of 4 mm per rad^2 leaves residuals that each image's own shear follows as well as that of a motion."""
    found = session(NEAR, 4.0, 4)
    assert "rolling shutter" in str(changing(found))
    assert MESSAGE in found.verdicts[0].message and "rolling shutter" not in str(found.verdicts)


def test_what_is_reported_of_a_pupil_is_also_asked_about(monkeypatch: pytest.MonkeyPatch) -> None:
    """So that lenses whose pupils may not move need not be asked again."""
    found = session(NEAR, MM_PER_RAD2, 0)
    far, pupil, reported = FarProjection.of(found), pupil_of(found), 0
    for part in np.geomspace(0.01, 3.0, 30).tolist():
        for sigmas in (0.5, 3.5, 10.0):
            amount = part * pupil.mm_per_rad2
            other = replace(
                pupil,
                mm_per_rad2=amount,
                sigma_mm_per_rad2=abs(amount) / sigmas + 1e-9,
                parameter_changes=part * pupil.parameter_changes,
            )
            monkeypatch.setattr(MovingPupil, "of", lambda _, one=other: one)
            assert may_move(found, far) or not list(moving_pupil(found, far))
            reported += len(list(moving_pupil(found, far)))
    assert reported > 3


def test_distant_boards_do_not_determine_a_moving_pupil() -> None:
    found = session(FAR, MM_PER_RAD2, 0, pupil="auto")
    assert found.pupil is None
    assert MESSAGE not in str(found.verdicts)
    assert off_far_away(found) < 0.2


def test_a_narrow_lens_does_not_determine_its_pupil() -> None:
    rng = np.random.default_rng(0)
    views = random_views(lens("reg"), 12, rng, reach_deg=REACH_DEG["reg"], noise_px=0.05)[0]
    found = calibrate(views, SIZE, model="brown", board="flat", folds=0)
    pupil = pupil_of(found)
    assert pupil.sigma_mm_per_rad2 > 0.1 and MESSAGE not in str(found.verdicts)


@pytest.mark.parametrize("folds", [0, 5])
def test_a_pupil_that_moves_is_solved_for(folds: int) -> None:
    """All of it is found, what is far away is right again, and how sure both are is known."""
    views = views_of_session(NEAR, MM_PER_RAD2, 0)
    found = calibrate(views, SIZE, model="kannala_brandt", board="flat", folds=folds)
    assert found.pupil is not None
    angle = np.radians(80.0)
    shift, sigma = found.pupil.shift_mm(angle)
    assert sigma < 0.05 and abs(shift - MM_PER_RAD2 * angle**2) < 3.0 * sigma
    off = found.pupil.terms - [MM_PER_RAD2, 0.0]
    assert (np.abs(off) < 3.0 * np.sqrt(np.diag(found.pupil.covariance))).all()
    far = FarProjection.of(found)
    assert off_far_away(found) < 2.0 * far.typical_px < 0.2
    assert off_far_away(session(NEAR, MM_PER_RAD2, 0)) > 1.0
    assert found.rms_px < 1.1 * NOISE_PX * np.sqrt(2.0)
    (printed,) = (one for one in found.verdicts if MESSAGE in one.message)
    assert printed.severity is Severity.GOOD and f"{found.pupil.shift_mm(_rim(found))[0]:.2f} ± " in printed.message
    assert any(one.name == MOVING and one.chosen for one in found.candidates)


def test_residuals_are_those_of_points_in_mm() -> None:
    found = session(NEAR, MM_PER_RAD2, 0, pupil="moving")
    used = np.flatnonzero(found.corners.kept)
    points = found.corners.in_cam(used)
    shown, valid = found.near.project(points)
    assert valid.all()
    np.testing.assert_allclose(found.corners.pixels[used] - shown, found.corners.residuals_px[used], atol=1e-9)
    assert np.linalg.norm(found.camera.project(points)[0] - shown, axis=1).max() > 1.0


def test_the_option_pupil_decides_whether_one_is_solved_for() -> None:
    assert session(NEAR, MM_PER_RAD2, 0).pupil is None
    forced = session(NEAR, 0.0, 1, pupil="moving")
    assert forced.pupil is not None and not pupil_is_significant(forced, session(NEAR, 0.0, 1))
    with pytest.raises(InputError, match="auto, central, moving"):
        session(NEAR, 0.0, 1, pupil="perhaps")


def test_an_insignificant_pupil_is_dropped_with_a_finding(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rigkit.calibration.calibrate.pupil_is_significant", lambda *_: False)
    found = session(NEAR, MM_PER_RAD2, 0, pupil="auto")
    assert found.pupil is None
    printed = {c.name: c for c in found.candidates}
    assert printed[CENTRAL].chosen and printed[CENTRAL].reason == "a moving pupil is not significant"
    assert not printed[MOVING].chosen and printed[MOVING].reason == "movement not significant"
    assert session(NEAR, MM_PER_RAD2, 0, pupil="moving").pupil is not None


def test_a_few_images_have_a_pupil_or_sigmas_that_include_it() -> None:
    """Where three to five images do not confirm the pupil, it is a rival of the central lens."""
    for count in (3, 4, 5):
        views = views_of_session(NEAR, MM_PER_RAD2, 0)[:count]
        found = calibrate(views, SIZE, model="kannala_brandt", board="flat")
        assert found.pupil is not None or MOVING in [rival.name for rival in found.rivals]
        assert off_far_away(found) < 3.0 * FarProjection.of(found).typical_px


def test_residuals_take_back_a_pupil_that_only_a_wrong_model_asks_for() -> None:
    rng = np.random.default_rng(0)
    views = random_views(lens("reg"), 12, rng, reach_deg=REACH_DEG["reg"], noise_px=0.05)[0]
    wrong, central = (
        calibrate(views, SIZE, model="pinhole", board="flat", folds=0, pupil=pupil) for pupil in ("moving", "central")
    )
    assert wrong.pupil is not None and solved_again(wrong) is None and not pupil_is_significant(wrong, central)
    again = solved_again(session(NEAR, MM_PER_RAD2, 0, pupil="moving"))
    assert again is not None and 0.9 * MM_PER_RAD2 < again.mm_per_rad2 < 1.1 * MM_PER_RAD2


def test_a_lens_that_departs_from_its_model_is_central() -> None:
    """Solved for with a pupil, lens and boards are so far from the truth that its residuals do not take it back."""
    rng = np.random.default_rng(38)
    amounts, views = rng.normal(size=DISPLACEMENTS), []
    for view in random_views(lens("wide"), 12, rng, reach_deg=REACH_DEG["wide"], noise_px=0.05)[0]:
        pixels = view.pixels + np.einsum("ijn,j->ni", displacements(view.pixels, SIZE), amounts)
        views.append(replace(view, pixels=np.clip(pixels, 0.0, np.array(SIZE) - 1.0)))
    moving, found = (
        calibrate(views, SIZE, model="kannala_brandt", board="flat", folds=0, pupil=pupil)
        for pupil in ("moving", "auto")
    )
    again = solved_again(moving)
    assert again is not None and again.chance < PUPIL_SIGNIFICANCE
    assert found.pupil is None and pupil_of(found).left_px < again.left_px


def test_a_requested_pupil_that_images_do_not_determine_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rigkit.calibration.calibrate.solved_with_pupil", lambda *_: None)
    with pytest.raises(DegenerateError, match="the images do not determine how the entrance pupil moves"):
        session(NEAR, MM_PER_RAD2, 0, pupil="moving")
    assert session(NEAR, MM_PER_RAD2, 0, pupil="auto").pupil is None


def test_the_pupil_widens_the_uncertainty_of_far_points() -> None:
    """A lens of which the pupil is found, too, is less sure than one whose pupil is known not to move."""
    views = views_of_session(NEAR, 0.0, 1)
    central, moving = (
        calibrate(views, SIZE, model="kannala_brandt", board="flat", folds=0, pupil=pupil)
        for pupil in ("central", "moving")
    )
    assert FarProjection.of(moving).typical_px > 1.05 * FarProjection.of(central).typical_px
    near = projection_uncertainty(moving, np.array([[800.0, 600.0], [1100.0, 700.0]]), range_mm=120.0)
    assert near.valid.all() and (near.worst_px < 0.1).all()


def test_the_joint_covariance_splits_into_lens_and_pupil() -> None:
    found = session(NEAR, MM_PER_RAD2, 0, pupil="moving")
    assert found.pupil is not None
    joint = found.near_covariance
    p = found.camera.parameters.size
    assert joint.shape == (p + 8, p + 8)
    frame, again = SolvedPupil.split(found.pupil.terms, joint)
    np.testing.assert_array_equal(frame, found.frame_covariance)
    np.testing.assert_array_equal(again.with_frame, found.pupil.with_frame)
    np.testing.assert_array_equal(joint[p : p + 2, p : p + 2], found.pupil.covariance)
    assert np.linalg.eigvalsh(joint / np.outer(*2 * [np.sqrt(np.diag(joint))])).min() > -1e-9


def _rim(found: Calibration) -> float:
    points = found.corners.in_cam(np.flatnonzero(found.corners.kept))
    return float(np.arctan2(np.hypot(points[:, 0], points[:, 1]), points[:, 2]).max())


def test_views_dropped_by_the_central_lens_return_with_a_pupil() -> None:
    """A board so near that its corners are pixels off where boards further away have put a central lens."""
    rng, true = np.random.default_rng(1), NearCamera.of(lens("fish"), (3.0, -0.3))
    views, nearer = (
        random_views(true, count, rng, reach_deg=80.0, board=Board(name, 9, 6, mm, mm), noise_px=NOISE_PX)[0]
        for name, count, mm in (("typical", 16, 16.0), ("nearer", 3, 4.0))
    )
    views += [replace(view, image=f"nearer {view.image}") for view in nearer]
    central, moving = (
        calibrate(views, SIZE, model="kannala_brandt", board="flat", pupil=pupil) for pupil in ("central", "auto")
    )
    assert len(central.dropped) == 2 and central.pupil is None
    assert not moving.dropped and len(moving.views) == len(views)
    assert moving.pupil is not None and moving.rms_px < 1.5 * np.sqrt(2.0) * NOISE_PX


def test_the_number_of_corners_in_a_block_of_rows_does_not_change_the_pupil(monkeypatch: pytest.MonkeyPatch) -> None:
    found = session(NEAR, MM_PER_RAD2, 0)

    def reported() -> FloatArray:
        pupil, evidence = MovingPupil.of(found), view_evidence(found)
        assert pupil is not None
        assert evidence is not None
        return np.array([pupil.mm_per_rad2, pupil.sigma_mm_per_rad2, evidence.total, *evidence.along.ravel()])

    whole = reported()
    # Two of the views, of 54 corners each, at once.
    monkeypatch.setattr("rigkit.calibration.diagnosis.view_evidence.CORNERS_AT_ONCE", 120)
    np.testing.assert_array_equal(reported(), whole)


def test_a_central_fit_to_a_lens_whose_pupil_moves_is_of_the_same_camera() -> None:
    """As of few images, which show no pupil: `diff` allows for what a central lens leaves out."""
    central, moving = session(NEAR, MM_PER_RAD2, 2), session(NEAR, MM_PER_RAD2, 1, pupil="moving")
    assert compare_calibrations(central, moving).same and compare_calibrations(moving, central).same
    assert not compare_calibrations(central, replace(moving, pupil=None)).same
    scale = np.where(np.arange(moving.camera.parameters.size) < 2, 1.02, 1.0)
    longer = replace(moving, camera=moving.camera.with_parameters(moving.camera.parameters * scale))
    assert not compare_calibrations(central, longer).same
