"""Sessions of several cameras: which images belong together, and faults of the file."""

from __future__ import annotations

from pathlib import Path

import pytest

from rigkit.cli.main import main
from rigkit.core.errors import InputError
from rigkit.io.manifests.rig_session import ONE, frames_of_images, is_rig_session, load_rig_session
from rigkit.io.manifests.session import load_session

BOARD = 'schema = "rigkit.board/1"\ncolumns = 9\nrows = 6\nsquare_mm = 30.0\n'
HEAD = 'schema = "rigkit.session/1"\nboard = "board.toml"\nmodel = "brown"\n'
LEFT = '[[cameras]]\nid = "left"\nimages = "left*.jpg"\n'
RIGHT = '[[cameras]]\nid = "right"\nimages = "right*.jpg"\nmodel = "scaramuzza"\ndegree = 5\n'
TWO = HEAD.replace('board = "board.toml"', 'boards = ["board.toml", "other.toml"]')
IMAGES = 'images = "*.jpg"\n'
RIGID = '[[rigid_boards]]\nboards = ["board", "other"]\n'
BASELINE = '[[baselines]]\na = "left"\nb = "right"\nvalue_mm = 100.0\nsigma_mm = 1.0\nhow = "steel rule"\n'


def session(tmp_path: Path, text: str) -> Path:
    (tmp_path / "board.toml").write_text(BOARD)
    (tmp_path / "other.toml").write_text(BOARD.replace("9", "8"))
    path = tmp_path / "session.toml"
    path.write_text(text)
    return path


def test_reads_what_is_written(tmp_path: Path) -> None:
    for name in ("left2.jpg", "left1.jpg", "right1.jpg"):
        (tmp_path / name).touch()
    path = session(tmp_path, HEAD + 'frames = "number"\n' + LEFT + RIGHT + BASELINE)
    assert is_rig_session(path)
    rig = load_rig_session(path)
    assert [p.name for p in rig.cameras["left"].images] == ["left1.jpg", "left2.jpg"]
    assert (rig.cameras["left"].model, rig.cameras["right"].model, rig.cameras["right"].degree) == (
        "brown",
        "scaramuzza",
        5,
    )
    assert rig.cameras["left"].corners_path != rig.cameras["right"].corners_path
    assert rig.frames == "number" and rig.baselines[0].length.value_mm == 100.0
    with pytest.raises(InputError, match="several"):
        load_session(path)


def test_reads_boards_on_one_mount(tmp_path: Path) -> None:
    angle = '{ a = "board", b = "other", value_deg = 90.0, sigma_deg = 0.3, how = "set square" }'
    length = '{ a = "board[0,0]", b = "other", value_mm = 150.0, sigma_mm = 1.0, how = "rule" }'
    text = TWO + IMAGES + RIGID + f'layout = {{ board = "floor" }}\nangles = [ {angle} ]\ndistances = [ {length} ]\n'
    path = session(tmp_path, text)
    assert is_rig_session(path)
    rig = load_rig_session(path)
    assert list(rig.cameras) == [ONE] and rig.cameras[ONE].camera is None
    assert rig.result_path.name == "calibration.json"
    (group,) = rig.rigid_boards
    assert group.boards == ("board", "other") and group.layout == {"board": "floor"}
    assert group.truth.angles[0].value_deg == 90.0 and str(group.truth.distances[0].a) == "board[0,0]"
    assert load_rig_session(session(tmp_path, TWO + LEFT + RIGHT + RIGID)).rigid_boards[0].boards == group.boards


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (HEAD + LEFT, "at least two"),
        (HEAD + LEFT + LEFT, "its own"),
        (HEAD + 'images = "*.jpg"\n' + LEFT + RIGHT, "together with"),
        (HEAD + 'frames = "clock"\n' + LEFT + RIGHT, "known: name, number, time, order"),
        (HEAD + LEFT + RIGHT + BASELINE.replace('b = "right"', 'b = "rihgt"'), "known: left, right"),
        (HEAD + LEFT + RIGHT + BASELINE.replace('b = "right"', 'b = "left"'), "name two cameras"),
        (HEAD + LEFT + RIGHT + BASELINE.replace("sigma_mm = 1.0\n", ""), "sigma_mm"),
        (HEAD + LEFT + RIGHT.replace("images", "image"), "images"),
        (HEAD + LEFT.replace('"left"', '"a/b"') + RIGHT, "slashes"),
        (HEAD + IMAGES + '[[rigid_boards]]\nboards = ["board"]\n', "at least two strings"),
        (HEAD + IMAGES + '[[rigid_boards]]\nboards = ["board", "roof"]\n', "no board is called 'roof'"),
        (TWO + IMAGES + RIGID + RIGID, "on two mounts"),
        (TWO + IMAGES + RIGID + 'layout = { roof = "left" }\n', "'roof' is none of its boards"),
        (TWO + IMAGES + RIGID + 'layout = { board = "sky" }\n', "'sky', which is unknown"),
        (TWO + IMAGES + RIGID + "angles = [ { a = 'board', b = 'other', value_deg = 90.0 } ]\n", "sigma_deg"),
        (TWO + IMAGES + RIGID + 'baseline = { value_mm = 3.0, sigma_mm = 1.0, how = "rule" }\n', "key 'baseline'"),
        (TWO + IMAGES + RIGID + "images = 'x.png'\n", "unknown key 'images'"),
        (HEAD + LEFT + RIGHT + BASELINE.replace("100.0", "0.5"), "session.toml: [[baselines]] number 1: length"),
    ],
)
def test_bad_files_are_explained(text: str, words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["calibrate", str(session(tmp_path, text))]) == 2
    printed = capsys.readouterr().err
    assert words in printed and printed.count("\n") == 1


def test_frames() -> None:
    by_name = frames_of_images({"a": ["0001.png", "0002.png"], "b": ["0002.jpg", "0003.jpg"]})
    assert by_name["a"]["0002.png"] == by_name["b"]["0002.jpg"] != by_name["b"]["0003.jpg"]
    by_number = frames_of_images({"l": ["left01.jpg", "left02.jpg"], "r": ["right2.jpg", "right10.jpg"]})
    assert by_number["l"]["left02.jpg"] == by_number["r"]["right2.jpg"]
    assert by_number["r"]["right10.jpg"] not in by_number["l"].values()
    by_order = frames_of_images({"l": ["x", "y"], "r": ["p", "q"]}, "order")
    assert by_order["l"]["y"] == by_order["r"]["q"] != by_order["r"]["p"]


def test_times_nearly_the_same_are_of_one_moment() -> None:
    """Drivers stamp each image when it arrives: 137 ns apart here, with one frame that the second camera lost."""
    first = [f"{1403636579763555584 + 50_000_000 * k}.png" for k in range(4)]
    second = [f"{1403636579763555584 + 50_000_000 * k + 137}.png" for k in (0, 1, 3)]
    frames = frames_of_images({"cam0": first, "cam1": second})
    assert [frames["cam1"][image] for image in second] == [frames["cam0"][first[k]] for k in (0, 1, 3)]
    assert len(set(frames["cam0"].values())) == 4
    seconds = frames_of_images({"a": ["1700000000.25.png", "1700000001.5.png"], "b": ["1700000000.4.png"]})
    assert seconds["a"]["1700000000.25.png"] == seconds["b"]["1700000000.4.png"]
    counted = [f"{k:010d}.png" for k in range(2)]
    assert frames_of_images({"image_00": counted, "image_01": counted})["image_01"][counted[1]] == "0000000001"
    with pytest.raises(InputError, match="by the times in their names"):
        frames_of_images({"a": ["1700000000.0.png", "1700000001.0.png"], "b": ["1700000000.5.png"]})
    with pytest.raises(InputError, match="are of one time"):
        frames_of_images({"a": ["mon/1700000000.png", "tue/1700000000.png"], "b": ["1700000000.png"]})
    with pytest.raises(InputError, match=r"'left1\.png' of camera 'a' is not named by a time"):
        frames_of_images({"a": ["left1.png"], "b": ["1700000000.png"]}, "time")


def test_near_copies_leave_the_moments_of_others_alone() -> None:
    """The nearest image counts; the other is of no moment of the second camera, whatever the shortest gap is."""
    times = [1700000000_000000000 + 5_000_000_000 * k for k in range(4)]
    near_copy = str(times[2] + 1_000_000)
    first, second = [f"{t}.png" for t in times], [f"{t + 600_000}.png" for t in times]
    for copied, other in ((first, second), (second, first)):
        frames = frames_of_images({"a": [*copied, f"{near_copy}.png"], "b": other})
        shared = [frames["a"][image] for image in copied] == [frames["b"][image] for image in other]
        taken = frames["a"][f"{near_copy}.png"] in frames["b"].values()
        # 0.4 ms after the image of the second camera is nearer than 0.6 ms before it.
        assert (shared, taken) == ((False, True) if copied is first else (True, False))
        assert len(set(frames["a"].values())) == 5
    # Two of the second camera are near one moment of the first.
    later = frames_of_images({"a": first, "b": [*second, f"{near_copy}.png"]})
    assert [later["a"][image] for image in first] == [later["b"][image] for image in second]
    assert later["b"][f"{near_copy}.png"] not in later["a"].values()


def test_images_of_one_name_in_many_folders_are_told_apart_by_what_differs() -> None:
    frames = frames_of_images({"a": ["mon/a/img.jpg", "tue/a/img.jpg"], "b": ["tue/b/img.jpg", "wed/b/img.jpg"]})
    assert frames["a"]["tue/a/img.jpg"] == frames["b"]["tue/b/img.jpg"]
    assert len({frame for own in frames.values() for frame in own.values()}) == 3
    numbered = frames_of_images({s: [f"{k}_{s}.jpg" for k in range(3)] for s in ("2211", "2257")})
    assert numbered["2211"]["1_2211.jpg"] == numbered["2257"]["1_2257.jpg"] == "1"
    with pytest.raises(InputError, match=r"'mon/a.jpg' and 'tue/a.jpg' of camera 'a' are simultaneous by their names"):
        frames_of_images({"a": ["mon/a.jpg", "tue/a.jpg"], "b": ["x/b.jpg", "y/b.jpg"]})


def test_images_without_a_common_frame_are_named() -> None:
    with pytest.raises(InputError, match='frames = "order"'):
        frames_of_images({"l": ["a.jpg", "b.jpg"], "r": ["c.jpg", "d.jpg"]})
    with pytest.raises(InputError, match="as many of every camera in the same order; there are 2 of 'l', 1 of 'r'"):
        frames_of_images({"l": ["a.jpg", "b.jpg"], "r": ["c.jpg"]})
    with pytest.raises(InputError, match="2 of 'l', 1 of 'r'"):
        frames_of_images({"l": ["a.jpg", "b.jpg"], "r": ["c.jpg"]}, "order")
    with pytest.raises(InputError, match=r"'a1\.jpg' and 'b1\.jpg' of camera 'l'"):
        frames_of_images({"l": ["a1.jpg", "b1.jpg"], "r": ["c1.jpg"]}, "number")
    # One image of every camera: there is but one moment.
    assert frames_of_images({"l": ["l.jpg"], "r": ["r.jpg"]}) == {"l": {"l.jpg": "0000-l"}, "r": {"r.jpg": "0000-l"}}
