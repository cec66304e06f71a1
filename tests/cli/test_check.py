"""`rigkit check` and `rigkit history` on rendered pictures: exit codes, correction, register, pages, refusals."""

from __future__ import annotations

import json
import os
import re
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.calibration_scenes import noisy_view
from helpers.monitoring_scenes import best_held, known_rig

from rigkit.calibration.calibrate import calibrate
from rigkit.cameras.base import Camera
from rigkit.cameras.brown import Brown
from rigkit.cameras.pinhole import Pinhole
from rigkit.cli.main import main
from rigkit.core.boards import Board
from rigkit.core.errors import DegenerateError, InputError
from rigkit.detection.detect import detect_boards
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3
from rigkit.io.boards.board_words import board_of_words
from rigkit.io.calibrations.calibration_file import camera_to_json, load_camera, save_calibration
from rigkit.io.calibrations.history_file import editions, load_history
from rigkit.io.corners.corner_cache import image_hash
from rigkit.io.media.images import read_image
from rigkit.report.pages.check_page import _power_words
from rigkit.synthetic.photometry import Photometry
from rigkit.synthetic.render import Optics, render
from rigkit.synthetic.scene import PlacedBoard
from rigkit.validation.monitoring.hypotheses import hypotheses_of
from rigkit.validation.monitoring.power import Power
from rigkit.validation.monitoring.verdict import CalibrationCheck, Change
from rigkit.workflows.checks.check import OWN_IMAGE, _replaced_by_known, _require_right_order, check_pictures
from rigkit.workflows.options.boards import CheckOptions
from rigkit.workflows.outputs.provenance import SHORT_HASH

BOARD = Board("board", 9, 6, 25.0, 25.0)
CAMERA = Brown((640, 480), np.array([620.0, 621.0, 322.0, 236.0, -0.12, 0.05, 0.0, 0.0, 0.0]))
FOCUS_PERCENT = 0.5
NOISE_PX = 0.03
MARKS = "marker_mm=20,dictionary=DICT_5X5_100"
LENGTH = ["--length", "100", "--distance", "500"]


def _pictures(folder: Path, camera: Camera, rng: np.random.Generator, *others: PlacedBoard) -> Path:
    folder.mkdir()
    for k, pose in enumerate(best_held(CAMERA, BOARD, 3, 0.1)):
        placed = [PlacedBoard(BOARD, pose), *others]
        optics, photometry = Optics(0.6, supersample=2), Photometry(noise_levels=1.0)
        image = render(placed, camera, Rigid3.identity(), optics=optics, photometry=photometry, rng=rng)
        cv2.imwrite(str(folder / f"{k}.png"), image)
    return folder


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A calibration, fresh pictures of the same camera, and of one whose focus changed."""
    root, rng = tmp_path_factory.mktemp("check"), np.random.default_rng(6)
    views = [
        noisy_view(CAMERA, pose, f"{k}", rng, NOISE_PX, board=BOARD)
        for k, pose in enumerate(best_held(CAMERA, BOARD, 14, 0.1))
    ]
    save_calibration(root / "cam.json", calibrate(views, CAMERA.size_px, model="brown", degree=5, board="flat"))
    _pictures(root / "same", CAMERA, rng)
    moved = CAMERA.parameters.copy()
    moved[:2] *= 1.0 + 0.01 * FOCUS_PERCENT
    _pictures(root / "moved", CAMERA.with_parameters(moved), rng)
    return root


def test_a_patterned_box_in_the_room_is_no_board(home: Path, capsys: pytest.CaptureFixture[str]) -> None:
    # Its fields are no squares; it stands behind the board, beside it in some pictures.
    box = PlacedBoard(Board("box", 5, 4, 30.0, 24.0), Rigid3(np.eye(3), [80.0, 60.0, 800.0]))
    pictures = _pictures(home / "tiled", CAMERA, np.random.default_rng(7), box)
    found = [detect_boards(read_image(path), [BOARD]) for path in sorted(pictures.iterdir())]
    assert any(len(own) > 1 for own in found)
    assert main(["check", str(home / "cam.json"), str(pictures), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["rms_px"] < 0.05


@pytest.mark.filterwarnings("ignore:overflow")
def test_a_board_that_looks_the_same_turned_is_counted_alike_by_two_cameras(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The second camera stands on its head."""
    board = board_of_words("circles:7x5x30")
    place = Rigid3(exp_so3(np.array([0.2, 0.3, 0.0])), [-90.0, -60.0, 400.0])
    poses = (Rigid3.identity(), Rigid3(exp_so3(np.array([0.0, 0.0, np.pi])), [60.0, 0.0, 0.0]))
    camera, optics = Pinhole((320, 240), np.array([260.0, 260.0, 160.3, 119.1])), Optics(0.6, supersample=2)
    pictures = [tmp_path / name for name in ("left.png", "right.png")]
    for path, pose in zip(pictures, poses, strict=True):
        cv2.imwrite(str(path), render([PlacedBoard(board, place)], camera, pose, optics=optics))
    cameras = [
        {"name": path.stem, "camera": camera_to_json(camera), "cam_from_rig": pose.matrix()[:3].tolist(), "rms_px": 0.1}
        for path, pose in zip(pictures, poses, strict=True)
    ]
    sure = (np.diag([0.1, 0.1, 0.1, 0.1] * 2 + [1e-4] * 3 + [0.05] * 3) ** 2).tolist()
    rig = {"schema": "rigkit.rig/1", "sigma_px": 0.05, "cameras": cameras, "covariance": sure}
    (tmp_path / "rig.json").write_text(json.dumps(rig))
    done = check_pictures(tmp_path / "rig.json", pictures, CheckOptions(boards=(board,)))
    # Counted from two ends, the mount would be off by a turn.
    assert done.check.rms_px < 0.1 and not done.left_out

    def no_pose(*_: object) -> None:
        raise DegenerateError("no pose")

    monkeypatch.setattr("rigkit.validation.monitoring.flipped.cam_from_seen_board", no_pose)
    turned = check_pictures(tmp_path / "rig.json", pictures, CheckOptions(boards=(board,))).check
    assert turned.unexplained and turned.rms_px > 10.0


def test_images_of_a_rig_that_are_exchanged_are_no_change_of_it(tmp_path: Path) -> None:
    rig, pictures = _rig_of_two(tmp_path, BOARD)
    options = CheckOptions(boards=(BOARD,))
    assert check_pictures(rig, pictures, options).check.holds
    with pytest.raises(InputError, match=r"the images of 'left' and 'right' are exchanged: .*rig's order, left, right"):
        check_pictures(rig, [pictures[k] for k in (1, 0, 3, 2)], options)
    # Of different moments: that no order puts right.
    assert check_pictures(rig, [pictures[k] for k in (0, 3)], options).check.unexplained


def test_an_image_of_the_calibration_leaves_the_other_cameras_image_of_that_moment(tmp_path: Path) -> None:
    rig, pictures = _rig_of_two(tmp_path, BOARD)
    # Of another moment: with this one the check would not hold.
    pictures[0].write_bytes(pictures[2].read_bytes() + b"again")
    made = {"made": {"images": [image_hash(path)[:SHORT_HASH] for path in (pictures[0], pictures[3])]}}
    rig.write_text(json.dumps(json.loads(rig.read_text()) | made))
    done = check_pictures(rig, pictures, CheckOptions(boards=(BOARD,)))
    assert done.check.holds and done.check.frames == 2
    assert done.left_out == ((f"{pictures[0]}", OWN_IMAGE), (f"{pictures[3]}", OWN_IMAGE))
    with pytest.raises(InputError, match="was made from these very images"):
        check_pictures(rig, [pictures[0], pictures[3]], CheckOptions(boards=(BOARD,)))
    # Matches of a scene need the images of both.
    with pytest.raises((InputError, DegenerateError)):
        check_pictures(rig, pictures, CheckOptions(boards=(BOARD,), scene=True))


def test_images_are_exchanged_where_the_other_order_holds_or_explains_more(monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(*_: object) -> CalibrationCheck:
        raise DegenerateError("no camera sees enough")

    rig = known_rig(Rigid3(np.eye(3), [-120.0, 0.0, 0.0]), [1.0] * 8, 1e-3, 100.0)
    turn = Change(
        hypothesis=next(h for h in hypotheses_of(rig) if h.kind == "rotation"),
        amounts=np.zeros(3),
        covariance=np.eye(3),
        freedom=np.inf,
        chance=0.0,
        size_px=5.0,
        max_px=5.0,
        gain=9.0,
    )
    moved = CalibrationCheck(
        chance=0.0,
        change=turn,
        monitored=rig,
        fixed=rig,
        step=np.zeros(len(rig.covariance)),
        covariance=rig.covariance,
        rms_px=0.1,
        rms_fixed_px=0.1,
        expected_px=0.1,
        frames=3,
        corners=100,
    )
    holding, odd = replace(moved, chance=1.0), replace(moved, rms_fixed_px=50.0)
    assert holding.holds and not moved.holds and not moved.unexplained and odd.unexplained
    for given, other, wrong in ((odd, odd, False), (moved, moved, False), (odd, moved, True), (moved, holding, True)):
        monkeypatch.setattr("rigkit.workflows.checks.check.check_views", lambda *_, other=other: other)
        with pytest.raises(InputError, match="'left' and 'right' are exchanged") if wrong else nullcontext():
            _require_right_order(given, [])
    monkeypatch.setattr("rigkit.workflows.checks.check.check_views", refused)
    _require_right_order(odd, [])


@pytest.mark.parametrize(
    ("whose", "flip", "words"),
    [
        (("right",), -1, "those of 'right' rotated by 180 degrees"),
        (("left",), 1, "those of 'left' mirrored left to right"),
        (("right",), 0, "those of 'left' mirrored top to bottom or those of 'right' mirrored top to bottom"),
        (("left", "right"), -1, "rotated by 180 degrees or mirrored left to right"),
    ],
)
@pytest.mark.parametrize("board", [BOARD, Board("even", 6, 4, 20.0, 20.0)], ids=["9x6", "6x4"])
def test_flipped_pictures_of_a_rig_are_named(
    board: Board, whose: tuple[str, ...], flip: int, words: str, tmp_path: Path
) -> None:
    """Also of a board that looks the same turned. The register has no moved principal point of them."""
    rig, pictures = _rig_of_two(tmp_path, board)
    register = tmp_path / "rig.jsonl"
    options = CheckOptions(boards=(board,), history=register)
    assert check_pictures(rig, pictures, options).check.holds
    for path, side in zip(pictures, ("left", "right") * 2, strict=True):
        if side in whose:
            cv2.imwrite(str(path), cv2.flip(np.asarray(read_image(path)), flip))
    if board.looks_same_turned and len(whose) == 2:
        with pytest.raises(InputError, match=f"'left' and 'right' are exchanged, or {words}: undoing that"):
            check_pictures(rig, pictures, options)
        return
    done = check_pictures(rig, pictures, options)
    assert done.check.flipped == words
    entry = json.loads(register.read_text().splitlines()[-1])
    assert entry["verdict"] == f"the images seem {words}; undoing that, it holds"
    assert entry["amounts"] == {} and not entry["holds"]


def test_squares_of_another_size_are_a_change_of_scale(tmp_path: Path) -> None:
    """Not a camera that was shifted and turned, as which derivatives at the old scale explain 0.7 % more."""
    rig, pictures = _rig_of_two(tmp_path, BOARD)
    change = check_pictures(rig, pictures, CheckOptions(boards=(Board("other", 9, 6, 20.0, 20.0),))).check.change
    assert change is not None
    assert change.hypothesis.kind == "scale"
    assert change.amounts[0] == pytest.approx(-20.0, abs=0.5)


def _rig_of_two(folder: Path, board: Board) -> tuple[Path, list[Path]]:
    """Return the file of a rig and four pictures of a board, left and right in turns, whose names do not say so."""
    poses = (Rigid3.identity(), Rigid3(exp_so3(np.array([0.0, 0.1, 0.0])), [-60.0, 0.0, 0.0]))
    camera, optics = Pinhole((320, 240), np.array([260.0, 260.0, 160.3, 119.1])), Optics(0.6, supersample=2)
    places = [Rigid3(exp_so3(np.array([0.2, tilt, 0.0])), [-70.0, -60.0, 400.0]) for tilt in (0.3, -0.3)]
    pictures = [folder / f"{name}{k}.png" for k in range(2) for name in ("one", "two")]
    for path, (place, pose) in zip(pictures, [(a, b) for a in places for b in poses], strict=True):
        cv2.imwrite(str(path), render([PlacedBoard(board, place)], camera, pose, optics=optics))
    cameras = [
        {"name": name, "camera": camera_to_json(camera), "cam_from_rig": pose.matrix()[:3].tolist(), "rms_px": 0.1}
        for name, pose in zip(("left", "right"), poses, strict=True)
    ]
    sure = (np.diag([0.1, 0.1, 0.1, 0.1] * 2 + [1e-4] * 3 + [0.05] * 3) ** 2).tolist()
    rig = folder / "rig.json"
    rig.write_text(json.dumps({"schema": "rigkit.rig/1", "sigma_px": 0.05, "cameras": cameras, "covariance": sure}))
    return rig, pictures


@pytest.mark.parametrize(("flip", "words"), [(-1, "rotated by 180 degrees"), (0, "mirrored top to bottom")])
def test_pictures_that_were_flipped_are_no_moved_principal_point(
    flip: int, words: str, home: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for path in (home / "same").iterdir():
        cv2.imwrite(str(tmp_path / path.name), cv2.flip(np.asarray(read_image(path)), flip))
    fixed = tmp_path / "fixed.json"
    assert main(["check", str(home / "cam.json"), str(tmp_path), "--fix", str(fixed)]) == 1
    printed = capsys.readouterr()
    assert f"they seem {words}; undoing that, it holds" in printed.out
    assert "The alternative explanation: the principal point of the camera moved" in printed.out
    assert "not written: the images were flipped" in printed.err and not fixed.exists()


def test_exit_codes_of_unchanged_and_changed_cameras(
    home: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    calibration, register = str(home / "cam.json"), tmp_path / "cam.jsonl"
    also = ["--register", str(register), "--temperature", "20.5"]
    page, fixed = tmp_path / "check.html", tmp_path / "fixed.json"
    assert main(["check", calibration, str(home / "same"), "--fix", str(fixed), *also]) == 0
    said_and_noted = capsys.readouterr()
    assert "Still holds" in said_and_noted.out
    assert "fixed.json not written: nothing changed" in said_and_noted.err and not fixed.exists()
    command = ["check", calibration, str(home / "moved"), "--json", "-r", str(page), "--fix", str(fixed), *also]
    assert main([*command, "--length", "200", "--distance", "600"]) == 1
    printed = json.loads(capsys.readouterr().out)
    assert printed["cause"] == "focus" and printed["units"] == ["%"] and printed["cost_unit"] == "mm"
    assert printed["amounts"] == pytest.approx([FOCUS_PERCENT], abs=0.1)
    # A length seen through a focus that is 0.5 % off is 0.5 % off.
    assert printed["cost"] == pytest.approx(0.01 * FOCUS_PERCENT * 200.0, rel=0.4)
    assert f"an error of {printed['cost']:.2g} mm rms in the length" in printed["statement"]
    assert "does not hold" in page.read_text()
    assert all(image.name in page.read_text() for image in (home / "moved").iterdir())
    assert load_camera(fixed).parameters[0] == pytest.approx(CAMERA.parameters[0] * 1.005, rel=1e-3)
    assert main(["check", str(fixed), str(home / "moved")]) == 0
    capsys.readouterr()
    assert main(["check", calibration, str(home / "moved")]) == 1
    assert re.search(r" px, [0-9.]+ mm at 1 m$", capsys.readouterr().out.splitlines()[0])
    drift = tmp_path / "drift.html"
    assert main(["history", str(register), "--add", str(fixed), "--to", calibration, "-r", str(drift)]) == 0
    lines = capsys.readouterr().out.splitlines()
    # As seen from the register's folder: several calibrations may be called alike.
    seen = os.path.relpath(calibration, tmp_path)
    assert len([line for line in lines if f"check of {seen}" in line]) == 2 and "fixed.json" in lines[-1]
    assert "20.5" in drift.read_text() and "focus, %" in drift.read_text()


@pytest.mark.parametrize(
    ("command", "words"),
    [
        (["{cam}", "{same}", "--scene"], "--scene needs a rig"),
        (["{cam}", "{same}", "--length", "3"], "belong together"),
        (["{cam}", "{home}/nothing.png"], "does not exist"),
        (["{cam}", "{cam}"], "rigkit: check: image '"),
        (["{cam}", "{same}", "--board", "8x5x25"], "9 x 6 inner corners are seen in 3 of 3 images, 8 x 5 are declared"),
        (
            ["{cam}", "{same}", "--board", "aprilgrid:5x4x25,spacing=0.3"],
            "no board was found in any of 3 images; in 3 images a chessboard of 9 x 6 inner corners is seen",
        ),
        (["{cam}", "{same}", "--fix", "{cam}", "--force"], "cam.json"),
        # The calibration's own board, whole, in the only image: its pictures once held with a row more.
        (["{cam}", "{one}", "--board", "9x7x25"], "9 x 6 inner corners are seen in 1 of 1 images, 9 x 7 are declared"),
    ],
)
def test_unusable_inputs_are_refused(
    command: list[str], words: str, home: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    one = sorted((home / "same").iterdir())[0]
    names = {"cam": str(home / "cam.json"), "same": str(home / "same"), "home": str(home), "one": str(one)}
    assert main(["check", *(part.format(**names) for part in command)]) == 2
    assert words in capsys.readouterr().err


def test_a_calibration_without_covariance_is_refused(
    home: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    there = str(tmp_path / "camchain.yaml")
    assert main(["export", str(home / "cam.json"), "-o", there, "--to", "kalibr"]) == 0
    for command in (["check", there, str(home / "same")], ["plan", there], ["certify", there, *LENGTH]):
        assert main(command) == 2
        assert "has no covariance" in capsys.readouterr().err


def test_errors_in_earlier_pictures_are_no_change(
    home: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A file whose focal length is off by a hundredth; pictures of before, some more, and some after a knock."""
    wrong, register, fixed = tmp_path / "wrong.json", tmp_path / "cam.jsonl", tmp_path / "fixed.json"
    reported = json.loads((home / "cam.json").read_text())
    reported["camera"]["parameters"] |= {name: 1.01 * reported["camera"]["parameters"][name] for name in ("fx", "fy")}
    wrong.write_text(json.dumps(reported))
    again = _pictures(tmp_path / "again", CAMERA, np.random.default_rng(8))
    since = ["--before", str(home / "same"), "--register", str(register)]
    assert main(["check", str(wrong), str(again), *since]) == 0
    printed = capsys.readouterr().out
    assert "Nothing changed since" in printed and "Reference: 3 earlier frames" in printed
    assert main(["check", str(wrong), str(home / "moved"), *since, "--fix", str(fixed), "--json"]) == 1
    done = json.loads(capsys.readouterr().out)
    assert done["cause"] == "focus" and done["baseline"]["frames"] == 3
    assert done["amounts"] == pytest.approx([FOCUS_PERCENT], abs=4.0 * done["sigmas"][0])
    # The change alone is put into the file, not what was wrong.
    longer = load_camera(fixed).parameters[0] / load_camera(wrong).parameters[0] - 1.0
    assert 100.0 * longer == pytest.approx(FOCUS_PERCENT, abs=0.1)
    entries = load_history(register)
    assert [bool(entry.baseline) for entry in entries] == [True, True]
    assert [len(edition.entries) for edition in editions(entries)] == [2]
    assert main(["check", str(wrong), str(again), "--before", str(again)]) == 2
    assert "given both as a new image and with --before" in capsys.readouterr().err


def test_enough_power_asks_for_no_more_pictures() -> None:
    sure = Power(
        kind="focal length", camera="left", size=0.1, unit="px", chance=0.97, found_from=0.08, frames=3, both=None
    )
    assert _power_words(sure).endswith("on).") and "images like these" not in _power_words(sure)


def test_a_pose_on_another_board_names_the_one_that_is_seen(home: Path, capsys: pytest.CaptureFixture[str]) -> None:
    one = str(sorted((home / "same").iterdir())[0])
    assert main(["pose", one, "--camera", str(home / "cam.json"), "--board", "8x5x25"]) == 1
    assert "does not show board 'board-8x5x25'; in 1 image 9 x 6 inner corners are seen" in capsys.readouterr().err


def test_a_board_is_known_by_whatever_name_and_way_up(caplog: pytest.LogCaptureFixture) -> None:
    known = [
        Board("ours", 9, 6, 29.99, 30.01),
        Board("copy", 9, 6, 30.0, 30.0),
        board_of_words(f"charuco:5x7x30,{MARKS}"),
    ]
    for words, expected in (("9x6x30", "ours"), ("6x9x30", "ours"), (f"charuco:5x7x30,{MARKS}", known[2].board_id)):
        (board,) = _replaced_by_known([board_of_words(words)], known)
        assert board.board_id == expected
    # By its own name first; each but once.
    assert [b.board_id for b in _replaced_by_known([Board("copy", 9, 6, 30.0, 30.0)], known)] == ["copy"]
    assert [b.board_id for b in _replaced_by_known([board_of_words("9x6x30"), board_of_words("6x9x30")], known)] == [
        "ours",
        "copy",
    ]
    assert not caplog.records
    for words in ("9x6x31", "8x6x30", f"charuco:7x5x30,{MARKS}", "circles:9x6x30"):
        (board,) = _replaced_by_known([board_of_words(words)], known)
        assert board.board_id == board_of_words(words).board_id
        assert f"board '{board.board_id}' is not one of the calibration" in caplog.text


@pytest.mark.parametrize("made", [None, {"inputs": None}, ["2 images"]])
def test_a_provenance_written_by_hand_does_not_end_the_check(home: Path, tmp_path: Path, made: object) -> None:
    stored = json.loads((home / "cam.json").read_text(encoding="utf-8")) | {"made": made}
    (tmp_path / "cam.json").write_text(json.dumps(stored), encoding="utf-8")
    assert main(["check", str(tmp_path / "cam.json"), str(home / "same" / "0.png")]) == 0
