"""The coach in a browser whose camera plays a rendered capture: it finds, guides, takes, stops, and loses nothing."""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from coach.test_coach import BOARD, CAMERA, SIZE, picture
from helpers.browser import chromium

from rigkit.cameras.compare import compare_cameras
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3
from rigkit.io.calibration_file import load_calibration
from rigkit.io.images import read_image
from rigkit.planning.goal import projection_goal
from rigkit.planning.information import CornerError, Knowledge
from rigkit.planning.plan import plan_views

POSES, HELD_FRAMES, MOVING_FRAMES, RATE = 13, 14, 2, 10
"""A person holds each pose for a second and a half, and takes a fifth of a second to the next."""
PATIENCE_S = 150.0
SIGMAS = 4.0
"""Of the rms error that the calibration states."""
EXACT_PX = 0.05
"""Nobody asks for less from 640x480 px through a browser's video."""


def person_like_video(path: Path, poses: int) -> Path:
    """Write a session as Y4M: boards held where a plan asks, within a hand's error, and moved between."""
    rng = np.random.default_rng(4)
    known = Knowledge.guessed(CAMERA, CornerError(0.1))
    plan = plan_views(known, [BOARD], projection_goal(CAMERA), poses)
    with path.open("wb") as out:
        out.write(f"YUV4MPEG2 W{SIZE[0]} H{SIZE[1]} F{RATE}:1 Ip A1:1 C420jpeg\n".encode())
        for view in plan.views:
            pose = view.cam_from_board
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


def _write(out, image: np.ndarray) -> None:
    chroma = np.full(SIZE[0] * SIZE[1] // 2, 128, np.uint8)
    out.write(b"FRAME\n" + image[..., 0].tobytes() + chroma.tobytes())


def _browse(browser: str, video: Path, url: str, profile: Path, log: Path) -> subprocess.Popen:
    return subprocess.Popen(
        [
            browser, "--headless=new", "--no-sandbox", "--disable-gpu", "--no-first-run", "--mute-audio",
            "--use-fake-device-for-media-stream", "--use-fake-ui-for-media-stream",
            f"--use-file-for-fake-video-capture={video}", "--enable-logging=stderr",
            f"--user-data-dir={profile}", url,
        ],
        stdout=subprocess.DEVNULL,
        stderr=log.open("wb"),
    )  # fmt: skip


def _guided(video: Path, folder: Path, place: Path, stop_at: int | None) -> int:
    """Run the coach and its page until so many frames are taken, or to its own end, kill both, and return how many
    there are; nothing may be complained of in the browser's console."""
    browser, log = chromium(), place / "browser.log"
    command = ["-c", "import sys; from rigkit.cli.main import main; sys.exit(main())", "coach", str(folder)]
    command += ["--board", "9x6x25", "--lens", "52", "--goal", "0.12", "--port", "0"]
    with subprocess.Popen([sys.executable, *command], stdout=subprocess.PIPE, text=True) as server:
        assert server.stdout is not None
        url = server.stdout.readline().strip()
        page = _browse(browser, video, url, place / f"profile{stop_at}", log)
        try:
            frames = _wait(folder, stop_at)
        finally:
            page.kill()
            page.wait()
            server.kill()
    said = log.read_text(errors="replace")
    assert not [line for line in said.splitlines() if "CONSOLE" in line], said[-2000:]
    return frames


def test_the_page_finds_a_board_and_takes_a_frame(tmp_path: Path) -> None:
    chromium()
    pytest.importorskip("uvicorn")
    video = person_like_video(tmp_path / "session.y4m", 2)
    assert _guided(video, tmp_path / "session", tmp_path, 1) >= 1
    assert read_image(tmp_path / "session/images/frame-0001.png").shape[:2] == SIZE[::-1]


@pytest.mark.slow
def test_a_capture_from_beginning_to_end(tmp_path: Path) -> None:
    chromium()
    pytest.importorskip("uvicorn")
    video, folder = person_like_video(tmp_path / "session.y4m", POSES), tmp_path / "session"
    # Killed in the middle, and started again.
    frames = [_guided(video, folder, tmp_path, stop_at) for stop_at in (3, None)]
    assert frames[0] >= 3
    kept = len(list((folder / "images").glob("*.png")))
    assert kept == frames[1] > frames[0]
    found = load_calibration(folder / "calibration.json")
    stated = float(projection_goal(found.camera).error(found.covariance))
    assert compare_cameras(CAMERA, found.camera).rms_px < max(SIGMAS * stated, EXACT_PX)


def _wait(folder: Path, count: int | None) -> int:
    """Wait for so many frames, or for the calibration, and return how many frames there are."""
    end = time.monotonic() + PATIENCE_S
    while time.monotonic() < end:
        frames = len(list((folder / "images").glob("*.png")))
        if (folder / "calibration.json").exists() if count is None else frames >= count:
            return frames
        time.sleep(0.2)
    raise AssertionError(f"{frames} frames after {PATIENCE_S} s, not {count or 'a calibration'}")
