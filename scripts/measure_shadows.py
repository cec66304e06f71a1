#!/usr/bin/env python3
"""Errors of corners close to the edge of a hard shadow, which is multiplied onto REAL images.

    python scripts/measure_shadows.py BOARDS=FOLDER ... [--left 0.25] [--count 18]

BOARDS as for compare_detection.py. Each set gets `--count` shadows, anywhere on the board and in any direction, with an
edge of 1 to 2 px. Printed are the recall relative to the image without shadow, of all corners and of those close to the
edge, and the RMS error of the latter per axis, over their sigma.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from detectors.degradations import Grey, shadowed

from rigkit.core.arrays import FloatArray
from rigkit.core.boards import Board
from rigkit.detection.detect import detect_boards
from rigkit.detection.saddles.response import grey_image
from rigkit.io.boards.board_words import board_of_words
from rigkit.io.media.images import IMAGE_ENDINGS, read_image

NEAR_PX = 12.0
"""So far from a shadow's edge corners are near it."""
SAME_PX = 2.0
"""A corner further off is another one."""
EDGE_PX = (1.0, 2.0)
"""Width of the edges: from 12 to 88 % of the light."""


def corners(image: Grey, board: Board) -> tuple[FloatArray, FloatArray]:
    """Return the corners (N, 2) of all that is found, and their sigmas (N,)."""
    found = detect_boards(image, [board])
    pixels = np.concatenate([np.empty((0, 2)), *(item.pixels for item in found)])
    return pixels, np.concatenate([np.empty(0), *(item.sigma_px for item in found)])


def measured(paths: Sequence[Path], board: Board, left: float, count: int) -> tuple[list[int], float]:
    """Return how many corners were found of all and of those near the edge, and error over sigma of the latter."""
    counts, ratios = [0, 0, 0, 0], [np.empty((0, 2))]
    for k in range(count):
        rng = np.random.default_rng(k)
        image = np.asarray(np.clip(grey_image(read_image(paths[k % len(paths)])), 0, 255), np.uint8)
        truth, _ = corners(image, board)
        if not len(truth):
            continue
        through, angle, width = truth[rng.integers(len(truth))] + rng.normal(0.0, 4.0, 2), *rng.uniform((0, 1), (1, 2))
        image = shadowed(image, through, 2.0 * np.pi * angle, width, left)
        pixels, sigma_px = corners(image, board)
        edge = np.abs((truth - through) @ (np.cos(2.0 * np.pi * angle), np.sin(2.0 * np.pi * angle))) < NEAR_PX
        seen = np.zeros(len(truth), bool)
        if len(pixels):
            apart = np.linalg.norm(pixels - truth[:, None], axis=2)
            at = apart.argmin(axis=1)
            seen = apart.min(axis=1) < SAME_PX
            ratios.append(((pixels[at] - truth) / sigma_px[at, None])[seen & edge])
        counts = [
            a + int(np.count_nonzero(b)) for a, b in zip(counts, (seen, seen | True, seen & edge, edge), strict=True)
        ]
    return counts, float(np.sqrt(np.mean(np.concatenate(ratios) ** 2)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sets", nargs="+", metavar="BOARDS=FOLDER")
    parser.add_argument("--left", type=float, default=0.25, help="of the light in the shadow")
    parser.add_argument("--count", type=int, default=18, help="shadows a set")
    args = parser.parse_args()
    print("| set | of all | near the edge | error over sigma |\n| :-- | --: | --: | --: |")
    for text in args.sets:
        words, _, folder = text.rpartition("=")
        paths = sorted(path for path in Path(folder).rglob("*") if path.suffix.lower() in IMAGE_ENDINGS)
        (seen, every, near, edge), ratio = measured(paths, board_of_words(words), args.left, args.count)
        print(f"| {Path(folder).name} | {seen} of {every} | {near} of {edge} | {ratio:.2f} |", flush=True)


if __name__ == "__main__":
    main()
