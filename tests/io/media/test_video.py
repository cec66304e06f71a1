"""Videos are read frame by frame; recorders' timestamps say which frames are of one moment."""

from __future__ import annotations

import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from rigkit.core.errors import InputError
from rigkit.io.media.images import read_image
from rigkit.io.media.video import Video, is_video, read_timestamps, videos_inside


def video(path: Path, levels: list[int]) -> Path:
    """Write a video, without loss, of even frames."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"FFV1"), 10, (64, 48))
    assert writer.isOpened()
    for level in levels:
        writer.write(np.full((48, 64, 3), level, np.uint8))
    writer.release()
    return path


def test_frames_come_by_number(tmp_path: Path) -> None:
    with Video(video(tmp_path / "a.avi", [10, 60, 110, 160])) as source:
        assert source.count == 4
        for number, level in ((0, 10), (2, 110), (3, 160)):
            frame = source.frame(number)
            assert frame is not None
            assert frame.shape == (48, 64)
            assert abs(int(frame[20, 20]) - level) <= 1
        assert source.frame(4) is None
        with pytest.raises(InputError, match="rising order"):
            source.frame(1)


def test_a_sequence_of_files_is_a_video(tmp_path: Path) -> None:
    for k in range(3):
        cv2.imwrite(str(tmp_path / f"shot_{k:03d}.png"), np.full((48, 64), 50 * k + 10, np.uint8))
    assert is_video(tmp_path / "shot_%03d.png")
    with Video(tmp_path / "shot_%03d.png") as source:
        frames = [source.frame(k) for k in range(3)]
        assert [int(frame[0, 0]) for frame in frames if frame is not None] == [10, 60, 110]


def test_sources_that_are_no_videos_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("OPENCV_FFMPEG_LOGLEVEL", raising=False)
    assert is_video("camera:0")
    assert not is_video(tmp_path / "a.png")
    with pytest.raises(InputError, match="does not exist"):
        Video(tmp_path / "none.mp4")
    (tmp_path / "bad.mp4").write_bytes(b"no video at all")
    with pytest.raises(InputError, match="cannot be decoded"):
        Video(tmp_path / "bad.mp4")
    # FFmpeg reads it when the first video of a process is opened: -8 is silent.
    assert os.environ["OPENCV_FFMPEG_LOGLEVEL"] == "-8"


def test_a_video_without_frames_is_named(tmp_path: Path) -> None:
    """As of a recording that was stopped at once: it opens well."""
    path = tmp_path / "none.avi"
    cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, (320, 240)).release()
    for read in (lambda video: video.frame(0), lambda video: video.frame(5), lambda video: video.skip_to_end()):
        with Video(path) as video, pytest.raises(InputError, match="has no frames that can be decoded"):
            read(video)


def test_hidden_files_of_a_folder_are_no_videos_and_no_images(tmp_path: Path) -> None:
    """A Mac writes ._a.mp4 beside a.mp4 on disks that cannot hold its attributes."""
    for name in ("a.mp4", "._a.mp4", "._cover.jpg"):
        (tmp_path / name).touch()
    assert videos_inside(tmp_path) == [tmp_path / "a.mp4"]
    (tmp_path / "b.jpg").touch()
    assert videos_inside(tmp_path) == [tmp_path]


@pytest.mark.parametrize(
    ("numbers", "counts", "places"),
    [
        ([[26, 27, 29], [30, 31, 32]], [4, 3], [[0, 1, 3], [0, 1, 2]]),  # a recorder counts before the recording
        ([[26, 27, 29], [30, 31, 32]], [0, 0], [[0, 1, 3], [0, 1, 2]]),
        ([[26, 27, 29], [30, 31, 32]], [30, 33], [[26, 27, 29], [30, 31, 32]]),  # numbers in the videos
        ([[0, 1, 2], [5, 6, 7]], [3, 8], [[0, 1, 2], [5, 6, 7]]),
        ([[0, 1, 2], [5, 6, 7]], [2, 9], [[0, 1, 2], [5, 6, 7]]),  # the first video is cut off
        ([[1, 2, 3], [6, 7, 8]], [3, 8], [[0, 1, 2], [5, 6, 7]]),  # from 1
        ([[26, 27, 28], [26, 27]], [3, 40], [[0, 1, 2], [0, 1]]),  # few frames of the second have a partner
        ([[26, 29, 30], [26, 27, 30]], [3, 5], [[0, 1, 2], [0, 1, 4]]),  # dropped frames
    ],
)
def test_numbers_of_timestamps_are_places_in_the_videos(
    numbers: list[list[int]], counts: list[int], places: list[list[int]], tmp_path: Path
) -> None:
    path = tmp_path / "timestamps.csv"
    rows = [f"{k},{c},{number}\n" for c, own in enumerate(numbers) for k, number in enumerate(own)]
    path.write_text("sync_index,cam_id,frame_index\n" + "".join(rows))
    moments = read_timestamps(path, {f"cam_{c}": count for c, count in enumerate(counts)})
    assert [[m[f"cam_{c}"] for m in moments.values() if f"cam_{c}" in m] for c in (0, 1)] == places


def test_videos_cut_from_longer_ones_are_named(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "timestamps.csv"
    path.write_text("sync_index,cam_id,frame_index\n7,0,500\n8,0,502\n9,0,700\n")
    assert read_timestamps(path, {"cam_0": 100}) == {7: {"cam_0": 0}, 8: {"cam_0": 2}, 9: {"cam_0": 200}}
    assert "camera 'cam_0' has numbers of 201 frames, its video 100" in caplog.text


def test_timestamps_of_other_cameras_or_columns_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "timestamps.csv"
    path.write_text("sync_index,cam_id,frame_index\n7,0,0\n")
    with pytest.raises(InputError, match="no rows of camera 'cam_4'"):
        read_timestamps(path, {"cam_0": 0, "cam_4": 0})
    path.write_text("time\n1\n")
    with pytest.raises(InputError, match="must name the columns"):
        read_timestamps(path, {"cam_0": 0})


@pytest.mark.parametrize(
    ("start", "name"),
    [
        (b"\0\0\0\x18ftypheic\0\0\0\0", "HEIC"),
        (b"\0\0\0\x18ftypavif\0\0\0\0", "AVIF"),
        (b"II*\0\x10\0\0\0CR\2\0", "CR2"),
        (b"SIMPLE  =      T", "FITS"),
        (b"\0\0\0\x18ftypisom\0\0\0\0", "a video"),
    ],
)
def test_formats_that_are_not_read_are_named(start: bytes, name: str, tmp_path: Path) -> None:
    path = tmp_path / "photo.jpg"
    path.write_bytes(start + bytes(200))
    with pytest.raises(InputError, match=f"{name}.*which is not read"):
        read_image(path)


def test_a_raw_image_is_not_read_by_its_thumbnail(tmp_path: Path) -> None:
    thumbnail = cv2.imencode(".tiff", np.zeros((16, 24), np.uint8))[1].tobytes()
    for name in ("photo.dng", "photo.NEF"):
        (tmp_path / name).write_bytes(thumbnail)
        with pytest.raises(InputError, match=f"{name}' is a raw image .*which is not read"):
            read_image(tmp_path / name)


@pytest.mark.parametrize(("ending", "code"), [(".3gp", "mp4v"), (".flv", "FLV1"), (".mjpg", "MJPG")])
def test_recordings_of_camcorders_and_phones_are_videos(ending: str, code: str, tmp_path: Path) -> None:
    path = tmp_path / f"a{ending}"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*code), 10, (64, 48))
    if not writer.isOpened():
        pytest.skip("OpenCV without this encoder")
    for level in (40, 90, 140):
        writer.write(np.full((48, 64, 3), level, np.uint8))
    writer.release()
    assert is_video(path)
    assert videos_inside(tmp_path) == [path]
    with Video(path) as source:
        frame = source.frame(2)
    assert frame is not None
    assert abs(int(frame[20, 20]) - 140) <= 3
    # A transport stream of three frames is too short for FFmpeg.
    assert all(map(is_video, ("a.MTS", "a.m2ts", "a.ts")))
