"""Compare circle grids with OpenCV: recall, and the error of cv2.calibrateCamera from each program's centres.

    python scripts/compare_circles.py --board circles.toml IMAGE...     REAL images
    python scripts/compare_circles.py --board circles.toml --worse IMAGE...
    python scripts/compare_circles.py                                   RENDERED ones, with the errors of the centres

With `--worse` real images are degraded in many ways. Printed are whole grids found, wrong grids, and the RMS
displacement of centres, per axis, from those in the original image; for rigkit also in its stated sigmas.

Errors on rendered images are compared with the Cramer-Rao bound of each circle. Then boards 60 degrees off the axis of
a fisheye lens and slanted by 60 degrees are rendered without noise: mean and largest errors. Both programs know the
board's size. OpenCV does not support hexagonal grids.
"""

from __future__ import annotations

import argparse
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from detection_bench.circle_bound import circle_information
from detection_bench.corner_bound import position_bound
from detection_bench.scenes import LENSES, BenchScene, bench_camera, bench_field_deg, one_board
from detectors.degradations import degraded, eight_bit

from rigkit.core.arrays import FloatArray
from rigkit.core.boards import Board
from rigkit.core.patterns.circles import Circles
from rigkit.detection.detect import detect_boards
from rigkit.detection.saddles.response import grey_image
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3
from rigkit.io.boards.board_file import load_board
from rigkit.io.media.images import read_image
from rigkit.synthetic.photometry import Photometry
from rigkit.synthetic.render import Optics
from rigkit.synthetic.scene import PlacedBoard

BLUR_PX, NOISE_LEVELS = 0.7, 2.0
OBLIQUE_DEG, SLANTED_SIZE_PX, DISTANCE_SQUARES = 60.0, (1280, 960), 9.0
FLAGS = {"regular": cv2.CALIB_CB_SYMMETRIC_GRID, "asymmetric": cv2.CALIB_CB_ASYMMETRIC_GRID}
WORSE = (
    *(("blur", px) for px in (1.0, 2.0, 3.0, 4.0)),
    *(("motion", px) for px in (5.0, 10.0)),
    *(("noise", levels) for levels in (5.0, 15.0)),
    ("jpeg", 10.0),
    ("sharpened", 3.0),
    ("glare", 200.0),
    ("vignetting", 0.1),
    *(("run over", px) for px in (1.0, 2.0, -1.0, -2.0)),
    *(("overexposed", times) for times in (1.5, 2.5)),
)
SAME_PX = 5.0
"""A grid whose centres lie further than this from those of the right one, in the median, is another: no degradation
moves them so far, and circles lie further apart."""
RENDERED = (
    Board("regular", 10, 8, 25.0, 25.0, pattern=Circles(diameter_mm=15.0)),
    Board("asymmetric", 4, 11, 40.0, 40.0, pattern=Circles("asymmetric", diameter_mm=16.0)),
)


Seen = tuple[FloatArray, FloatArray | None]
"""The centres (N, 2) of a whole board, row by row, and their sigmas (N,) where they are stated."""


def by_rigkit(image: np.ndarray, board: Board) -> Seen | None:
    found = [item for item in detect_boards(image, [board]) if item.board_id == board.board_id and item.complete]
    return (found[0].pixels, found[0].sigma_px) if found else None


def by_opencv(image: np.ndarray, board: Board) -> Seen | None:
    pattern = board.pattern
    if not isinstance(pattern, Circles) or pattern.layout not in FLAGS:
        return None
    dark = 255 - image if pattern.inverted else image
    # The second is for slanted views (cv2 documentation).
    for extra in (0, cv2.CALIB_CB_CLUSTERING):
        known, centres = cv2.findCirclesGrid(dark, board.size, flags=FLAGS[pattern.layout] | extra)
        if known:
            return np.asarray(centres, np.float64).reshape(-1, 2), None
    return None


FINDERS = {"rigkit": by_rigkit, "OpenCV": by_opencv}


def reprojection_rms_px(centres: Sequence[FloatArray], board: Board, size_px: tuple[int, int]) -> float:
    points = board.points().astype(np.float32)
    seen = [part.astype(np.float32)[:, None] for part in centres]
    rms, *_ = cv2.calibrateCamera([points] * len(seen), seen, size_px, np.eye(3), np.zeros(5))
    return float(rms)


def compare_real(paths: Sequence[Path], board: Board) -> None:
    images = [np.asarray(grey_image(read_image(path))) for path in paths]
    found = {name: [finder(image, board) for image in images] for name, finder in FINDERS.items()}
    common = [k for k in range(len(images)) if all(centres[k] is not None for centres in found.values())]
    size_px = (images[0].shape[1], images[0].shape[0])
    for name, centres in found.items():
        count = sum(part is not None for part in centres)
        line = f"{name:7s} {count} of {len(images)} images"
        chosen = [part[0] for part in centres if part is not None]
        if len(chosen) >= 3:
            line += f", calibrateCamera {reprojection_rms_px(chosen, board, size_px):.4f} px from all of them"
        shared = [part[0] for k in common if (part := centres[k]) is not None]
        if len(shared) >= 3:
            line += f", {reprojection_rms_px(shared, board, size_px):.4f} px from the {len(common)} of both"
        print(line)


@dataclass
class Worse:
    """What a detector makes of images that were made worse: whole grids, those that lie elsewhere, and by how much (N,)
    the centres of the others moved."""

    whole: int = 0
    wrong: int = 0
    moved: list[FloatArray] = field(default_factory=list)
    in_sigmas: list[FloatArray] = field(default_factory=list)

    def add(self, found: Seen | None, as_it_was: Seen | None, place: FloatArray) -> None:
        """Count what was `found` of a grid at `place` (N, 2), where the same detector saw it in the image as it was."""
        if found is None:
            return
        centres, sigma_px = found
        if np.median(nearest_px(centres, place)) > SAME_PX:
            self.wrong += 1
            return
        self.whole += 1
        if as_it_was is not None:
            off = nearest_px(centres, as_it_was[0])
            self.moved.append(off)
            self.in_sigmas += [] if sigma_px is None else [off / sigma_px]

    def words(self) -> str:
        wrong = f" ({self.wrong} wrong)" if self.wrong else ""
        if not self.moved:
            return f"{self.whole}{wrong}"
        rms = float(np.sqrt(np.mean(np.concatenate(self.moved) ** 2) / 2.0))
        sigmas = np.concatenate([*self.in_sigmas, np.zeros(0)])
        return f"{self.whole}{wrong}, {rms:.3f} px" + (
            f", {np.sqrt(np.mean(sigmas**2) / 2.0):.2f} sigmas" if len(sigmas) else ""
        )


def nearest_px(centres: FloatArray, others: FloatArray) -> FloatArray:
    """Return how far (N,) each of the `centres` (N, 2) lies from the nearest of the others."""
    return np.asarray(np.linalg.norm(centres[:, None] - others, axis=2).min(axis=1))


def compare_worse(paths: Sequence[Path], board: Board) -> None:
    """Print what detectors make of the images made worse, as Markdown."""
    images = {path.name: np.asarray(grey_image(read_image(path))) for path in paths}
    before = {name: {key: finder(image, board) for key, finder in FINDERS.items()} for name, image in images.items()}
    print("| done to the images | " + " | ".join(FINDERS) + " |\n|:--|" + "--:|" * len(FINDERS))
    for what, amount in WORSE:
        scores = {key: Worse() for key in FINDERS}
        for name, image in images.items():
            rng = np.random.default_rng(zlib.crc32(f"{name} {what} {amount}".encode()))
            worse = np.asarray(degraded(what, amount, eight_bit(image), rng)[0])
            place = next((seen[0] for seen in before[name].values() if seen is not None), None)
            for key, finder in FINDERS.items():
                if place is not None:
                    scores[key].add(finder(worse, board), before[name][key], place)
        print(f"| {what} {amount:g} | " + " | ".join(score.words() for score in scores.values()) + " |", flush=True)


def compare_rendered(count: int) -> None:
    for board in RENDERED:
        for lens in LENSES:
            off: dict[str, list[FloatArray]] = {name: [] for name in FINDERS}
            squared, bounds, relative = [], [], []
            for seed in range(count):
                rng = np.random.default_rng(seed)
                scene = one_board(rng, lens=lens, board=board)
                image = np.asarray(scene.render(blur_px=BLUR_PX, noise_levels=NOISE_LEVELS, rng=rng))
                truth = scene.truth()[0].pixels
                for name, finder in FINDERS.items():
                    seen = finder(image, board)
                    if seen is not None:
                        centres = seen[0]
                        nearest = np.linalg.norm(centres[:, None] - truth, axis=2).argmin(axis=1)
                        off[name].append(centres - truth[nearest])
                covariance = position_bound(circle_information(scene, BLUR_PX), NOISE_LEVELS)
                least = np.trace(covariance, axis1=1, axis2=2)
                for item in detect_boards(image, [board]):
                    nearest = np.linalg.norm(item.pixels[:, None] - truth, axis=2).argmin(axis=1)
                    error, known = item.pixels - truth[nearest], np.isfinite(least[nearest])
                    squared.append((error[known] ** 2).sum(axis=1))
                    bounds.append(least[nearest][known])
                    relative.append((error / item.sigma_px[:, None]) ** 2)
            words = (
                f"{name} {len(parts)} of {count}, rms {np.sqrt((np.concatenate(parts) ** 2).mean()):.4f} px"
                for name, parts in off.items()
                if parts
            )
            ratio = np.sqrt(np.concatenate(squared).mean() / np.concatenate(bounds).mean())
            reported = np.sqrt(np.concatenate(relative).mean())
            print(f"{board.board_id:10s} {lens:7s}", "; ".join(words), end="")
            print(f"; rigkit {ratio:.2f} bounds, errors over sigmas {reported:.2f}")


def compare_slanted(count: int) -> None:
    """Print by how much centres are off, without noise, at OBLIQUE_DEG off the axis and of slant."""
    camera = bench_camera("fisheye", SLANTED_SIZE_PX)
    for board in RENDERED:
        off = []
        for seed in range(count):
            rng = np.random.default_rng(seed)
            angle, turn = rng.uniform(0.0, 2.0 * np.pi, 2)
            # Facing the camera there, then slanted.
            facing = exp_so3(np.radians(OBLIQUE_DEG) * np.array([-np.sin(angle), np.cos(angle), 0.0]))
            axis = np.array([np.cos(turn), np.sin(turn), 0.0])
            rotation = facing @ exp_so3(np.radians(OBLIQUE_DEG) * axis)
            place = DISTANCE_SQUARES * board.square_x_mm * facing[:, 2] - rotation @ board.points().mean(axis=0)
            placed = PlacedBoard(board, Rigid3(rotation, place))
            scene = BenchScene("slanted", (placed,), (), camera, bench_field_deg("fisheye"))
            image = scene.render(optics=Optics(BLUR_PX), photometry=Photometry(bits=16))
            truth = scene.truth()[0]
            for item in detect_boards(image, [board]):
                nearest = np.linalg.norm(item.pixels[:, None] - truth.pixels, axis=2).argmin(axis=1)
                off.append(item.pixels - truth.pixels[nearest])
        every = np.concatenate(off)
        print(
            f"{board.board_id:10s} {OBLIQUE_DEG:g} degrees off the axis and slanted: {len(off)} of {count} boards, "
            f"{len(every)} circles, mean {np.linalg.norm(every.mean(axis=0)):.4f} px, "
            f"median {np.median(np.linalg.norm(every, axis=1)):.4f} px, "
            f"99 % {np.quantile(np.linalg.norm(every, axis=1), 0.99):.4f} px"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("images", nargs="*", type=Path)
    parser.add_argument("--board", type=Path)
    parser.add_argument("--worse", action="store_true", help="make the real images worse in many ways")
    parser.add_argument("--count", type=int, default=12, help="rendered images of each kind")
    args = parser.parse_args()
    if args.images and args.worse:
        compare_worse(args.images, load_board(args.board))
    elif args.images:
        compare_real(args.images, load_board(args.board))
    else:
        compare_rendered(args.count)
        compare_slanted(args.count)


if __name__ == "__main__":
    main()
