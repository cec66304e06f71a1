"""Rigs: mounts, baseline and its uncertainty, against known rigs of mixed lenses."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.calibration_scenes import BOARD, lens

from rigkit.calibration.camera_prior import camera_prior
from rigkit.calibration.normal_equations import SchurStep
from rigkit.calibration.observations import Observations
from rigkit.calibration.rig.calibrate import calibrate_rig
from rigkit.calibration.rig.compare import Mounted, compare_mounts
from rigkit.calibration.rig.result import RigCalibration
from rigkit.calibration.rig.solver import rig_normal
from rigkit.calibration.rig.state import RigObservations, RigState
from rigkit.calibration.rig.uncertainty import transfer_covariance, transfer_uncertainty
from rigkit.calibration.shape import shape_model
from rigkit.calibration.state import evaluate
from rigkit.cameras.base import Camera
from rigkit.core.boards import Board
from rigkit.core.detections import BoardView
from rigkit.core.errors import InputError
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3, log_so3
from rigkit.io.rig_file import load_saved_rig, rig_text
from rigkit.kernels.departures import displacements
from rigkit.workflows.certify import load_instrument
from rigkit.workflows.diff import RigPair, diff

NOISE_PX = 0.2
SIGMAS = 4.0
"""A mount further than this from the truth, in its own standard deviations, is wrong: 1 in 16000 by chance."""
MOVED_MM = 1.0
RIGS = 12
MODELS = {"reg": "brown", "wide": "kannala_brandt", "fish": "kannala_brandt"}

Views = dict[str, list[tuple[str, BoardView]]]


def mounts() -> dict[str, tuple[Camera, Rigid3]]:
    turned = exp_so3(np.array([0.02, -0.1, 0.3]))
    return {
        "reg": (lens("reg"), Rigid3.identity()),
        "wide": (lens("wide"), Rigid3(turned, [-120.0, 15.0, 5.0])),
        "fish": (lens("fish"), Rigid3(turned.T, [140.0, -20.0, 30.0])),
    }


def rig_views(
    rng: np.random.Generator, frames: int, *, chain: bool = False, bumps_mm: np.ndarray | float = 0.0
) -> Views:
    """Return frames seen by all cameras that have the board in view; with `chain` never by first and last at once.

    `bumps_mm` (54, 3) is how far the corners are from where the board is said to have them.
    """
    views: Views = {name: [] for name in mounts()}
    k = 0
    for _ in range(2000):
        if k == frames:
            break
        rotation = exp_so3(rng.normal(size=3) * np.array([0.45, 0.45, 1.5]))
        middle = rotation @ BOARD.points().mean(axis=0)
        rig_from_board = Rigid3(
            rotation, np.array([rng.uniform(-160, 160), rng.uniform(-110, 110), rng.uniform(350, 700)]) - middle
        )
        seen = {}
        for name, (camera, cam_from_rig) in mounts().items():
            pixels, valid = camera.project((cam_from_rig @ rig_from_board).apply(BOARD.points() + bumps_mm))
            if valid.all() and camera.on_image(pixels).all():
                noisy = np.clip(pixels + NOISE_PX * rng.normal(size=pixels.shape), 0.0, np.array(camera.size_px) - 1.0)
                seen[name] = BoardView(f"{name}{k}.png", BOARD, BOARD.grid(), noisy, np.full(54, NOISE_PX))
        if len(seen) < 2:
            continue
        if chain:
            seen.pop("reg" if k % 2 else "fish", None)
        for name, view in seen.items():
            views[name].append((f"{k:03d}", view))
        k += 1
    assert k == frames
    return views


def sizes() -> dict[str, tuple[int, int]]:
    return {name: camera.size_px for name, (camera, _) in mounts().items()}


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


@pytest.mark.parametrize("kind", ["flat", "warp", "released"])
@pytest.mark.parametrize("tied", [False, True])
def test_gradient_and_gauss_newton_matrix(kind: str, tied: bool, rng: np.random.Generator) -> None:
    """Central differences of the cost and of the residuals, by every kind of unknown."""
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
    layout = state.layout(observations)
    assert layout.count == 17 + 6 + (6 if tied else 0) + shape.count
    normal = rig_normal(observations, state)
    scale = np.ones(layout.count + 6 * poses)
    for run, camera in zip(layout.cameras, state.cameras, strict=True):
        scale[run] = 1e-2 * np.maximum(np.abs(camera.parameters), 1e-2)

    def residuals(x: np.ndarray) -> np.ndarray:
        moved = state.moved(SchurStep(x[: layout.count], x[layout.count :].reshape(-1, 6), 0.0), layout)
        assert moved is not None
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
    numeric = (jacobian @ jacobian.T) * scale[:, None] * scale
    assert np.abs(numeric - gauss_newton * scale[:, None] * scale).max() < 1e-5 * np.abs(numeric).max()
    with_priors = rig_normal(observations, state, 0.3)
    expected = sum(float((camera_prior(camera)[1] ** 2).sum()) for camera in state.cameras)
    expected += float(((state.unknowns / shape.sigma) ** 2).sum())
    assert with_priors.cost - normal.cost == pytest.approx(0.09 * expected, rel=1e-6)
    gradient = (jacobian @ residuals(np.zeros(h.size))) * scale
    assert np.abs(gradient - np.concatenate([normal.g, normal.p.ravel()]) * scale).max() < 1e-5 * np.abs(gradient).max()


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
    with pytest.raises(InputError, match="'fish' shares no board"):
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
    lenses, known = rig.quoted
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


def test_transfer_is_as_sure_as_it_says() -> None:
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


def mounted(rig: RigCalibration) -> Mounted:
    cameras = {c.name: (c.camera, c.cam_from_rig) for c in rig.cameras}
    return Mounted(cameras, rig.covariance, rig.freedom)


@pytest.fixture(scope="module")
def rigs() -> list[Mounted]:
    found = []
    for seed in range(RIGS):
        views = {n: own for n, own in rig_views(np.random.default_rng(seed), 12).items() if n != "fish"}
        found.append(mounted(calibrate_rig(views, sizes(), model=MODELS, folds=0)))
    return found


def moved(rig: Mounted, name: str, by: Rigid3) -> Mounted:
    cameras = {n: (c, by @ m if n == name else m) for n, (c, m) in rig.cameras.items()}
    return Mounted(cameras, rig.covariance, rig.freedom)


def test_rigs_that_did_not_change_are_the_same(rigs: list[Mounted]) -> None:
    """Chances of one and the same rig are uniform, and what was moved is found."""
    found = [compare_mounts(a, b).chance for a, b in zip(rigs[::2], rigs[1::2], strict=True)]
    chances = [chance for chance in found if chance is not None]
    assert len(chances) == len(found)
    assert min(chances) > 0.01 and 0.15 < np.mean(chances) < 0.9
    turned = Rigid3(exp_so3(np.array([0.0, 0.004, 0.0])), [MOVED_MM, 0.0, 0.0])
    other = compare_mounts(rigs[0], moved(rigs[1], "wide", turned))
    assert other.same is False and other.mounts[0].rotation_deg > 0.15


def test_a_turn_of_the_lens_that_the_mount_takes_up_is_no_motion(rigs: list[Mounted]) -> None:
    """A moved principal point and a mount turned back by what it looks like: the same rig. The mount alone, turned by
    as much: another one."""
    rig = rigs[0]
    camera, mount = rig.cameras["wide"]
    shifted = camera.parameters.copy()
    # Kannala-Brandt: fx, fy, cx, cy, ...
    shifted[2] += 2.0
    other = camera.with_parameters(shifted)
    turn = Rigid3(exp_so3(np.array([0.0, -2.0 / shifted[0], 0.0])), np.zeros(3))
    both = dict(rig.cameras) | {"wide": (other, turn @ mount)}
    hidden = compare_mounts(rig, Mounted(both, rig.covariance, rig.freedom))
    plain = compare_mounts(rig, moved(rig, "wide", turn))
    assert hidden.mounts[0].rotation_deg < 0.3 * plain.mounts[0].rotation_deg
    assert hidden.chance is not None
    assert plain.chance is not None
    assert hidden.chance > plain.chance


def test_mounts_of_a_rig_that_does_not_say_how_sure_it_is_have_no_chance(rigs: list[Mounted]) -> None:
    found = compare_mounts(rigs[0], Mounted(rigs[1].cameras, None))
    assert found.chance is None and found.same is None and found.mounts[0].shift_mm > 0.0


def calibrated(views: Views) -> RigCalibration:
    return calibrate_rig(views, sizes(), model=MODELS, board="flat", folds=0)


def globals_of(rig: RigCalibration, start: RigCalibration) -> np.ndarray:
    """Return how intrinsics and mounts differ from those of another rig, in the order of its covariance."""
    out = [c.camera.parameters - s.camera.parameters for c, s in zip(rig.cameras, start.cameras, strict=True)]
    for c, s in zip(rig.cameras[1:], start.cameras[1:], strict=True):
        now, then = c.cam_from_rig, s.cam_from_rig
        out += [log_so3(now.rotation @ then.rotation.T), now.translation_mm - then.translation_mm]
    return np.concatenate(out)


def test_the_rig_follows_a_departure_as_a_new_fit_does(rng: np.random.Generator) -> None:
    """One lens moved by its largest mode: all intrinsics and mounts of a new calibration are off by the moves."""
    views = rig_views(rng, 12)
    start = calibrated(views)
    own = start.departures[2]
    size = start.cameras[2].camera.size_px
    moved = dict(views)
    moved["fish"] = [
        (frame, replace(v, pixels=v.pixels + np.einsum("ijn,j->ni", displacements(v.pixels, size), own.modes[:, -1])))
        for frame, v in views["fish"]
    ]
    # What is right is the fit less what it has followed.
    off, sigma = -globals_of(calibrated(moved), start), np.sqrt(np.diag(start.covariance))
    expected = own.moves[:, -1] / sigma
    assert np.abs(expected).max() > 0.05
    assert off / sigma == pytest.approx(expected, abs=0.1 * np.abs(expected).max())
    assert np.abs(expected[-12:]).max() > 0.02


def mounts_apart(a: Path, b: Path) -> float:
    """Return the chance of the difference of two rigs' mounts."""
    found = diff(a, b)
    assert isinstance(found, RigPair) and found.mounts.chance is not None
    return found.mounts.chance


def test_a_rig_file_says_what_lenses_may_do_beyond_their_models(rng: np.random.Generator, tmp_path: Path) -> None:
    rig = calibrated(rig_views(rng, 8))
    path = tmp_path / "rig.json"
    path.write_text(rig_text(rig))
    saved = load_saved_rig(path)
    for own, back in zip(rig.departures, saved.departures, strict=True):
        assert (own.modes == back.modes).all() and (own.moves == back.moves).all()
    lenses, _ = rig.with_departures
    instrument = load_instrument(path, ("reg", "fish"))
    assert [c.parameters.size for c in instrument.cameras] == [lenses[k].parameters.size for k in (0, 2)]
    assert instrument.intrinsic_count > sum(rig.cameras[k].camera.parameters.size for k in (0, 2))
    # What lenses may do moves mounts: a difference of theirs is less of a surprise.
    other = tmp_path / "other.json"
    other.write_text(rig_text(calibrated(rig_views(rng, 8))))
    found = mounts_apart(path, other)
    # A file of before files said so, and damaged ones.
    for old in (path, other):
        data = json.loads(old.read_text())
        for camera in data["cameras"]:
            camera.pop("departures")
        (tmp_path / f"old-{old.name}").write_text(json.dumps(data))
    assert found > mounts_apart(tmp_path / "old-rig.json", tmp_path / "old-other.json")
    data = json.loads(path.read_text())
    for camera in data["cameras"]:
        camera.pop("departures")
    path.write_text(json.dumps(data))
    assert load_saved_rig(path).departures == ()
    assert load_instrument(path).intrinsic_count == sum(rig.cameras[k].camera.parameters.size for k in (0, 1))
    damages: list[dict[str, object]] = [
        {"modes": [[1.0]], "moves": [[1.0]]},
        {"modes": []},
        {"modes": [["x"]], "moves": []},
    ]
    for damage in damages:
        data["cameras"][0]["departures"] = damage
        path.write_text(json.dumps(data))
        with pytest.raises(InputError, match=r"rig\.json"):
            load_saved_rig(path)
