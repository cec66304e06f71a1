"""`rigkit check --scene`: a rig before textured walls, without boards."""

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

CAMERA = Pinhole((240, 180), np.array([210.0, 210.0, 120.3, 89.1]))
MOUNT = Rigid3(exp_so3(np.array([0.0, 0.06, 0.01])), [-150.0, 2.0, 1.0])
TURN_RAD = 0.01
"""1.5 px at the border of the image; the corrected rig is told from it by a tenth."""


def test_a_turned_camera_is_found_and_corrected(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    walls, rng = Corner.of_a_room(), np.random.default_rng(4)
    turned = Rigid3(exp_so3(np.array([0.0, 0.0, TURN_RAD])), [0.0, 0.0, 0.0]) @ MOUNT
    pictures = {name: tmp_path / f"{name}.png" for name in ("left", "same", "turned")}
    for path, pose in zip(pictures.values(), (Rigid3.identity(), MOUNT, turned), strict=True):
        cv2.imwrite(str(path), walls.image(CAMERA, pose, rng))
    cameras = [
        {"name": name, "camera": camera_to_json(CAMERA), "cam_from_rig": pose.matrix()[:3].tolist(), "rms_px": 0.1}
        for name, pose in (("left", Rigid3.identity()), ("right", MOUNT))
    ]
    sure = (np.diag([0.1] * 8 + [1e-4] * 3 + [0.05] * 3) ** 2).tolist()
    rig, fixed = tmp_path / "rig.json", tmp_path / "fixed.json"
    rig.write_text(json.dumps({"schema": "rigkit.rig/1", "sigma_px": 0.05, "cameras": cameras, "covariance": sure}))
    words = ["check", str(rig), str(pictures["left"]), "--scene", "--json"]
    assert main([*words[:3], str(pictures["same"]), *words[3:], "--fix", str(fixed)]) == 0
    assert json.loads(capsys.readouterr().out)["holds"] and not fixed.exists()
    assert main([*words[:3], str(pictures["turned"]), *words[3:], "--fix", str(fixed)]) == 1
    assert "right" in capsys.readouterr().out
    left, right = json.loads(fixed.read_text())["cameras"]
    np.testing.assert_array_equal(left["cam_from_rig"], np.eye(4)[:3])
    found = np.array(right["cam_from_rig"])
    off = found[:, :3] @ turned.rotation.T
    assert np.arccos((np.trace(off) - 1.0) / 2.0) < 0.1 * TURN_RAD
    np.testing.assert_allclose(found[:, 3], turned.translation_mm, atol=0.2)
    # Walls without texture are no evidence.
    blank = [tmp_path / "a.png", tmp_path / "b.png"]
    for path in blank:
        cv2.imwrite(str(path), np.full((180, 240), ord(path.stem), np.uint8))
    assert main([*words[:2], *map(str, blank), "--scene"]) == 3
    assert "less than" in capsys.readouterr().err
