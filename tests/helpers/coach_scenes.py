"""One camera, or a rig of two, and its boards, for the tests of the coach."""

from __future__ import annotations

import http.client
from contextlib import suppress
from functools import cache
from pathlib import Path

import numpy as np

from helpers.calibration_scenes import noisy_view
from rigkit.cameras.brown import Brown
from rigkit.coach.guide import GuideOptions
from rigkit.coach.look import FrameObservation
from rigkit.coach.server import MAX_UPLOAD_BYTES
from rigkit.core.boards import Board
from rigkit.core.reach import Reach
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3
from rigkit.planning.candidates import board_poses_in_view
from rigkit.planning.information import BoardPoses
from rigkit.synthetic.photometry import Photometry
from rigkit.synthetic.render import Optics, render
from rigkit.synthetic.scene import PlacedBoard
from rigkit.workflows.options.coach import CoachOptions

SIZE = (640, 480)
BOARD = Board("board-9x6x25", 9, 6, 25.0, 25.0)
CAMERA = Brown(SIZE, np.array([620.0, 621.0, 322.0, 236.0, -0.12, 0.05, 0.0, 0.0, 0.0]))
MOUNT = Rigid3(exp_so3(np.array([0.0, 0.06, 0.01])), [-60.0, 1.0, 2.0])
"""right_from_left of the rig."""
NOISE_PX = 0.05
REACH = Reach(nearest_mm=250.0)


def picture(pose: Rigid3, rng: np.random.Generator, *, blur_px: float = 0.5) -> np.ndarray:
    """Return the rendered picture of the board, in colour."""
    grey = render(
        [PlacedBoard(BOARD, pose)],
        CAMERA,
        Rigid3.identity(),
        optics=Optics(blur_px, supersample=2),
        photometry=Photometry(noise_levels=1.0),
        rng=rng,
    )
    return np.repeat(grey[..., None], 3, axis=2)


def options(folder: Path, **more: object) -> CoachOptions:
    guide = GuideOptions(boards=(BOARD,), hfov_deg=52.0, goal_px=0.1)
    return CoachOptions(folder=folder, boards=("9x6x25",), guide=guide, **more)  # type: ignore[arg-type]


def ask(port: int, method: str, path: str, body: bytes = b"", **headers: str) -> tuple[int, bytes]:
    """Return the status and the body of the answer of the coach's server."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=30)
    own = {"Origin": f"http://127.0.0.1:{port}", **headers} if method == "POST" else headers
    if headers.get("chunks"):
        # Nobody says how much it will be.
        connection.putrequest(method, path)
        for name, value in own.items():
            connection.putheader(name, value)
        connection.endheaders()
        megabyte = b"100000\r\n" + bytes(2**20) + b"\r\n"
        with suppress(OSError):
            for _ in range(MAX_UPLOAD_BYTES // 2**20 + 2):
                connection.send(megabyte)
    else:
        connection.request(method, path, body, {k.replace("_", "-"): v for k, v in own.items() if v})
    answer = connection.getresponse()
    return answer.status, answer.read()


def shared_boards(count: int) -> tuple[BoardPoses, BoardPoses]:
    """Return the first `count` poses in which both cameras see the whole board."""
    in_a = _shared_boards()
    chosen = in_a.chosen(np.arange(min(count, len(in_a))))
    rotation = MOUNT.rotation @ chosen.rotation
    translation = chosen.translation_mm @ MOUNT.rotation.T + MOUNT.translation_mm
    return chosen, BoardPoses(chosen.points_mm, rotation, translation, chosen.seen)


@cache
def _shared_boards() -> BoardPoses:
    in_a = board_poses_in_view(CAMERA, BOARD, REACH)
    pixels = [CAMERA.project((MOUNT @ in_a.pose(k)).apply(BOARD.points()))[0] for k in range(len(in_a))]
    return in_a.chosen(np.flatnonzero([CAMERA.on_image(p).all() for p in pixels]))


def frame_observation(pose: Rigid3, rng: np.random.Generator, name: str) -> FrameObservation:
    """Return what a camera sees of a board held still, without a picture."""
    view = noisy_view(CAMERA, pose, name, rng, NOISE_PX, board=BOARD)
    if len(view.grid) < 30:
        return FrameObservation(size_px=SIZE, view=None)
    return FrameObservation(size_px=SIZE, view=view, edge_px=2.0, moved_px=0.0, contrast=150.0)


def both(pose: Rigid3, rng: np.random.Generator, name: str) -> list[FrameObservation]:
    """Return what both cameras of the rig see of a board."""
    return [frame_observation(pose, rng, name), frame_observation(MOUNT @ pose, rng, name)]
