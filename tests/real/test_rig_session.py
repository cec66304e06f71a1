"""A public stereo capture through `rigkit calibrate`: from images to the rig's file, its baseline and the page."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from helpers.data import shared_data

from rigkit.cli.main import main
from rigkit.io.calibration_file import load_camera
from rigkit.io.rig_file import load_rig

pytestmark = pytest.mark.real

BASELINE_MM = (99.81, 0.25)
"""Published with the capture, and its uncertainty."""
SESSION = """schema = "rigkit.session/1"
board = "board.toml"
model = "brown"
[[cameras]]
id = "left"
images = "left*.jpg"
[[cameras]]
id = "right"
images = "right*.jpg"
[[baselines]]
a = "left"
b = "right"
value_mm = {value}
sigma_mm = 0.25
how = "published"
"""


def test_stereo_session(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for path in shared_data("real/bouguet-stereo").glob("*.jpg"):
        shutil.copy(path, tmp_path)
    (tmp_path / "board.toml").write_text('schema = "rigkit.board/1"\ncolumns = 9\nrows = 6\nsquare_mm = 30.0\n')
    session = tmp_path / "session.toml"
    session.write_text(SESSION.format(value=BASELINE_MM[0]))
    assert main(["calibrate", str(session), "--json", "-r"]) == 0
    told = json.loads(capsys.readouterr().out)
    baseline = told["baselines"][0]
    assert abs(baseline["value_mm"] - BASELINE_MM[0]) < BASELINE_MM[1]
    assert 0.0 < baseline["sigma_mm"] < 0.1
    assert told["checks"][0]["passed"]
    rig = load_rig(tmp_path / "rig.json")
    assert list(rig) == ["left", "right"]
    assert (load_camera(tmp_path / "rig-left.json").parameters == rig["left"][0].parameters).all()
    page = (tmp_path / "rig.html").read_text()
    assert page.count("data:image/jpeg") == 28 and len(page) < 5e6

    # A wrong rule: the check fails, and so does the program.
    session.write_text(SESSION.format(value=110.0))
    assert main(["calibrate", str(session), "--force"]) == 1
    assert "NOT as measured" in capsys.readouterr().out
