"""`rigkit reconstruct --rig RIG --images A B C`: several views with known poses become one cloud."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.textured_scene import Corner

from rigkit.cameras.pinhole import Pinhole
from rigkit.cli.main import main
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3
from rigkit.io.calibrations.calibration_file import camera_to_json
from rigkit.io.ply import read_ply
from rigkit.workflows.reconstruction.reconstruct_rig import neighbouring_pairs

CAMERA = Pinhole((240, 180), np.array([210.0, 210.0, 119.5, 89.5]))
TURNS = ((0.0, 0.0, 0.0), (0.02, -0.12, 0.05), (0.03, -0.2, 0.02))
PLACES_MM = ((0.0, 0.0, 0.0), (150.0, -50.0, 30.0), (260.0, 20.0, 40.0))
POSES = tuple(
    Rigid3(exp_so3(np.array(w)), -exp_so3(np.array(w)) @ np.array(c)) for w, c in zip(TURNS, PLACES_MM, strict=True)
)


@pytest.fixture(scope="module")
def corner_images() -> list[np.ndarray]:
    """One picture of the corner by each camera."""
    rng = np.random.default_rng(5)
    return [Corner.of_a_room().image(CAMERA, pose, rng) for pose in POSES]


@pytest.fixture
def files(corner_images: list[np.ndarray], tmp_path: Path) -> tuple[Path, list[str], Corner]:
    """A folder with the rig's file, three images, and the exact scene."""
    names = [str(tmp_path / f"{k}.png") for k in range(len(corner_images))]
    for name, picture in zip(names, corner_images, strict=True):
        cv2.imwrite(name, picture)
    cameras = [
        {"name": f"cam{k}", "camera": camera_to_json(CAMERA), "cam_from_rig": p.matrix()[:3].tolist(), "rms_px": 0.1}
        for k, p in enumerate(POSES)
    ]
    (tmp_path / "rig.json").write_text(json.dumps({"schema": "rigkit.rig/1", "cameras": cameras}))
    return tmp_path, names, Corner.of_a_room()


def run(folder: Path, *more: str) -> int:
    return main(["reconstruct", "--rig", str(folder / "rig.json"), "-o", str(folder / "out"), *more])


def test_three_views_become_one_cloud(
    files: tuple[Path, list[str], Corner], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, images, corner = files
    # Views are simulated where features are few; `rigkit reconstruct --images` is tested with those.
    monkeypatch.setattr("rigkit.affine.features.ENOUGH_PLAIN", 50)
    # The world is the frame of the first image's camera, which need not be the rig's first.
    order = [1, 0, 2]
    names = [f"cam{k}" for k in order]
    assert run(folder, "--images", *(images[k] for k in order), "--names", *names, "--json") == 0
    result = json.loads(capsys.readouterr().out)
    cloud = read_ply(folder / "out" / "scene.ply")
    assert len(cloud) == result["points"] > 2000
    assert result["merged"] > 500
    assert {tuple(sorted(pair["cameras"])) for pair in result["pairs"]} == {
        ("cam0", "cam1"),
        ("cam0", "cam2"),
        ("cam1", "cam2"),
    }
    points = POSES[1].inverse().apply(cloud.points_mm)
    off = np.abs((points - corner.apex_mm) @ corner.axes).min(axis=1)
    # Of a distance of 1.3 m: a thousandth.
    assert np.median(off) < 1.3
    assert sorted(p.name for p in (folder / "out").iterdir()) == ["cloud.png", "scene.html", "scene.ply"]


def test_views_that_cannot_be_fused_are_named(
    files: tuple[Path, list[str], Corner], capsys: pytest.CaptureFixture[str]
) -> None:
    folder, images, _ = files
    for more, words in (
        (("--images", *images, "--pose-type", "general"), "--pose-type applies to two images only"),
        (("--images", *images, "--names", "cam0", "cam1"), "3 images for 2 names"),
        (("--images", *images, "--names", "cam0", "cam1", "left"), "no camera 'left'"),
        (("--images", images[0]), "--images names two"),
        (("--images", images[0], images[1], images[1]), "same picture"),
    ):
        assert run(folder, *more, "--no-pictures") == 2, more
        assert words in capsys.readouterr().err
    assert main(["reconstruct", "--camera", str(folder / "rig.json"), "--images", *images]) == 2
    assert "need --rig" in capsys.readouterr().err


def test_views_are_paired_with_their_neighbours_that_look_the_same_way() -> None:
    def at(x: float, turn: float) -> Rigid3:
        return (
            Rigid3(np.eye(3), [-x, 0.0, 0.0]) if not turn else Rigid3(exp_so3(np.array([0.0, turn, 0.0])), [-x, 0, 0])
        )

    row = [at(100.0 * k, 0.0) for k in range(6)]
    pairs = neighbouring_pairs(row)
    assert (0, 1) in pairs
    assert (0, 5) not in pairs
    assert all(i < j for i, j in pairs)
    # Two places are one: no baseline.
    assert neighbouring_pairs([at(0.0, 0.0), at(0.0, 0.0), at(100.0, 0.0)]) == [(0, 2), (1, 2)]


def test_exchanged_images_of_a_rig_are_named(
    files: tuple[Path, list[str], Corner], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, images, _ = files
    monkeypatch.setattr("rigkit.affine.features.ENOUGH_PLAIN", 50)
    assert run(folder, "--images", images[1], images[0], "--sparse") == 3
    printed = capsys.readouterr().err
    assert f"images '{images[1]}' and '{images[0]}' are exchanged" in printed and "--names" in printed
