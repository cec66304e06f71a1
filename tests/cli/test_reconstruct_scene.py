"""`rigkit reconstruct` on scenes without boards: files in, files out, bad input in one line."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.data import shared_data
from helpers.epipolar_scenes import REGULAR, pair, pose_errors_deg
from helpers.textured_scene import Corner

from rigkit.affine.correspondences import Correspondences
from rigkit.calibration.result import Calibration
from rigkit.cameras.pinhole import Pinhole
from rigkit.cli.main import main
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3
from rigkit.io.calibrations.calibration_file import save_calibration, save_camera
from rigkit.io.corners.correspondences import correspondences_text, read_correspondences
from rigkit.io.ply import read_ply

SMALL = Pinhole((320, 240), np.array([280.0, 280.0, 159.5, 119.5]))
TURN = exp_so3(np.array([0.02, -0.2, 0.05]))
CAM2_FROM_CAM1 = Rigid3(TURN, -TURN @ [280.0, -30.0, 40.0])


@pytest.fixture
def files(tmp_path: Path, rng: np.random.Generator) -> tuple[Path, Rigid3]:
    """A folder with a camera and correspondences; the true pose."""
    m, pose, _ = pair(rng, 60, noise_px=0.3, sigma_A=0.03)
    save_camera(tmp_path / "camera.json", REGULAR)
    (tmp_path / "found.csv").write_text(correspondences_text(Correspondences(m.pixels1, m.pixels2, m.A21)))
    return tmp_path, pose


def run(folder: Path, *more: str) -> int:
    return main(["reconstruct", "--camera", str(folder / "camera.json"), "-o", str(folder / "out"), *more])


def test_a_file_of_correspondences(files: tuple[Path, Rigid3], capsys: pytest.CaptureFixture[str]) -> None:
    folder, pose = files
    assert run(folder, "--correspondences", str(folder / "found.csv"), "--baseline-mm", "300", "--json") == 0
    result = json.loads(capsys.readouterr().out)
    assert result["unit"] == "mm"
    # 60 points at 0.3 px know the pose to about 0.05 degrees.
    assert max(pose_errors_deg(Rigid3.from_matrix(result["cam2_from_cam1"]), pose)) < 0.5
    assert len(read_ply(folder / "out" / "scene.ply")) == result["points"] > 50
    assert sorted(p.name for p in (folder / "out").iterdir()) == ["cloud.png", "scene.html", "scene.ply"]
    assert run(folder, "--correspondences", str(folder / "found.csv")) == 2
    assert "--force" in capsys.readouterr().err
    assert run(folder, "--correspondences", str(folder / "found.csv"), "--force", "--no-pictures") == 0
    printed = capsys.readouterr()
    assert "(baselines)" in printed.out
    assert "lengths are in baselines" in printed.err
    assert b"units baselines" in (folder / "out" / "scene.ply").read_bytes()[:300]


def test_a_pose_that_the_images_contradict(files: tuple[Path, Rigid3], capsys: pytest.CaptureFixture[str]) -> None:
    folder, pose = files
    wrong = Rigid3(exp_so3(np.array([0.0, 0.0, 0.1])) @ pose.rotation, pose.translation_mm)
    np.savetxt(folder / "wrong.txt", wrong.matrix())
    given = ("--correspondences", str(folder / "found.csv"), "--no-pictures")
    assert run(folder, *given, "--pose", str(folder / "wrong.txt")) == 3
    assert "of 60 correspondences agree with the measured pose" in capsys.readouterr().err


@pytest.mark.parametrize("layout", ["npz", "extractor"])
def test_other_layouts_of_the_file(files: tuple[Path, Rigid3], layout: str, capsys: pytest.CaptureFixture[str]) -> None:
    folder, _ = files
    found = read_correspondences(folder / "found.csv")
    assert found.A21 is not None
    if layout == "npz":
        np.savez(folder / "other.npz", pixels1=found.pixels1, pixels2=found.pixels2, A21=found.A21)
    else:
        shift = found.pixels2 - np.einsum("nij,nj->ni", found.A21, found.pixels1)
        # a11 a21 a12 a22 tx ty x1 y1 x2 y2
        columns = [np.swapaxes(found.A21, 1, 2).reshape(-1, 4), shift, found.pixels1, found.pixels2]
        np.savetxt(folder / "other.npz", np.hstack(columns), fmt="%.17g")
    results = []
    for name in ("found.csv", "other.npz"):
        assert run(folder, "--correspondences", str(folder / name), "--json", "--no-pictures", "--force") == 0
        results.append(np.array(json.loads(capsys.readouterr().out)["cam2_from_cam1"]))
    np.testing.assert_allclose(results[0], results[1], atol=1e-7)


@pytest.mark.parametrize(("second", "stated"), [("camera.json", False), ("calibration.json", True)])
def test_sigmas_are_said_to_include_the_calibrations_only_where_both_state_one(
    second: str, stated: bool, files: tuple[Path, Rigid3], calibration: Calibration
) -> None:
    folder, _ = files
    save_calibration(folder / "calibration.json", calibration)
    cameras = ["--camera", str(folder / "calibration.json"), "--camera2", str(folder / second)]
    assert (
        main(["reconstruct", *cameras, "-o", str(folder / "out"), "--correspondences", str(folder / "found.csv")]) == 0
    )
    assert read_ply(folder / "out" / "scene.ply").calibration_in_sigmas == stated


def pictures_of_a_corner(folder: Path, rng: np.random.Generator) -> tuple[Corner, list[str]]:
    """Write a camera and two pictures of the corner of a room; return the corner and the pictures' names."""
    corner = Corner.of_a_room()
    save_camera(folder / "camera.json", SMALL)
    names = []
    for name, pose in (("a.png", Rigid3.identity()), ("b.png", CAM2_FROM_CAM1)):
        cv2.imwrite(str(folder / name), corner.image(SMALL, pose, rng))
        names.append(str(folder / name))
    return corner, names


def test_two_images(tmp_path: Path, rng: np.random.Generator, capsys: pytest.CaptureFixture[str]) -> None:
    corner, names = pictures_of_a_corner(tmp_path, rng)
    assert run(tmp_path, "--images", *names, "--json") == 0
    out, err = capsys.readouterr()
    result = json.loads(out)
    assert f"'{tmp_path / 'camera.json'}' states no uncertainty" in err
    assert max(pose_errors_deg(Rigid3.from_matrix(result["cam2_from_cam1"]), CAM2_FROM_CAM1)) < 0.5
    found = sorted(p.name for p in (tmp_path / "out").iterdir())
    assert found == [
        "cloud.png",
        "correspondences.csv",
        "epipolar.png",
        "maps.npz",
        "normals.png",
        "scene.html",
        "scene.ply",
    ]
    with np.load(tmp_path / "out" / "maps.npz") as maps:
        known = np.isfinite(maps["depth"])
        assert known.sum() == result["points"]
        points, _ = corner.surface(SMALL, maps["pixels"][known])
        scale = np.median(points[:, 2] / maps["depth"][known])
        assert np.median(np.abs(scale * maps["depth"][known] / points[:, 2] - 1.0)) < 0.02
        np.testing.assert_allclose(np.linalg.norm(maps["normals"][known], axis=-1), 1.0)


def test_a_measured_pose_is_kept(tmp_path: Path, rng: np.random.Generator, capsys: pytest.CaptureFixture[str]) -> None:
    _, names = pictures_of_a_corner(tmp_path, rng)
    np.savetxt(tmp_path / "pose.txt", CAM2_FROM_CAM1.matrix())
    printed = ("--images", *names, "--json", "--no-pictures", "--pose")
    assert run(tmp_path, *printed, str(tmp_path / "pose.txt")) == 0
    result = json.loads(capsys.readouterr().out)
    np.testing.assert_allclose(result["cam2_from_cam1"], CAM2_FROM_CAM1.matrix(), atol=1e-9)
    assert result["unit"] == "mm"
    cloud = read_ply(tmp_path / "out" / "scene.ply")
    assert len(cloud) == result["points"] > 1000
    # The corner is 1.3 m away; its diagonal is 1.5 m.
    assert 800.0 < np.median(np.linalg.norm(cloud.points_mm, axis=1)) < 1500.0
    wrong = Rigid3(exp_so3(np.array([0.0, 0.0, 0.3])) @ TURN, CAM2_FROM_CAM1.translation_mm)
    (tmp_path / "wrong.json").write_text(json.dumps({"cam2_from_cam1": wrong.matrix().tolist()}))
    assert run(tmp_path, *printed, str(tmp_path / "wrong.json"), "--force") == 3
    assert "agree" in capsys.readouterr().err
    (tmp_path / "short.txt").write_text("1 2 3")
    assert run(tmp_path, *printed, str(tmp_path / "short.txt"), "--force") == 2
    assert "3 numbers" in capsys.readouterr().err


def test_bad_input_is_one_line(files: tuple[Path, Rigid3], capsys: pytest.CaptureFixture[str]) -> None:
    folder, _ = files
    found, camera = str(folder / "found.csv"), str(folder / "camera.json")
    (folder / "flat.png").write_bytes(cv2.imencode(".png", np.full((240, 320), 90, np.uint8))[1].tobytes())
    (folder / "small.png").write_bytes(cv2.imencode(".png", np.full((80, 80), 90, np.uint8))[1].tobytes())
    (folder / "dark.png").write_bytes(cv2.imencode(".png", np.full((240, 320), 30, np.uint8))[1].tobytes())
    flat, dark, small = (str(folder / f"{name}.png") for name in ("flat", "dark", "small"))
    save_camera(folder / "little.json", SMALL)
    little = str(folder / "little.json")
    (folder / "few.csv").write_text("\n".join(Path(found).read_text().splitlines()[:5]))
    cases = (
        (["reconstruct"], 2, "DATASET"),
        (["reconstruct", str(folder), "--correspondences", found], 2, "either"),
        (["reconstruct", "--correspondences", found], 2, "--camera"),
        (["reconstruct", "--correspondences", "gone.csv", "--camera", camera], 2, "gone.csv"),
        (["reconstruct", "--correspondences", found, "--camera", "gone.json"], 2, "gone.json"),
        (["reconstruct", "--correspondences", str(folder / "few.csv"), "--camera", camera], 2, "at least 8"),
        (["reconstruct", "--correspondences", found, "--camera", camera, "--baseline-mm", "0"], 2, "baseline"),
        (["reconstruct", "--images", "gone.png", flat, "--camera", camera], 2, "gone.png"),
        (["reconstruct", "--images", small, small, "--camera", camera], 2, "80x80"),
        (["reconstruct", "--images", flat, dark, "--camera", little], 3, "textured scene"),
        (["reconstruct", "--images", flat, flat, "--camera", little], 2, "the same picture"),
    )
    for arguments, code, words in cases:
        assert main([*arguments, "-o", str(folder / "out")]) == code, arguments
        lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("rigkit: ")]
        assert len(lines) == 1
        assert words in lines[0]
    assert not (folder / "out").exists()


@pytest.mark.real
def test_a_scene_with_hardly_any_texture(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A rendered aeroplane, 28 degrees between the views: 27 of 69 matches are right, the others must not win."""
    folder = shared_data("real/simplestereo-0")
    rig = json.loads((folder / "rigRect.json").read_text())
    K = np.array(rig["intrinsic1"])
    save_camera(tmp_path / "camera.json", Pinhole(tuple(rig["res1"]), K[[0, 1, 0, 1], [0, 1, 2, 2]]))
    images = [str(folder / name) for name in ("left.png", "right.png")]
    assert run(tmp_path, "--images", *images, "--json", "--no-pictures") == 0
    result = json.loads(capsys.readouterr().out)
    pose = Rigid3(np.array(rig["R"]), np.array(rig["T"])[:, 0])
    # 1.5 and 1.8 degrees measured; the best that these few matches can say is about half a degree.
    assert max(pose_errors_deg(Rigid3.from_matrix(result["cam2_from_cam1"]), pose)) < 3.0
