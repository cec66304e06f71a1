#!/usr/bin/env python3
"""Compare AprilGrids with the Cramer-Rao bound, pupil-apriltags, and motion capture.

    python scripts/compare_tags.py
    python scripts/compare_tags.py --board grid.toml IMAGE...
    python scripts/compare_tags.py --board grid.toml --calibration grid.json --body body0.csv --target data.csv IMAGE...

The first renders boards (RENDERED) and prints errors over the Cramer-Rao bound. The second prints tags found in REAL
images and processor time, also of pupil-apriltags if installed. The third compares board poses with tracked ones after
a hand-eye calibration. Tracked poses are CSV: time in ns, x, y, z in m, quaternion x, y, z, w. Images are named by
their time in ns.
"""

from __future__ import annotations

import argparse
import importlib
import os
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import cv2
import numpy as np
from detection_bench.corner_bound import position_bound
from detection_bench.scenes import LENSES, one_board
from detection_bench.tag_bound import tag_information
from detectors.degradations import eight_bit

from rigkit.calibration.hand_eye import hand_eye
from rigkit.core.boards import Board
from rigkit.core.detections import BoardView
from rigkit.core.patterns.aprilgrid import AprilGrid
from rigkit.detection.detect import detect_boards
from rigkit.detection.saddles.response import grey_image
from rigkit.geometry.rigid3 import Rigid3
from rigkit.io.boards.board_file import load_board
from rigkit.io.calibrations.calibration_file import load_calibration
from rigkit.io.media.images import read_image

BLUR_PX, NOISE_LEVELS = 0.7, 2.0


def rendered(count: int) -> None:
    for squares in (True, False):
        board = Board("k", 10, 8, 60.0, 60.0, pattern=AprilGrid(0.3, corner_squares=squares))
        for lens in LENSES:
            squared, bounds, relative, corners = [], [], [], 0
            for seed in range(count):
                rng = np.random.default_rng(seed)
                scene = one_board(rng, lens=lens, board=board)
                found = detect_boards(scene.render(blur_px=BLUR_PX, noise_levels=NOISE_LEVELS, rng=rng), [board])
                truth, bound = scene.truth()[0], np.full((board.rows, board.columns), np.nan)
                covariance = position_bound(tag_information(scene, BLUR_PX), NOISE_LEVELS)
                bound[truth.grid[:, 1], truth.grid[:, 0]] = np.trace(covariance, axis1=1, axis2=2)
                for item in found:
                    off = item.pixels - truth.lattice()[item.grid[:, 1], item.grid[:, 0]]
                    own = bound[item.grid[:, 1], item.grid[:, 0]]
                    seen = np.isfinite(own)
                    squared.append((off[seen] ** 2).sum(axis=1))
                    bounds.append(own[seen])
                    relative.append((off[seen] / item.sigma_px[seen, None]) ** 2)
                    corners += len(off)
            rms, best = (float(np.sqrt(np.concatenate(part).mean())) for part in (squared, bounds))
            each = float(np.sqrt((np.concatenate(squared) / np.concatenate(bounds)).mean()))
            z = float(np.sqrt(np.concatenate(relative).mean()))
            name = "Kalibr" if squares else "tags alone"
            print(f"{name}, {lens}: {corners} of {80 * count} corners, rms {rms:.4f} px, bound {best:.4f} px: ", end="")
            print(f"{rms / best:.2f}, corner by corner {each:.2f}; errors over sigmas {z:.2f}")


def spent_ms(call: Callable[[], object]) -> float:
    start = time.process_time()
    call()
    return 1e3 * (time.process_time() - start)


def real(paths: Sequence[Path], board: Board, turns: int) -> None:
    """Print tags and processor time. Detectors take turns, an image after the other: what else the machine does then
    falls on all of them, and the best turn of each is the least disturbed."""
    cv2.setNumThreads(1)
    images = [np.asarray(grey_image(read_image(path))) for path in paths]
    in_bytes = [eight_bit(grey) for grey in images]
    pattern = board.pattern
    assert isinstance(pattern, AprilGrid)
    calls: dict[str, Callable[[int], int]] = {
        "rigkit": lambda k: sum(len(item.grid) for item in detect_boards(images[k], [board])) // 4
    }
    try:
        peer = importlib.import_module("pupil_apriltags")
        for part in (1, 2):
            detect = peer.Detector(families=pattern.family, nthreads=1, quad_decimate=part).detect
            calls[f"pupil-apriltags 1/{part}"] = partial(lambda detect, k: len(detect(in_bytes[k])), detect)
    except ImportError:
        pass
    every = range(len(images))
    tags = np.array([[call(k) for k in every] for call in calls.values()])
    spent = np.array([[[spent_ms(partial(call, k)) for call in calls.values()] for k in every] for _ in range(turns)])
    best = spent.min(axis=0)
    for path, own, counts in zip(paths, best, tags.T, strict=True):
        words = (f"{name} {count} tags, {ms:.1f} ms" for name, count, ms in zip(calls, counts, own, strict=True))
        print(f"{path.name}:", "; ".join(words))
    for k, name in enumerate(calls):
        ratios = best[:, 0] / best[:, k]
        print(f"{name}: {tags[k].sum()} tags, {best[:, k].mean():.2f} ms an image", end="")
        print(f"; rigkit takes {np.median(ratios):.3f} of its time (median of the images)" if k else "")


class Track:
    """Poses of a body that is tracked: turns are interpolated between the two samples beside a moment."""

    def __init__(self, path: Path) -> None:
        from scipy.spatial.transform import Rotation, Slerp

        table = np.loadtxt(path, delimiter=",", skiprows=1)
        self.times, self.places_mm = table[:, 0], 1e3 * table[:, 1:4]
        self.turns = Slerp(self.times, Rotation.from_quat(table[:, 4:8]))

    def at(self, moment: float) -> Rigid3:
        place = [np.interp(moment, self.times, self.places_mm[:, k]) for k in range(3)]
        return Rigid3(self.turns(np.clip(moment, self.times[0], self.times[-1])).as_matrix(), place)


def tracked(paths: Sequence[Path], board: Board, calibration: Path, body: Path, target: Path) -> None:
    camera, hand, stand = load_calibration(calibration).camera, Track(body), Track(target)
    views = [
        BoardView.from_detection(path.name, item, [board])
        for path in paths
        for item in detect_boards(grey_image(read_image(path)), [board], camera=camera)
    ]
    moments = [float(Path(view.image).stem) for view in views]
    fitted = hand_eye(camera, views, [hand.at(t).inverse() @ stand.at(t) for t in moments])
    off_mm, angles = fitted.translation_residuals_mm, np.degrees(fitted.rotation_residuals_rad)
    print(
        f"{len(off_mm)} images: median {np.median(off_mm):.2f} mm, {np.median(angles):.3f} deg; "
        f"largest {off_mm.max():.2f} mm, {angles.max():.3f} deg"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("images", nargs="*", type=Path)
    parser.add_argument("--board", type=Path)
    parser.add_argument("--count", type=int, default=6, help="rendered images of each kind")
    parser.add_argument("--turns", type=int, default=7, help="each image is searched so many times by each detector")
    parser.add_argument("--calibration", type=Path)
    parser.add_argument("--body", type=Path)
    parser.add_argument("--target", type=Path)
    args = parser.parse_args()
    if args.calibration:
        tracked(args.images, load_board(args.board), args.calibration, args.body, args.target)
    elif args.images:
        real(args.images, load_board(args.board), args.turns)
    else:
        rendered(args.count)


if __name__ == "__main__":
    main()
