"""`rigkit init`: manifests of data sets and rigs from folders of images, and the facts that it asks for."""

from __future__ import annotations

import json
import shutil
from itertools import combinations
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.data import REPOSITORY

from rigkit.cli.main import main
from rigkit.core.errors import InputError
from rigkit.geometry.rigid3 import Rigid3
from rigkit.io.calibrations.calibration_file import load_calibration_or_camera
from rigkit.io.manifests.manifest import load_dataset
from rigkit.io.manifests.manifest_writer import FoundPair, ImageBoards, group_pairs
from rigkit.io.manifests.rig_session import load_rig_session
from rigkit.io.manifests.session import load_session
from rigkit.io.media.images import read_image
from rigkit.workflows.reconstruction.datasets import load_cameras

IMAGES = REPOSITORY / "datasets" / "lab-a" / "images"
CALIBRATION = REPOSITORY / "calib" / "cameras" / "mvca020_fe185" / "calibration.json"


def test_a_folder_becomes_a_manifest_that_loads(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shutil.copytree(IMAGES / "fisheye-general", tmp_path / "images" / "first")
    for side, number in (("left", 1), ("right", 2)):
        shutil.copy(IMAGES / "fisheye-standard" / f"view{number}.jpg", tmp_path / f"second_{side}.jpg")
    options = ["--square-mm", "50", "--pose-type", "general", "--calibration", str(CALIBRATION)]
    measured = ["--baseline-mm", "second=300+-2", "--angle-deg", "f*=90+-0.3"]
    assert main(["init", str(tmp_path), *options, *measured, "--name", "mine"]) == 0
    dataset = load_dataset(tmp_path)
    assert dataset.name == "mine"
    assert [pair.pair_id for pair in dataset.pairs] == ["first", "second"]
    assert [board.size for board in dataset.boards] == [(8, 6)] * 3
    second = dataset.pair("second")
    assert (second.image1.name, second.image2.name) == ("second_left.jpg", "second_right.jpg")
    assert second.truth.baseline is not None
    assert (second.truth.baseline.value_mm, second.truth.baseline.sigma_mm) == (300.0, 2.0)
    assert second.truth.angles == ()
    angles = [(a.a, a.b, a.value_deg, a.sigma_deg) for a in dataset.pair("first").truth.angles]
    assert angles == [(a, b, 90.0, 0.3) for a, b in combinations(("plane1", "plane2", "plane3"), 2)]
    before = (tmp_path / "dataset.toml").read_text()
    assert main(["init", str(tmp_path), *options]) == 2
    assert (tmp_path / "dataset.toml").read_text() == before


def test_a_board_in_words_stands_for_its_copies(tmp_path: Path) -> None:
    shutil.copytree(IMAGES / "fisheye-general", tmp_path / "first")
    options = ["--pose-type", "general", "--calibration", str(CALIBRATION), "--angle-deg", "90+-0.3"]
    assert main(["init", str(tmp_path), "--board", "8x6x50", *options]) == 0
    dataset = load_dataset(tmp_path)
    assert [(b.board_id, b.size, b.squares_mm) for b in dataset.boards] == [
        (f"plane{k}", (8, 6), (50.0, 50.0)) for k in (1, 2, 3)
    ]
    assert len(dataset.pair("first").truth.angles) == 3


def test_an_angle_needs_two_boards(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shutil.copytree(IMAGES / "fisheye-general", tmp_path / "first")
    board = REPOSITORY / "calib" / "boards" / "a8x6_50.toml"
    options = ["--pose-type", "general", "--calibration", str(CALIBRATION), "--angle-deg", "90+-0.3"]
    assert main(["init", str(tmp_path), "--board", str(board), *options]) == 2
    assert "--angle-deg is between two boards, but pair 'first' has one" in capsys.readouterr().err
    assert not (tmp_path / "dataset.toml").exists()


def test_folders_of_two_sides_and_names_with_quotes(tmp_path: Path) -> None:
    root = tmp_path / 'the "lab"'
    for side, number in (("left", 1), ("right", 2)):
        (root / side).mkdir(parents=True)
        for name, pair in (("0001", "fisheye-general"), ('b "2"', "fisheye-standard")):
            shutil.copy(IMAGES / pair / f"view{number}.jpg", root / side / f"{name}.jpg")
    options = ["--square-mm", "50", "--pose-type", "general", "--calibration", str(CALIBRATION)]
    assert main(["init", str(root), *options]) == 0
    dataset = load_dataset(root)
    assert dataset.name == "the lab"
    named = {p.pair_id: tuple(i.relative_to(root).as_posix() for i in (p.image1, p.image2)) for p in dataset.pairs}
    assert named == {"0001": ("left/0001.jpg", "right/0001.jpg"), "b-2-": ('left/b "2".jpg', 'right/b "2".jpg')}


@pytest.mark.parametrize("folders", [("pose_1", "pose_2"), ("day-a", "day-b")])
def test_folders_of_pairs_stay_so(tmp_path: Path, folders: tuple[str, str]) -> None:
    root = tmp_path.resolve()
    shown = [ImageBoards(root / f / f"{n}.jpg", (800, 600), ((8, 6),)) for f in folders for n in ("x", "y")]
    pairs = group_pairs(shown, root)
    assert [(p.name, p.first.image.name, p.second.image.name) for p in pairs] == [
        (f, "x.jpg", "y.jpg") for f in folders
    ]


def test_numbers_one_and_two_are_a_pair_where_there_are_no_others(tmp_path: Path) -> None:
    root = tmp_path.resolve()
    names = ("first1", "first2", "far-01", "far-02", "series1", "series2", "series3")
    shown = [ImageBoards(root / f"{n}.jpg", (800, 600), ((8, 6),)) for n in names]
    pairs = group_pairs(shown, root)
    assert [(p.name, p.first.image.stem, p.second.image.stem) for p in pairs] == [
        ("far", "far-01", "far-02"),
        ("first", "first1", "first2"),
    ]
    assert group_pairs(shown[4:], root) == []


@pytest.mark.parametrize("rests", [("01", "02"), ("_1", "_2"), ("_p0_0", "_p0_1")])
def test_names_that_begin_with_the_side(tmp_path: Path, rests: tuple[str, str]) -> None:
    """As stereo programs write them; left_1 and left_2 are of one camera."""
    root = tmp_path.resolve()
    names = [f"{side}{rest}" for side in ("left", "right") for rest in rests]
    pairs = group_pairs([ImageBoards(root / f"{n}.jpg", (800, 600), ((8, 6),)) for n in names], root)
    assert [(p.name, p.first.image.stem, p.second.image.stem) for p in pairs] == [
        (rest.strip("_"), f"left{rest}", f"right{rest}") for rest in rests
    ]
    lefts = [ImageBoards(root / f"left_{n}.jpg", (800, 600), ((8, 6),)) for n in ("view1", "view2")]
    assert [p.first.image.stem for p in group_pairs(lefts, root)] == ["left_view1"]


def test_facts_that_images_do_not_show_are_required(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    import io
    import sys

    monkeypatch.setattr(sys, "stdin", io.StringIO(""))
    shutil.copytree(IMAGES / "fisheye-general", tmp_path / "first")
    assert main(["init", str(tmp_path)]) == 2
    printed = capsys.readouterr().err
    assert all(option in printed for option in ("--square-mm", "--calibration", "--pose-type"))
    assert len(printed.splitlines()) == 1
    assert not (tmp_path / "dataset.toml").exists()


def test_an_empty_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["init", str(tmp_path)]) == 2
    assert "no images" in capsys.readouterr().err


@pytest.mark.parametrize(
    "options", [["--square-mm", "nan"], ["--square-mm", "-5"], ["--square-mm", "50", "--baseline-mm", "first=300+-0"]]
)
def test_impossible_lengths_are_refused(options: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shutil.copytree(IMAGES / "fisheye-general", tmp_path / "first")
    assert main(["init", str(tmp_path), "--calibration", "c.json", "--pose-type", "general", *options]) == 2
    assert "positive number" in capsys.readouterr().err
    assert not (tmp_path / "dataset.toml").exists()


def test_a_baseline_of_no_pair(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A single pair needs no name."""
    (tmp_path / "mine").mkdir()
    shutil.copy(IMAGES / "fisheye-general" / "view1.jpg", tmp_path / "mine")
    shutil.copy(CALIBRATION, tmp_path / "c.json")
    options = ["--square-mm", "50", "--pose-type", "general", "--baseline-mm", "120+-1"]
    command = ["init", str(tmp_path), "--calibration", str(tmp_path / "c.json"), *options]
    assert main(command) == 2
    assert "no two images look like a pair" in capsys.readouterr().err
    shutil.copy(IMAGES / "fisheye-general" / "view2.jpg", tmp_path / "mine")
    assert main(command) == 0
    baseline = load_dataset(tmp_path).pairs[0].truth.baseline
    assert baseline is not None and (baseline.value_mm, baseline.sigma_mm) == (120.0, 1.0)
    shutil.copytree(IMAGES / "fisheye-general", tmp_path / "other")
    assert main([*command, "--force"]) == 2
    assert "'120+-1' names no pair: write PAIR=MM+-SIGMA, such as mine=120+-1" in capsys.readouterr().err
    # A suggestion is one that is taken.
    command[command.index("120+-1")] = "120"
    assert main([*command, "--force"]) == 2
    assert "such as mine=120+-2" in capsys.readouterr().err


def test_a_calibration_of_another_image_size(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for view in (1, 2):
        image = read_image(IMAGES / "regular-general" / f"view{view}.jpg")
        cv2.imwrite(str(tmp_path / f"view{view}.png"), np.ascontiguousarray(image[8:]))
    options = ["--square-mm", "50", "--calibration", str(CALIBRATION), "--pose-type", "general"]
    assert main(["init", str(tmp_path), *options]) == 2
    assert f"view1.png' is 1624x1232 px, but '{CALIBRATION}' is of a camera of 1624x1240" in capsys.readouterr().err
    assert not (tmp_path / "dataset.toml").exists()


def test_several_cameras_and_pose_types(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two calibrations are those of the two images; of more, patterns say which pairs are whose; paths are as typed."""
    root = tmp_path / "lab"
    for pair in ("fisheye-general", "fisheye-standard"):
        shutil.copytree(IMAGES / pair, root / "images" / pair)
    for name in ("wide", "tele"):
        shutil.copy(CALIBRATION, tmp_path / f"{name}.json")
    monkeypatch.chdir(tmp_path)
    command = ["init", "lab", *3 * ["--board", "8x6x50"], "--force"]
    declared = ["--pose-type", "*-standard=standard", "--pose-type", "general"]
    assert main([*command, "--calibration", "wide.json", "--calibration", "tele.json", *declared]) == 0
    dataset = load_dataset(root)
    assert [(p.pose_type, p.camera1.camera_id, p.camera2.camera_id) for p in dataset.pairs] == [
        ("general", "camera1", "camera2"),
        ("standard", "camera1", "camera2"),
    ]
    assert dataset.pairs[0].camera1.calibration == (tmp_path / "wide.json").resolve()
    boards = [(board.board_id, board.size, board.square_x_mm) for board in dataset.boards]
    assert boards == [(f"plane{n}", (8, 6), 50.0) for n in (1, 2, 3)]
    three = [f"--calibration={name}" for name in ("w=wide.json", "t=tele.json", "x=wide.json")]
    assert main([*command, *three, *declared]) == 2
    assert "which cameras took pair 'fisheye-general'; add --cameras" in capsys.readouterr().err
    assert main([*command, *three, *declared, "--cameras", "*-general=w,t", "--cameras", "*=t,t"]) == 0
    cameras = [(p.camera1.camera_id, p.camera2.camera_id) for p in load_dataset(root).pairs]
    assert cameras == [("w", "t"), ("t", "t")]
    for wrong in (["--cameras", "*=w,y"], ["--cameras", "w,t"], ["--pose-type", "sideways"]):
        assert main([*command, *three, *declared, *wrong]) == 2


def test_a_rig_stands_for_its_cameras(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """`rigkit calibrate left right -o rig.json` writes rig-left.json and rig-right.json, too."""
    shutil.copytree(IMAGES / "fisheye-general", tmp_path / "lab" / "images" / "first")
    camera = json.loads(CALIBRATION.read_text())["camera"]
    pose = Rigid3.identity().matrix()[:3].tolist()
    cameras = [{"name": name, "camera": camera, "cam_from_rig": pose, "rms_px": 0.1} for name in ("left", "right")]
    (tmp_path / "rig.json").write_text(json.dumps({"schema": "rigkit.rig/1", "cameras": cameras}))
    shutil.copy(CALIBRATION, tmp_path / "rig-left.json")
    monkeypatch.chdir(tmp_path)
    command = ["init", "lab", "--square-mm", "50", "--pose-type", "general", "--calibration", "rig.json"]
    assert main(command) == 2
    printed = capsys.readouterr().err
    assert "'rig-right.json' is not beside it; give each camera's own file" in printed and printed.count("\n") == 1
    shutil.copy(CALIBRATION, tmp_path / "rig-right.json")
    assert main(command) == 0
    pair = load_dataset(tmp_path / "lab").pairs[0]
    assert {entry.camera_id: entry.calibration.name for entry in (pair.camera1, pair.camera2)} == {
        "left": "rig-left.json",
        "right": "rig-right.json",
    }
    with pytest.raises(InputError, match=r"is a rig.*give the file of the one camera, which is called as 'rig-NAME"):
        load_calibration_or_camera(tmp_path / "rig.json")


def test_a_session_of_two_cameras_is_written_and_loads(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for side in ("left", "right"):
        (tmp_path / side).mkdir()
        shutil.copy(IMAGES / "fisheye-general" / "view1.jpg", tmp_path / side / "01.jpg")
    command = ["init", str(tmp_path), "--session", "--board", "8x6x50"]
    assert main(command) == 0
    session = load_rig_session(tmp_path / "session.toml")
    assert list(session.cameras) == ["left", "right"]
    assert session.cameras["left"].boards[0].square_x_mm == 50.0
    assert main(command) == 2
    assert main([*command, "--square-mm", "50", "--force"]) == 2
    assert main([*command, "--pose-type", "general", "--force"]) == 2
    assert "only --board, --square-mm, --cameras and --model apply" in capsys.readouterr().err


def test_a_session_of_as_many_cameras_as_are_known(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for k in range(3):
        (tmp_path / f"{k}").mkdir()
        for view, name in (("view1", "A"), ("view2", "B")):
            shutil.copy(IMAGES / "regular-general" / f"{view}.jpg", tmp_path / f"{k}" / f"{name}.jpg")
    command = ["init", str(tmp_path), "--session", "--board", "8x6x50", "--cameras"]
    assert main([*command, "2"]) == 0
    session = load_rig_session(tmp_path / "session.toml")
    assert [len(own.images) for own in session.cameras.values()] == [3, 3]
    for number, words in (("3", "not of 3 cameras"), ("0", "give the number"), ("f-*=a,b", "give the number")):
        assert main([*command, number, "--force"]) == 2
        assert words in capsys.readouterr().err
    assert main(["init", str(tmp_path), "--session", "--square-mm", "50", "--cameras", "1", "--force"]) == 0
    assert len(load_session(tmp_path / "session.toml").images) == 6


@pytest.mark.parametrize(
    ("words", "refusal"),
    [
        ("photos --square-mm -3", "init: --square-mm: a positive number of mm is needed, got '-3.0'"),
        ("photos --square-mm nan", "init: --square-mm: a positive number of mm is needed, got 'nan'"),
        ("photos --square-mm 50 --model foo", "rigkit: camera model 'foo' is unknown; known: brown"),
        ("photos --square-mm 50 --board 8x6x50", "rigkit: --board states the square size already"),
        ("photos/1.jpg --board 8x6x50", "'photos/1.jpg' is an image; give the folder that holds it instead, 'photos'"),
        ("photos --board b.toml -o b.toml --force", "'b.toml'"),
        ("photos --board 8x6x50 -o photos/1.jpg --force", "'photos/1.jpg'"),
    ],
)
def test_impossible_sessions_are_refused(
    words: str, refusal: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Inputs stay also with --force."""
    monkeypatch.chdir(tmp_path)
    Path("photos").mkdir()
    Path("photos/1.jpg").write_bytes(b"an image")
    Path("b.toml").write_text("a board")
    assert main(["init", "--session", *words.split()]) == 2
    assert refusal in capsys.readouterr().err
    assert Path("photos/1.jpg").read_bytes() == b"an image" and Path("b.toml").read_text() == "a board"
    assert not list(tmp_path.rglob("session.toml"))


@pytest.mark.parametrize("declared", ["90", "first=90+-x", "190+-1", "90+-0"])
def test_impossible_angles_are_refused(declared: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "first").mkdir()
    shutil.copy(IMAGES / "fisheye-general" / "view1.jpg", tmp_path / "first")
    assert main(["init", str(tmp_path), "--square-mm", "50", "--angle-deg", declared]) == 2
    assert f"--angle-deg '{declared}': write" in capsys.readouterr().err


def test_pictures_of_results_are_no_pairs_and_paths_stay_as_typed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """One lacks a board; those of a folder have its name."""
    monkeypatch.chdir(tmp_path)
    for folder in ("seen", "first"):
        (tmp_path / folder).mkdir()
    for side, number, covered_px in (("left", 1, (800, 1240)), ("right", 2, (0, 0))):
        shutil.copy(IMAGES / "fisheye-general" / f"view{number}.jpg", f"{side}.jpg")
        shutil.copy(IMAGES / "fisheye-planar" / f"view{number}.jpg", f"first/view{number}.jpg")
        drawn, other = cv2.imread(f"{side}.jpg"), cv2.imread(f"first/view{number}.jpg")
        assert drawn is not None and other is not None
        drawn[slice(*covered_px)] = 0
        cv2.imwrite(f"seen/{side}.png", cv2.circle(drawn, (40, 40), 20, (0, 0, 255), 2))
        cv2.imwrite(f"seen/first_view{number}.png", other)
    options = ["--square-mm", "50", "--pose-type", "general", "--calibration", str(CALIBRATION)]
    assert main(["init", ".", *options]) == 0
    printed = capsys.readouterr()
    assert printed.out == "dataset.toml\n"
    for pictures, pair in (("left.png", "right.png"), "pair"), (("first_view1.png", "first_view2.png"), "first"):
        words = " and ".join(f"'seen/{name}'" for name in pictures)
        assert f"left out: {words} show the boards where pair '{pair}' does" in printed.err
    assert [pair.pair_id for pair in load_dataset(tmp_path).pairs] == ["first", "pair"]


Boards = list[tuple[tuple[int, int], tuple[float, ...]]]
BOTH: Boards = [((8, 6), (400.0, 380.0, 740.0, 730.0)), ((8, 6), (830.0, 380.0, 1170.0, 700.0))]


@pytest.mark.parametrize(
    ("image", "boards", "repeated"),
    [
        ("seen/a.png", BOTH, False),
        ("seen/first_a.png", BOTH, True),
        ("first/seen/a.png", BOTH, True),
        ("first/seen/a.png", BOTH[1:], True),  # one is drawn over
        ("first/seen/a.png", [((7, 6), (441.0, 381.0, 739.0, 731.0))], True),  # a column is
        ("first/seen/a.png", [((8, 6), (441.0, 381.0, 739.0, 731.0))], False),  # farther away
        ("first/seen/a.png", [((7, 6), (441.0, 381.0, 743.0, 731.0))], False),  # elsewhere
        ("first/seen/a.png", [((9, 6), (440.0, 381.0, 739.0, 731.0))], False),  # of another kind
        ("first/seen/a.png", [*BOTH, ((7, 6), (0.0, 0.0, 100.0, 100.0))], False),
    ],
)
def test_pictures_of_results_show_boards_only_where_the_capture_does(
    image: str, boards: Boards, repeated: bool
) -> None:
    def pair(image: str, boards: Boards) -> FoundPair:
        sizes, ends = zip(*boards, strict=True)
        one = ImageBoards(Path(image), (1624, 1240), sizes, ends)
        return FoundPair("p", one, one)

    assert pair(image, boards).repeats(pair("first/a.jpg", BOTH)) == repeated


def test_calibrations_of_other_programs_are_taken(tmp_path: Path) -> None:
    shutil.copytree(IMAGES / "regular-general", tmp_path / "first")
    camera = "camera_model: pinhole, distortion_model: none, intrinsics: [1355, 1355, 811.5, 619.5]"
    text = f"cam0: {{{camera}, distortion_coeffs: [], resolution: [1624, 1240]}}\n"
    (tmp_path / "kalibr.yaml").write_text(text)
    options = ["--square-mm", "50", "--pose-type", "general", "--calibration", str(tmp_path / "kalibr.yaml")]
    assert main(["init", str(tmp_path), *options]) == 0
    cameras = load_cameras(load_dataset(tmp_path))
    assert [camera.calibration for camera in cameras.known.values()] == [None] and not cameras.failed
