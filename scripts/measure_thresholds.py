#!/usr/bin/env python3
"""Measure what tells chessboards from other patterns: fit the weights of `rigkit.detection.checks.evidence` again.

    python scripts/measure_thresholds.py [--boards DIR ...] [--without DIR ...] [--seeds 12]

Rendered boards (all conditions of the benchmark, blurs up to 3.5 px, squares down to 8 px) and rendered patterns (the
blank pictures of the benchmark, grids of dots) are always measured; `--boards` adds folders of images of which every
large grid is a board, `--without` folders of images that show none. Every lattice that reaches the judgement counts;
chance blocks of codes and mosaics, which are true pieces of chessboards, are left to `validate.compact`.

Prints the weights of a logistic regression (classes of images weigh the same), then the scores of the boards seen
worst and of the patterns that resemble boards most, by the weights in use: the margin on both sides of 0.
"""

from __future__ import annotations

import argparse
import os
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from rigkit.benchmark.blanks import BLANKS, blank
from rigkit.benchmark.scenes import CONDITIONS, LENSES, one_board
from rigkit.detection.checks.evidence import MIN_SPACING_CHANGE, MIN_UNEXPLAINED, OFFSET, SCORE, Evidence
from rigkit.detection.checks.validate import compact, has_edge_offset
from rigkit.detection.lattice.lattice import Lattice
from rigkit.detection.lattice.local_fit import fit_cells
from rigkit.detection.lattices import candidates
from rigkit.detection.saddles.bad_pixels import without_bad_pixels
from rigkit.detection.saddles.response import GreyImage, Level, grey_image
from rigkit.detection.subpixel.subpixel import refine
from rigkit.io.images import read_image

SIZES_PX = ((640, 480), (1280, 960), (320, 240))
MIN_CORNERS = 12
MIN_BOARD = 24
"""Smaller grids in images of boards may be parts of other things."""
BLURS_PX, NOISE_LEVELS = (1.5, 2.5, 3.5), 5.0
SQUARES_PX = (8.0, 12.0)
MIN_CELL_PX = 6.0
"""Boards of smaller squares, pictures of boards in the background among them, are listed apart."""
CHANCE = ("codes", "mosaic")
RIDGE = 1e-3
SHOWN = 10
SUFFIXES = (".png", ".jpg", ".jpeg", ".pgm", ".bmp", ".tif", ".tiff")


@dataclass(frozen=True, eq=False, slots=True)
class Candidate:
    """A lattice that reached the judgement: which kind of image it is from, and whether that shows boards."""

    kind: str
    image: str
    board: bool
    corners: int
    cell_px: float
    evidence: Evidence

    def measures(self) -> list[float]:
        """Return the logarithms that are weighed."""
        sigma_cells, scatter, unexplained, change, raggedness = self.evidence
        return [
            float(np.log(sigma_cells)),
            float(np.log(scatter)),
            float(np.log(max(unexplained, MIN_UNEXPLAINED))),
            float(np.log(max(change, MIN_SPACING_CHANGE))),
            float(np.log(raggedness)),
        ]


def dot_grid(rng: np.random.Generator, size_px: tuple[int, int]) -> NDArray[np.uint8]:
    """Return an asymmetric grid of 6 x 8 dots, dark on light or light on dark, turned, blurred and noisy."""
    u, v = np.meshgrid(np.arange(size_px[0]) - 0.5 * size_px[0], np.arange(size_px[1]) - 0.5 * size_px[1])
    angle, depth = rng.uniform(0.0, np.pi), 1.0 + rng.uniform(-0.4, 0.4) / max(size_px) * u
    x, y = (np.cos(angle) * u + np.sin(angle) * v) / depth, (np.cos(angle) * v - np.sin(angle) * u) / depth
    pitch = min(size_px) / rng.uniform(6.0, 20.0)
    radius = rng.uniform(0.2, 0.42) * np.sqrt(0.5) * pitch
    squared = [sum((np.mod(part + shift, pitch) - 0.5 * pitch) ** 2 for part in (x, y)) for shift in (0.0, 0.5 * pitch)]
    inside = (np.abs(x) < 3.0 * pitch) & (np.abs(y) < 4.0 * pitch)
    image = np.where(inside & (np.minimum(*squared) < radius**2), 25.0, 205.0)
    image = 230.0 - image if rng.random() < 0.5 else image
    image = cv2.GaussianBlur(image, (0, 0), rng.uniform(0.6, 2.0)) + 2.0 * rng.standard_normal(image.shape)
    return np.asarray(np.clip(np.rint(image), 0, 255), np.uint8)


def rendered(seeds: int) -> Iterator[tuple[str, str, bool, NDArray[np.generic]]]:
    """Yield (kind, image, whether it shows a board, pixels)."""
    for seed in range(seeds):
        for name in BLANKS:
            if name not in CHANCE:
                yield name, f"{name} {seed}", False, blank(name, np.random.default_rng(seed), SIZES_PX[seed % 3])
        for k in range(3):
            yield "dot grid", f"dot grid {seed}.{k}", False, dot_grid(np.random.default_rng(3 * seed + k), SIZES_PX[k])
    for seed in range(max(seeds // 4, 1)):
        for lens in LENSES:
            scene = one_board(np.random.default_rng(seed), lens=lens)
            for name, (optics, photometry) in CONDITIONS.items():
                image = scene.render(rng=np.random.default_rng(seed), optics=optics, photometry=photometry)
                yield name, f"{name}, {lens} {seed}", True, image
            for blur_px in BLURS_PX:
                image = scene.render(rng=np.random.default_rng(seed), blur_px=blur_px, noise_levels=NOISE_LEVELS)
                yield "blurred", f"blur {blur_px}, {lens} {seed}", True, image
        for square_px in SQUARES_PX:
            scene = one_board(np.random.default_rng(seed), square_px=square_px)
            plain = replace(CONDITIONS["plain"][1], noise_levels=NOISE_LEVELS)
            image = scene.render(rng=np.random.default_rng(seed), photometry=plain)
            yield "small", f"squares of {square_px} px, {seed}", True, image


def real(folders: list[Path], board: bool) -> Iterator[tuple[str, str, bool, NDArray[np.generic]]]:
    """Yield likewise the images of `folders`."""
    for folder in folders:
        for path in sorted(item for item in folder.rglob("*") if item.suffix.lower() in SUFFIXES):
            yield folder.name, f"{folder.name}/{path.name}", board, read_image(path)


def judged(kind: str, image: str, board: bool, pixels: NDArray[np.generic]) -> list[Candidate]:
    """Return what of an image reaches the judgement, whatever that says."""
    grey = without_bad_pixels(grey_image(pixels))

    def promising(_: GreyImage, finest: Level, lattice: Lattice) -> bool:
        return not (lattice.solid and has_edge_offset(lattice, finest))

    least = MIN_BOARD if board else MIN_CORNERS
    size_px = (grey.shape[1], grey.shape[0])
    fitted = refine(grey, candidates(grey, MIN_CORNERS, promising))
    kept = [item for item in fitted if item.lattice.count >= least and compact(item.lattice, size_px)]
    return [
        Candidate(kind, image, board, item.lattice.count, _cell_px(item.lattice), Evidence.of(item)) for item in kept
    ]


def _cell_px(lattice: Lattice) -> float:
    """Return the median side of the cells, px."""
    return float(np.median(fit_cells(lattice.pixels, lattice.known, degree=1).cell_px()))


def fitted_weights(found: list[Candidate]) -> NDArray[np.float64]:
    """Return the weights of the measures and the offset of a logistic regression; kinds of images weigh the same."""
    measures, sign = np.array([c.measures() for c in found]), np.array([1.0 if c.board else -1.0 for c in found])
    counts = Counter((c.board, c.kind) for c in found)
    kinds = Counter(board for board, _ in counts)
    weight = np.array([0.5 / kinds[c.board] / counts[c.board, c.kind] for c in found])
    mean = measures.mean(axis=0)

    def cost(p: NDArray[np.float64]) -> float:
        score = (measures - mean) @ p[:-1] + p[-1]
        return float(weight @ np.logaddexp(0.0, -sign * score) + RIDGE * p[:-1] @ p[:-1])

    best = minimize(cost, np.zeros(measures.shape[1] + 1)).x
    return np.append(best[:-1], best[-1] - mean @ best[:-1])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--boards", type=Path, nargs="*", default=[], help="folders of images of boards")
    parser.add_argument("--without", type=Path, nargs="*", default=[], help="folders of images without boards")
    parser.add_argument("--seeds", type=int, default=12, help="rendered pictures of each kind")
    args = parser.parse_args()
    images = (*rendered(args.seeds), *real(args.boards, True), *real(args.without, False))
    found = [candidate for image in images for candidate in judged(*image)]
    tiny = sorted(c.evidence.score for c in found if c.board and c.cell_px < MIN_CELL_PX)
    found = [c for c in found if not c.board or c.cell_px >= MIN_CELL_PX]
    print(f"boards with squares under {MIN_CELL_PX:g} px: {len(tiny)}, scores", ", ".join(f"{s:.1f}" for s in tiny))
    for board, what in ((True, "boards"), (False, "other patterns")):
        print(f"{what}: {sum(c.board is board for c in found)} lattices reach the judgement")
    *weights, offset = fitted_weights(found)
    print("fitted:  ", ", ".join(f"{n} {w:.2f}" for n, w in zip(SCORE, weights, strict=True)), f"offset {offset:.2f}")
    print("in use:  ", ", ".join(f"{n} {w:.2f}" for n, w in SCORE.items()), f"offset {OFFSET:.2f}")
    print("\n| score | image | corners | sigma, cells | scatter | unexplained | spacing change | raggedness |")
    print("|--:|:--|--:|--:|--:|--:|--:|--:|")
    for board in (True, False):
        mine = [c for c in found if c.board is board]
        ranked = sorted(mine, key=lambda c: c.evidence.score, reverse=not board)
        for c in ranked[:SHOWN]:
            print(
                f"| {c.evidence.score:.2f} | {c.image} | {c.corners} |", " | ".join(f"{v:.4f}" for v in c.evidence), "|"
            )
    lowest = min(c.evidence.score for c in found if c.board)
    highest = max((c.evidence.score for c in found if not c.board), default=float("nan"))
    print(f"\nmargin: boards from {lowest:.2f} upwards, other patterns up to {highest:.2f}; the limit is 0")


if __name__ == "__main__":
    main()
