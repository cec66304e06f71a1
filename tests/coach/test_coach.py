"""The coach: which frames it takes and keeps, resuming a capture, and requests that its server refuses."""

from __future__ import annotations

import json
import os
import re
import threading
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.coach_scenes import BOARD, CAMERA, SIZE, ask, options, picture
from helpers.monitoring_scenes import best_held

from rigkit.calibration.certainty.displaced import uncertain_camera
from rigkit.cameras.compare import compare_cameras
from rigkit.coach.coach import Coach, Take
from rigkit.coach.guide import MIN_GAIN, MIN_GAIN_OF_PHOTO, CaptureGuide, GuideOptions
from rigkit.coach.look import FrameObservation, observe_frame
from rigkit.coach.server import LOCAL, MAX_UPLOAD_BYTES
from rigkit.coach.sources import Frame, device_frames, frames_of_folders
from rigkit.core.boards import Board
from rigkit.core.detections import BoardView
from rigkit.core.errors import InputError
from rigkit.geometry.rigid3 import Rigid3
from rigkit.io.calibrations.calibration_file import load_calibration
from rigkit.planning.goal import projection_goal
from rigkit.workflows.capture.coach import coach_frames, coach_recording, open_coach, run_coach
from rigkit.workflows.options.coach import CoachOptions

FRAMES = 9


@pytest.fixture(scope="module")
def poses() -> list[Rigid3]:
    return best_held(CAMERA, BOARD, FRAMES, 0.1)


@pytest.fixture(scope="module")
def pictures(poses: list[Rigid3]) -> list[np.ndarray]:
    rng = np.random.default_rng(1)
    return [picture(pose, rng) for pose in poses]


def test_a_frame_is_taken_when_it_is_still_sharp_and_helps(pictures: list[np.ndarray], poses: list[Rigid3]) -> None:
    guide = CaptureGuide(GuideOptions(boards=(BOARD,), hfov_deg=52.0))
    first = observe_frame(pictures[0], [BOARD], "a")
    assert first.view is not None and not guide.advise(first).take, "nobody knows yet whether it is still"
    again = observe_frame(pictures[0], [BOARD], "b", first)
    assert again.still and again.sharp and guide.advise(again).take
    guide.add(again.view, again.size_px)  # type: ignore[arg-type]
    assert guide.advise(again).frame_gain == 0.0, "the same once more counts as one"
    blurred = observe_frame(picture(poses[1], np.random.default_rng(2), blur_px=4.0), [BOARD], "c").as_photo()
    assert blurred.view is None or (not blurred.sharp and not guide.advise(blurred).take)
    empty = observe_frame(np.full((480, 640, 3), 90, np.uint8), [BOARD], "d")
    advice = guide.advise(empty)
    assert not advice.take and advice.words.startswith("Hold the board: ")
    assert np.isfinite(advice.target_px).all()


def test_a_photo_that_is_there_needs_to_bring_less_than_a_frame_that_may_be_waited_for(poses: list[Rigid3]) -> None:
    coarse = Board("board", 4, 3, 25.0, 25.0)
    guide = CaptureGuide(GuideOptions(boards=(coarse,), hfov_deg=52.0))
    away = Rigid3(poses[0].rotation, 3.0 * poses[0].translation_mm)
    pixels, _ = CAMERA.project(away.apply(coarse.points()))
    far = FrameObservation(
        size_px=SIZE, view=BoardView("far", coarse, coarse.grid(), pixels, np.full(len(pixels), 0.1)), contrast=100.0
    )
    photo = far.as_photo()
    assert MIN_GAIN_OF_PHOTO < guide.advise(photo).frame_gain < MIN_GAIN
    assert not guide.advise(photo).take and guide.advise(photo, photo=True).take


def test_frames_are_offered_until_there_are_enough() -> None:
    class Satisfied:
        finished = None
        offered = 0

        def look(self, images: list[np.ndarray], **how: object) -> dict[str, bool]:
            self.offered += 1
            return {"enough": self.offered == 2}

    coach = Satisfied()
    coach_frames(coach, iter([Frame([])] * 5), photos=True)  # type: ignore[arg-type]
    assert coach.offered == 2


def test_a_watched_folder_makes_a_session_that_matches_the_truth(pictures: list[np.ndarray], tmp_path: Path) -> None:
    monitored = tmp_path / "incoming"
    monitored.mkdir()
    for k, image in enumerate(pictures):
        cv2.imwrite(str(monitored / f"{k:02d}.png"), image)
    (monitored / "notes.png").write_text("no picture")
    reported: list[str] = []
    coach = open_coach(options(tmp_path / "session"), reported.append)
    # The first picture once more, and the first place once more: whoever took it is told that it brought nothing.
    cv2.imwrite(str(monitored / "001.png"), pictures[0])
    cv2.imwrite(str(monitored / "002.png"), pictures[0] ^ 1)
    printed, counts = [], []

    def show(images: object) -> None:
        printed.append(coach.state().get("words"))
        counts.append(len(reported))

    coach_frames(coach, frames_of_folders([monitored], until_idle_s=0.5), photos=True, show=show)
    # The picture before the page is the one whose corners are drawn on it.
    assert counts[0] == 1
    assert any(str(words).startswith("Not taken, as it is frame-0001.png already. ") for words in printed)
    assert any(
        str(words).startswith("Not taken, as it adds little: 0 % of what the place asked for would. ")
        for words in printed
    )
    assert len(coach.guide.frames) >= 7
    kept = sorted((tmp_path / "session/images").glob("*.png"))
    assert len(kept) == len(coach.guide.frames)
    first = np.asarray(cv2.imread(str(kept[0])))
    assert any(np.array_equal(first, image) for image in pictures), "kept without loss"
    (lens,) = coach.guide.lenses
    said_px = lens.advise(FrameObservation(size_px=SIZE, view=None)).remaining[0].error
    assert said_px is not None and re.match(r"Done: \w+, error [0-9.]+ px \(", coach.finish())
    assert "00.png: taken as frame-0001.png" in reported and any(
        line.startswith("002.png: not taken, as it adds little: 0 % of") for line in reported
    )
    assert len([line for line in reported if ": taken as " in line]) == len(kept) and reported[-1] == coach.finished
    found = load_calibration(tmp_path / "session/calibration.json")
    error = compare_cameras(CAMERA, found.camera).rms_px
    known = uncertain_camera(found)
    stated = float(projection_goal(known.camera).error(known.covariance))
    assert stated == pytest.approx(said_px, rel=0.1), "what it said is what `calibrate` states"
    assert error < max(4.0 * stated, 0.15)


def test_a_recording_is_gone_through_whole_and_what_it_lacks_is_said(
    pictures: list[np.ndarray], tmp_path: Path
) -> None:
    film, held = tmp_path / "film.avi", pictures[:5]
    writer = cv2.VideoWriter(str(film), cv2.VideoWriter.fourcc(*"FFV1"), 10.0, SIZE)
    blurred = [cv2.GaussianBlur(image, (0, 0), 2.5) for image in held]
    # The board comes blurred into every pose, is held, and the recording begins with nothing.
    for image in [np.full_like(held[0], 90), *(x for pair in zip(blurred, held, strict=True) for x in pair)]:
        writer.write(image)
    writer.release()
    coach = open_coach(options(tmp_path / "session", video=(film,)))
    shown: list[object] = []
    reported: list[tuple[int, int]] = []
    lacks = coach_recording(
        coach, [film], show=shown.append, progress=lambda what, done, total: reported.append((done, total))
    )
    assert (reported[0], reported[-1]) == ((0, 11), (11, 11))
    kept = [np.asarray(cv2.imread(str(path))) for path in sorted((tmp_path / "session/images").glob("*.png"))]
    assert 4 <= len(kept) == len(shown) == len(coach.guide.frames)
    # Grey as the recording is decoded: of every pose the sharp picture.
    assert all(min(np.abs(k.astype(int) - p).max() for p in held) <= 2 for k in kept)
    assert lacks.startswith(". What it lacks: hold the board: ") and "two more pictures would bring" in lacks


def _with_a_part(image: np.ndarray, columns: range) -> np.ndarray:
    """Return the picture with something before the board from the first of the columns on that leaves a part of it of
    which nothing tells which it is."""
    for column in columns:
        covered = image.copy()
        covered[:, column:] = 120
        view = observe_frame(covered, [BOARD], "tried").view
        if view is not None and view.board.board_id != BOARD.board_id:
            return covered
    pytest.fail("no part is seen")


def test_parts_of_the_board_in_several_frames_are_different_parts(pictures: list[np.ndarray], tmp_path: Path) -> None:
    coach: Coach = open_coach(options(tmp_path))
    narrow, wide = (_with_a_part(pictures[0], columns) for columns in (range(200, 640, 20), range(640, 200, -20)))
    for image in (narrow, wide, *pictures[1:6]):
        coach.look([image], take=Take.YES)
    lens = coach.guide.lenses[0]
    assert len({view.board.size for view in lens.views}) == 3 and len(lens.views) == 7
    assert lens.calibration is not None and len(lens.calibration.views) >= 6


def test_what_is_shown_can_be_taken_once_and_undone(pictures: list[np.ndarray], tmp_path: Path) -> None:
    coach = open_coach(options(tmp_path))
    with pytest.raises(InputError, match="no frame to undo"):
        coach.undo()
    with pytest.raises(InputError, match="no new picture"):
        coach.take_shown()
    coach.look([pictures[0]])
    assert coach.take_shown()["taken"] == "frame-0001.png"
    with pytest.raises(InputError, match="no new picture"):
        coach.take_shown()
    # An image that shows no board, as a person may leave one there, is none of the coach's frames.
    cv2.imwrite(str(tmp_path / "images/frame-0009.png"), np.full((480, 640), 90, np.uint8))
    again = open_coach(options(tmp_path))
    assert again.undo()["frames"] == 0
    assert (tmp_path / "images/frame-0001.png.dropped").exists() and again.keeper.frames == ["frame-0009.png"]


def test_a_picture_that_was_copied_slowly_is_read_once_it_is_whole(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rigkit.coach.sources.POLL_S", 0.05)
    whole = cv2.imencode(".png", np.full((40, 50), 90, np.uint8))[1].tobytes()
    place = tmp_path / "1.png"
    place.write_bytes(whole[:-20])
    os.utime(place, (0.0, 0.0))
    frames = frames_of_folders([tmp_path], until_idle_s=0.8)

    def copy_on() -> None:
        """The copy rested for so long that it looked whole."""
        place.write_bytes(whole)

    later = threading.Timer(0.2, copy_on)
    later.start()
    assert [frame.source for frame in frames] == ["1.png"]
    later.join()
    assert caplog.text.count("left out: ") == 1 and "1.png" in caplog.text


def test_what_gives_no_frames_is_refused_at_once(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="not a folder"):
        frames_of_folders([tmp_path / "none"])
    with pytest.raises(InputError, match="camera 97 gives no image"):
        device_frames([97])
    with pytest.raises(InputError, match="does not exist"):
        run_coach(options(tmp_path / "session", video=(tmp_path / "none.mp4",)), print)
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="is a file, not a folder"):
        open_coach(options(tmp_path / "file"))


def test_killed_and_started_again_nothing_is_lost(pictures: list[np.ndarray], tmp_path: Path) -> None:
    coach = open_coach(options(tmp_path))
    for image in pictures[:5]:
        coach.look([image], take=Take.YES)
    # Nothing was said to it: it is simply gone.
    again = open_coach(options(tmp_path))
    assert len(again.guide.frames) == 5
    (lens,) = again.guide.lenses
    assert lens.calibration is not None
    drawn = lens.sigma_map()
    assert drawn is not None and lens.sigma_map() is drawn, "nothing new was seen"
    again.look([pictures[5]], take=Take.YES)
    assert again.keeper.frames[-1] == "frame-0006.png"
    again.undo()
    assert len(again.guide.frames) == len(again.keeper.frames) == 5
    # The next frame has its name, and set aside, too, takes nothing from it.
    again.look([pictures[4]], take=Take.YES)
    again.undo()
    aside = [tmp_path / f"images/frame-0006.png.dropped{more}" for more in ("", "-2")]
    assert len({path.read_bytes() for path in aside}) == 2
    with pytest.raises(InputError, match="is a session of other boards or cameras"):
        open_coach(CoachOptions(folder=tmp_path, boards=("8x5x20",), guide=options(tmp_path).guide))


@pytest.fixture
def served(tmp_path: Path, serve: Callable[[Coach, tuple[str, ...]], int]) -> tuple[Coach, int]:
    coach = open_coach(options(tmp_path))
    return coach, serve(coach, LOCAL)


def test_the_server_answers_its_own_page_alone(served: tuple[Coach, int], pictures: list[np.ndarray]) -> None:
    coach, port = served
    png = cv2.imencode(".png", pictures[0])[1].tobytes()
    status, page = ask(port, "GET", "/secret/")
    assert status == 200 and b"getUserMedia" in page and b"http" not in page.replace(b"http-equiv", b"")
    status, printed = ask(port, "POST", "/secret/look", png)
    assert status == 200 and len(json.loads(printed)["cameras"][0]["corners"]) == 54
    assert coach.keeper.frames == []
    assert ask(port, "POST", "/secret/take", png)[0] == 200
    assert len(coach.keeper.frames) == 1
    for method, path, body, headers, wanted in (
        ("GET", "/", b"", {}, 404),
        ("GET", "/wrong/", b"", {}, 404),
        ("POST", "/wrong/take", png, {}, 404),
        ("POST", "/secre%74x/take", png, {}, 404),
        ("POST", "/secret/take", png, {"Origin": "http://evil.example"}, 403),
        ("POST", "/secret/take", png, {"Origin": ""}, 403),
        ("POST", "/secret/take", png, {"Origin": "null"}, 403),
        ("GET", "/secret/", b"", {"Host": f"127.0.0.1@evil.example:{port}"}, 403),
        ("GET", "/secret/", b"", {"Host": "["}, 400),
        ("PUT", "/secret/take", png, {}, 405),
        ("GET", "/secret/", b"", {"Host": "evil.example"}, 403),
        ("GET", "/secret/../../etc/passwd", b"", {}, 404),
        ("GET", "/secret/%2e%2e%2f%2e%2e%2fetc%2fpasswd", b"", {}, 404),
        ("POST", "/secret/..%2fimages%2fx.png", png, {}, 404),
        ("POST", "/secret/delete", b"", {}, 404),
        ("GET", "/secret/frame0.jpg", b"", {}, 404),
        ("POST", f"/secret/take?sizes={len(png)},9", png, {}, 400),
        ("POST", f"/secret/take?sizes={len(png)},-9,9", png, {}, 400),
        ("POST", "/secret/take?sizes=x", png, {}, 400),
        ("POST", f"/secret/take?sizes={len(png)},{len(png)}", png + png, {}, 400),
        ("POST", "/secret/take", b"no picture", {}, 400),
        # A kilobyte that announces a gigabyte.
        ("POST", "/secret/take", png[:16] + (60_000).to_bytes(4, "big") * 2 + png[24:900], {}, 400),
        ("POST", "/secret/take", b"", {"Content-Length": str(MAX_UPLOAD_BYTES + 1)}, 413),
        ("POST", "/secret/take", b"", {"Transfer-Encoding": "chunked", "chunks": "too many"}, 413),
    ):
        assert ask(port, method, path, body, **headers)[0] == wanted, (method, path, headers)
    assert len(coach.keeper.frames) == 1


def test_without_the_extra_one_line_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    import sys

    from rigkit.cli.main import main

    monkeypatch.setitem(sys.modules, "starlette.applications", None)
    assert main(["coach", str(tmp_path), "--board", "9x6x25"]) == 2
    assert "pip install" in capsys.readouterr().err
