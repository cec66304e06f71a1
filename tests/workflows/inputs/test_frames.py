"""Frames are chosen from videos: sharp, different, and of one moment for several cameras."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from rigkit.cameras.pinhole import Pinhole
from rigkit.cli.main import main
from rigkit.core.arrays import FloatArray
from rigkit.core.boards import Board
from rigkit.core.errors import InputError
from rigkit.core.patterns.charuco import Charuco
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3
from rigkit.io.disk.writing import write_atomic
from rigkit.io.media.images import read_image
from rigkit.synthetic.photometry import Photometry, develop
from rigkit.synthetic.render import Optics, radiance
from rigkit.synthetic.scene import PlacedBoard
from rigkit.workflows.calibration.calibrate_any import calibrate_folders
from rigkit.workflows.detect import detect_in_images
from rigkit.workflows.inputs import frames
from rigkit.workflows.inputs.folder_session import boards_seen
from rigkit.workflows.inputs.frame_choice import DIRECTIONS, FrameChoice, KeptFrame
from rigkit.workflows.inputs.frames import SEARCHING, frames_of_videos, moments_of_videos
from rigkit.workflows.inputs.identify_board import identify_board
from rigkit.workflows.options.cameras import CalibrateOptions, FolderOptions

BOARD = Board("b", 7, 5, 20.0, 20.0)
CAMERA = Pinhole((320, 240), np.array([300.0, 300.0, 159.5, 119.5]))


MARKED = Board("c", 5, 4, 26.0, 26.0, pattern=Charuco("DICT_4X4_50", 19.5))


def picture(
    turn: tuple[float, float, float], right_mm: float, *, blur_px: float = 0.7, board: Board = BOARD
) -> np.ndarray:
    rotation = exp_so3(np.array(turn))
    placed = PlacedBoard(
        board, Rigid3(rotation, np.array([right_mm, 0.0, 300.0]) - rotation @ np.array([60.0, 40.0, 0.0]))
    )
    light = radiance((placed,), CAMERA, Rigid3.identity(), optics=Optics(blur_px, supersample=2))
    return np.asarray(develop(light, Photometry(noise_levels=1.0), np.random.default_rng(0)))


def video(path: Path, frames: Iterable[np.ndarray]) -> Path:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"FFV1"), 10, CAMERA.size_px)
    for frame in frames:
        writer.write(cv2.cvtColor(frame, cv2.COLOR_GRAY2BGR))
    writer.release()
    return path


def test_each_view_is_kept_once_and_sharp(tmp_path: Path) -> None:
    """Four poses, each held for three frames of which one is sharp, and frames without a board."""
    poses = (((0.0, 0.0, 0.0), 0.0), ((0.4, 0.0, 0.1), 20.0), ((0.0, 0.5, 0.0), -20.0), ((-0.4, 0.3, 0.3), 0.0))
    empty = np.full((240, 320), 90, np.uint8)
    frames = [empty]
    for k, pose in enumerate(poses):
        frames += [picture(*pose, blur_px=0.7 if shot == k % 3 else 2.5) for shot in range(3)]
    done = frames_of_videos({"": video(tmp_path / "a.avi", frames)}, tmp_path / "out", [BOARD])
    assert [path.stem for path in done[""]] == ["000001", "000005", "000009", "000010"]
    kept = read_image(done[""][1])
    assert np.array_equal(kept, cv2.cvtColor(cv2.cvtColor(frames[5], cv2.COLOR_GRAY2BGR), cv2.COLOR_BGR2GRAY))
    # Nothing else is left behind, and the second time nothing is decoded.
    assert sorted(p.name for p in (tmp_path / "out").iterdir())[:-1] == [p.name for p in done[""]]
    stamp = (tmp_path / "out" / "frames.json").stat().st_mtime_ns
    again = frames_of_videos({"": tmp_path / "a.avi"}, tmp_path / "out", [BOARD])
    assert again == done
    assert (tmp_path / "out" / "frames.json").stat().st_mtime_ns == stamp
    with pytest.raises(InputError, match="no board in 2 frames"):
        frames_of_videos({"": video(tmp_path / "b.avi", [empty, empty])}, tmp_path / "other")


def test_videos_of_two_cameras_give_frames_of_one_moment(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    shots = [picture((0.1 * k, 0.1, 0.0), 12.0 * k - 20.0) for k in range(4)]
    one = video(tmp_path / "cam_0.avi", shots)
    two = video(tmp_path / "cam_1.avi", [np.full((240, 320), 90, np.uint8), *shots[:2]])
    stamps = tmp_path / "timestamps.csv"
    rows = [(10 + k, 0, 5 + k) for k in range(4)] + [(11 + k, 1, 8 + k) for k in range(3)]
    stamps.write_text("sync_index,cam_id,frame_index\n" + "".join(f"{a},{b},{c}\n" for a, b, c in rows))
    done = frames_of_videos({"cam_0": one, "cam_1": two}, tmp_path / "frames", [BOARD], timestamps=stamps)
    assert [p.stem for p in done["cam_0"]] == ["000010", "000011", "000012", "000013"]
    assert [p.stem for p in done["cam_1"]] == ["000012", "000013"]
    # Without the table frames are counted, which videos of other lengths speak against.
    assert "differ" not in caplog.text
    frames_of_videos({"cam_0": one, "cam_1": two}, tmp_path / "counted", [BOARD])
    assert "the videos differ in frames, 4 of 'cam_0', 3 of 'cam_1'" in caplog.text
    assert "per second" not in caplog.text


def test_detect_and_identify_take_a_folder_with_a_video(tmp_path: Path) -> None:
    video(tmp_path / "clip.avi", [picture((0.2 * k, 0.0, 0.0), 0.0) for k in range(3)])
    done = detect_in_images([tmp_path])
    assert [len(found) for found in done.found.values()] == [1, 1, 1]
    assert main(["board", "identify", str(tmp_path)]) == 0
    assert all(Path(name).parent == tmp_path / "clip-frames" for name in done.found)


def frame(number: int, view: FloatArray, sigma_px: float) -> KeptFrame:
    return KeptFrame(number, {"": view}, sigma_px)


def test_a_long_video_keeps_few_frames_that_are_spread() -> None:
    """A thousand places along a line: never more than twice as many kept as wanted, at the end well spread."""
    choice = FrameChoice(10)
    places = np.random.default_rng(3).permutation(1000) / 1000.0
    for number, place in enumerate(places.tolist()):
        choice.offer(frame(number, 0.1 + place * DIRECTIONS[:, 0], 0.1))
        assert len(choice.kept) <= 20
    choice.finish()
    kept = np.sort([places[k] for k in choice.kept])
    assert len(kept) == 10
    assert np.diff(kept).min() > 0.04
    assert np.diff(kept).max() < 0.25


def test_blurred_frames_are_left_out() -> None:
    choice = FrameChoice(10)
    for number in range(6):
        choice.offer(frame(number, 1.0 + 0.1 * number * DIRECTIONS[:, 0], 0.5 if number == 3 else 0.05))
    choice.finish()
    assert sorted(choice.kept) == [0, 1, 2, 4, 5]


def test_a_folder_of_videos_is_a_camera_each(tmp_path: Path) -> None:
    for name in ("left", "right"):
        video(tmp_path / f"{name}.avi", [np.full((240, 320), 90, np.uint8)] * 2)
    (tmp_path / "notes.txt").write_text("of two cameras")
    said: list[tuple[str, int, int]] = []
    with pytest.raises(InputError, match=r"left\.avi', '.*right\.avi': no board in 2 frames"):
        calibrate_folders(
            [tmp_path], FolderOptions(boards=("7x5x20",)), CalibrateOptions(), progress=lambda *step: said.append(step)
        )
    assert [step for step in said if step[0] == SEARCHING] == [(SEARCHING, k, 2) for k in range(3)]
    # Where only one camera sees the board it is the other that is named.
    video(tmp_path / "left.avi", [picture((0.3 * k, 0.0, 0.0), 0.0) for k in range(2)])
    with pytest.raises(InputError, match=r"^'[^']*right\.avi': no board in 2 frames"):
        calibrate_folders([tmp_path], FolderOptions(boards=("7x5x20",)), CalibrateOptions())
    assert not (tmp_path / "frames").exists()


def test_results_in_one_folder_have_frames_of_their_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Frames chosen for another board would replace those that the session of the first result names."""
    folders = []

    def kept(sources: object, folder: Path, *_: object, **__: object) -> None:
        folders.append(folder)
        raise InputError("enough")

    monkeypatch.setattr("rigkit.workflows.calibration.calibrate_any.frames_of_videos", kept)
    path = video(tmp_path / "a.avi", [np.full((240, 320), 90, np.uint8)])
    for name in ("one", "two"):
        with pytest.raises(InputError, match="enough"):
            calibrate_folders(
                [path], FolderOptions(boards=("7x5x20",)), CalibrateOptions(output=tmp_path / "out" / f"{name}.json")
            )
    assert folders == [tmp_path / "out" / f"{name}-session-frames" for name in ("one", "two")]


def test_moments_of_videos_are_chosen_by_number(tmp_path: Path) -> None:
    path = video(tmp_path / "a.avi", [np.full((240, 320), 60 * k, np.uint8) for k in range(4)])
    found = [int(pictures[""].mean()) for _, pictures in moments_of_videos({"": path}, (1, 3))]
    assert np.abs(np.array(found) - [60, 180]).max() <= 2


def test_a_video_tells_its_board_and_why_another_is_not_seen(tmp_path: Path) -> None:
    """Its first frames are empty."""
    shown = [picture((0.1 * k, 0.2, 0.0), 5.0 * k, board=MARKED) for k in range(3)]
    path = video(tmp_path / "a.avi", [np.full((240, 320), 90, np.uint8)] * 3 + shown)
    found = identify_board([path])
    assert isinstance(found.board.pattern, Charuco)
    assert (found.board.size, found.board.pattern.inverted) == ((5, 4), False)
    assert (len(found.seen), len(found.looked_at)) == (3, 6)
    other = replace(MARKED, pattern=Charuco("DICT_4X4_50", 19.5, inverted=True))
    with pytest.raises(InputError, match=r"no board in 6 frames; 5 x 4 inner corners seen .*: set inverted = false"):
        frames_of_videos({"": path}, tmp_path / "out", [other])


def test_the_board_of_a_video_is_identified(tmp_path: Path) -> None:
    path = video(tmp_path / "a.avi", [picture((0.2 * k - 0.4, 0.3 * k - 0.5, 0.0), 5.0 * k) for k in range(5)])
    assert boards_seen([path], 12.5) == (f"{BOARD.columns}x{BOARD.rows}x12.5",)
    with pytest.raises(InputError, match="the square size is missing"):
        calibrate_folders([path], FolderOptions(), CalibrateOptions())


def test_a_view_that_is_there_already_is_kept_only_if_it_is_sharper() -> None:
    choice, place = FrameChoice(10), {"": np.arange(8.0)}
    for number, sigma_px in ((3, 0.05), (7, 0.2), (9, 0.01)):
        choice.offer(KeptFrame(number, place, sigma_px))
        assert list(choice.kept) == [9 if number == 9 else 3]


def test_frames_of_an_earlier_choice_are_removed(tmp_path: Path) -> None:
    """As after the board was corrected: all images of the folder are those of the camera."""
    shots = [picture((0.0, 0.3 * k, 0.0), 0.0) for k in range(2)]
    first = frames_of_videos({"": video(tmp_path / "a.avi", shots)}, tmp_path / "out", [BOARD])
    again = frames_of_videos({"": video(tmp_path / "a.avi", shots[:1])}, tmp_path / "out", [BOARD])
    assert len(first[""]) == 2 and again[""] == first[""][:1]
    assert sorted((tmp_path / "out").glob("*.png")) == list(again[""])


def test_frames_stay_where_another_board_is_in_no_frame(tmp_path: Path) -> None:
    """A board declared in error leaves the images of an earlier calibration, and no folder where there was none."""
    path = video(tmp_path / "a.avi", [picture((0.0, 0.3 * k, 0.0), 0.0, board=MARKED) for k in range(2)])
    kept = frames_of_videos({"": path}, tmp_path / "out", [MARKED])
    other = replace(MARKED, pattern=Charuco("DICT_4X4_50", 19.5, inverted=True))
    for folder in ("out", "new"):
        with pytest.raises(InputError, match="no board in 2 frames"):
            frames_of_videos({"": path}, tmp_path / folder, [other])
    assert all(path.is_file() for path in kept[""])
    assert not (tmp_path / "new").exists()


def test_frames_of_an_interrupted_choice_are_not_taken_for_those_of_an_earlier_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shots = [picture((0.0, 0.3 * k, 0.0), 0.0) for k in range(2)]
    paths = [video(tmp_path / name, own) for name, own in (("a.avi", shots), ("b.avi", shots[::-1]))]
    first = [read_image(path) for path in frames_of_videos({"": paths[0]}, tmp_path / "out", [BOARD])[""]]

    def written(path: Path, data: str | bytes, *, force: bool) -> None:
        if path.suffix == ".json" and "b.avi" in str(data):
            raise KeyboardInterrupt
        write_atomic(path, data, force=force)

    with monkeypatch.context() as patched, pytest.raises(KeyboardInterrupt):
        patched.setattr(frames, "write_atomic", written)
        frames_of_videos({"": paths[1]}, tmp_path / "out", [BOARD])
    again = [read_image(path) for path in frames_of_videos({"": paths[0]}, tmp_path / "out", [BOARD])[""]]
    assert np.array_equal(again, first)


def test_nothing_is_left_of_frames_that_do_not_fit_on_the_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shots = [picture((0.0, 0.3 * k, 0.0), 0.0) for k in range(2)]
    for sources in ({"": "a"}, {"left": "a", "right": "a"}):
        videos = {name: video(tmp_path / f"{source}.avi", shots) for name, source in sources.items()}
        count = 0

        def full(path: Path, data: bytes, *, force: bool) -> None:
            nonlocal count
            count += path.suffix == ".png"
            if count == 2:
                raise InputError("no space")
            write_atomic(path, data, force=force)

        with monkeypatch.context() as patched, pytest.raises(InputError, match="no space"):
            patched.setattr(frames, "write_atomic", full)
            frames_of_videos(videos, tmp_path / "out", [BOARD])
        assert count == 2 and {path.name for path in tmp_path.iterdir()} == {"a.avi"}
