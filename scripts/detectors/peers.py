"""Detectors of chessboards behind one interface, each in its own process.

A worker process runs one detector on one core with one thread. So processor time and peak memory are only the
detector's, a crash does not affect others, and incompatible packages can be in another environment. This file needs
only numpy; each worker imports what it needs.

    python scripts/detectors/peers.py NAME        run as a worker (by `Worker`): pickles in, pickles out
"""

from __future__ import annotations

import os
import pickle
import resource
import select
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

Boards = list[tuple[np.ndarray, np.ndarray | None, np.ndarray | None]]
"""For each board found: pixels (N, 2), grid (N, 2) or None, sigma_px (N,) or None."""
ONE_THREAD = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "RAYON_NUM_THREADS", "MKL_NUM_THREADS"), "1")
Detect = Callable[[np.ndarray, list[tuple[int, int]]], Boards]


START_S = 120.0


@dataclass(frozen=True)
class Detector:
    """How to get a detector.

    Attributes
    ----------
    load : returns the function that detects, given an image and the sizes of the boards; raises ImportError.
    boards : whether it returns boards; if not, corners without order.
    """

    load: Callable[[], Detect]
    boards: bool = True


def load_rigkit() -> Detect:
    from rigkit.detection.detect import detect_boards

    return lambda image, sizes: [(d.pixels, d.grid, d.sigma_px) for d in detect_boards(image)]


def load_opencv(sector: bool) -> Detect:
    """OpenCV's detectors are told the sizes, and each board found is painted over before the next is looked for."""
    import cv2

    cv2.setNumThreads(1)

    def find(image: np.ndarray, size: tuple[int, int]) -> np.ndarray | None:
        if sector:
            found, corners = cv2.findChessboardCornersSB(image, size)
            return corners.reshape(-1, 1, 2) if found else None
        found, corners = cv2.findChessboardCorners(image, size)
        if not found:
            return None
        grid = corners.reshape(size[1], size[0], 2)
        nearest = min(float(np.linalg.norm(np.diff(grid, axis=axis), axis=2).min()) for axis in (0, 1))
        half = int(np.clip(0.4 * nearest, 2, 11))
        return np.asarray(cv2.cornerSubPix(image, corners.reshape(-1, 1, 2), (half, half), (-1, -1), (3, 40, 1e-4)))

    def detect(image: np.ndarray, sizes: list[tuple[int, int]]) -> Boards:
        image = image.copy()
        out: Boards = []
        for size in sizes:
            corners = find(image, size)
            if corners is None:
                continue
            row, column = np.divmod(np.arange(size[0] * size[1]), size[0])
            out.append((corners.reshape(-1, 2).astype(np.float64), np.stack([column, row], axis=1), None))
            cv2.fillConvexPoly(image, cv2.convexHull(corners).astype(np.int32), int(np.median(image)))
        return out

    return detect


def load_libcbdetect() -> Detect:
    """libcbdetect: returns one board, the largest."""
    from libCBDetect import Checkerboard

    def detect(image: np.ndarray, sizes: list[tuple[int, int]]) -> Boards:
        board = Checkerboard()
        board.show_processing = False
        board.array_norm_to_image(image / 255.0, *image.shape)
        board.find_corners()
        board.find_board_from_corners()
        u, v = np.zeros(board.rows * board.cols), np.zeros(board.rows * board.cols)
        if not len(u):
            return []
        board.get_board_corners(u, v)
        return [(np.stack([u, v], axis=1), None, None)]

    return detect


def load_pycbd() -> Detect:
    """PyCBD without its Gaussian processes, as by default: libcbdetect with its own scaling; one board."""
    from PyCBD.checkerboard_detection import CheckerboardDetector

    detector = CheckerboardDetector()
    detector.detector.show_processing = False

    def detect(image: np.ndarray, sizes: list[tuple[int, int]]) -> Boards:
        pixels, _, _ = detector.detect_checkerboard(image)
        return [(pixels, None, None)] if len(pixels) else []

    return detect


def load_chess_corners() -> Detect:
    import chess_corners

    detector = chess_corners.Detector(chess_corners.DetectorConfig.chess_multiscale())
    return lambda image, sizes: [(np.asarray(detector.detect(image).xy, np.float64), None, None)]


def load_calib_targets() -> Detect:
    import calib_targets

    def board(found: Any) -> tuple[np.ndarray, np.ndarray, None]:
        pixels = np.array([c.position for c in found.corners], np.float64)
        return pixels, np.array([(c.grid.u, c.grid.v) for c in found.corners]), None

    return lambda image, sizes: [board(found) for found in calib_targets.detect_chessboard_all(image)]


DETECTORS: dict[str, Detector] = {
    "rigkit": Detector(load_rigkit),
    "libcbdetect": Detector(load_libcbdetect),
    "PyCBD": Detector(load_pycbd),
    "chess-corners": Detector(load_chess_corners, boards=False),
    "calib-targets": Detector(load_calib_targets),
    "OpenCV classic": Detector(lambda: load_opencv(sector=False)),
    "OpenCV SB": Detector(lambda: load_opencv(sector=True)),
}
PEERS = tuple(name for name in DETECTORS if name != "rigkit")
INSTALL = (
    "python -m venv PEERS && PEERS/bin/pip install libcbdetect chess-corners calib-targets && "
    "PEERS/bin/pip install --no-deps PyCBD, then --peers-python PEERS/bin/python"
)
"""libcbdetect wants another build of OpenCV than ours, hence the environment; what PyCBD wants besides (torch) serves
steps that are off by default."""


@dataclass(frozen=True)
class Answer:
    """What a detector made of an image.

    Attributes
    ----------
    boards : what it found.
    cpu_s : processor time of a call: the least of several.
    peak_mb : largest memory of its process so far, interpreter and image included.
    failed : why there is no answer ("" if there is one).
    """

    boards: Boards
    cpu_s: float
    peak_mb: float
    failed: str = ""


class Worker:
    """A detector in a process of its own.

    Attributes
    ----------
    missing : why the detector cannot be had ("" if it can).
    """

    def __init__(self, name: str, python: str = sys.executable) -> None:
        self.name, self.python = name, python
        self.missing = ""
        self._start()

    def _start(self) -> None:
        command = [self.python, os.path.abspath(__file__), self.name]
        try:
            self._process = subprocess.Popen(
                command,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                env=os.environ | ONE_THREAD,
            )
            self.missing = str(self._read(START_S))
        except (EOFError, OSError) as error:
            self.missing = f"its process did not start ({error})"

    def run(
        self, image: np.ndarray, sizes: list[tuple[int, int]], *, budget_s: float = 0.5, limit_s: float = 120.0
    ) -> Answer:
        """Detect in `image`; the call is repeated for `budget_s` of processor time, and given up after `limit_s`."""
        assert self._process.stdin is not None
        try:
            pickle.dump((image, sizes, budget_s), self._process.stdin)
            self._process.stdin.flush()
            found = self._read(limit_s)
        except (EOFError, BrokenPipeError) as error:
            self._restart()
            return Answer([], float("nan"), float("nan"), f"crashed ({type(error).__name__})")
        except TimeoutError:
            self._restart()
            return Answer([], float("nan"), float("nan"), f"more than {limit_s:.0f} s")
        return Answer(*found)

    def close(self) -> None:
        """End the process."""
        self._process.kill()
        self._process.wait()

    def _restart(self) -> None:
        self.close()
        self._start()

    def _read(self, limit_s: float) -> Any:
        stream = self._process.stdout
        assert stream is not None
        ready, _, _ = select.select([stream], [], [], limit_s)
        if not ready:
            raise TimeoutError(f"no answer in {limit_s:.0f} s")
        return pickle.load(stream)


def serve(name: str) -> None:
    """Answer pickled images on the standard streams until they end."""
    if hasattr(os, "sched_setaffinity"):
        cores = sorted(os.sched_getaffinity(0))
        os.sched_setaffinity(0, {cores[os.getpid() % len(cores)]})
    answers: BinaryIO = os.fdopen(os.dup(1), "wb")
    # Libraries that print must not disturb the answers.
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    try:
        detect = DETECTORS[name].load()
    except ImportError as error:
        pickle.dump(str(error), answers)
        answers.flush()
        return
    pickle.dump("", answers)
    answers.flush()
    while True:
        try:
            image, sizes, budget_s = pickle.load(sys.stdin.buffer)
        except EOFError:
            return
        try:
            answer = timed(detect, image, sizes, budget_s)
        except Exception as error:
            answer = ([], float("nan"), float("nan"), f"raised {type(error).__name__}: {error}")
        pickle.dump(answer, answers)
        answers.flush()


def timed(
    detect: Detect, image: np.ndarray, sizes: list[tuple[int, int]], budget_s: float
) -> tuple[Boards, float, float, str]:
    """Return the fields of `Answer`."""
    begin = time.process_time()
    boards = detect(image, sizes)
    first = time.process_time() - begin
    spent, best = first, first
    while spent < budget_s:
        begin = time.process_time()
        detect(image, sizes)
        last = time.process_time() - begin
        spent, best = spent + max(last, 1e-3), min(best, last)
    return boards, best, peak_mb(), ""


def peak_mb() -> float:
    """Return the largest memory that this process has held, MB."""
    status = Path("/proc/self/status")
    if status.exists():
        # ru_maxrss would start from the parent's.
        return float(status.read_text().split("VmHWM:")[1].split()[0]) / 1024.0
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0


if __name__ == "__main__":
    serve(sys.argv[1])
