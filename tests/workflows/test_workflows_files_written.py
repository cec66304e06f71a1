"""Where the workflows write: not where a manifest or a link points, and not over existing files."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from helpers.data import REPOSITORY

from rigkit.cli.main import main
from rigkit.core.errors import InputError
from rigkit.io.calibrations.calibration_file import load_calibration
from rigkit.workflows.calibration.calibrate import calibrate_session
from rigkit.workflows.options.cameras import Cache, CalibrateOptions
from rigkit.workflows.outputs.results import write_results

LAB = REPOSITORY / "datasets" / "lab-a"
IMAGES = LAB / "calibration" / "fisheye"
LENS = REPOSITORY / "calib" / "cameras" / "mvca020_fe185" / "calibration.json"
BOARD = 'schema = "rigkit.board/1"\ncolumns = 9\nrows = 6\nsquare_mm = 30.0\n'
SESSION = 'schema = "rigkit.session/1"\nimages = "*.jpg"\nboard = "board.toml"\nmodel = "{model}"\n'
PAIR = """
[[pairs]]
id = "{name}"
camera1 = "{camera}"
camera2 = "{camera}"
image1 = "{images}/view1.jpg"
image2 = "{images}/view2.jpg"
pose_type = "standard"
boards = ["plane1", "plane2", "plane3"]
[pairs.truth]
baseline = {{ value_mm = 300.0, sigma_mm = 20.0, how = "rule" }}
"""


@pytest.fixture
def lens(tmp_path: Path) -> Path:
    """A folder with calibration images, a board and a session."""
    folder = tmp_path / "lens"
    folder.mkdir()
    for k, path in enumerate(sorted(IMAGES.glob("*.jpg"))[:5]):
        shutil.copy(path, folder / f"{k:02d}.jpg")
    (folder / "board.toml").write_text(BOARD)
    (folder / "session.toml").write_text(SESSION.format(model="kannala_brandt"))
    return folder


@pytest.fixture
def dataset(tmp_path: Path, lens: Path) -> Path:
    """A data set of one pair whose manifest names as calibration something else of a person."""
    foreign = tmp_path / "letters"
    foreign.mkdir()
    (foreign / "letter.txt").write_text("Dear rig,")
    folder = tmp_path / "data"
    folder.mkdir()
    text = 'schema = "rigkit.dataset/1"\nname = "mine"\n'
    for k in (1, 2, 3):
        text += f'[[boards]]\nid = "plane{k}"\ncolumns = 8\nrows = 6\nsquare_mm = 50.0\n'
    text += '[[cameras]]\nid = "lens"\ncalibration = "../letters/letter.txt"\nsession = "../lens/session.toml"\n'
    text += f'[[cameras]]\nid = "other"\ncalibration = "{LENS}"\n'
    text += PAIR.format(name="first", camera="lens", images=LAB / "images" / "fisheye-standard")
    (folder / "dataset.toml").write_text(text)
    return folder


def content(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def test_a_manifest_does_not_decide_where_a_calibration_goes(tmp_path: Path, dataset: Path) -> None:
    before = content(tmp_path)
    arguments = ["reconstruct", str(dataset), "--recalibrate", "--no-pictures", "-j", "1", "-o", str(tmp_path / "out")]
    assert main(arguments) == 0
    after = content(tmp_path)
    assert {name: after[name] for name in before} == before
    assert all(name.startswith("out/") for name in set(after) - set(before))
    assert load_calibration(tmp_path / "out" / "calibrations" / "lens.json").camera.model == "kannala_brandt"


def test_a_bad_camera_and_a_lost_image_end_their_own_pairs_only(
    tmp_path: Path, dataset: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    manifest = dataset / "dataset.toml"
    images = LAB / "images" / "fisheye-standard"
    more = PAIR.format(name="second", camera="other", images=images)
    more += PAIR.format(name="third", camera="other", images="nowhere")
    manifest.write_text(manifest.read_text() + more)
    arguments = ["reconstruct", str(dataset), "--json", "--no-pictures", "-j", "1", "-o", str(tmp_path / "out")]
    # The first pair's camera is a letter.
    assert main(arguments) == 2
    reported = json.loads(capsys.readouterr().out)
    assert [pair["pair"] for pair in reported["pairs"]] == ["second"]
    assert "letter.txt" in reported["failed"]["first"] and "nowhere" in reported["failed"]["third"]
    assert (tmp_path / "out" / "second" / "3SDIR.ply").is_file()
    assert main([word for word in arguments if word != "--json"] + ["--force"]) == 2
    assert "3SDIR.ply: 144 points, 3 boards, baseline" in capsys.readouterr().out


def test_a_link_in_the_folder_of_results_is_not_followed(tmp_path: Path) -> None:
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    out = tmp_path / "out"
    out.mkdir()
    (out / "pair").symlink_to(elsewhere)
    with pytest.raises(InputError, match="leads out of it"):
        write_results(out, {"pair/cloud.ply": b"", "tables.md": ""}, force=True)
    assert list(elsewhere.iterdir()) == [] and not (out / "tables.md").exists()
    (out / "pair").unlink()
    write_results(out, {"pair/cloud.ply": b"", "tables.md": ""}, force=True)
    assert (out / "pair" / "cloud.ply").is_file()


def test_kept_corners_change_the_time_never_the_result(lens: Path) -> None:
    session = lens / "session.toml"
    clean = calibrate_session(session, CalibrateOptions(cache=Cache.OFF)).calibration
    assert not (lens / "corners.json").exists()
    # Another session of the same images, through the lens of another model.
    session.write_text(SESSION.format(model="pinhole"))
    calibrate_session(session, CalibrateOptions(cache=Cache.UPDATE))
    kept = (lens / "corners.json").read_bytes()
    session.write_text(SESSION.format(model="kannala_brandt"))
    for cache in (Cache.READ, Cache.UPDATE, Cache.UPDATE):
        again = calibrate_session(session, CalibrateOptions(cache=cache)).calibration
        assert np.array_equal(again.camera.parameters, clean.camera.parameters)
        assert again.heldout_rms_px == clean.heldout_rms_px
        assert ((lens / "corners.json").read_bytes() == kept) is (cache is Cache.READ)


def test_a_truncated_image_is_named_and_the_rest_is_done(lens: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = lens / "02.jpg"
    path.write_bytes(path.read_bytes()[:300])
    assert main(["calibrate", str(lens / "session.toml"), "--no-cache"]) == 2
    said = [line for line in capsys.readouterr().out.splitlines() if "02.jpg" in line]
    assert len(said) == 1 and "cut off" in said[0]
    assert len(load_calibration(lens / "calibration.json").views) == 4
    assert main(["detect", str(lens), "-o", str(lens / "corners.csv"), "-j", "1"]) == 2
    printed = capsys.readouterr()
    assert "02.jpg" in printed.err and "4 boards in 4 of 5 images; 1 cannot be used" in printed.out
    assert (lens / "corners.csv").is_file()
