"""`rigkit rectify` end to end: files in, file out, one line on stdout, nothing overwritten."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from rigkit.cameras.kannala_brandt import KannalaBrandt
from rigkit.cli.main import main
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3
from rigkit.io.calibrations.calibration_file import camera_to_json, save_camera
from rigkit.io.disk import writing

ROW_PX = 0.2
"""Centre of a blob of 3 px in 8-bit pixels, thresholded: the frame of the blob is distorted between the views."""
CAMERA = KannalaBrandt((160, 120), np.array([48.0, 48.0, 79.5, 59.5, 0.0, 0.0, 0.0, 0.0]))


@pytest.fixture(name="files")
def _files(tmp_path: Path) -> tuple[str, str]:
    save_camera(tmp_path / "camera.json", CAMERA)
    image = np.full((120, 160, 3), 40, dtype=np.uint8)
    # A bright blob 45 degrees to the right of the axis.
    blob, _ = CAMERA.project(np.array([1.0, 0.0, 1.0]))
    cv2.circle(image, tuple(int(v) for v in np.rint(blob)), 4, (10, 20, 250), -1)
    cv2.imwrite(str(tmp_path / "image.png"), image)
    return str(tmp_path / "image.png"), str(tmp_path / "camera.json")


def test_a_view_to_the_right_shows_the_right_in_the_middle(
    files: tuple[str, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "new" / "out.png"
    options = ["--yaw-deg", "45", "--hfov-deg", "60", "--size", "81x61", "-o", str(out)]
    assert main(["rectify", files[0], "--camera", files[1], *options]) == 0
    printed = capsys.readouterr().out
    assert "81 x 61 px" in printed and "100.0 %" in printed
    image = cv2.imread(str(out))
    assert image is not None and image.shape == (61, 81, 3)
    # Colours keep their order: the blob is red.
    assert image[30, 40].tolist() == pytest.approx([10, 20, 250], abs=3)
    assert image[5, 5].tolist() == pytest.approx([40, 40, 40], abs=3)


@pytest.mark.parametrize("projection", ["perspective", "cylindrical", "equirectangular"])
def test_json_says_what_the_image_is(
    files: tuple[str, str], tmp_path: Path, capsys: pytest.CaptureFixture[str], projection: str
) -> None:
    out = tmp_path / "out.tif"
    arguments = ["rectify", files[0], "--camera", files[1], "-o", str(out), "--projection", projection, "--json"]
    assert main([*arguments, "--hfov-deg", "90", "--interpolation", "linear"]) == 0
    result = json.loads(capsys.readouterr().out)
    image = cv2.imread(str(out))
    assert image is not None
    assert result["size_px"] == [image.shape[1], image.shape[0]]
    assert result["projection"] == projection
    assert np.allclose(result["target_from_cam"], np.eye(3))
    assert 0.0 < result["covered"] <= 1.0


def test_nothing_is_overwritten_and_errors_are_one_line(
    files: tuple[str, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out.png"
    out.write_bytes(b"mine")
    start = ["rectify", files[0], "--camera", files[1]]
    for options, words in (
        (["-o", str(out)], "exists"),
        (["-o", str(tmp_path / "a.xyz")], ".xyz"),
        (["-o", str(tmp_path / "a.png"), "--size", "12"], "--size"),
        (["-o", str(tmp_path / "a.png"), "--hfov-deg", "200"], "field of view"),
        (["-o", str(tmp_path / "a.png"), "--yaw-deg", "180", "--hfov-deg", "40"], "outside the camera's field of view"),
    ):
        assert main([*start, *options]) == 2
        err = capsys.readouterr().err
        assert words in err and len(err.strip().splitlines()) == 1
    assert out.read_bytes() == b"mine"
    assert not (tmp_path / "a.png").exists()
    assert main([*start, "-o", str(out), "--force"]) == 0
    assert cv2.imread(str(out)) is not None


@pytest.mark.parametrize("projection", ["perspective", "equirectangular"])
def test_a_pair_gets_the_same_rows(tmp_path: Path, capsys: pytest.CaptureFixture[str], projection: str) -> None:
    """A bright blob in both images, where each camera sees one point: after rectification on one row. Their names say
    which camera took which, not their order."""
    poses = {"left": Rigid3.identity(), "right": Rigid3(exp_so3(np.array([0.05, -0.1, 0.2])), [-200.0, 20.0, 10.0])}
    entries = []
    for name, pose in poses.items():
        blob, _ = CAMERA.project(pose.apply(np.array([150.0, 200.0, 900.0])))
        v, u = np.mgrid[0:120, 0:160]
        image = 30.0 + 200.0 * np.exp(-((u - blob[0]) ** 2 + (v - blob[1]) ** 2) / 18.0)
        cv2.imwrite(str(tmp_path / f"{name}04.png"), np.rint(image).astype(np.uint8))
        matrix = pose.matrix()[:3].tolist()
        entries.append({"name": name, "camera": camera_to_json(CAMERA), "cam_from_rig": matrix, "rms_px": 0.1})
    rig = tmp_path / "rig.json"
    rig.write_text(json.dumps({"schema": "rigkit.rig/1", "cameras": entries}))
    images = [str(tmp_path / "right04.png"), str(tmp_path / "left04.png")]
    arguments = ["rectify", *images, "--rig", str(rig), "-o", str(tmp_path / "r.png"), "--projection", projection]
    assert main([*arguments, "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert abs(result["rect2_from_rect1_mm"][0]) == pytest.approx(np.linalg.norm(poses["right"].translation_mm))
    centres = []
    for i in (1, 2):
        image = cv2.imread(str(tmp_path / f"r-{i}.png"), 0)
        assert image is not None
        weight = np.clip(image.astype(float) - 60.0, 0.0, None)
        v, u = np.mgrid[0 : image.shape[0], 0 : image.shape[1]]
        centres.append([(u * weight).sum() / weight.sum(), (v * weight).sum() / weight.sum()])
    assert centres[0][1] == pytest.approx(centres[1][1], abs=ROW_PX)
    assert abs(centres[0][0] - centres[1][0]) > 3.0
    assert main(arguments) == 2
    assert "exists" in capsys.readouterr().err
    for extra, words in ((["--hfov-deg", "60"], "baseline"), (["--names", "left", "up"], "no camera 'up'")):
        assert main([*arguments, "--force", *extra]) == 2
        assert words in capsys.readouterr().err
    assert main(["rectify", *images, "-o", str(tmp_path / "x.png")]) == 2
    assert "--rig" in capsys.readouterr().err
    # With one camera these are two images of it.
    save_camera(tmp_path / "camera.json", CAMERA)
    alone = ["rectify", *images, "--camera", str(tmp_path / "camera.json"), "--interpolation", "nearest", "-o"]
    assert main([*alone, str(tmp_path / "x.png")]) == 2
    assert "several images, so -o must name a folder" in capsys.readouterr().err
    assert main([*alone, str(tmp_path / "x")]) == 0
    assert sorted(p.name for p in (tmp_path / "x").iterdir()) == ["left04.png", "right04.png"]


def test_folders_of_a_pair_are_rectified_with_their_geometry(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    poses = {"left": Rigid3.identity(), "right": Rigid3(exp_so3(np.array([0.05, -0.1, 0.2])), [-200.0, 20.0, 10.0])}
    entries = []
    rng = np.random.default_rng(1)
    for name, pose in poses.items():
        (tmp_path / name).mkdir()
        for k in range(3):
            cv2.imwrite(str(tmp_path / name / f"{k}.png"), rng.integers(0, 255, (120, 160), dtype=np.uint8))
        matrix = pose.matrix()[:3].tolist()
        entries.append({"name": name, "camera": camera_to_json(CAMERA), "cam_from_rig": matrix, "rms_px": 0.1})
    rig, out, maps = tmp_path / "rig.json", tmp_path / "out", tmp_path / "maps.npz"
    rig.write_text(json.dumps({"schema": "rigkit.rig/1", "cameras": entries}))
    both = [str(tmp_path / "left"), str(tmp_path / "right")]
    command = ["rectify", *both, "--rig", str(rig), "--interpolation", "linear"]
    assert main([*command, "-o", str(out), "--maps", str(maps)]) == 0
    assert sorted(str(p.relative_to(out)) for p in out.rglob("*.png")) == [
        f"{name}/{k}.png" for name in poses for k in range(3)
    ]
    # Images of which there is the same to say are one line.
    lines = capsys.readouterr().out.splitlines()
    assert [line.split(":")[0] for line in lines[:-1]] == [f"{out / name}, 3 images" for name in poses]
    # One of the folder is what it is alone.
    alone = [str(tmp_path / name / "2.png") for name in poses]
    assert main(["rectify", *alone, "--rig", str(rig), "--interpolation", "linear", "-o", str(out / "a.png")]) == 0
    for i, name in enumerate(poses, start=1):
        one, other = cv2.imread(str(out / f"a-{i}.png"), 0), cv2.imread(str(out / name / "2.png"), 0)
        assert one is not None and other is not None
        np.testing.assert_array_equal(one, other)
    # The file's P1, P2, Q and maps say of a point what the cameras say.
    with np.load(maps) as geometry:
        point = np.array([[150.0, 200.0, 900.0]])
        seen = []
        for i, (pose, P) in enumerate(zip(poses.values(), (geometry["P1"], geometry["P2"]), strict=True), start=1):
            in_rect1 = geometry["target_from_cam1"] @ point[0]
            u, v, w = P @ [*in_rect1, 1.0]
            seen.append([u / w, v / w])
            column, row = np.rint(seen[-1]).astype(int)
            there = [geometry[f"map_x{i}"][row, column], geometry[f"map_y{i}"][row, column]]
            np.testing.assert_allclose(there, CAMERA.project(pose.apply(point))[0][0], atol=1.0)
        assert seen[0][1] == pytest.approx(seen[1][1])
        back = geometry["Q"] @ [*seen[0], seen[0][0] - seen[1][0], 1.0]
        np.testing.assert_allclose(back[:3] / back[3], in_rect1, rtol=1e-9)
    capsys.readouterr()
    # One folder of both cameras', and two images into a folder: the same.
    for given in ([str(tmp_path)], alone):
        into = tmp_path / f"of-{len(given)}"
        assert main(["rectify", *given, "--rig", str(rig), "--interpolation", "linear", "-o", str(into)]) == 0
        for name in poses:
            assert (into / name / "2.png").read_bytes() == (out / name / "2.png").read_bytes()
    # Those of left and right may be called l and r.
    for name in poses:
        for image in (tmp_path / name).iterdir():
            image_of_side = tmp_path / "sides" / f"{name[0]}{image.name}"
            image_of_side.parent.mkdir(exist_ok=True)
            shutil.copy(image, image_of_side)
    start = ["rectify", str(tmp_path / "sides"), "--rig", str(rig), "--interpolation", "linear"]
    assert main([*start, "--names", "L", "R", "-o", str(tmp_path / "of-sides")]) == 0
    for name in poses:
        written = tmp_path / "of-sides" / name / f"{name[0]}2.png"
        assert written.read_bytes() == (out / name / "2.png").read_bytes()
    # Folders that are called as the cameras are theirs, in whatever order they come.
    assert main(["rectify", *both[::-1], *command[3:], "-o", str(tmp_path / "turned")]) == 0
    for name in poses:
        assert (tmp_path / "turned" / name / "2.png").read_bytes() == (out / name / "2.png").read_bytes()
    # What has no partner is left out; which belongs to which is told by names, not by the order.
    (tmp_path / "right" / "1.png").unlink()
    assert main([*command, "-o", str(tmp_path / "other")]) == 2
    assert "left/1.png': the other camera has no image" in capsys.readouterr().err
    for name in poses:
        assert (tmp_path / "other" / name / "2.png").read_bytes() == (out / name / "2.png").read_bytes()


@pytest.mark.parametrize("name", ["out.xyz", "out.json"])
def test_an_unknown_image_format_is_refused_before_the_work(
    name: str,
    files: tuple[str, str],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("rigkit.workflows.rectify.import_camera", lambda _: pytest.fail("work was done"))
    assert main(["rectify", files[0], "--camera", files[1], "-o", str(tmp_path / name)]) == 2
    assert ".png" in capsys.readouterr().err
    assert not (tmp_path / name).exists()


@pytest.mark.parametrize(
    ("size", "name", "shown_text"),
    [("60000x60000", "out.png", "more than 200 million"), ("66000x10", "out.jpg", "takes no image of 66000 x 10 px")],
)
def test_an_image_that_is_too_large_is_refused(
    size: str, name: str, shown_text: str, files: tuple[str, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["rectify", files[0], "--camera", files[1], "-o", str(tmp_path / name), "--size", size]
    assert main([*arguments, "--interpolation", "nearest"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert shown_text in line and name in line and "--size" in line
    assert not (tmp_path / name).exists()


def test_one_bad_image_does_not_end_a_folder(
    files: tuple[str, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A truncated image, one of another size and one that is none: the rest is written, each is named, exit 2."""
    folder, out = tmp_path / "many", tmp_path / "out"
    folder.mkdir()
    whole = Path(files[0]).read_bytes()
    bad = {"b": whole[: len(whole) // 2], "c": b"no image", "e": None}
    for name in "abcdef":
        (folder / f"{name}.png").write_bytes(bad.get(name) or whole)
    cv2.imwrite(str(folder / "e.png"), np.zeros((60, 80), np.uint8))
    command = ["rectify", str(folder), "--camera", files[1], "-o", str(out), "--interpolation", "linear"]
    assert main(command) == 2
    shown_text = capsys.readouterr()
    assert sorted(p.stem for p in out.iterdir()) == ["a", "d", "f"] and f"{out}, 3 images:" in shown_text.out
    assert [name for name in "abcdef" if f"'{folder / name}.png'" in shown_text.err] == sorted(bad)
    for name in "abdf":
        (folder / f"{name}.png").unlink()
    assert main(command) == 2
    reported = capsys.readouterr().err
    assert "c.png" in reported and "e.png" in reported


def test_a_disk_that_fills_up_says_what_is_written(
    files: tuple[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    fill, out = writing._fill, tmp_path / "out"

    def until_the_second(handle: int, data: bytes) -> None:
        if any(out.glob("*.png")):
            os.close(handle)
            raise OSError(28, "No space left on device")
        fill(handle, data)

    monkeypatch.setattr(writing, "_fill", until_the_second)
    two = [str(shutil.copy(files[0], tmp_path / f"{name}.png")) for name in "ab"]
    assert main(["rectify", *two, "--camera", files[1], "-o", str(out)]) == 2
    words = "b.png': No space left on device; it stays as it was; written before it: 1 image"
    assert words in capsys.readouterr().err and [p.name for p in out.iterdir()] == ["a.png"]


def test_one_bad_image_of_a_pair_leaves_out_both(
    files: tuple[str, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    poses = {"left": Rigid3.identity(), "right": Rigid3(np.eye(3), [-200.0, 0.0, 0.0])}
    for name in poses:
        (tmp_path / name).mkdir()
        for k in range(3):
            (tmp_path / name / f"{k}.png").write_bytes(Path(files[0]).read_bytes())
    (tmp_path / "right" / "1.png").write_bytes(b"no image")
    entries = [
        {"name": name, "camera": camera_to_json(CAMERA), "cam_from_rig": pose.matrix()[:3].tolist(), "rms_px": 0.1}
        for name, pose in poses.items()
    ]
    rig, out = tmp_path / "rig.json", tmp_path / "out"
    rig.write_text(json.dumps({"schema": "rigkit.rig/1", "cameras": entries}))
    both = [str(tmp_path / name) for name in poses]
    assert main(["rectify", *both, "--rig", str(rig), "-o", str(out), "--interpolation", "linear", "--json"]) == 2
    shown_text = capsys.readouterr()
    assert len(json.loads(shown_text.out)["images"]) == 4 and "right/1.png" in shown_text.err
    assert sorted(p.stem for p in out.rglob("*.png")) == ["0", "0", "2", "2"]


def test_a_crop_is_seen_whole_and_its_geometry_follows(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Of a lens whose image ends in a circle: nothing black is left, K moved by the corner cut off, and a pixel of the
    crop is the same ray as before."""
    save_camera(tmp_path / "camera.json", CAMERA)
    cv2.imwrite(str(tmp_path / "image.png"), np.full((120, 160), 200, dtype=np.uint8))
    command = ["rectify", str(tmp_path / "image.png"), "--camera", str(tmp_path / "camera.json"), "--json"]
    command += ["--interpolation", "linear", "--hfov-deg", "120", "--yaw-deg", "50", "--roll-deg", "20"]
    reported = {}
    for name, more in (("whole", []), ("crop", ["--crop", "--maps", str(tmp_path / "maps.npz")])):
        assert main([*command, *more, "-o", str(tmp_path / f"{name}.png")]) == 0
        reported[name] = json.loads(capsys.readouterr().out)
    assert reported["whole"]["covered"] < 1.0 == reported["crop"]["covered"]
    image, part = (cv2.imread(str(tmp_path / f"{name}.png"), cv2.IMREAD_GRAYSCALE) for name in ("whole", "crop"))
    assert image is not None and part is not None
    assert image.min() == 0 and part.min() > 100
    assert reported["crop"]["size_px"] == [part.shape[1], part.shape[0]]
    left, top = (round(reported["whole"]["parameters"][k] - reported["crop"]["parameters"][k]) for k in ("cx", "cy"))
    np.testing.assert_array_equal(part, image[top : top + part.shape[0], left : left + part.shape[1]])
    maps = np.load(tmp_path / "maps.npz")
    assert maps["map_x"].shape == part.shape and maps["K"][0, 2] == pytest.approx(reported["crop"]["parameters"]["cx"])
    # No side has room for another row or column.
    seen = np.pad(image > 100, 1)
    rows, columns = slice(top + 1, top + 1 + part.shape[0]), slice(left + 1, left + 1 + part.shape[1])
    assert not seen[top, columns].all() and not seen[rows.stop, columns].all()
    assert not seen[rows, left].all() and not seen[rows, columns.stop].all()


def _video(path: Path, columns: list[int]) -> None:
    """Write a video with a bright bar, one frame for each of its columns."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 5.0, CAMERA.size_px)
    for column in columns:
        frame = np.full((120, 160, 3), 40, dtype=np.uint8)
        frame[:, column - 3 : column + 4] = (10, 20, 250)
        writer.write(frame)
    writer.release()


def test_every_frame_of_a_video(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    save_camera(tmp_path / "camera.json", CAMERA)
    _video(tmp_path / "clip.avi", [60, 80, 100])
    view = ["--camera", str(tmp_path / "camera.json"), "--hfov-deg", "60", "--size", "81x61"]
    out = tmp_path / "out"
    assert main(["rectify", str(tmp_path / "clip.avi"), *view, "-o", str(out)]) == 0
    assert "3 images" in capsys.readouterr().out
    frames = [cv2.imread(str(out / f"{k:06d}.png")) for k in range(3)]
    middles = [float(np.flatnonzero((f[30, :, 2] > 150) & (f[30, :, 0] < 60)).mean()) for f in frames if f is not None]
    assert middles[0] < 30.0 and middles[1] == pytest.approx(40.5, abs=1.0) and middles[2] > 50.0
    assert main(["rectify", str(tmp_path / "clip.avi"), *view, "-o", str(tmp_path / "one.png")]) == 2
    assert "is a video, so -o must name a folder" in capsys.readouterr().err


def test_two_videos_frame_by_frame(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rig = tmp_path / "rig.json"
    poses = {"left": Rigid3.identity(), "right": Rigid3(np.eye(3), np.array([-100.0, 0.0, 0.0]))}
    # A third camera, which is neither the first nor the second of the rig, is known by the videos' names.
    every = {"front": Rigid3(np.eye(3), np.array([70.0, 0.0, 0.0])), **poses}
    entries = [
        {"name": name, "camera": camera_to_json(CAMERA), "cam_from_rig": pose.matrix()[:3].tolist(), "rms_px": 0.1}
        for name, pose in every.items()
    ]
    rig.write_text(json.dumps({"schema": "rigkit.rig/1", "cameras": entries}))
    _video(tmp_path / "left.avi", [60, 80, 100])
    _video(tmp_path / "right.avi", [60, 80])
    both = [str(tmp_path / "left.avi"), str(tmp_path / "right.avi")]
    assert main(["rectify", *both, "--rig", str(rig), "-o", str(tmp_path / "out")]) == 0
    shown_text = capsys.readouterr()
    assert (
        "baseline 100.000 mm" in shown_text.out
        and "3 frames" in shown_text.err
        and "2: those of one number" in shown_text.err
    )
    for name in poses:
        assert sorted(p.name for p in (tmp_path / "out" / name).iterdir()) == ["000000.png", "000001.png"]
    # The right one began a frame later.
    rows = "5,left,0\n6,left,1\n6,right,0\n7,left,2\n7,right,1\n"
    (tmp_path / "timestamps.csv").write_text("sync_index,cam_id,frame_index\n" + rows)
    assert main(["rectify", *both, "--rig", str(rig), "-o", str(tmp_path / "timed")]) == 0
    for name, frame in (("left", 1), ("right", 0)):
        timed = tmp_path / "timed" / name
        assert sorted(p.name for p in timed.iterdir()) == ["000006.png", "000007.png"]
        assert (timed / "000006.png").read_bytes() == (tmp_path / "out" / name / f"{frame:06d}.png").read_bytes()
    (tmp_path / "timestamps.csv").write_text("sync_index,cam_id,frame_index\n5,left,0\n6,right,0\n")
    assert main(["rectify", *both, "--rig", str(rig), "-o", str(tmp_path / "more")]) == 2
    assert "no moment has a frame of every video, left and right" in capsys.readouterr().err
    (tmp_path / "timestamps.csv").unlink()
    (tmp_path / "folder").mkdir()
    assert main(["rectify", both[0], str(tmp_path / "folder"), "--rig", str(rig), "-o", str(tmp_path / "more")]) == 2
    assert "two images, two folders or two videos" in capsys.readouterr().err


@pytest.mark.parametrize("angle", ["nan", "inf"])
def test_a_view_that_is_not_a_number_is_blamed_on_the_option(
    angle: str, files: tuple[str, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["rectify", files[0], "--camera", files[1], "-o", str(tmp_path / "out.png"), "--yaw-deg", angle]
    assert main(arguments) == 2
    shown_text = capsys.readouterr().err
    assert (
        f"rectify: yaw {angle}, pitch 0, roll 0: three finite numbers are needed" in shown_text
        and files[1] not in shown_text
    )
