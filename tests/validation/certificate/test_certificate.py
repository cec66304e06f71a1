"""Certificates against Monte Carlo: rigs and cameras drawn from their own covariance measure known lengths."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.cameras import PARAMETERS, SIZE_PX
from helpers.measuring import read_off
from matplotlib.figure import Figure
from scipy.special import stdtrit

from rigkit.calibration.certainty.displaced import DisplacedCamera
from rigkit.cameras.base import Camera
from rigkit.cameras.registry import camera_model
from rigkit.core.arrays import FloatArray
from rigkit.core.errors import DegenerateError, InputError
from rigkit.core.findings import Severity
from rigkit.core.measurement_task import Quantity, Task
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3
from rigkit.geometry.triangulation import triangulate_rays
from rigkit.report.pages import certificate_page
from rigkit.report.pages.certificate_page import basis, bound_figure, certificate_facts, certificate_pdf
from rigkit.report.pictures.figures import _drawn
from rigkit.validation.certificate.certify import certify
from rigkit.validation.certificate.propagation import (
    OF_CORNERS,
    OF_LENSES,
    OF_MOUNTS,
    gradients,
    measured_points,
    variances,
)
from rigkit.validation.certificate.result import Certificate, instrument_of
from rigkit.validation.monitoring.evidence import Monitored

TRIALS = 800
COVERAGE = (0.93, 0.97)
"""Of a 95 % bound, on average over the places."""
COVERAGE_AT_A_PLACE = (0.919, 0.981)
"""Four standard deviations of a share that is counted in 800 trials."""
PLACES = 4
SECOND = Rigid3(exp_so3(np.array([0.02, -0.15, 0.01])), [-250.0, 4.0, 20.0])


def lens(name: str) -> Camera:
    return camera_model(name)(SIZE_PX, np.array(PARAMETERS[name]))


def covariance_of(camera: Camera, rng: np.random.Generator) -> FloatArray:
    """With correlations; about 0.3 px in focal lengths and centre, and so little in distortion that the bound, which is
    linear, is not asked for more than it says: at 100 degrees off the axis k4 stands beside the 9th power."""
    sigma = np.where(np.arange(camera.parameters.size) < 4, 0.3, 1e-4 if camera.model == "brown" else 5e-6)
    mixing = np.eye(sigma.size) + 0.4 * rng.normal(size=(sigma.size, sigma.size))
    return np.asarray(sigma[:, None] * (mixing @ mixing.T) / 2.0 * sigma)


def rig_covariance(camera: Camera, rng: np.random.Generator) -> FloatArray:
    """Of two such lenses and the second one's mount, part of which follows the lenses as in a joint solution."""
    p = camera.parameters.size
    joint = np.zeros((2 * p + 6, 2 * p + 6))
    joint[:p, :p], joint[p : 2 * p, p : 2 * p] = covariance_of(camera, rng), covariance_of(camera, rng)
    lenses = joint[: 2 * p, : 2 * p]
    follows = rng.normal(size=(6, 2 * p)) * np.array([2e-4, 2e-4, 2e-4, 0.1, 0.1, 0.1])[:, None]
    follows /= np.sqrt(np.diag(lenses) * 2 * p)
    joint[2 * p :, : 2 * p] = follows @ lenses
    joint[: 2 * p, 2 * p :] = joint[2 * p :, : 2 * p].T
    joint[2 * p :, 2 * p :] = follows @ lenses @ follows.T + np.diag([2e-4, 3e-4, 1e-4, 0.2, 0.1, 0.3]) ** 2
    return joint


def known_rig(name: str, joint: FloatArray, *, scale_sigma: float = 4e-4) -> Monitored:
    return Monitored(
        names=("left", "right"),
        cameras=(lens(name), lens(name)),
        cam_from_rig=(Rigid3.identity(), SECOND),
        covariance=joint,
        sigma_px=0.08,
        scale_sigma=scale_sigma,
    )


def rig_of(name: str, joint: FloatArray, *, scale_sigma: float = 4e-4) -> Monitored:
    return instrument_of(known_rig(name, joint, scale_sigma=scale_sigma))


def places_of(certificate: Certificate, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Rays and bounds of some places in view where the bound is no coarse one."""
    rows, columns = np.nonzero(certificate.in_view & ~certificate.coarse)
    assert len(rows) >= PLACES
    some = rng.choice(len(rows), PLACES, replace=False)
    pixels = certificate.pixels[rows[some], columns[some]]
    return certificate.instrument.cameras[0].unproject(pixels)[0], certificate.bound[rows[some], columns[some]]


def holds(inside: FloatArray) -> None:
    """Assert that the bound of the way that is harder to measure holds as often as it says; `inside` (places, ways)."""
    share = (inside / TRIALS).min(axis=1)
    assert COVERAGE[0] <= share.mean() <= COVERAGE[1], share
    assert (share >= COVERAGE_AT_A_PLACE[0]).all(), share
    assert (share <= COVERAGE_AT_A_PLACE[1]).all(), share


@pytest.mark.parametrize(
    "quantity, name",
    [
        (Quantity.LENGTH, "brown"),
        (Quantity.DEPTH, "kannala_brandt"),
        (Quantity.PLANE, "brown"),
        (Quantity.ANGLE, "kannala_brandt"),
    ],
)
def test_bounds_of_a_rig_hold_as_often_as_they_say(quantity: Quantity, name: str, rng: np.random.Generator) -> None:
    joint = rig_covariance(lens(name), rng)
    rig = rig_of(name, joint)
    task = Task(quantity=quantity, size_mm=150.0, distance_mm=1500.0)
    rays, bounds = places_of(certify(rig, task, cells=(9, 7)), rng)
    points, _ = measured_points(rays, task, True)
    exact = read_off(quantity, points)
    seen = [c.project(pose.apply(points))[0] for c, pose in zip(rig.cameras, rig.cam_from_rig, strict=True)]
    p, factor = rig.cameras[0].parameters.size, np.linalg.cholesky(joint)
    inside = np.zeros(exact.shape)
    for _ in range(TRIALS):
        wrong = factor @ rng.normal(size=len(joint))
        cameras = [c.with_parameters(c.parameters + wrong[k * p :][:p]) for k, c in enumerate(rig.cameras)]
        pose = Rigid3(exp_so3(wrong[2 * p : 2 * p + 3]) @ SECOND.rotation, SECOND.translation_mm + wrong[2 * p + 3 :])
        pixels = [q + rig.sigma_px * rng.normal(size=q.shape) for q in seen]
        sight = [c.unproject(q)[0] for c, q in zip(cameras, pixels, strict=True)]
        slopes = [c.ray_jacobian(q) for c, q in zip(cameras, pixels, strict=True)]
        found, valid = triangulate_rays(sight[0], sight[1], pose, jacobians1=slopes[0], jacobians2=slopes[1])
        assert valid.all()
        found *= 1.0 + rig.scale_sigma * rng.normal()
        inside += np.abs(read_off(quantity, found) - exact) <= bounds[:, None]
    holds(inside)


@pytest.mark.parametrize("quantity", [Quantity.LENGTH, Quantity.DEPTH, Quantity.ANGLE])
def test_what_noise_along_the_rays_does_to_second_order_is_counted(
    quantity: Quantity, rng: np.random.Generator
) -> None:
    """Points that are off along their rays by a twentieth of what is measured, many times as much as across."""
    rig = replace(rig_of("kannala_brandt", np.zeros((2 * 8 + 6,) * 2), scale_sigma=0.0), sigma_px=0.25)
    task = Task(quantity=quantity, size_mm=150.0, distance_mm=1500.0)
    rays, _ = rig.cameras[0].unproject(np.array([[620.0, 500.0], [800.0, 300.0]]))
    points, weights = measured_points(rays, task, True)
    found = gradients(rig.cameras, rig.cam_from_rig, points, weights)
    stated = variances(rig, task, points, found)[OF_CORNERS]
    noise = rng.normal(size=(8000, *found.points_by_pixel.shape[:2], 4))
    off = rig.sigma_px * np.einsum("nkip,snkp->snki", found.points_by_pixel, noise)

    def squares(off: np.ndarray) -> np.ndarray:
        moved = read_off(quantity, (points + off).reshape(-1, *points.shape[1:])).reshape(8000, len(points), -1)
        error = (moved - read_off(quantity, points)) * (np.radians(1.0) if quantity is Quantity.ANGLE else 1.0)
        return np.asarray((error**2).mean(axis=0))

    # The third order, which is not counted, makes errors of angles smaller by up to a twentieth at some orientations.
    rtol = 0.12 if quantity is Quantity.ANGLE else 0.08
    np.testing.assert_allclose(squares(off), stated, rtol=rtol)
    first = rig.sigma_px**2 * (found.by_corner**2).sum(axis=(-1, -2))
    # What does not face the first order at all: depths, of which ends nearer or farther are that.
    assert (first < (1.0 if quantity is Quantity.DEPTH else 0.9) * stated).all()
    # Errors of the calibration, too; those of lenses at places that differ do not shift all points alike.
    sigmas = np.concatenate([*2 * [[2.0, 2.0, 2.0, 2.0, 0.02, 0.02, 0.02, 0.02]], [1e-4, 3e-3, 1e-4, 0.1, 0.1, 0.1]])
    by_calibration = found.points_by_calibration * sigmas
    off += np.einsum("nkip,sp->snki", by_calibration, rng.normal(size=(8000, len(sigmas))))
    of_both = sum(variances(replace(rig, covariance=np.diag(sigmas**2)), task, points, found).values())
    np.testing.assert_allclose(squares(off), of_both, rtol=rtol)
    linear = np.sum((found.by_calibration * sigmas) ** 2, axis=-1)
    assert quantity is not Quantity.ANGLE or (stated + linear < 0.9 * of_both).all()


def test_bounds_of_angles_hold_however_these_lie(rng: np.random.Generator) -> None:
    """The stated variance at the worst orientation is that of any other to a tenth: also of those between the ones
    that are looked at."""
    rig = rig_of("kannala_brandt", rig_covariance(lens("kannala_brandt"), rng))
    certificate = certify(rig, Task(quantity=Quantity.ANGLE, size_mm=150.0, distance_mm=1500.0), cells=(7, 5))
    stated = np.sum([s**2 for s in certificate.sigma.values()], axis=0)[certificate.in_view]
    rays, _ = rig.cameras[0].unproject(certificate.pixels[certificate.in_view])
    level = np.cross([0.0, 1.0, 0.0], rays)
    level /= np.linalg.norm(level, axis=1, keepdims=True)
    upright = np.cross(rays, level)
    for turn in np.linspace(0.0, 2.0 * np.pi, 23):
        a, b = (np.cos(t) * level + np.sin(t) * upright for t in (turn, turn + 0.5 * np.pi))
        points = 1500.0 * rays[:, None] + 150.0 * np.stack([np.zeros_like(a), a, b], axis=1)
        weights = np.stack([a + b, -b, -a], axis=1)[:, None] / 150.0
        found = gradients(rig.cameras, rig.cam_from_rig, points, weights)
        noise = rig.sigma_px**2 * (found.by_corner**2).sum(axis=(-1, -2))
        lenses = np.einsum("nmi,ij,nmj->nm", found.by_calibration, rig.covariance, found.by_calibration)
        variance = np.rad2deg(1.0) ** 2 * (noise + lenses)[:, 0]
        assert (variance <= 1.1 * stated).all()


def test_bounds_of_one_camera_hold_as_often_as_they_say(rng: np.random.Generator) -> None:
    camera = lens("kannala_brandt")
    covariance = covariance_of(camera, rng)
    alone = Monitored(
        names=("cam",),
        cameras=(camera,),
        cam_from_rig=(Rigid3.identity(),),
        covariance=covariance,
        sigma_px=0.08,
    )
    task = Task(quantity=Quantity.LENGTH, size_mm=400.0, distance_mm=1000.0, distance_sigma_mm=0.5)
    rays, bounds = places_of(certify(alone, task, cells=(9, 7)), rng)
    points, _ = measured_points(rays, task, False)
    seen, factor = camera.project(points)[0], np.linalg.cholesky(covariance)
    inside = np.zeros((PLACES, 2))
    for _ in range(TRIALS):
        wrong = camera.with_parameters(camera.parameters + factor @ rng.normal(size=len(factor)))
        sight, _ = wrong.unproject(seen + alone.sigma_px * rng.normal(size=seen.shape))
        a, b = sight[:, 0::2], sight[:, 1::2]
        distance = task.distance_mm + task.distance_sigma_mm * rng.normal()
        length = 2.0 * distance * np.tan(0.5 * np.arccos(np.sum(a * b, axis=-1)))
        inside += np.abs(length - task.size_mm) <= bounds[:, None]
    holds(inside)


def test_bounds_hold_where_the_covariance_itself_is_an_estimate(rng: np.random.Generator) -> None:
    """Eight degrees of freedom: with the normal quantile 91 % would be within. The linear error itself is drawn."""
    joint, freedom, trials = rig_covariance(lens("brown"), rng), 8.0, 1500
    task = Task(quantity=Quantity.LENGTH, size_mm=150.0, distance_mm=1500.0)
    exact = certify(rig_of("brown", joint, scale_sigma=0.0), task, cells=(3, 3))
    row, column = exact.worst_place
    sigma = np.array([exact.sigma[cause][row, column] for cause in (OF_CORNERS, OF_LENSES, OF_MOUNTS)])
    inside, narrow = 0, 0
    for estimate in rng.chisquare(freedom, trials) / freedom:
        bound = bound_at(sigma * np.sqrt([1.0, estimate, estimate]), freedom)
        error = abs(float(sigma @ rng.normal(size=3)))
        inside += error <= bound
        narrow += error <= bound_at(sigma * np.sqrt([1.0, estimate, estimate]), np.inf)
    assert COVERAGE[0] <= inside / trials <= COVERAGE[1]
    assert narrow < inside
    known = replace(exact.instrument, freedom=freedom)
    stated = certify(known, task, cells=(3, 3)).bound[row, column]
    assert stated == pytest.approx(bound_at(sigma, freedom), rel=1e-9)


def bound_at(sigma: FloatArray, freedom: float) -> float:
    """The bound of causes (corners, lenses, mounts) by GUM G.4."""
    whole, calibration = float(np.sum(sigma**2)), float(np.sum(sigma[1:] ** 2))
    return float(stdtrit(min(freedom * (whole / calibration) ** 2, 1e6), 0.975)) * np.sqrt(whole)


def test_the_causes_add_up_and_the_worst_is_named_first(rng: np.random.Generator) -> None:
    rig = rig_of("brown", rig_covariance(lens("brown"), rng), scale_sigma=0.01)
    certificate = certify(rig, Task(quantity=Quantity.LENGTH, size_mm=200.0, distance_mm=1200.0), cells=(9, 7))
    assert sum(certificate.shares().values()) == pytest.approx(1.0)
    assert max(certificate.shares(), key=lambda cause: certificate.shares()[cause]) == "board scale"
    advice = certificate.findings[-1]
    assert "to halve the worst error: board scale makes" in advice.message
    assert 0.0 < certificate.share_within(certificate.median) < certificate.share_within(certificate.worst) == 1.0
    exact = certify(replace(rig, scale_sigma=0.0), certificate.task, cells=(9, 7))
    rows = [str(certificate_page.causes_table(one).rows) for one in (certificate, exact)]
    assert ["board scale" in words for words in rows] == [True, False]


def test_what_is_said_of_the_worst_place_is_said_of_a_certified_one(rng: np.random.Generator) -> None:
    """Where nothing is certified the bound is largest, but it is none."""
    rig = rig_of("brown", rig_covariance(lens("brown"), rng))
    whole = certify(rig, Task(quantity=Quantity.LENGTH, size_mm=200.0, distance_mm=1500.0), cells=(9, 7))
    partly = replace(whole, coarse=whole.in_view & (whole.bound > whole.median))
    assert 0.3 < partly.coarse_share < 0.7
    assert partly.worst == partly.to_dict()["worst"] == pytest.approx(whole.median)
    assert partly.median < partly.worst < whole.worst
    assert not partly.coarse[partly.worst_place] and partly.bound[partly.worst_place] == partly.worst
    place = ", ".join(f"{x:.0f}" for x in partly.pixels[partly.worst_place])
    assert f"in half of that part, and largest at pixel ({place})" in certificate_facts(partly).sentences[0]
    nowhere = replace(whole, coarse=whole.in_view)
    assert nowhere.worst == whole.worst and nowhere.worst_place == whole.worst_place


@pytest.mark.parametrize("times", [0.5, 4.0])
def test_an_error_that_is_expected_does_not_vary(times: float, rng: np.random.Generator) -> None:
    """The bound holds as often as it says; 1.96 times the root of all squares would hold more often."""
    joint, task = rig_covariance(lens("brown"), rng), Task(quantity=Quantity.DEPTH, size_mm=150.0, distance_mm=1500.0)
    error = times * np.linalg.cholesky(joint + 1e-12 * np.diag(np.diag(joint))) @ rng.normal(size=len(joint))
    square = np.outer(error, error)
    rig = replace(rig_of("brown", joint, scale_sigma=0.0), covariance=joint + square, expected=square)
    certificate = certify(rig, task, cells=(5, 4))
    points, weights = measured_points(rig.cameras[0].unproject(certificate.pixels[certificate.in_view])[0], task, True)
    found = gradients(rig.cameras, rig.cam_from_rig, points, weights)
    about = variances(replace(rig, covariance=joint), task, points, found)
    drawn = np.sqrt(np.sum(list(about.values()), axis=0)[:, 0, None]) * rng.normal(size=(len(points), 4000))
    drawn += (found.by_calibration @ error)[:, :1]
    inside = (np.abs(drawn) <= certificate.bound[certificate.in_view][:, None]).mean()
    assert inside == pytest.approx(0.95, abs=0.005)
    plain = certify(replace(rig, expected=None), task, cells=(5, 4))
    assert plain.sigma[OF_LENSES] == pytest.approx(certificate.sigma[OF_LENSES], nan_ok=True)
    wider = (np.abs(drawn) <= plain.bound[plain.in_view][:, None]).mean()
    assert wider > (0.985 if times > 1.0 else 0.95)


def test_the_worst_orientation_is_that_of_the_largest_bound() -> None:
    """Upright lengths vary by one unit, level ones are off by a known 1.1: twice the first is the larger bound."""
    camera = camera_model("pinhole")(SIZE_PX, np.array([800.0, 800.0, *(0.5 * (np.array(SIZE_PX) - 1.0))]))
    known, varies = np.diag([1.1, 0.0, 0.0, 0.0]) ** 2, np.diag([0.0, 1.0, 0.0, 0.0])
    one = Monitored(
        names=("one",),
        cameras=(camera,),
        cam_from_rig=(Rigid3.identity(),),
        covariance=known + varies,
        expected=known,
        sigma_px=1e-6,
    )
    task = Task(quantity=Quantity.LENGTH, size_mm=50.0, distance_mm=1500.0)
    upright, both = (certify(own, task, cells=(3, 3)) for own in (replace(one, covariance=varies, expected=None), one))
    assert both.bound[1, 1] == pytest.approx(upright.bound[1, 1], rel=1e-6)


def test_what_is_not_counted_in_is_said(rng: np.random.Generator) -> None:
    rig = rig_of("brown", rig_covariance(lens("brown"), rng), scale_sigma=0.0)
    certificate = certify(rig, Task(quantity=Quantity.DEPTH, size_mm=100.0, distance_mm=900.0), cells=(5, 4))
    assert any("square_sigma_mm" in str(f) for f in certificate.findings if f.severity is Severity.LOOK)


def test_the_first_camera_may_be_any_of_the_rig(rng: np.random.Generator) -> None:
    """A rig's frame is no camera's affair: seen from the other side the same length is as uncertain."""
    joint = rig_covariance(lens("brown"), rng)
    forth, back = (instrument_of(known_rig("brown", joint), pair) for pair in (None, ("right", "left")))
    task = Task(quantity=Quantity.DEPTH, size_mm=1.0, distance_mm=1500.0)
    one, other = certify(forth, task, cells=(21, 17)), certify(back, task, cells=(21, 17))
    # Not the same lines of sight, but over the whole field much the same.
    assert one.median == pytest.approx(other.median, rel=0.2)


def test_refusals(rng: np.random.Generator) -> None:
    camera = lens("brown")
    alone = Monitored(
        names=("cam",),
        cameras=(camera,),
        cam_from_rig=(Rigid3.identity(),),
        covariance=covariance_of(camera, rng),
        sigma_px=0.1,
    )
    with pytest.raises(InputError, match="one camera measures no depth"):
        certify(alone, Task(quantity=Quantity.DEPTH, size_mm=10.0, distance_mm=1000.0))
    with pytest.raises(DegenerateError, match="nowhere is a length of 90000 mm"):
        certify(alone, Task(quantity=Quantity.LENGTH, size_mm=90000.0, distance_mm=1000.0))
    with pytest.raises(InputError, match="size must be positive"):
        Task(quantity=Quantity.LENGTH, size_mm=0.0, distance_mm=1000.0)
    one_place = replace(known_rig("brown", rig_covariance(camera, rng)), cam_from_rig=(Rigid3.identity(),) * 2)
    with pytest.raises(DegenerateError, match="look from one place"):
        certify(instrument_of(one_place), Task(quantity=Quantity.LENGTH, size_mm=100.0, distance_mm=1000.0))
    with pytest.raises(InputError, match="two different cameras of left, right"):
        instrument_of(known_rig("brown", rig_covariance(camera, rng)), ("left", "left"))


def test_the_bound_is_drawn_with_and_without_places_where_it_is_a_lower_one(rng: np.random.Generator) -> None:
    """There it is hatched: less of the picture is plain."""
    rig = rig_of("brown", rig_covariance(lens("brown"), rng))
    sure = certify(rig, Task(quantity=Quantity.LENGTH, size_mm=200.0, distance_mm=1500.0), cells=(9, 7))
    drawn = [_drawn(bound_figure(replace(sure, coarse=np.full(sure.bound.shape, coarse)))) for coarse in (False, True)]
    assert drawn[0].shape == drawn[1].shape and (drawn[0] != drawn[1]).mean() > 0.01


def test_the_sheet_keeps_its_words_above_the_lines_for_the_signature(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """However many words there are. The cameras are named by their models, also where their inadequacy is known."""
    rig = rig_of("brown", rig_covariance(lens("brown"), rng))
    modes = np.zeros((2, 1))
    displaced = [DisplacedCamera(c.size_px, np.append(c.parameters, 0.0), c, modes) for c in rig.cameras]
    sure = certify(rig, Task(quantity=Quantity.LENGTH, size_mm=200.0, distance_mm=1500.0), cells=(9, 7))
    named = replace(sure, instrument=replace(rig, cameras=tuple(displaced)))
    assert basis(named)["cameras"] == basis(sure)["cameras"] and "brown" in basis(sure)["cameras"]
    sheets: list[Figure] = []

    def kept(figure: Figure) -> bytes:
        sheets.append(figure)
        return b""

    monkeypatch.setattr(certificate_page, "as_pdf", kept)
    for count in (1, 14):
        certificate_pdf(sure, "a rig", {f"file {k}": "SHA-256 " + "0" * 64 for k in range(count)})
        figure = sheets.pop()
        figure.canvas.draw()
        under = ("Date", "Name", "Signature")
        lowest = min(text.get_window_extent().y0 for text in figure.texts if text.get_text() not in under)
        assert lowest > max(line.get_window_extent().y1 for line in figure.artists)
