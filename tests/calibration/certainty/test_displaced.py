"""Model inadequacy as displacements of the camera, joint with the covariance of its parameters."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.calibration_scenes import BOARD, REACH_DEG, SIZE, lens, random_views

from rigkit.calibration.calibrate import calibrate
from rigkit.calibration.certainty.coverage import covered_by_boards
from rigkit.calibration.certainty.departures import with_own_noise
from rigkit.calibration.certainty.displaced import DisplacedCamera, lens_modes, uncertain_camera, with_modes
from rigkit.calibration.certainty.series import Remainder
from rigkit.calibration.certainty.uncertainty import FarProjection, _projected, projection_design
from rigkit.calibration.result import Calibration, Rival
from rigkit.cameras.base import Camera
from rigkit.cameras.compare import best_rotation, grid_pixels
from rigkit.cameras.uncertain import UncertainCamera
from rigkit.core.arrays import FloatArray
from rigkit.core.errors import InputError
from rigkit.geometry.rotation import rotation_angle
from rigkit.kernels.departures import DISPLACEMENTS, displacements
from rigkit.planning.goal import projection_goal
from rigkit.planning.information import Knowledge
from rigkit.planning.plan import covariance_of, plan_views
from rigkit.workflows.calibration.next_pictures import next_views

DEPARTS = np.zeros(DISPLACEMENTS)
DEPARTS[5:7] = 0.3, -0.2
"""Decentring, px in the corners."""
LIKELY = 0.3


def displaced(name: str, *, amounts: tuple[float, float]) -> DisplacedCamera:
    known, rng = lens(name), np.random.default_rng(3)
    modes, turns = rng.normal(size=(DISPLACEMENTS, 2)), 0.05 * rng.normal(size=(3, 2))
    return DisplacedCamera(SIZE, np.concatenate([known.parameters, amounts]), known, modes, turns)


def with_model_inadequacy(seed: int) -> Calibration:
    """Return a calibration without decentring of a lens that has some."""
    views, _, _ = random_views(lens("fish"), 20, np.random.default_rng(seed), reach_deg=80.0, noise_px=0.02)
    moved = [np.einsum("ijn,j->ni", displacements(np.asarray(view.pixels), SIZE), DEPARTS) for view in views]
    views = [replace(view, pixels=view.pixels + by) for view, by in zip(views, moved, strict=True)]
    return calibrate(views, SIZE, model="kannala_brandt", board="flat", folds=0)


@pytest.mark.parametrize("name", ["reg", "fish"])
def test_a_displaced_camera_is_a_camera(name: str, rng: np.random.Generator) -> None:
    """There and back; derivatives are those of the projection; without amounts it is its lens."""
    camera = displaced(name, amounts=(0.7, -1.3))
    pixels = grid_pixels(SIZE, (12, 9)).reshape(-1, 2)
    rays, valid = camera.unproject(pixels)
    pixels, rays = pixels[valid], rays[valid]
    assert camera.project(rays)[0] == pytest.approx(pixels, abs=1e-8)
    assert np.abs(camera.project(rays)[0] - lens(name).project(rays)[0]).max() > 1.0
    points = rays * rng.uniform(300.0, 900.0, (len(rays), 1))
    _, _, d_pixels_d_point, d_pixels_d_parameters = camera.project_with_jacobians(points)
    for k in range(3):
        step = 1e-3 * np.eye(3)[k]
        moved = (camera.project(points + step)[0] - camera.project(points - step)[0]) / 2e-3
        assert d_pixels_d_point[..., k] == pytest.approx(moved, abs=1e-6)
    for k, value in enumerate(camera.parameters):
        change = 1e-6 * max(abs(float(value)), 1.0) * np.eye(camera.parameters.size)[k]
        one, two = (camera.with_parameters(camera.parameters + s * change).project(points)[0] for s in (1.0, -1.0))
        assert d_pixels_d_parameters[..., k] == pytest.approx((one - two) / (2.0 * change[k]), rel=1e-5, abs=1e-5)
    as_lens = displaced(name, amounts=(0.0, 0.0))
    assert (as_lens.project(points)[0] == lens(name).project(points)[0]).all()
    assert (as_lens.unproject(pixels)[0] == lens(name).unproject(pixels)[0]).all()
    with pytest.raises(InputError, match="parameters expected"):
        camera.with_parameters(camera.parameters[:-1])


def far_variance(known: UncertainCamera, calibration: Calibration, pixels: FloatArray) -> FloatArray:
    """Return the variance (N,) of the projection by the covariance, after the rotation hidden at the corners."""
    camera, p = known.camera, known.camera.parameters.size
    sigmas = np.sqrt(np.diag(known.covariance))
    corners = projection_design(camera, FarProjection.of(calibration).corners.rays)
    there = corners.transpose(1, 0, 2).reshape(p + 3, -1)
    compensation = np.linalg.lstsq(there[p:].T, (sigmas[:, None] * there[:p]).T, rcond=None)[0]
    design = projection_design(camera, calibration.camera.unproject(pixels)[0])
    left = sigmas[:, None] * design[:, :p] - np.einsum("wp,iwm->ipm", compensation, design[:, p:])
    return np.asarray(np.einsum("ikm,kl,ilm->m", left, known.covariance / np.outer(sigmas, sigmas), left))


def test_the_covariance_with_departures_is_that_of_the_projection(monkeypatch: pytest.MonkeyPatch) -> None:
    found = with_model_inadequacy(0)
    pixels = grid_pixels(SIZE, (20, 15)).reshape(-1, 2)
    pixels = pixels[found.camera.unproject(pixels)[1]]
    covered, rays = covered_by_boards(found, pixels), found.camera.unproject(pixels)[0]
    # What a series leaves out is followed as rivals are: where boards were, as far as displacements can elsewhere.
    whole = FarProjection.of(found).covariance(rays).trace(axis1=1, axis2=2)
    followed = far_variance(uncertain_camera(found), found, pixels) / whole
    assert np.median(followed[covered]) == pytest.approx(1.0, abs=0.05)
    assert 0.05 < followed.min() < np.quantile(followed, 0.95) < 1.6
    # At the few places that no boards surround.
    assert followed.max() < 5.0
    monkeypatch.setattr(Remainder, "of", lambda *_: None)
    known = uncertain_camera(found)
    stated = FarProjection.of(found).covariance(rays).trace(axis1=1, axis2=2)
    assert far_variance(known, found, pixels) == pytest.approx(stated, rel=0.05)
    # The parameters alone say much less.
    alone = far_variance(UncertainCamera(found.camera, found.covariance), found, pixels)
    assert np.median(alone / stated) < 0.5
    assert len(known.moved()) == known.camera.parameters.size


def test_model_inadequacy_contains_no_rotation() -> None:
    """Decentring, a shift of the principal point and a turn look nearly alike where boards were. Which way a lens looks
    that departs from its model only the model says: stated normals were a quarter too wide for that turn."""
    found = with_model_inadequacy(0)
    known, p = uncertain_camera(found).camera, found.camera.parameters.size
    assert isinstance(known, DisplacedCamera) and known.turns is not None
    rays = FarProjection.of(found).corners.rays
    pixels, everywhere = found.camera.project(rays)[0], np.ones(len(rays))
    modes = lens_modes(found)
    for k in range(modes.modes.shape[1]):
        step = np.append(modes.moves[:, k], np.eye(modes.modes.shape[1])[k])
        moved = known.with_parameters(known.parameters + step)
        turned = replace(moved, turns=None)
        without, still = (rotation_angle(best_rotation(rays, pixels, everywhere, c)) for c in (turned, moved))
        assert still < 0.05 * np.linalg.norm(known.turns[:, k]) + 1e-7
        assert without == pytest.approx(np.linalg.norm(known.turns[:, k]), rel=0.05)
    assert len(known.parameters) > p


def test_a_lens_that_is_its_model_stays_as_it_is(rng: np.random.Generator) -> None:
    """Boards all over the image: what else it may do is little, and of few kinds."""
    views, _, _ = random_views(lens("fish"), 30, rng, reach_deg=REACH_DEG["fish"], noise_px=0.1)
    found = calibrate(views, SIZE, model="kannala_brandt", board="flat", folds=0)
    known: Camera = uncertain_camera(found).camera
    assert known.parameters.size - found.camera.parameters.size <= 5
    rays = known.unproject(views[0].pixels)[0]
    assert rays == pytest.approx(found.camera.unproject(views[0].pixels)[0], abs=1e-12)


def test_knowledge_with_departures_is_the_joint_covariance() -> None:
    """As a plan has it: information of parameters and amounts, of which a view of a board tells both."""
    found = with_model_inadequacy(0)
    own, modes = Knowledge.of(with_own_noise(found)), lens_modes(found)
    known, p = own.with_model_inadequacy(modes), found.camera.parameters.size
    (camera,), joint, _ = with_modes((found.camera,), covariance_of(own.information)[:p, :p], (modes,))
    size, sigma = camera.parameters.size, np.sqrt(np.diag(joint))
    assert covariance_of(known.information)[:size, :size] / np.outer(sigma, sigma) == pytest.approx(
        joint / np.outer(sigma, sigma), abs=1e-6
    )
    one, two = next_views(found, [BOARD], 1), plan_views(own, [BOARD], projection_goal(found.camera), 1)
    # What the lens does beyond its model is left when its parameters are known.
    assert one.views[0].error > 1.2 * two.views[0].error
    assert one.error > two.error


def test_a_rival_model_is_approached_in_small_steps_without_rotation() -> None:
    """Displacements of a hundred pixels that the parameters and a turned camera take up again show a rival at first
    order; the camera that is really moved so far shows something else, and stated normals were fifty times too wide."""
    views, _, _ = random_views(lens("wide"), 14, np.random.default_rng(5), reach_deg=REACH_DEG["wide"], noise_px=0.02)
    found, other = (calibrate(views, SIZE, model="scaramuzza", degree=k, board="flat", folds=0) for k in (6, 7))
    calibration = replace(found, rivals=(Rival("scaramuzza 7", other.camera, LIKELY),))
    alone, beside = (
        float(np.linalg.norm(FarProjection.of(one).departure_compensation @ lens_modes(one).modes))
        for one in (found, calibration)
    )
    rim = found.camera.unproject(np.array([[20.0, 20.0], [1600.0, 1220.0]]))[0]
    stated = [np.trace(FarProjection.of(one).covariance(rim), axis1=1, axis2=2) for one in (found, calibration)]
    assert (stated[1] > 1.5 * stated[0]).all()
    assert lens_modes(calibration).modes.size > 0
    assert beside == pytest.approx(alone, rel=0.1)
    # One sigma of everything: what is left open at first order is what the moved cameras show.
    known = uncertain_camera(calibration)
    pixels = grid_pixels(SIZE, (12, 9)).reshape(-1, 2)
    rays, valid = found.camera.unproject(pixels)
    pixels, rays = pixels[valid], rays[valid]
    shown = np.array([camera.project(rays)[0] - pixels for camera in known.moved()])
    design = known.camera.project_with_jacobians(rays)[3]
    linear = np.einsum("nip,pq,niq->n", design, known.covariance, design)
    assert (shown**2).sum(axis=(0, 2)) == pytest.approx(linear, rel=0.2)


def test_a_ray_outside_the_field_of_view_has_no_pixel() -> None:
    camera = lens("reg")
    shown, design = _projected(camera, np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]), np.inf)
    assert np.isfinite(shown[0]).all() and np.isnan(shown[1]).all()
    assert design.shape == (2, camera.parameters.size + 3, 2)


def test_penalties_that_lead_to_impossible_cameras_are_skipped(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the penalties with which a rival is followed the softest ask for most; the others serve."""
    views, _, _ = random_views(lens("reg"), 6, np.random.default_rng(5), reach_deg=24.0, noise_px=0.1)
    found = calibrate(views, SIZE, model="brown", degree=4, board="flat", folds=0)
    other = found.camera.with_parameters(found.camera.parameters * (1.0 + 1e-4))
    calibration, asked = replace(found, rivals=(Rival("other", other, LIKELY),)), []

    def refused(*given: object) -> DisplacedCamera:
        asked.append(given)
        if len(asked) == 1:
            raise InputError("beyond")
        return DisplacedCamera(*given)  # type: ignore[arg-type]

    monkeypatch.setattr("rigkit.calibration.certainty.displaced.DisplacedCamera", refused)
    assert np.isfinite(lens_modes(calibration).modes).all() and len(asked) > 1
