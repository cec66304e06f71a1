"""`rigkit calibrate FOLDER`: folders of pictures and the size of the board, without any file written by hand."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.schemas import faults
from helpers.stereo_pictures import CAMERA, FRAMES, RIGHT_FROM_LEFT, of_one_camera

from rigkit.calibration.certainty.displaced import covariance_of_modes
from rigkit.cameras.base import Camera
from rigkit.cli.main import main
from rigkit.core.errors import InputError
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import nearest_rotation
from rigkit.interop.opencv import read_opencv, write_opencv
from rigkit.interop.ros import read_camera_info
from rigkit.io.calibrations.calibration_file import camera_to_json, load_calibration
from rigkit.io.calibrations.rig_file import load_rig, load_saved_rig
from rigkit.io.corners.corner_cache import FoundCorners
from rigkit.io.corners.corners_file import read_corners
from rigkit.io.manifests.rig_session import load_rig_session
from rigkit.io.manifests.session import load_session
from rigkit.workflows.calibration import calibrate_any
from rigkit.workflows.calibration.calibrate import SessionCalibration, calibrate_session
from rigkit.workflows.calibration.calibrate_any import calibrate_session_file
from rigkit.workflows.inputs.camera_files import import_rig
from rigkit.workflows.inputs.corners import first_calibration
from rigkit.workflows.inputs.folder_session import cameras_in, session_of_folders
from rigkit.workflows.inputs.known_cameras import known_cameras, known_cameras_first
from rigkit.workflows.options.cameras import CalibrateOptions, FolderOptions, Known

SAME_LENS_PX = 0.1
"""Projections of the camera found against the true one, where boards were: corners of JPEGs to about 0.03 px, 9 images;
a board of another size, or another format's convention, gives a pixel at least."""
SIGMAS = 4.0


def undated(path: Path) -> dict[str, Any]:
    """A result without the day it was made on; what it was made from stays."""
    data: dict[str, Any] = json.loads(path.read_text())
    assert data["made"]["inputs"] and data["made"]["rigkit"]
    del data["made"]["written"]
    return data


def worst_px(camera: Camera) -> float:
    """Return how far the projections are off in the middle of the image, but for a rotation of the camera."""
    u, v = np.meshgrid(np.linspace(150.0, 490.0, 18), np.linspace(120.0, 360.0, 13))
    pixels = np.stack([u.ravel(), v.ravel()], axis=1)
    rays, ours = CAMERA.unproject(pixels)[0], camera.unproject(pixels)[0]
    projected, valid = camera.project(rays @ nearest_rotation(ours.T @ rays).T)
    assert valid.all()
    return float(np.abs(projected - pixels).max())


def test_a_broken_link_is_named(pictures: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A store of data links images that were not fetched to nothing: the others are used, and these are named."""
    folder = of_one_camera(pictures, tmp_path / "photos")
    (folder / "DSC_9999.JPG").symlink_to(tmp_path / "store" / "abc.jpg")
    command = [
        "calibrate",
        str(folder),
        "--board",
        "9x6x30",
        "--model",
        "brown",
        "-r",
        "-o",
        str(tmp_path / "out.json"),
    ]
    assert main(command) == 2
    assert load_calibration(tmp_path / "out.json").heldout_rms_px is not None
    assert f"{FRAMES} files; SHA-256" in (tmp_path / "out.html").read_text()
    assert "image 'DSC_9999.JPG' is left out" in "".join(capsys.readouterr())


def test_from_pictures_to_a_page_and_two_formats_in_one_command(
    pictures: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = of_one_camera(pictures, tmp_path / "my [photos]")
    command = ["calibrate", str(folder), "--board", "9x6x30", "-r", "--export", "opencv", "ros"]
    assert main(command) == 0
    assert all(map(str.count, capsys.readouterr(), ("held-out RMS", "session.toml, corners.json written")))
    cameras = [
        load_calibration(folder / "calibration.json").camera,
        read_opencv((folder / "calibration-opencv.yaml").read_text(), ""),
        read_camera_info((folder / "calibration-ros.yaml").read_text(), ""),
    ]
    assert max(map(worst_px, cameras)) < SAME_LENS_PX
    assert (folder / "calibration.html").read_text().count("data:image/jpeg") == FRAMES
    # What was used stands there, and gives the same again.
    session = load_session(folder / "session.toml")
    assert len(session.images) == FRAMES and session.model == "auto"
    assert session.boards[0].size == (9, 6) and session.boards[0].square_x_mm == 30.0
    before = {path: path.read_bytes() for path in folder.iterdir()}
    result = undated(folder / "calibration.json")
    assert main(command) == 2
    assert "calibration.json' exists and is left as it is; use --force to replace" in capsys.readouterr().err
    # The folder is read by the session that lies in it.
    assert main(["calibrate", str(folder), "--force"]) == 0
    assert undated(folder / "calibration.json") == result
    assert {path.name for path in folder.iterdir()} == {path.name for path in before} | {"corners.json"}


def test_results_in_one_folder_have_a_session_each(
    pictures: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    # A file that is no cache of corners stays.
    foreign = tmp_path / "far-session-corners.json"
    foreign.write_text('{"mine": 1}')
    for name, model in (("near", "brown"), ("far", "pinhole")):
        folder = of_one_camera(pictures, tmp_path / f"{name}-photos", 4)
        output = tmp_path / f"{name}.json"
        command = ["calibrate", str(folder), "--board", "9x6x30", "--model", model, "-o", str(output), "--json"]
        assert main(command) == 0
        printed = capsys.readouterr()
        assert ("left as it is; rename it; the corners are used, but not kept" in printed.err) == (name == "far")
        answer = json.loads(printed.out)
        assert answer["model"] == model and faults(answer["page"]) == []
        assert set(answer["sigmas"]) == set(answer["parameters"])
        assert {"parameters", "boards", "images"} <= {table["key"] for table in answer["page"]["tables"]}
        session = load_session(tmp_path / f"{name}-session.toml")
        assert session.model == model and {image.parent for image in session.images} == {folder}
        assert f"rigkit calibrate {name}-session.toml -o {name}.json --force" in session.path.read_text()
    assert foreign.read_text() == '{"mine": 1}'


def test_a_session_of_a_person_is_not_replaced(
    pictures: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = of_one_camera(pictures, tmp_path / "photos")
    session = folder / "session.toml"
    session.write_text("# mine\n")
    assert main(["calibrate", str(folder), "--board", "9x6x30"]) == 2
    assert "session.toml' exists" in capsys.readouterr().err
    assert session.read_text() == "# mine\n" and not (folder / "board-9x6x30.toml").exists()
    session.unlink()
    # Nothing comes out, nothing is left.
    assert main(["calibrate", str(folder), "--board", "7x5x30"]) == 2
    assert "columns and rows" in capsys.readouterr().err
    assert sorted({path.suffix for path in folder.iterdir()} - {".json"}) == [".JPG"]
    assert main(["calibrate", str(folder)]) == 2
    assert "--board 9x6xMM" in capsys.readouterr().err
    assert main(["calibrate", str(folder), "--board", "9x6"]) == 2
    assert "say how large a square is" in capsys.readouterr().err


@pytest.mark.parametrize("layout", ["names", "folders", "two folders"])
def test_pictures_of_two_cameras_are_a_rig(pictures: Path, tmp_path: Path, layout: str) -> None:
    folder = tmp_path / "rig"
    sources = [folder]
    shutil.copytree(pictures, folder)
    if layout != "names":
        for side in ("left", "right"):
            (folder / side).mkdir()
            for path in folder.glob(f"{side}*.jpg"):
                path.rename(folder / side / path.name.replace(side, "IMG"))
        sources = [folder] if layout == "folders" else [folder / "left", folder / "right"]
    command = ["calibrate", *map(str, sources), "--board", "9x6x30", "--model", "brown", "--export", "opencv"]
    assert main(command) == 0
    rig = load_rig(folder / "rig.json")
    assert list(rig) == list(load_rig_session(folder / "session.toml").cameras) == ["left", "right"]
    found = rig["right"][1] @ rig["left"][1].inverse()
    covariance = load_saved_rig(folder / "rig.json").covariance
    assert covariance is not None
    sigma = np.sqrt(np.diag(covariance)[-3:])
    assert np.all(np.abs(found.translation_mm - RIGHT_FROM_LEFT.translation_mm) < SIGMAS * sigma + 0.05)
    assert np.linalg.norm(sigma) < 1.0
    # The rig's file has the lenses as well.
    assert sorted(path.name for path in folder.glob("*-opencv*")) == ["rig-opencv.yaml"]
    pair = import_rig(folder / "rig-opencv.yaml")
    assert all(worst_px(camera) < SAME_LENS_PX for camera, _ in pair.values())
    np.testing.assert_allclose((pair["right"][1] @ pair["left"][1].inverse()).matrix(), found.matrix(), atol=1e-9)


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (["left01.jpg", "right01.jpg"], {"left": ["left[0-9]*.jpg"], "right": ["right[0-9]*.jpg"]}),
        (["01_left.png", "01_right.png"], {"left": ["*[0-9]_left.png"], "right": ["*[0-9]_right.png"]}),
        (["cam2_1.png", "cam10_1.png"], {"cam2": ["cam2_[0-9]*.png"], "cam10": ["cam10_[0-9]*.png"]}),
        (
            ["left_p0_1.png", "right_p0_1.png", "left_p0_2.png"],
            {"left": ["left_*[0-9].png"], "right": ["right_*[0-9].png"]},
        ),
        (["a_1_left.png", "a_1_right.png"], {"left": ["*[0-9]_left.png"], "right": ["*[0-9]_right.png"]}),
        # Where a board was held before one camera.
        (["left_far_1.png", "left_near_2.png", "right_tilted_3.png"], {"": ["*.png"]}),
        # One that belongs to neither side, or one side alone: one camera.
        (["left01.jpg", "right01.jpg", "upright.jpg"], {"": ["*.jpg"]}),
        (["left01.jpg", "left02.JPG"], {"": ["*.JPG", "*.jpg"]}),
        (["a/1.jpg", "b/1.jpg"], None),
        (["cam0/1.jpg", "cam1/1.jpg", "other/1.jpg"], {"cam0": ["*.jpg"], "cam1": ["*.jpg"]}),
    ],
)
def test_cameras_are_recognised_by_file_names(
    tmp_path: Path, names: list[str], expected: dict[str, list[str]] | None
) -> None:
    for name in names:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    if expected is None:
        with pytest.raises(InputError, match="give one folder a camera"):
            cameras_in([tmp_path])
        return
    assert {name: [pattern for _, pattern in own] for name, own in cameras_in([tmp_path]).items()} == expected


def test_a_name_that_a_session_cannot_hold(tmp_path: Path) -> None:
    folder = tmp_path / "ph\udcffotos"
    folder.mkdir()
    (folder / "1.jpg").touch()
    with pytest.raises(InputError, match="rename"):
        session_of_folders([folder], ["9x6x25"], tmp_path / "session.toml")


@pytest.mark.parametrize("kind", ["csv", "vnl", "json"])
def test_corners_from_a_file(
    pictures: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = of_one_camera(pictures, tmp_path / "photos")
    assert main(["calibrate", str(folder), "--board", "9x6x30", "--model", "brown"]) == 0
    plain = load_calibration(folder / "calibration.json")
    corners = tmp_path / f"corners.{kind}"
    if kind == "json":
        shutil.copy(folder / "corners.json", corners)
    else:
        csv = tmp_path / "corners.csv"
        assert main(["detect", str(folder), "-o", str(csv), "-j", "1"]) == 0
        if kind == "vnl":
            write_vnl(csv, corners)
    (folder / "corners.json").unlink()
    capsys.readouterr()
    monkeypatch.setattr(
        "rigkit.workflows.inputs.corners.detect_boards", lambda *_, **__: pytest.fail("looked for corners")
    )
    arguments = ["calibrate", str(folder / "session.toml"), "--corners", str(corners), "-o", str(tmp_path / "new.json")]
    assert main(arguments) == 0
    found = load_calibration(tmp_path / "new.json")
    assert found.corner_count == plain.corner_count == FRAMES * 54
    assert worst_px(found.camera) < SAME_LENS_PX
    assert not (folder / "corners.json").exists()
    assert main([*arguments[:-1], str(corners), "--force"]) == 2
    assert "it would be lost" in capsys.readouterr().err
    for path in folder.glob("*.JPG"):
        path.rename(path.with_name(f"x{path.name}"))
    assert main([*arguments, "--force"]) == 2
    assert f"names none of the {FRAMES} images" in capsys.readouterr().err


def write_vnl(csv: Path, vnl: Path) -> None:
    """Write the corners of a whole 9x6 board in each image as mrgingham does, row by row."""
    lines = ["# filename x y level"]
    for image, (found,) in read_corners(csv).items():
        assert (found.columns, found.rows) == (9, 6)
        for k in np.lexsort((found.grid[:, 0], found.grid[:, 1])):
            lines.append(f"{Path(image).name} {found.pixels[k, 0]:.5f} {found.pixels[k, 1]:.5f} 0")
    vnl.write_text("\n".join(lines) + "\n")


def test_a_session_file_from_python_too(pictures: Path, tmp_path: Path) -> None:
    (tmp_path / "board.toml").write_text('schema = "rigkit.board/1"\ncolumns = 9\nrows = 6\nsquare_mm = 30.0\n')
    (tmp_path / "session.toml").write_text(
        f'schema = "rigkit.session/1"\nimages = "{pictures}/left*.jpg"\nboard = "board.toml"\nmodel = "brown"\n'
    )
    session = tmp_path / "session.toml"
    done = calibrate_session_file(session, CalibrateOptions())
    assert done.written == (tmp_path / "calibration.json",)
    again = calibrate_session(session)
    assert not again.written
    assert isinstance(done, SessionCalibration)
    np.testing.assert_array_equal(again.calibration.camera.parameters, done.calibration.camera.parameters)
    # No camera is found of nothing; why, the calibration itself says.
    assert first_calibration(load_session(session), {"left01.jpg": FoundCorners((640, 480), ())}) is None


def test_lenses_that_are_known_stay_and_a_camera_is_added_to_a_rig(pictures: Path, tmp_path: Path) -> None:
    """Only the mount is found with the lenses of files; a camera joins a rig that stays as it is; the session written
    says so, and does the same again."""
    folder = tmp_path / "rig"
    folder.mkdir()
    for path in pictures.glob("*0[1-4].jpg"):
        shutil.copy(path, folder)
    lens = tmp_path / "lens.yaml"
    lens.write_text(write_opencv(CAMERA).text)
    command = ["calibrate", str(folder), "--board", "9x6x30"]
    assert main([*command, "--only-extrinsics", str(lens), str(lens)]) == 0
    rig = load_rig(folder / "rig.json")
    for camera, _ in rig.values():
        np.testing.assert_allclose(camera.parameters, CAMERA.parameters, rtol=1e-8, atol=1e-10)
    moved = rig["right"][1].translation_mm - RIGHT_FROM_LEFT.translation_mm
    assert np.linalg.norm(moved) < 0.1
    assert list(load_rig_session(folder / "session.toml").lenses) == ["left", "right"]
    before = undated(folder / "rig.json")
    assert main(["calibrate", str(folder / "session.toml"), "--force"]) == 0
    assert undated(folder / "rig.json") == before

    # The right camera anew, with the left one as a rig of its own frame has it.
    left = {key: before["cameras"][0][key] for key in ("name", "camera", "cam_from_rig", "rms_px")}
    saved = {"schema": before["schema"], "cameras": [left], "covariance": (1e-12 * np.eye(9)).tolist()}
    known = tmp_path / "known.json"
    known.write_text(json.dumps(saved))
    added = tmp_path / "out" / "rig.json"
    added.parent.mkdir()
    assert main([*command, "--add-camera", str(known), "-o", str(added), "--model", "brown"]) == 0
    rig = load_rig(added)
    np.testing.assert_allclose(rig["left"][0].parameters, CAMERA.parameters, rtol=1e-8, atol=1e-10)
    assert worst_px(rig["right"][0]) < SAME_LENS_PX
    # The lenses of a rig's file come with how unsure they are.
    session = replace(load_rig_session(folder / "session.toml"), lenses={"right": added})
    reported, saved_rig = known_cameras(session), load_saved_rig(added)
    assert reported is not None and reported.covariance is not None
    of_file = saved_rig.widened_covariance
    assert of_file is not None
    # The mounts and the other lens are left out, but not what the other lens's departures do to this one.
    others = covariance_of_modes(saved_rig.departures[:1], len(of_file))
    np.testing.assert_allclose(reported.covariance, (of_file + others)[9:18, 9:18], rtol=1e-12)
    assert reported.departures["right"].modes.shape == saved_rig.departures[1].modes.shape


def test_known_cameras_are_written_to_the_session(
    pictures: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    lens, known = tmp_path / "lens.yaml", tmp_path / "known.json"
    lens.write_text(write_opencv(CAMERA).text)
    cameras = [
        {"name": name, "camera": camera_to_json(CAMERA), "cam_from_rig": pose.matrix()[:3].tolist(), "rms_px": 0.1}
        for name, pose in (("left", Rigid3.identity()), ("top", RIGHT_FROM_LEFT))
    ]
    known.write_text(json.dumps({"schema": "rigkit.rig/1", "cameras": cameras}))
    options = CalibrateOptions(known=Known(rig=known))
    wanted = session_of_folders([pictures], ["9x6x30"], tmp_path / "session.toml", options=options)
    for path, text in wanted.items():
        path.write_text(text)
    session = load_rig_session(tmp_path / "session.toml")
    assert session.known_rig == known and list(session.cameras) == ["left", "right"]
    # Of the rig's file nobody knows how sure it is, nor of another tool's lens.
    reported = known_cameras(replace(session, lenses={"right": lens}))
    assert reported is not None and list(reported.cameras) == ["left", "right"] and reported.covariance is None
    assert all(f"'{path}' states no uncertainty" in caplog.text for path in (known, lens))
    # A camera of the rig that has no images is not lost without a word.
    known_cameras_first(session)
    assert "without images here, top will not be in the new rig" in caplog.text
    caplog.clear()
    known.write_text(json.dumps({"schema": "rigkit.rig/1", "cameras": [{**cameras[0], "name": "right"}]}))
    assert list(known_cameras_first(session).cameras) == ["right", "left"] and not caplog.text
    with pytest.raises(InputError, match="3 lenses for 2 cameras"):
        Known(lenses=(lens, lens, lens)).of_cameras(["left", "right"])
    one = of_one_camera(pictures, tmp_path / "one")
    assert main(["calibrate", str(one), "--board", "9x6x30", "--only-extrinsics", str(lens)]) == 2
    assert "rigkit pose" in capsys.readouterr().err


def test_the_square_is_enough_where_images_show_the_board(pictures: Path, tmp_path: Path) -> None:
    folder = of_one_camera(pictures, tmp_path / "photos", 4)
    assert main(["calibrate", str(folder), "--square-mm", "30", "--model", "brown"]) == 0
    assert 'board = "board-9x6x30.toml"' in (folder / "session.toml").read_text()
    # What the session says is kept: again without a word, or with the same ones.
    assert main(["calibrate", str(folder), "--force"]) == 0
    assert main(["calibrate", str(folder), "--board", "9x6x30", "--model", "brown", "--force"]) == 0


@pytest.mark.parametrize("name", ["calibration.json", "calibration.html", "calibration-opencv.yaml"])
def test_an_existing_result_is_refused_before_boards_are_identified(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "photos"
    folder.mkdir()
    (folder / "0.png").touch()
    (folder / name).touch()
    monkeypatch.setattr("rigkit.workflows.calibration.calibrate_any.boards_seen", None)
    assert main(["calibrate", str(folder), "--square-mm", "30", "-r", "--export", "opencv"]) == 2
    assert f"'{folder / name}' exists and is left as it is" in capsys.readouterr().err


def test_a_session_of_another_run_at_the_same_time_stays(
    pictures: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two runs in one folder: the second finds the first one's result, and leaves that one's session to it."""
    for path in sorted(pictures.glob("left*.jpg"))[:2]:
        shutil.copy(path, tmp_path)
    result = tmp_path / "calibration.json"

    def slower(session: Path, *_: object, **__: object) -> None:
        if of_other_run:
            result.write_text("of the other run")
        raise InputError(f"'{result}' exists")

    monkeypatch.setattr(calibrate_any, "calibrate_session_file", slower)
    for of_other_run in (False, True):
        with pytest.raises(InputError, match="exists"):
            calibrate_any.calibrate_folders([tmp_path], FolderOptions(boards=("9x6x30",)), CalibrateOptions())
        assert (tmp_path / "session.toml").exists() == of_other_run
