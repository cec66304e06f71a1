"""`rigkit certify`: statement, exit code, page, sheet and JSON."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.browser import pages_printed

from rigkit.cameras.registry import camera_model
from rigkit.cli.main import main
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3
from rigkit.io.calibrations.calibration_file import camera_to_json

SIGMAS = [0.3, 0.3, 0.3, 0.3, 1e-4, 1e-4, 1e-4, 1e-4]


@pytest.fixture
def rig(tmp_path: Path) -> Path:
    return rig_of(tmp_path, focal_px=900.0)


def rig_of(tmp_path: Path, focal_px: float) -> Path:
    scale = [focal_px, focal_px + 1.0]
    camera = camera_model("kannala_brandt")((1280, 960), np.array([*scale, 641.0, 478.0, 0.02, 0.0, 0.0, 0.0]))
    poses = {"left": Rigid3.identity(), "right": Rigid3(exp_so3(np.array([0.0, -0.1, 0.0])), [-200.0, 0.0, 0.0])}
    covariance = np.diag([*SIGMAS, *SIGMAS, 1e-4, 1e-4, 1e-4, 0.1, 0.1, 0.1]) ** 2
    data: dict[str, Any] = {
        "schema": "rigkit.rig/1",
        "sigma_px": 0.05,
        "scale_sigma": 1e-4,
        "cameras": [
            {
                "name": name,
                "camera": camera_to_json(camera),
                "cam_from_rig": pose.matrix()[:3].tolist(),
                "rms_px": 0.07,
            }
            for name, pose in poses.items()
        ],
        "covariance": covariance.tolist(),
    }
    path = tmp_path / "rig.json"
    path.write_text(json.dumps(data))
    return path


def test_a_length_with_page_sheet_and_limit(rig: Path, capsys: pytest.CaptureFixture[str]) -> None:
    page, sheet = rig.with_name("c.html"), rig.with_name("c.pdf")
    asked = ["certify", str(rig), "--length", "300", "--distance", "1200"]
    assert main([*asked, "--report", str(page), "--pdf", str(sheet), "--limit", "1000"]) == 0
    words = capsys.readouterr().out
    assert "A length of 300 mm across the line of sight, 1200 mm away: 95 % of errors within" in words
    assert "To halve the worst error: " in words
    assert "within the limit" in page.read_text()
    assert sheet.read_bytes().startswith(b"%PDF")
    assert main([*asked, "--limit", "0.001", "--json"]) == 1
    assert "above the limit" in capsys.readouterr().out


@pytest.mark.thorough
def test_the_page_prints_on_one_sheet(rig: Path) -> None:
    """Also with every sentence that a certificate may have: of a bad calibration, uncertain somewhere."""
    data = json.loads(rig.read_text())
    bad = "held-out RMS 0.1 px, but the focal length differs between the first and the second half of the images"
    data |= {"scale_sigma": 0.0, "verdicts": [{"severity": "bad", "message": bad, "remedy": "hold the lens"}]}
    rig.write_text(json.dumps(data))
    page, sizes = rig.with_suffix(".html"), ["--length", "27", "--distance", "3000"]
    main(["certify", str(rig), *sizes, "--limit", "100", "--report", str(page)])
    words = page.read_text()
    assert "not to be trusted" in words and "of the view no bound is certified" in words
    assert pages_printed(page) == 1


@pytest.mark.parametrize(
    ("focal_px", "size", "distance", "share"),
    # Wide lenses see along the baseline, where nothing has a distance.
    [(900.0, "8", "3000", "100 %"), (410.0, "300", "1200", "less than 1 %")],
)
def test_a_bound_that_is_not_certified_passes_no_limit(
    focal_px: float, size: str, distance: str, share: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """However large the limit is: the bound is within it, but nobody knows what it is worth."""
    path = rig_of(tmp_path, focal_px)
    page, asked = tmp_path / "c.html", ["certify", str(path), "--length", size, "--distance", distance]
    assert main([*asked, "--limit", "100000", "--report", str(page)]) == 1
    words = capsys.readouterr().out
    assert f"n {share} of the view no bound is certified: points are uncertain" in words
    assert "everywhere in view" not in words
    assert "not certified</span>" in page.read_text()
    everywhere = share == "100 %"
    assert ("no bound is certified" in words.splitlines()[0]) == everywhere
    # Without a limit there is still something to certify elsewhere.
    assert main([*asked, "--json"]) == everywhere
    reported = json.loads(capsys.readouterr().out)
    assert reported["passed"] is (False if everywhere else None)
    assert reported["coarse"] == 1.0 if everywhere else 0.0 < reported["coarse"] < 0.01


@pytest.mark.parametrize(("severity", "code"), [("look", 0), ("bad", 1)])
def test_a_bad_calibration_gets_no_certificate(
    severity: str, code: int, rig: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its sigmas hold for lenses as it takes them to be: a limit that is kept says nothing."""
    data = json.loads(rig.read_text())
    asked = ["certify", str(rig), "--length", "300", "--distance", "1200", "--limit", "1000"]
    printed = {"severity": severity, "message": "held-out RMS 0.1 px, but the focal length differs", "remedy": "fix it"}
    rig.write_text(json.dumps(data | {"verdicts": [printed]}))
    assert main(asked) == code
    words = capsys.readouterr().out.splitlines()
    called = "  The calibration's verdict is bad: held-out RMS 0.1 px, but the focal length differs; fix it."
    assert (words[1] == called) == (severity == "bad")
    page = rig.with_suffix(".html")
    assert main([*asked, "--report", str(page), "--json"]) == code
    reported = json.loads(capsys.readouterr().out)["page"]
    assert ("not to be trusted" in json.dumps(reported)) == (severity == "bad")
    assert ("not to be trusted" in page.read_text()) == (severity == "bad")


@pytest.mark.parametrize("quantity", ["depth", "plane", "angle"])
def test_json_has_the_certificate(quantity: str, rig: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["certify", str(rig), f"--{quantity}", "50", "--distance", "900", "--json"]
    assert main(command) == 0
    reported = json.loads(capsys.readouterr().out)
    assert reported["quantity"] == quantity
    assert reported["cameras"] == ["left", "right"]
    assert reported["passed"] is None
    bounds = [value for row in reported["bound"] for value in row if value is not None]
    assert max(bounds) == reported["worst"]
    assert main([*command, "--sigma-px", "0.1"]) == 0
    assert json.loads(capsys.readouterr().out)["median"] > reported["median"]


@pytest.mark.parametrize(
    "more, words",
    [
        (["--length", "-3", "--distance", "900"], "the size must be positive"),
        (["--length", "3", "--distance", "900", "--sigma-px", "0"], "--sigma-px 0.0: it must be positive"),
        (["--length", "3", "--distance", "900", "--limit", "nan"], "the limit must be positive"),
        (["--length", "3", "--distance", "900", "--confidence", "100"], "between 0 and 100 %, got 100 %"),
        (["--length", "3", "--distance", "900", "--names", "left", "top"], "two different cameras of left, right"),
        (["--length", "3", "--distance", "900", "--report", "rig.json", "--force"], "rig.json"),
    ],
)
def test_bad_input(
    rig: Path, more: list[str], words: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(rig.parent)
    before = rig.read_bytes()
    assert main(["certify", "rig.json", *more]) == 2
    assert words in capsys.readouterr().err
    assert rig.read_bytes() == before


def test_a_rig_without_covariance_is_refused(rig: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data = json.loads(rig.read_text())
    del data["covariance"]
    rig.write_text(json.dumps(data))
    assert main(["certify", str(rig), "--length", "300", "--distance", "1200"]) == 2
    assert "the rig has no covariance" in capsys.readouterr().err


def test_cameras_that_do_not_expose_at_once_are_named(rig: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """What moves between the exposures is no part of the bound."""
    asked = ["certify", str(rig), "--length", "300", "--distance", "1200"]
    assert main(asked) == 0
    assert "at rest" not in capsys.readouterr().out
    data = json.loads(rig.read_text())
    data["cameras"][1]["lag"] = {"frames": -0.11, "sigma": 0.02, "scatter": 0.1}
    rig.write_text(json.dumps(data))
    assert main(asked) == 0
    words = " ".join(capsys.readouterr().out.split())
    assert (
        "Camera 'left' exposes 0.110 frame periods after 'right' (jitter 0.100): the bound is of things at rest"
        in words
    )
