"""Rigs: mounts, baseline and its uncertainty, against known rigs of mixed lenses."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from helpers.calibration_scenes import BOARD
from helpers.rig_scenes import MODELS, NOISE_PX, SIGMAS, mounts, rig_views, sizes

from rigkit.calibration.certainty.covariance import GlobalCovariance
from rigkit.calibration.rig.calibrate import _mistakes, calibrate_rig
from rigkit.calibration.rig.certainty.uncertainty import transfer_covariance, transfer_uncertainty
from rigkit.calibration.rig.result import RigCalibration
from rigkit.calibration.rig.solving.exposure_times import ExposureTimes
from rigkit.calibration.rig.solving.pose_jacobians import pose_jacobians
from rigkit.calibration.rig.solving.solver import rig_normal
from rigkit.calibration.rig.solving.state import RigObservations, RigState
from rigkit.calibration.rig.verdicts import _not_converged
from rigkit.calibration.rig.views.observations import RigViews
from rigkit.calibration.solving.camera_prior import camera_prior
from rigkit.calibration.solving.clustered import Clustered
from rigkit.calibration.solving.normal_equations import SchurStep
from rigkit.calibration.solving.shape import shape_model
from rigkit.calibration.solving.state import State, evaluate
from rigkit.calibration.views.observations import Observations
from rigkit.core.boards import Board
from rigkit.core.detections import BoardView
from rigkit.core.errors import InputError
from rigkit.core.findings import Finding, Severity
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3, log_so3

SHAPE_WEIGHT = 0.3
"""px of a corner, against which the priors of boards' shapes are weighed."""


@pytest.mark.parametrize("chain", [False, True])
def test_recovers_mounts_of_mixed_lenses(chain: bool, rng: np.random.Generator) -> None:
    rig = calibrate_rig(rig_views(rng, 30, chain=chain), sizes(), model=MODELS)
    assert rig.convergence.converged
    assert rig.sigma_px == pytest.approx(NOISE_PX, rel=0.05)
    count = sum(c.camera.parameters.size for c in rig.cameras)
    for k, name in enumerate(["wide", "fish"]):
        true = mounts()[name][1]
        found = rig.cameras[k + 1].cam_from_rig
        error = np.concatenate([log_so3(found.rotation @ true.rotation.T), found.translation_mm - true.translation_mm])
        block = rig.covariance[count + 6 * k : count + 6 * k + 6, count + 6 * k : count + 6 * k + 6]
        assert (np.abs(error) < SIGMAS * np.sqrt(np.diag(block))).all()
        assert np.sqrt(np.diag(block))[3:].max() < 2.0
        length, sigma = rig.baseline_mm("reg", name)
        assert abs(length - np.linalg.norm(true.translation_mm)) < SIGMAS * sigma
    assert rig.baseline_mm("wide", "fish")[0] == pytest.approx(
        np.linalg.norm(rig.cam2_from_cam1("wide", "fish").translation_mm)
    )


def test_joint_solve_is_no_worse_than_single_ones(rng: np.random.Generator) -> None:
    rig = calibrate_rig(rig_views(rng, 20), sizes(), model=MODELS)
    for camera, alone in zip(rig.cameras, rig.single, strict=True):
        assert camera.rms_px < 1.1 * alone.rms_px


def _small_rig(kind: str, tied: bool, rng: np.random.Generator) -> tuple[RigObservations, RigState]:
    """Two cameras before two boards of a shape, three frames: on one target (tied), or each with poses of its own."""
    boards = [Board("a", 4, 3, 40.0, 40.0), Board("b", 3, 3, 50.0, 50.0)]
    names = ["reg", "wide"]
    views = [
        BoardView(f"{name}{f}", b, b.grid(), 500.0 + 300.0 * rng.random((b.corner_count, 2)), np.ones(b.corner_count))
        for name in names
        for f in range(3)
        for b in boards
    ]
    everything = Observations.from_views(views)
    cameras = [everything.subset(np.arange(6 * c, 6 * c + 6)) for c in range(2)]
    # Tied: both boards share the frame's pose; else each has its own.
    frame = np.repeat(np.arange(3), 2) if tied else np.arange(6)
    keys = tuple((str(k), "") for k in range(int(frame.max()) + 1))
    weights = [rng.uniform(0.5, 2.0, own.present.shape) * own.present for own in cameras]
    shape = shape_model(kind, everything)
    observations = RigObservations(
        cameras=tuple(cameras),
        weights=tuple(weights),
        shape=shape,
        frame=(frame, frame),
        keys=keys,
        places=(False, tied),
    )
    poses = len(keys)
    state = RigState(
        cameras=tuple(mounts()[name][0] for name in names),
        mount_rotation=np.array([mounts()[name][1].rotation for name in names]),
        mount_mm=np.array([mounts()[name][1].translation_mm for name in names]),
        frame_rotation=exp_so3(0.3 * rng.normal(size=(poses, 3))),
        frame_mm=np.array([-60.0, -40.0, 600.0]) + 20.0 * rng.normal(size=(poses, 3)),
        board_rotation=np.array([np.eye(3), exp_so3(0.5 * rng.normal(size=3)) if tied else np.eye(3)]),
        board_mm=np.array([np.zeros(3), 80.0 * rng.normal(size=3) if tied else np.zeros(3)]),
        unknowns=0.3 * rng.normal(size=shape.count),
    )
    return observations, state


def _lagging(state: RigState, rng: np.random.Generator) -> RigState:
    """Return the state with a second camera that lags, by a little more or less from picture to picture."""
    poses = len(state.frame_mm)
    # Turning about one axis: of a way that winds, a second order of the time is left out of the lag's derivative.
    axis = rng.normal(size=(poses, 1, 3))
    ways = np.concatenate([axis * [[0.2], [0.1]], 30.0 * rng.normal(size=(poses, 2, 3))], axis=-1)
    own, information = np.zeros((2, poses)), np.full((2, poses), np.inf)
    own[1], information[1] = 0.1 * rng.normal(size=poses), 1e6 * rng.uniform(1.0, 2.0, poses)
    return replace(state, exposures=ExposureTimes(np.array([0.0, 0.3]), ways, own, information, np.zeros(2)))


@pytest.mark.parametrize("kind", ["flat", "warp", "released"])
@pytest.mark.parametrize(("tied", "late"), [(False, False), (True, False), (False, True)])
def test_gradient_and_gauss_newton_matrix(kind: str, tied: bool, late: bool, rng: np.random.Generator) -> None:
    """Central differences of the cost and of the residuals, by every kind of unknown; the pictures' own times, too,
    which are then eliminated."""
    observations, state = _small_rig(kind, tied, rng)
    state = _lagging(state, rng) if late else state
    shape, poses = observations.shape, len(observations.keys)
    layout = state.layout(observations)
    assert layout.count == 17 + 6 + (6 if tied else 0) + late + shape.count
    normal = rig_normal(observations, state)
    scale = np.ones(layout.count + 6 * poses)
    for run, camera in zip(layout.cameras, state.cameras, strict=True):
        scale[run] = 1e-2 * np.maximum(np.abs(camera.parameters), 1e-2)

    def residuals(x: np.ndarray, own_times: np.ndarray | float = 0.0) -> np.ndarray:
        moved = state.moved(SchurStep(x[: layout.count], x[layout.count :].reshape(-1, 6), 0.0), layout)
        if moved.exposures is not None:
            moved = replace(moved, exposures=replace(moved.exposures, own=moved.exposures.own + own_times))
        return np.concatenate(
            [
                (evaluate(moved.of_camera(c, observations), own).px * w[..., None]).ravel()
                for c, (own, w) in enumerate(zip(observations.cameras, observations.weights, strict=True))
            ]
        )

    h = 1e-5 * scale
    jacobian = np.array(
        [(residuals(-s * e) - residuals(s * e)) / (2 * s) for s, e in zip(h, np.eye(h.size), strict=True)]
    )
    gauss_newton = np.zeros((h.size, h.size))
    gauss_newton[: layout.count, : layout.count] = normal.gg
    for f in range(poses):
        own = slice(layout.count + 6 * f, layout.count + 6 * f + 6)
        gauss_newton[: layout.count, own] = normal.gp[f]
        gauss_newton[own, : layout.count] = normal.gp[f].T
        gauss_newton[own, own] = normal.pp[f]
    here = residuals(np.zeros(h.size))
    numeric, gradient = jacobian @ jacobian.T, jacobian @ here
    if state.exposures is not None:
        each = 1e-5 * np.eye(poses)[:, None] * [[0.0], [1.0]]
        times = np.array([(residuals(0.0 * h, -e) - residuals(0.0 * h, e)) / 2e-5 for e in each])
        known, own_times = np.diag(state.exposures.information[1]), state.exposures.own[1]
        back = jacobian @ times.T @ np.linalg.inv(times @ times.T + known)
        numeric -= back @ times @ jacobian.T
        gradient -= back @ (times @ here - known @ own_times)
        reduced = here @ here + own_times @ known @ own_times
        pull = times @ here - known @ own_times
        reduced -= pull @ np.linalg.solve(times @ times.T + known, pull)
        assert normal.cost == pytest.approx(reduced, rel=1e-6)
    numeric *= scale[:, None] * scale
    assert np.abs(numeric - gauss_newton * scale[:, None] * scale).max() < 1e-5 * np.abs(numeric).max()
    with_priors = rig_normal(observations, state, 0.3)
    expected = sum(float((camera_prior(camera)[1] ** 2).sum()) for camera in state.cameras)
    expected += float(((state.unknowns / shape.sigma) ** 2).sum())
    assert with_priors.cost - normal.cost == pytest.approx(0.09 * expected, rel=1e-6)
    gradient *= scale
    assert np.abs(gradient - np.concatenate([normal.g, normal.p.ravel()]) * scale).max() < 1e-5 * np.abs(gradient).max()


@pytest.mark.parametrize("kind", ["flat", "warp", "released"])
@pytest.mark.parametrize(("tied", "late"), [(False, False), (True, False), (False, True)])
def test_covariance_of_lenses_and_of_the_boards_mean_motion(
    kind: str, tied: bool, late: bool, rng: np.random.Generator
) -> None:
    """Against the inverse of all equations at once, carried to a camera's boards by central differences."""
    observations, state = _small_rig(kind, tied, rng)
    state = _lagging(state, rng) if late else state
    layout, normal = state.layout(observations), rig_normal(observations, state, SHAPE_WEIGHT)
    count, poses = layout.count, len(observations.keys)
    whole = np.zeros((count + 6 * poses, count + 6 * poses))
    whole[:count, :count] = normal.gg
    whole[:count, count:] = np.moveaxis(normal.gp, 0, 1).reshape(count, -1)
    whole[count:, :count] = whole[:count, count:].T
    for f in range(poses):
        own = slice(count + 6 * f, count + 6 * f + 6)
        whole[own, own] = normal.pp[f]
    scale = 1.0 / np.sqrt(np.diag(whole))
    inverse = np.linalg.inv(whole * scale[:, None] * scale) * scale[:, None] * scale
    n = layout.shape.start + observations.shape.basis.shape[-1]
    known = GlobalCovariance(normal, 0.5, Clustered(0.25 * normal.covariance[0][:n, :n], 1.0, float("inf")))
    root = rng.normal(size=(count, 3)) * scale[:count, None]
    for c, lens_of in enumerate(layout.cameras):
        before = state.of_camera(c, observations)

        def shown(x: np.ndarray, c: int = c, before: State = before) -> np.ndarray:
            moved = state.moved(SchurStep(x[:count], x[count:].reshape(-1, 6), 0.0), layout)
            now = moved.of_camera(c, observations)
            turn = log_so3(now.rotation @ np.swapaxes(before.rotation, 1, 2))
            shift = now.translation_mm - before.translation_mm + np.cross(before.translation_mm, turn)
            return np.concatenate([moved.cameras[c].parameters, turn.mean(axis=0), shift.mean(axis=0)])

        h = 1e-4 * scale
        design = np.array([(shown(s * e) - shown(-s * e)) / (2 * s) for s, e in zip(h, np.eye(h.size), strict=True)]).T
        # Poses follow what is not sure of the globals beside.
        through = design[:, :count] - design[:, count:] @ normal.covariance[1].reshape(-1, count)
        parts = pose_jacobians(observations, state, c, before.translation_mm)
        for more, expected in (
            (None, 0.25 * design @ inverse @ design.T),
            (root @ root.T, 0.25 * design @ inverse @ design.T + through @ root @ root.T @ through.T),
        ):
            found = known.of_camera(lens_of, parts, before.translation_mm, more)
            size = np.sqrt(np.diag(expected))
            assert (np.abs(found - expected) < 1e-5 * size[:, None] * size).all()


def test_views_of_which_no_corner_counts_have_no_part_in_the_mean_motion(rng: np.random.Generator) -> None:
    observations, state = _small_rig("flat", False, rng)
    known = np.arange(len(observations.keys)) > 0
    weights = [w * known[f][:, None] for w, f in zip(observations.weights, observations.frame, strict=True)]
    found = []
    for seen in (replace(observations, weights=tuple(weights)), observations.subset(known)):
        normal, lens_of = rig_normal(seen, state, SHAPE_WEIGHT), state.layout(seen).cameras[1]
        translation = state.of_camera(1, seen).translation_mm
        sure = GlobalCovariance(normal, 0.5, Clustered(0.25 * normal.covariance[0], 1.0, float("inf")))
        found.append(sure.of_camera(lens_of, pose_jacobians(seen, state, 1, translation), translation))
    scale = np.sqrt(np.diag(found[1]))
    assert (np.abs(found[0] - found[1]) < 1e-9 * scale[:, None] * scale).all()


def test_baseline_sigma_is_that_of_moved_mounts(rng: np.random.Generator) -> None:
    """The variance of a baseline against mounts drawn from the covariance."""
    rig = calibrate_rig(rig_views(rng, 20), sizes(), model=MODELS)
    length, sigma = rig.baseline_mm("wide", "fish")
    count = sum(c.camera.parameters.size for c in rig.cameras)
    drawn = rng.multivariate_normal(np.zeros(12), rig.covariance[count:, count:], size=4000)
    centres = []
    for k, camera in enumerate(rig.cameras[1:]):
        moved = drawn[:, 6 * k : 6 * k + 6]
        rotation = exp_so3(moved[:, :3]) @ camera.cam_from_rig.rotation
        translation = camera.cam_from_rig.translation_mm + moved[:, 3:]
        centres.append(-np.einsum("nji,nj->ni", rotation, translation))
    lengths = np.linalg.norm(centres[1] - centres[0], axis=1)
    # 4000 draws know a standard deviation to 1.1 %.
    assert lengths.std() == pytest.approx(sigma, rel=0.05)
    assert lengths.mean() == pytest.approx(length, abs=sigma)


def test_cameras_that_share_nothing_are_named(rng: np.random.Generator) -> None:
    views = rig_views(rng, 16)
    views["fish"] = [(f"other{frame}", view) for frame, view in views["fish"]]
    with pytest.raises(
        InputError, match=r"'fish' shares no board .* mounted to each other, declared as \[\[rigid_boards\]\]"
    ):
        calibrate_rig(views, sizes(), model=MODELS)
    with pytest.raises(InputError, match="at least two"):
        calibrate_rig({"reg": views["reg"]}, sizes())


def test_transfer_follows_the_covariance(rng: np.random.Generator) -> None:
    """Against central differences by every parameter and mount, the pixel in the first camera held."""
    rig = calibrate_rig(rig_views(rng, 8), sizes(), model=MODELS, folds=0)
    first = rig.cameras[1].camera.unproject(np.array([[700.0, 500.0], [900.0, 700.0]]))[0] * np.array(
        [[450.0], [600.0]]
    )
    covariance, seen = transfer_covariance(rig, "wide", "fish", first)
    assert seen.all()
    pixel = rig.cameras[1].camera.project(first)[0]
    length = np.linalg.norm(first, axis=1, keepdims=True)
    lenses, known = rig.quoted.cameras, rig.quoted.covariance
    assert len(known) > len(rig.covariance)
    ends = np.cumsum([0, *(camera.parameters.size for camera in lenses)])

    def there(x: np.ndarray) -> np.ndarray:
        cameras = [
            camera.with_parameters(camera.parameters + x[a:b])
            for camera, a, b in zip(lenses, ends[:-1], ends[1:], strict=True)
        ]
        moves = x[ends[-1] :].reshape(-1, 6)
        poses = [
            Rigid3(exp_so3(m[:3]) @ c.cam_from_rig.rotation, c.cam_from_rig.translation_mm + m[3:])
            for c, m in zip(rig.cameras[1:], moves, strict=True)
        ]
        return cameras[2].project((poses[1] @ poses[0].inverse()).apply(length * cameras[1].unproject(pixel)[0]))[0]

    sigma = np.sqrt(np.diag(known))
    slope = np.array([(there(d) - there(-d)) / (2e-3 * s) for d, s in zip(np.diag(1e-3 * sigma), sigma, strict=True)])
    expected = np.einsum("anx,ab,bny->nxy", slope, known, slope)
    assert np.abs(covariance - expected).max() < 1e-3 * np.abs(expected).max()


def test_cameras_of_different_noise_keep_their_own(rng: np.random.Generator) -> None:
    """A sharp camera is not spoilt by a blurred one: each residual counts in its own camera's noise."""
    views = {name: own for name, own in rig_views(rng, 15).items() if name != "fish"}
    views["wide"] = [
        (f, replace(v, pixels=np.clip(v.pixels + 0.8 * rng.normal(size=v.pixels.shape), 0.0, 1239.0)))
        for f, v in views["wide"]
        if (v.pixels < 1230.0).all()
    ]
    rig = calibrate_rig(views, sizes(), model=MODELS, folds=0)
    sharp, alone = rig.cameras[0].calibration, rig.single[0]
    assert (sharp.parameter_sigmas[:4] / rig.overdispersion < 1.05 * alone.parameter_sigmas[:4]).all()


def test_transfer_errors_agree_with_their_sigmas() -> None:
    """Where points of one camera appear in another: errors over predicted deviations, 20 rigs."""
    z = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        rig = calibrate_rig(rig_views(rng, 10), sizes(), model=MODELS, folds=0)
        pixels = rng.uniform([500.0, 350.0], [1100.0, 850.0], size=(8, 2))
        for a, b in (("reg", "wide"), ("wide", "fish")):
            (camera_a, a_from_rig), (camera_b, b_from_rig) = mounts()[a], mounts()[b]
            distance = rng.uniform(400.0, 700.0, size=(8, 1))
            true = camera_b.project(
                (b_from_rig @ a_from_rig.inverse()).apply(distance * camera_a.unproject(pixels)[0])
            )[0]
            points = distance * rig.cameras[rig.index(a)].camera.unproject(pixels)[0]
            found = rig.cameras[rig.index(b)].camera.project(rig.cam2_from_cam1(a, b).apply(points))[0]
            covariance, seen = transfer_covariance(rig, a, b, points)
            assert seen.all()
            z.append((found - true) / np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1)))
    # 40 rigs and pairs, about three independent numbers each.
    assert 0.85 < np.sqrt(np.mean(np.square(z))) < 1.15
    transfer = transfer_uncertainty(rig, "reg", "wide")
    assert transfer is not None and 0.0 < transfer.median_px < transfer.worst_px


def test_overdispersion_has_no_bias_with_few_frames() -> None:
    """Six frames hold the solution fast: what each has pulled it by is counted."""
    squared = []
    for seed in range(16):
        views = {n: own for n, own in rig_views(np.random.default_rng(seed), 6).items() if n != "fish"}
        squared.append(calibrate_rig(views, sizes(), model=MODELS, folds=0).overdispersion ** 2)
    # One run scatters by 0.24 (0.12 of the standard deviation): 16 by 0.06.
    assert np.mean(squared) == pytest.approx(1.0, abs=0.2)


def test_overdispersion_is_one_for_noise_and_more_for_errors_in_common() -> None:
    """Boards that are not what they are said to be: sigmas grow, and with them the truth stays within reach."""
    clean, bumpy, z = [], [], []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        views = {n: own for n, own in rig_views(rng, 12).items() if n != "fish"}
        clean.append(calibrate_rig(views, sizes(), model=MODELS, folds=0).overdispersion)
        column = np.zeros((54, 3))
        column[:, 0] = 0.12 * rng.normal(size=9)[BOARD.grid()[:, 0]]
        column[:, 2] = 0.3 * (np.linspace(-1.0, 1.0, 9)[BOARD.grid()[:, 0]] ** 2)
        views = {n: own for n, own in rig_views(rng, 12, bumps_mm=column).items() if n != "fish"}
        rig = calibrate_rig(views, sizes(), model=MODELS, folds=0)
        bumpy.append(rig.overdispersion)
        length, sigma = rig.baseline_mm("reg", "wide")
        z.append((length - np.linalg.norm(mounts()["wide"][1].translation_mm)) / sigma)
    assert np.mean(clean) < 1.1 and np.mean(bumpy) > 1.15
    assert np.sqrt(np.mean(np.square(z))) < 1.6


def test_a_mixup_of_all_frames_is_looked_for_where_most_of_them_disagree(monkeypatch: pytest.MonkeyPatch) -> None:
    cause = Finding.bad("the images of 'right' are mirrored", "use the image files as the camera wrote them")
    monkeypatch.setattr("rigkit.calibration.rig.calibrate.mixup_of_all_frames", lambda views: cause)
    rig, views = cast(RigCalibration, SimpleNamespace(cameras=(), left_out=())), RigViews([], [], (), {})
    assert _mistakes(rig, views, 1e3) == [cause]
    assert _mistakes(rig, views, 1.0) == []


@pytest.mark.parametrize("converged", [False, True])
def test_a_solution_that_did_not_converge_is_bad(converged: bool) -> None:
    rig = cast(RigCalibration, SimpleNamespace(convergence=SimpleNamespace(converged=converged, reason="50 rounds")))
    found = list(_not_converged(rig))
    assert [one.severity for one in found] == [Severity.BAD] * (not converged)
    assert converged or "did not converge (50 rounds)" in found[0].message
