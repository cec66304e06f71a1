"""`rigkit calibrate` on a rig, from cached corners: file, messages, page, exit code."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from helpers.board_rig_scenes import ALIKE, corner_of_a_room, target_views
from helpers.calibration_scenes import lens
from helpers.rig_scenes import Views, mounts, rig_views

from rigkit.cli.main import main
from rigkit.core.boards import Board
from rigkit.core.detections import BoardDetection
from rigkit.geometry.rigid3 import Rigid3
from rigkit.io.calibrations.calibration_file import load_calibration
from rigkit.io.calibrations.rig_file import load_board_rigs, load_rig
from rigkit.io.corners.corner_cache import CornerCache, FoundCorners
from rigkit.io.manifests.rig_session import load_rig_session
from rigkit.workflows.calibration.calibrate import calibrate_camera

NAMES = ("reg", "wide")
SIGMAS = 4.0


@pytest.fixture
def session(tmp_path: Path, rng: np.random.Generator) -> Path:
    """A session of two cameras whose images are gone, their corners kept: reg07.png and wide007.png are one frame."""
    true = np.linalg.norm(mounts()["wide"][1].translation_mm)
    cameras = "".join(f'[[cameras]]\nid = "{name}"\nimages = "{name}*.png"\n' for name in NAMES)
    (tmp_path / "9x6.toml").write_text(
        'schema = "rigkit.board/1"\ncolumns = 9\nrows = 6\nsquare_mm = 30.0\nsquare_sigma_mm = 0.3\n'
    )
    path = tmp_path / "session.toml"
    path.write_text(
        'schema = "rigkit.session/1"\nboard = "9x6.toml"\nmodel = "kannala_brandt"\nboard_shape = "flat"\n'
        f'{cameras}[[baselines]]\na = "wide"\nb = "reg"\nvalue_mm = {true}\nsigma_mm = 0.5\nhow = "drawing"\n'
    )
    keep_corners(path, rig_views(rng, 16))
    return path


def keep_corners(path: Path, views: Views, *, named: bool = True) -> None:
    """Keep the corners beside the session; the images themselves are gone."""
    for name, own in load_rig_session(path).cameras.items():
        cache = CornerCache(own.corners_path, own.boards)
        images: dict[str, list[BoardDetection]] = {}
        for frame, view in views[name]:
            board: Board = view.board
            found = BoardDetection(
                board.board_id if named else None, *board.size, view.grid, view.pixels, view.sigma_px
            )
            images.setdefault(f"{name}{int(frame):0{2 if name == 'reg' else 3}d}.png", []).append(found)
        for image, detections in images.items():
            cache.put(image, "0" * 64, FoundCorners(lens("reg").size_px, tuple(detections)))
        cache.save()


def test_pupils_of_a_rig_move_where_that_is_asked_for(session: Path) -> None:
    for pupil, known in (("central", 0), ("moving", 2)):
        assert main(["calibrate", str(session), "--pupil", pupil, "--force"]) == 0
        assert (session.parent / "rig.json").read_text(encoding="utf-8").count('"pupil"') == known


def test_rig_from_kept_corners(session: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["calibrate", str(session), "--json", "--report"]) == 0
    reported = json.loads(capsys.readouterr().out)
    true = float(np.linalg.norm(mounts()["wide"][1].translation_mm))
    baseline = reported["baselines"][0]
    assert abs(baseline["value_mm"] - true) < SIGMAS * baseline["sigma_mm"]
    # The squares are known to one per cent: no length is known better.
    assert 0.01 * true < baseline["sigma_mm"] < 0.011 * true
    rig = load_rig(session.parent / "rig.json")
    assert np.allclose(rig["wide"][1].matrix()[:3], reported["cameras"][1]["cam_from_rig"])
    page = (session.parent / "rig.html").read_text()
    assert "Cameras of the rig" in page and 'id="wide"' in page and "drawing" in page

    assert main(["calibrate", str(session)]) == 2
    assert "--force" in capsys.readouterr().err

    session.write_text(session.read_text().replace("value_mm = 1", "value_mm = 2"))
    assert main(["calibrate", str(session), "--force"]) == 1
    assert "NOT as measured" in capsys.readouterr().out


def test_diff_has_a_verdict_on_rigs_and_their_cameras(
    session: Path, rng: np.random.Generator, capsys: pytest.CaptureFixture[str]
) -> None:
    """The same rig again is the same; one with a camera moved by a millimetre is not, its lenses are."""
    folder = session.parent
    assert main(["calibrate", str(session)]) == 0
    keep_corners(session, rig_views(rng, 10))
    assert main(["calibrate", str(session), "-o", str(folder / "again.json")]) == 0
    capsys.readouterr()
    assert main(["diff", str(folder / "rig-wide.json"), str(folder / "again-wide.json"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["same"] is True
    assert main(["diff", str(folder / "rig.json"), str(folder / "again.json"), "--json"]) == 0
    reported = json.loads(capsys.readouterr().out)
    assert reported["chance"] > 0.01 and set(reported["cameras"]) == set(NAMES)

    saved = json.loads((folder / "again.json").read_text())
    for k in range(3):
        saved["cameras"][1]["cam_from_rig"][k][3] += 1.0
    (folder / "again.json").write_text(json.dumps(saved))
    page = folder / "diff.html"
    assert main(["diff", str(folder / "rig.json"), str(folder / "again.json"), "-r", str(page)]) == 1
    printed, noted = capsys.readouterr()
    assert f"{page} written" in noted
    text = page.read_text()
    # Of each camera a drawing for light pages and one for dark ones.
    assert "NOT the same rig" in text and text.count("data:image/png") == 2 * len(NAMES)
    assert "NOT the same rig" in printed and printed.count("no contradiction") == len(NAMES)
    assert main(["diff", str(folder / "rig.json"), str(folder / "rig-reg.json")]) == 2


def test_a_camera_of_a_rig_is_surer_than_alone(session: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Its file is a whole calibration: what `validate` needs to count its share."""
    assert main(["calibrate", str(session), "--json"]) == 0
    reported = json.loads(capsys.readouterr().out)
    for camera in reported["cameras"]:
        saved = load_calibration(session.parent / f"rig-{camera['name']}.json")
        assert saved.parameter_sigmas.tolist() == list(camera["sigmas"].values())
        assert saved.heldout_rms_px == camera["heldout_rms_px"]
        assert saved.verdicts[0].severity != "bad"
    assert reported["heldout_rms_px"] == pytest.approx(np.sqrt(2.0) * 0.2, rel=0.05)
    assert 0.0 < reported["transfers"][0]["median_px"] < 0.5


def test_boards_on_one_mount(tmp_path: Path, rng: np.random.Generator, capsys: pytest.CaptureFixture[str]) -> None:
    """One camera, three boards that look alike: a calibration like any other, and the boards' own geometry."""
    for board in ALIKE:
        (tmp_path / f"{board.board_id}.toml").write_text(
            f'schema = "rigkit.board/1"\nid = "{board.board_id}"\ncolumns = 8\nrows = 6\nsquare_mm = 30.0\n'
        )
    names = json.dumps([b.board_id for b in ALIKE])
    files = json.dumps([f"{b.board_id}.toml" for b in ALIKE])
    path = tmp_path / "session.toml"
    head = f'schema = "rigkit.session/1"\nboards = {files}\nmodel = "brown"\nboard_shape = "flat"\nimages = "*.png"\n'
    declared = '{ a = "plane1", b = "plane2", value_deg = 90.0, sigma_deg = 3.0, how = "set square" }'
    path.write_text(f"{head}[[rigid_boards]]\nboards = {names}\nangles = [ {declared} ]\n")
    room = corner_of_a_room(rng, ALIKE)
    one = {"camera": (lens("reg"), Rigid3.identity())}
    views = target_views(rng, one, ALIKE, room, 6, noise_px=0.1, distance_mm=1000.0, shuffled=True)
    keep_corners(path, views, named=False)
    assert main(["calibrate", str(path), "--json", "--report"]) == 0
    reported = json.loads(capsys.readouterr().out)
    assert reported["checks"][0]["passed"] and reported["checks"][0]["our_sigma"] < 0.05
    assert load_calibration(tmp_path / "calibration.json").heldout_rms_px == reported["cameras"][0]["heldout_rms_px"]
    (target,) = load_board_rigs(tmp_path / "calibration-boards.json")
    assert sorted(target.names) == [b.board_id for b in ALIKE] and target.image_count == 6
    between, sigma = target.angle_deg("plane1", "plane2")
    assert between == pytest.approx(reported["checks"][0]["ours"])
    # The deviations in the file are those of its degrees of freedom.
    kept = json.loads((tmp_path / "calibration-boards.json").read_text())["rigs"][0]
    assert sigma in [pytest.approx(entry["sigma_deg"]) for entry in kept["angles"]]
    assert target.freedom == kept["freedom"]
    assert "Rigidly mounted boards" in (tmp_path / "calibration.html").read_text()

    capsys.readouterr()
    saved = tmp_path / "calibration-boards.json"
    moved = json.loads(saved.read_text())
    moved["rigs"][0]["boards"][1]["target_from_board"][0][3] += 2.0
    (tmp_path / "moved.json").write_text(json.dumps(moved))
    assert main(["diff", str(saved), str(saved)]) == 0 and "the boards did not move" in capsys.readouterr().out
    assert main(["diff", str(saved), str(tmp_path / "moved.json"), "--json"]) == 1
    boards_found = json.loads(capsys.readouterr().out)["targets"][target.names[0]]["boards"]
    assert boards_found[0]["shift_mm"] == pytest.approx(2.0) and boards_found[1]["shift_mm"] == 0.0
    assert main(["diff", str(saved), str(tmp_path / "calibration.json")]) == 2

    again = calibrate_camera(path)
    assert again.heldout_rms_px == reported["cameras"][0]["heldout_rms_px"]

    # Without the mount, two cameras cannot know which board is which.
    path.write_text(
        head.replace('images = "*.png"\n', "")
        + "".join(f'[[cameras]]\nid = "{name}"\nimages = "{name}*.png"\n' for name in "ab")
    )
    assert main(["calibrate", str(path), "--force"]) == 2
    assert "look alike" in capsys.readouterr().err


def test_images_without_common_names_are_refused_before_the_search(
    session: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    searched: list[object] = []
    monkeypatch.setattr("rigkit.workflows.calibration.calibrate.corners_of", searched.append)
    for name in ("reg_a", "reg_b", "wide_c", "wide_d"):
        (session.parent / f"{name}.png").write_bytes(b"")
    assert main(["calibrate", str(session)]) == 2
    assert "same name or number" in capsys.readouterr().err and not searched


def test_a_camera_without_views_is_named(session: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (session.parent / "corners-wide.json").unlink()
    assert main(["calibrate", str(session)]) == 2
    printed = capsys.readouterr().err
    assert "no image matches 'images' of camera 'wide'" in printed and "Traceback" not in printed
