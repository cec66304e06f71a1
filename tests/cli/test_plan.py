"""`rigkit plan`: from a calibration or for a lens, its refusals, and its page."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from helpers.calibration_scenes import REACH_DEG, lens, random_views

from rigkit.calibration.calibrate import calibrate
from rigkit.calibration.certainty.displaced import uncertain_camera
from rigkit.cli.main import main
from rigkit.core.boards import Board
from rigkit.geometry.rigid3 import Rigid3
from rigkit.io.boards.board_file import board_values
from rigkit.io.calibrations.calibration_file import camera_to_json, load_calibration, save_calibration
from rigkit.planning.goal import projection_goal


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    camera = lens("reg")
    views, _, _ = random_views(camera, 6, np.random.default_rng(3), reach_deg=REACH_DEG["reg"])
    path = tmp_path_factory.mktemp("plan") / "calibration.json"
    save_calibration(path, calibrate(views, camera.size_px, model="brown", degree=5, board="flat"))
    return path


def test_next_pictures_of_a_calibration(calibrated: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    page = tmp_path / "next.html"
    assert main(["plan", str(calibrated), "-n", "2", "-r", str(page), "--json"]) == 0
    data = json.loads(capsys.readouterr().out)
    errors = [data["error_now"], *(view["error_then"] for view in data["views"])]
    assert errors == sorted(errors, reverse=True) and len(errors) == 3
    stated = uncertain_camera(load_calibration(calibrated))
    assert errors[0] == pytest.approx(float(projection_goal(stated.camera).error(stated.covariance)))
    outline = np.array(data["views"][0]["outline_px"])
    assert (outline >= 0.0).all() and (outline <= [1623.0, 1239.0]).all()
    text = page.read_text()
    assert data["views"][1]["words"] in text and text.count("<svg") == 2 and "Blue dots" in text
    assert main(["plan", str(calibrated), "-r", str(page)]) == 2
    assert "exists" in capsys.readouterr().err


def test_a_length_is_planned_for_in_mm(calibrated: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["plan", str(calibrated), "-n", "1", "--length", "300", "--distance", "900"]) == 0
    out = capsys.readouterr().out
    assert "standard error of a length of 300 mm at 900 mm" in out and " mm now" in out
    assert "1 more image: " in out


def test_pictures_to_check_with(calibrated: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    page = tmp_path / "check.html"
    assert main(["plan", str(calibrated), "--check", "-r", str(page)]) == 0
    out = capsys.readouterr().out
    assert "standard error of a change of intrinsics" in out and " now" not in out and "less error" not in out
    assert "Changes that these images would reveal" in out and "principal point" in out
    assert "Changes that these images would reveal" in page.read_text() and "inf" not in out
    assert main(["plan", str(calibrated), "--check", "--json"]) == 0
    data = json.loads(capsys.readouterr().out)
    assert data["error_now"] is None and len(data["views"]) == 3


def test_the_expected_accuracy_of_a_lens_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    errors = {}
    for views in (4, 12):
        command = ["plan", "--lens", "120", "--size", "1280x960", "--board", "9x6x30", "--views", str(views), "--json"]
        assert main(command) == 0
        errors[views] = json.loads(capsys.readouterr().out)["views"][-1]["error_then"]
    assert errors[12] < 0.7 * errors[4]


@pytest.mark.parametrize(
    ("command", "words"),
    [
        (["plan"], "give a calibration or a session"),
        (["plan", "--lens", "90"], "--lens needs --size"),
        (["plan", "--lens", "90", "--size", "12", "--board", "9x6x30"], "such as 1280x960"),
        (["plan", "--lens", "0", "--size", "640x480", "--board", "9x6x30"], "0.5 to 300"),
        (["plan", "x.json", "--board", "9x6x30"], "needs --lens"),
        (["plan", "x.json", "--check", "--length", "300", "--distance", "900"], "leave out --lens and --length"),
        (["plan", "--lens", "90", "--size", "640x480", "--board", "9x6x30", "--length", "3"], "belong together"),
    ],
)
def test_unusable_inputs_are_refused(command: list[str], words: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(command) == 2
    assert words in capsys.readouterr().err


def test_a_session_of_a_rig_is_planned_by_its_rig(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    session = tmp_path / "rig.toml"
    cameras = "".join(f'[[cameras]]\nid = "{name}"\nimages = "{name}*.png"\n' for name in ("left", "right"))
    session.write_text(f'schema = "rigkit.session/1"\nboard = "board.toml"\n{cameras}')
    for asked in ([], ["--check"]):
        assert main(["plan", str(session), *asked]) == 2
        assert "rig.json" in capsys.readouterr().err


def test_pictures_to_check_a_rig_with(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    camera, path = lens("reg"), tmp_path / "rig.json"
    poses = {"left": Rigid3.identity(), "right": Rigid3(np.eye(3), [-80.0, 0.0, 0.0])}
    rig = {
        "schema": "rigkit.rig/1",
        "sigma_px": 0.05,
        "cameras": [
            {"name": n, "camera": camera_to_json(camera), "cam_from_rig": p.matrix()[:3].tolist(), "rms_px": 0.1}
            for n, p in poses.items()
        ],
        "covariance": (
            np.diag([0.1] * 4 + [1e-4] * 5 + [0.1] * 4 + [1e-4] * 5 + [1e-5] * 3 + [0.05] * 3) ** 2
        ).tolist(),
    }
    path.write_text(json.dumps(rig))
    assert main(["plan", str(path), "--check"]) == 2
    assert "does not say what boards" in capsys.readouterr().err
    board = {"board_id": "b", "target": board_values(Board("b", 9, 6, 30.0, 30.0))}
    path.write_text(json.dumps(rig | {"boards": [board]}))
    page = tmp_path / "check.html"
    assert main(["plan", str(path), "--check", "-n", "2", "-r", str(page), "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert all(set(view["seen_by"]) == set(poses) for view in printed["views"])
    text = page.read_text()
    assert "before camera" in text and "rotation of right" in text and text.count("<svg") == 2
    assert "Blue dots" not in text
    assert main(["plan", str(path), "-n", "2", "--json"]) == 0
    better = json.loads(capsys.readouterr().out)
    assert "with extrinsics" in better["goal"]
    assert better["error_now"] > better["views"][0]["error_then"] > better["views"][1]["error_then"]
    assert main(["plan", str(path), "-n", "1", "--length", "300", "--distance", "900"]) == 0
    assert "standard error of a length of 300 mm" in capsys.readouterr().out


def test_a_calibration_that_was_called_bad_is_warned_of(
    calibrated: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """What the next pictures bring is reckoned from its sigmas."""
    data = json.loads(calibrated.read_text())
    for severity in ("look", "bad"):
        printed = {"severity": severity, "message": "two cameras are mixed", "remedy": "calibrate each"}
        source = tmp_path / f"{severity}.json"
        source.write_text(json.dumps(data | {"verdicts": [printed]}))
        page = tmp_path / f"{severity}.html"
        assert main(["plan", str(source), "-n", "1", "-r", str(page)]) == 0
        assert ("verdict is bad: two cameras are mixed" in page.read_text()) == (severity == "bad")
        called = f"'{source}': the calibration's verdict is bad: two cameras are mixed"
        assert (called in capsys.readouterr().err) == (severity == "bad")
