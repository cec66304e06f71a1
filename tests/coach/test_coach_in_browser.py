"""The coach in a browser whose camera plays a rendered capture: from the first frame to the stop, without losses."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from helpers.browser import chromium
from helpers.coach_scenes import BOARD, CAMERA, SIZE, picture, shared_boards
from helpers.driven import DrivenPage
from helpers.monitoring_scenes import best_held

from rigkit.cameras.compare import compare_cameras
from rigkit.coach.look import observe_frame
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3
from rigkit.io.calibrations.calibration_file import load_calibration
from rigkit.io.media.images import read_image
from rigkit.planning.goal import projection_goal

POSES, HELD_FRAMES, MOVING_FRAMES, RATE = 13, 14, 2, 10
"""A person holds each pose for a second and a half, and takes a fifth of a second to the next."""
PATIENCE_S = 150.0
SIGMAS = 4.0
"""Of the rms error that the calibration states."""
GOAL_PX = 0.12
EXACT_PX = 0.05
"""Nobody asks for less from 640x480 px through a browser's video."""


def person_like_video(path: Path, poses: int) -> Path:
    """Write a session as Y4M: boards held where a plan asks, within a hand's error, and moved between."""
    rng = np.random.default_rng(4)
    with path.open("wb") as out:
        out.write(_head(SIZE[0]))
        for pose in best_held(CAMERA, BOARD, poses, 0.1):
            turned = exp_so3(np.radians(2.0) * rng.standard_normal(3)) @ pose.rotation
            held = Rigid3(turned, pose.translation_mm * (1.0 + 0.02 * rng.standard_normal()))
            for k in range(MOVING_FRAMES):
                away = Rigid3(turned, held.translation_mm + np.array([12.0 * (MOVING_FRAMES - k), 0.0, 40.0]))
                _write(out, picture(away, rng, blur_px=2.5))
            still = picture(held, rng)[..., :1].astype(np.float32)
            for _ in range(HELD_FRAMES):
                noise = rng.standard_normal(still.shape, np.float32)
                _write(out, np.clip(np.rint(still + noise), 0, 255).astype(np.uint8))
    return path


def _head(width: int) -> bytes:
    return f"YUV4MPEG2 W{width} H{SIZE[1]} F{RATE}:1 Ip A1:1 C420jpeg\n".encode()


def _write(out, image: np.ndarray) -> None:
    chroma = np.full(image[..., 0].size // 2, 128, np.uint8)
    out.write(b"FRAME\n" + image[..., 0].tobytes() + chroma.tobytes())


HALVES = """
const real = navigator.mediaDevices.getUserMedia.bind(navigator.mediaDevices);
navigator.mediaDevices.enumerateDevices = async () =>
  [0, 1].map((k) => ({ deviceId: `${k}`, label: `Half ${k}`, kind: "videoinput", groupId: "" }));
let film = null;
navigator.mediaDevices.getUserMedia = async (want) => {
  const half = Number(want.video.deviceId?.exact ?? 0), part = document.createElement("canvas");
  if (!film) {
    film = Object.assign(document.createElement("video"), { muted: true, srcObject: await real({ video: true }) });
    await film.play();
  }
  part.width = film.videoWidth / 2; part.height = film.videoHeight;
  const draw = () => part.getContext("2d").drawImage(film, -half * part.width, 0);
  draw(); setInterval(draw, 50);
  return part.captureStream(15);
};
"""
"""Chromium plays one film for all cameras: two of them are its halves."""


FLASHES = """
(() => { const flash = document.getElementById("flash"); flash.style.pointerEvents = "auto";
  const top = document.elementFromPoint(innerWidth / 2, 99); flash.style.pointerEvents = "none";
  return top === flash; })()
"""
"""Whether what lights up when a frame is taken is before the picture."""


@contextmanager
def _guided(video: Path | None, folder: Path, profile: Path, *more: str, before: str = "") -> Iterator[DrivenPage]:
    """Run the coach and its page, and kill both in the end; nothing may be complained of in the browser's console."""
    chromium()
    pytest.importorskip("uvicorn")
    command = ["-c", "import sys; from rigkit.cli.main import main; sys.exit(main())", "coach", str(folder)]
    command += ["--board", "9x6x25", "--lens", "52", "--goal", str(GOAL_PX), "--port", "0", *more]
    with subprocess.Popen([sys.executable, *command], stdout=subprocess.PIPE, text=True) as server:
        assert server.stdout is not None
        camera = ["--use-fake-device-for-media-stream", "--use-fake-ui-for-media-stream"]
        url = server.stdout.readline().strip()
        film = [] if video is None else [*camera, f"--use-file-for-fake-video-capture={video}"]
        page = DrivenPage(url, profile, *film, before=before)
        try:
            yield page
        finally:
            page.close()
            server.kill()
    assert not page.complaints


def _words(page: DrivenPage) -> str:
    return str(page.evaluate('document.getElementById("words").textContent'))


def test_the_page_finds_a_board_and_takes_a_frame_and_obeys_keys(tmp_path: Path) -> None:
    chromium()
    video, folder = person_like_video(tmp_path / "session.y4m", 1), tmp_path / "session"
    with _guided(video, folder, tmp_path / "profile") as page:
        page.wait("coach.state.frames >= 1", PATIENCE_S)
        assert read_image(folder / "images/frame-0001.png").shape[:2] == SIZE[::-1]
        for key, button in (("m", "mapped"), ("s", "quiet")):
            page.press(key)
            assert page.evaluate(f'document.getElementById("{button}").ariaPressed') == "true"
        # Of one frame nobody says how near the goal is; the map's scale leaves the picture as large as it was.
        assert page.evaluate('document.getElementById("least").textContent') == "of at least 8"
        assert page.evaluate('document.getElementById("meter").value') < 0.2
        assert page.evaluate('document.getElementById("stage").contains(document.getElementById("scale"))')
        # The flash is over the picture, not behind it.
        assert page.evaluate(FLASHES)
        # Who went to a button by keys presses that one, and takes no picture.
        page.evaluate('document.getElementById("quiet").focus()')
        page.press(" ")
        page.wait('document.getElementById("quiet").ariaPressed == "false"', PATIENCE_S)
        page.evaluate("document.activeElement.blur()")
        # One pose is all there is: what is taken now is taken because somebody asked for it.
        page.press(" ")
        page.wait("coach.state.frames >= 2", PATIENCE_S)
        page.press("u")
        page.wait("coach.state.frames == 1", PATIENCE_S)
    assert (folder / "images/frame-0002.png.dropped").exists()


@pytest.mark.thorough
def test_two_cameras_take_frames_together(tmp_path: Path) -> None:
    chromium()
    rng, (in_a, in_b) = np.random.default_rng(6), shared_boards(40)
    film, folder = tmp_path / "pair.y4m", tmp_path / "session"
    with film.open("wb") as out:
        out.write(_head(2 * SIZE[0]))
        for k in (0, 20, 39):
            pair = np.concatenate([picture(held.pose(k), rng) for held in (in_a, in_b)], axis=1)
            for _ in range(3 * HELD_FRAMES):
                _write(out, pair)
    with _guided(film, folder, tmp_path / "profile", "--cameras", "2", before=HALVES) as page:
        page.wait("coach.state.frames >= 1", PATIENCE_S)
        assert "camera" in _words(page)
    kept = [read_image(folder / f"images/camera{c}/frame-0001.png") for c in (0, 1)]
    # Both see one pose: the board is where the mount puts it, and not in one picture twice.
    assert all(image.shape[:2] == SIZE[::-1] for image in kept) and not np.array_equal(kept[0], kept[1])
    found = [observe_frame(image, [BOARD], "kept").view for image in kept]
    assert all(view is not None and len(view.grid) == BOARD.corner_count for view in found)


@pytest.mark.thorough
def test_without_a_camera_the_page_says_what_to_do(tmp_path: Path) -> None:
    """And nothing is complained of where the pictures come from elsewhere, and none is there yet."""
    (tmp_path / "incoming").mkdir()
    with _guided(None, tmp_path / "a", tmp_path / "pa", "--watch", str(tmp_path / "incoming")) as page:
        page.wait("coach.looks > 2", PATIENCE_S)
        assert _words(page).startswith("Waiting for pictures in ")
        intro = page.evaluate('document.getElementById("intro").innerText')
        assert "put the file into the folder" in intro and "by itself" not in intro
        assert page.evaluate('["sharp", "still", "light"].every((id) => document.getElementById(id).hidden)')
        assert page.evaluate('document.querySelector("img").hidden'), "an empty picture has a frame"
        page.press("u")
        page.wait('document.getElementById("words").textContent.includes("no frame to undo")', PATIENCE_S)
    with _guided(None, tmp_path / "b", tmp_path / "pb") as page:
        page.wait('document.getElementById("words").textContent.startsWith("No live camera: no camera")', PATIENCE_S)
        assert page.evaluate('!document.getElementById("photo").hidden')
        page.evaluate('document.querySelector("#photo input").onclick = () => { window.asked = true; return false; }')
        page.press(" ")
        page.wait("window.asked", PATIENCE_S)


@pytest.mark.slow
def test_a_capture_from_beginning_to_end(tmp_path: Path) -> None:
    chromium()
    video, folder = person_like_video(tmp_path / "session.y4m", POSES), tmp_path / "session"
    with _guided(video, folder, tmp_path / "first") as page:
        page.wait("coach.state.frames >= 3", PATIENCE_S)
    # Killed in the middle, and started again: nothing is lost.
    kept = len(list((folder / "images").glob("*.png")))
    assert kept >= 3
    with _guided(video, folder, tmp_path / "second") as page:
        page.wait("coach.looks > 0", PATIENCE_S)
        assert page.evaluate("coach.state.frames") >= kept
        printed = page.wait("coach.state.enough && coach.state.words", PATIENCE_S)
        assert printed.startswith("Enough: ") and "two more pictures would bring" in printed
        assert page.evaluate("coach.state.share") <= 1
        page.wait("coach.state.finished", PATIENCE_S)
        assert _words(page).startswith("Done: ") and "calibration.json written" in _words(page)
        assert page.evaluate('["take", "undo", "done"].every((id) => document.getElementById(id).hidden)')
        assert page.evaluate('["left", "meter"].every((id) => document.getElementById(id).hidden)')
        # The camera is let go.
        assert page.evaluate('document.querySelector("video").srcObject.getTracks()[0].readyState') == "ended"
        frames = page.evaluate("coach.state.frames")
    assert len(list((folder / "images").glob("*.png"))) == frames > kept
    found = load_calibration(folder / "calibration.json")
    stated = float(projection_goal(found.camera).error(found.covariance))
    assert compare_cameras(CAMERA, found.camera).rms_px < max(SIGMAS * stated, EXACT_PX)
    assert not [v.message for v in found.verdicts if "count as one" in v.message]
