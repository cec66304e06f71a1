"""Comparison of rigs, and what a rig's file has of its lenses."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.rig_scenes import MODELS, Views, rig_views, sizes

from rigkit.calibration.rig.calibrate import calibrate_rig
from rigkit.calibration.rig.compare import compare_mounts
from rigkit.calibration.rig.mounted import MountedCameras
from rigkit.calibration.rig.result import RigCalibration
from rigkit.core.errors import InputError
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3, log_so3
from rigkit.io.calibrations.rig_file import load_saved_rig, rig_text
from rigkit.kernels.departures import displacements
from rigkit.workflows.checks.certify import load_instrument
from rigkit.workflows.checks.diff import RigPair, diff

MOVED_MM = 1.0
RIGS = 12


def mounted(rig: RigCalibration) -> MountedCameras:
    """Without departures, which are the same in all these rigs."""
    return replace(rig.mounted, departures=())


@pytest.fixture(scope="module")
def rigs() -> list[MountedCameras]:
    found = []
    for seed in range(RIGS):
        views = {n: own for n, own in rig_views(np.random.default_rng(seed), 12).items() if n != "fish"}
        found.append(mounted(calibrate_rig(views, sizes(), model=MODELS, folds=0)))
    return found


def moved(rig: MountedCameras, name: str, by: Rigid3) -> MountedCameras:
    cameras = {n: (c, by @ m if n == name else m) for n, (c, m) in rig.cameras.items()}
    return replace(rig, cameras=cameras)


def test_another_board_size_is_reported_as_scale_and_not_as_motion(rigs: list[MountedCameras]) -> None:
    """All lengths are longer by one factor; a camera that moved otherwise leaves no such factor."""
    first, second = rigs[:2]
    scaled = {n: (c, Rigid3(m.rotation, 1.2 * m.translation_mm)) for n, (c, m) in second.cameras.items()}
    found = compare_mounts(first, replace(second, cameras=scaled))
    assert found.same is False and found.scale == pytest.approx(1.2, rel=0.01)
    turned = Rigid3(exp_so3(np.array([0.0, 0.02, 0.0])), [5.0, 3.0, 0.0])
    other = compare_mounts(first, moved(second, "wide", turned))
    assert other.same is False and other.scale is None
    assert compare_mounts(first, second).scale is None


def test_rigs_that_did_not_change_are_the_same(rigs: list[MountedCameras]) -> None:
    """Chances of one and the same rig are uniform, and what was moved is found."""
    found = [compare_mounts(a, b).chance for a, b in zip(rigs[::2], rigs[1::2], strict=True)]
    chances = [chance for chance in found if chance is not None]
    assert len(chances) == len(found)
    assert min(chances) > 0.01 and 0.15 < np.mean(chances) < 0.9
    turned = Rigid3(exp_so3(np.array([0.0, 0.004, 0.0])), [MOVED_MM, 0.0, 0.0])
    other = compare_mounts(rigs[0], moved(rigs[1], "wide", turned))
    assert other.same is False and other.mounts[0].rotation_deg > 0.15


def test_a_turn_of_the_lens_that_the_mount_takes_up_is_no_motion(rigs: list[MountedCameras]) -> None:
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
    hidden = compare_mounts(rig, replace(rig, cameras=both))
    plain = compare_mounts(rig, moved(rig, "wide", turn))
    assert hidden.mounts[0].rotation_deg < 0.3 * plain.mounts[0].rotation_deg
    assert hidden.chance is not None
    assert plain.chance is not None
    assert hidden.chance > plain.chance


def test_a_rig_without_covariance_has_no_p_values(rigs: list[MountedCameras]) -> None:
    found = compare_mounts(rigs[0], replace(rigs[1], covariance=None))
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


def mount_differences(a: Path, b: Path) -> float:
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
    lenses = rig.mounted.with_departures.lenses
    instrument = load_instrument(path, ("reg", "fish"))
    assert [c.parameters.size for c in instrument.cameras] == [lenses[k].parameters.size for k in (0, 2)]
    assert instrument.layout.cameras[-1].stop > sum(rig.cameras[k].camera.parameters.size for k in (0, 2))
    # What lenses may do moves mounts: a difference of theirs is less of a surprise.
    other = tmp_path / "other.json"
    other.write_text(rig_text(calibrated(rig_views(rng, 8))))
    found = mount_differences(path, other)
    # A file of before files said so, and damaged ones.
    for old in (path, other):
        data = json.loads(old.read_text())
        for camera in data["cameras"]:
            camera.pop("departures")
        (tmp_path / f"old-{old.name}").write_text(json.dumps(data))
    assert found > mount_differences(tmp_path / "old-rig.json", tmp_path / "old-other.json")
    data = json.loads(path.read_text())
    for camera in data["cameras"]:
        camera.pop("departures")
    path.write_text(json.dumps(data))
    assert load_saved_rig(path).departures == ()
    own = load_instrument(path).layout.cameras[-1].stop
    assert own == sum(rig.cameras[k].camera.parameters.size for k in (0, 1))
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
