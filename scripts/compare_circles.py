"""Circle grids beside OpenCV: images found, and the error of cv2.calibrateCamera from either's centres.

    python scripts/compare_circles.py --board circles.toml IMAGE...     real images
    python scripts/compare_circles.py                                   rendered ones, with the errors of the centres

OpenCV is told the size, as rigkit is. It knows no hexagonal grids.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from rigkit.benchmark.scenes import one_board
from rigkit.core.arrays import FloatArray
from rigkit.core.boards import Board
from rigkit.core.patterns.circles import Circles
from rigkit.detection.detect import detect_boards
from rigkit.detection.saddles.response import grey_image
from rigkit.io.board_file import load_board
from rigkit.io.images import read_image

FLAGS = {"regular": cv2.CALIB_CB_SYMMETRIC_GRID, "asymmetric": cv2.CALIB_CB_ASYMMETRIC_GRID}
RENDERED = (
    Board("regular", 10, 8, 25.0, 25.0, pattern=Circles(diameter_mm=15.0)),
    Board("asymmetric", 4, 11, 40.0, 40.0, pattern=Circles("asymmetric", diameter_mm=16.0)),
)


def by_rigkit(image: np.ndarray, board: Board) -> FloatArray | None:
    """Return the centres (N, 2) of the whole board, row by row, or None."""
    found = [item for item in detect_boards(image, [board]) if item.board_id == board.board_id and item.complete]
    return found[0].pixels if found else None


def by_opencv(image: np.ndarray, board: Board) -> FloatArray | None:
    pattern = board.pattern
    if not isinstance(pattern, Circles) or pattern.layout not in FLAGS:
        return None
    dark = 255 - image if pattern.inverted else image
    # The second is for slanted views (cv2 documentation).
    for extra in (0, cv2.CALIB_CB_CLUSTERING):
        known, centres = cv2.findCirclesGrid(dark, board.size, flags=FLAGS[pattern.layout] | extra)
        if known:
            return np.asarray(centres, np.float64).reshape(-1, 2)
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
        chosen = [part for part in centres if part is not None]
        if len(chosen) >= 3:
            line += f", calibrateCamera {reprojection_rms_px(chosen, board, size_px):.4f} px from all of them"
        shared = [part for k in common if (part := centres[k]) is not None]
        if len(shared) >= 3:
            line += f", {reprojection_rms_px(shared, board, size_px):.4f} px from the {len(common)} of both"
        print(line)


def compare_rendered(count: int) -> None:
    for board in RENDERED:
        for lens in ("regular", "fisheye"):
            off: dict[str, list[FloatArray]] = {name: [] for name in FINDERS}
            for seed in range(count):
                rng = np.random.default_rng(seed)
                scene = one_board(rng, lens=lens, board=board)
                image = np.asarray(scene.render(noise_levels=2.0, rng=rng))
                truth = scene.truth()[0].pixels
                for name, finder in FINDERS.items():
                    centres = finder(image, board)
                    if centres is not None:
                        nearest = np.linalg.norm(centres[:, None] - truth, axis=2).argmin(axis=1)
                        off[name].append(centres - truth[nearest])
            words = (
                f"{name} {len(parts)} of {count}, rms {np.sqrt((np.concatenate(parts) ** 2).mean()):.4f} px"
                for name, parts in off.items()
                if parts
            )
            print(f"{board.board_id:10s} {lens:7s}", "; ".join(words))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("images", nargs="*", type=Path)
    parser.add_argument("--board", type=Path)
    parser.add_argument("--count", type=int, default=12, help="rendered images of each kind")
    args = parser.parse_args()
    if args.images:
        compare_real(args.images, load_board(args.board))
    else:
        compare_rendered(args.count)


if __name__ == "__main__":
    main()
