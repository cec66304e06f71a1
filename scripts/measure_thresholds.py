#!/usr/bin/env python3
"""Fit the weights of `rigkit.detection.checks.evidence`, which separate chessboards from other patterns.

    python scripts/measure_thresholds.py [--boards DIR ...] [--without DIR ...] [--seeds 12] [--worse 4]
    python scripts/measure_thresholds.py --circles [--boards DIR ...] [--without DIR ...]

Rendered boards (all conditions of the benchmark, blurs up to 3.5 px, squares down to 8 px) and rendered patterns (the
blank pictures of the benchmark, grids of dots) are always used; `--boards` adds folders of images of boards,
`--without` folders of images without boards. Each real image and pattern is used with degraded copies: blurred, noisy,
compressed, sharpened, faint, shrunk, covered, cut. Lattices at boards found in the original image are positives; other
lattices of such images are left out. As in a search, the finest level of the image's pyramid is followed by the corners
with motion blur, and by the coarser levels alone: of images with boards up to the first with a board's lattices, of
others all. Random blocks of codes and mosaics, which are real pieces of chessboards, are left
to `validate.is_compact`.

Prints the weights of a logistic regression (equal weights of the kinds of images; with the prior of
`rigkit.detection.checks.evidence`), its errors when cross-validated over kinds of images, and the scores, by the
weights in use, of the worst boards and of the patterns most similar to boards: the margin on both sides of 0.

With `--circles` it does the same for circle grids and `rigkit.detection.circles.evidence`: scores of the largest
lattice of each image of a grid, and of all lattices of other images.
"""

from __future__ import annotations

import argparse
import os
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import zlib

import cv2
import numpy as np
from detection_bench.blanks import BLANKS, blank
from detection_bench.circle_thresholds import BOARDS as CIRCLE_BOARDS
from detection_bench.circle_thresholds import print_circle_margins
from detection_bench.scenes import CONDITIONS, LENSES, one_board
from detectors.degradations import SAME, Grey, degraded
from numpy.typing import NDArray
from scipy.optimize import minimize

from rigkit.core.arrays import FloatArray
from rigkit.detection.checks.border import squares_end
from rigkit.detection.checks.evidence import (
    MIN_EXPECTED_CORNERS,
    OF_EXPECTED_SIZE,
    OF_WHOLE,
    OFFSET,
    SCORE,
    Evidence,
)
from rigkit.detection.checks.validate import has_bowed_edges, has_edge_offset, is_compact
from rigkit.detection.detect import detect_boards
from rigkit.detection.lattice.lattice import Lattice
from rigkit.detection.lattice.local_fit import fit_cells
from rigkit.detection.lattices import candidate_lattices
from rigkit.detection.saddles.bad_pixels import without_bad_pixels
from rigkit.detection.saddles.response import GreyImage, Level, grey_image
from rigkit.detection.searched_image import SearchedImage
from rigkit.detection.subpixel.refined import RefinedLattice
from rigkit.detection.subpixel.subpixel import refine
from rigkit.io.media.images import read_image

SIZES_PX = ((640, 480), (1280, 960), (320, 240))
MIN_CORNERS = 12
MIN_BOARD = 24
"""Smaller grids in images of boards may be parts of other things."""
BLURS_PX, NOISE_LEVELS = (1.5, 2.5, 3.5), 5.0
SQUARES_PX = (8.0, 12.0)
MIN_CELL_PX = 6.0
"""Boards of smaller squares, pictures of boards in the background among them, are listed apart."""
CHANCE = ("codes", "mosaic", "code")
CIRCLE_BLANKS = ("dots", "staggered")
"""Blank pictures for chessboards that show grids of circles."""
RIDGE = 1e-4
MAX_RAGGED = 4.0
"""The prior: what keeps weights near 0, and that of raggedness at most this far from it."""
SAME_CELLS, SAME_SHARE = 0.25, 0.9
"""A lattice is a board seen before where so much of it lies so near, in cells, to corners of that."""
SHOWN = 10
WORSE: dict[str, tuple[float, ...]] = {
    "noise": (10.0, 25.0),
    "faint": (0.15,),
    "gamma": (0.4, 2.5),
    "blur": (1.5, 3.0, 4.0),
    "sharpened": (2.0, 5.0),
    "jpeg": (30.0, 10.0),
    "size": (0.5, 0.34),
    "covered": (0.2,),
    "cut": (0.5,),
    "webcam": (6.0,),
}
"""What is done to images, and how much: see `detectors/degradations.py`."""
SUFFIXES = (".png", ".jpg", ".jpeg", ".pgm", ".bmp", ".tif", ".tiff")


@dataclass(frozen=True, eq=False, slots=True)
class Candidate:
    """A lattice that reached the judgement: which kind of image it is from, whether that shows boards, and whether the
    lattice is seen to end where it does."""

    kind: str
    image: str
    board: bool
    corners: int
    size: tuple[int, int]
    cell_px: float
    evidence: Evidence
    ends: bool

    def measures(self) -> list[float]:
        """Return the logarithms that are weighed."""
        return self.evidence.logarithms()


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


def worsened(grey: Grey, rng: np.random.Generator) -> tuple[str, Grey, FloatArray]:
    """Return what was done, a worse image, and the map (2, 3) of the first's pixels into it."""
    name = str(rng.choice(list(WORSE)))
    amount = WORSE[name][int(rng.integers(len(WORSE[name])))]
    image, moved = degraded(name, amount, grey, rng)
    return name, np.asarray(image, np.uint8), moved


def looks(name: str, pixels: NDArray[np.generic], times: int) -> Iterator[tuple[str, Grey, FloatArray]]:
    """Yield (what was done, image, map of the first's pixels into it) of an image and `times` worse ones."""
    seen: Any = grey_image(pixels)
    if seen.dtype == np.uint8:
        grey = np.asarray(seen)
    else:
        low, high = float(seen.min()), float(seen.max())
        grey = np.asarray((seen - low) * (255.0 / max(high - low, 1e-6)), np.uint8)
    yield "", grey, SAME
    rng = np.random.default_rng(zlib.crc32(name.encode()))
    for _ in range(times):
        yield worsened(grey, rng)


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


def judged(kind: str, image: str, board: bool, pixels: NDArray[np.generic], worse: int) -> list[Candidate]:
    """Return what of an image, and of `worse` ones made from it, reaches the judgement, whatever that says."""
    known = [item.pixels for item in detect_boards(pixels)] if board else []
    out = []
    for done, grey, moved in looks(image, pixels, worse):
        boards = [corners @ moved[:, :2].T + moved[:, 2] for corners in known]
        out += _judged(kind, f"{image} {done}".strip(), board, grey, boards)
    return out


def _judged(kind: str, image: str, board: bool, pixels: Grey, boards: list[FloatArray]) -> list[Candidate]:
    grey = without_bad_pixels(pixels)

    def promising(_: object, finest: Level, lattice: Lattice) -> bool:
        return not (lattice.solid and has_edge_offset(lattice, finest))

    least = MIN_BOARD if board else MIN_CORNERS
    size_px = (grey.shape[1], grey.shape[0])
    mine: list[RefinedLattice] = []
    for number, seen in enumerate(_searches(grey)):
        fitted = refine(grey, candidate_lattices(seen, MIN_CORNERS, promising))
        kept = [item for item in fitted if item.lattice.count >= least and is_compact(item.lattice, size_px)]
        if number:
            kept = [item for item in kept if not (item.lattice.solid and has_bowed_edges(item.lattice, seen.finest))]
        mine += [item for item in kept if not board or any(_of_board(item.lattice, corners) for corners in boards)]
        if board and mine:
            break
    return [
        Candidate(
            kind=kind,
            image=image,
            board=board,
            corners=item.lattice.count,
            size=item.lattice.size,
            cell_px=_cell_px(item.lattice),
            evidence=Evidence.of(item),
            ends=squares_end(grey, item.lattice),
        )
        for item in mine
    ]


def _searches(grey: GreyImage) -> Iterator[SearchedImage]:
    """Yield the corners of an image as `find_lattices` searches them, one after the other."""
    seen = SearchedImage.of(grey)
    yield seen
    if len(seen.saddles.smeared):
        yield seen.with_smeared()
    for k in range(1, len(seen.levels)):
        coarser = seen.coarser(k)
        if coarser is not None:
            yield coarser


def _of_board(lattice: Lattice, corners: FloatArray) -> bool:
    off = np.linalg.norm(lattice.pixels[lattice.known][:, None] - corners, axis=2).min(axis=1)
    return float(np.mean(off < SAME_CELLS * _cell_px(lattice))) > SAME_SHARE


def _cell_px(lattice: Lattice) -> float:
    """Return the median side of the cells, px."""
    return float(np.median(fit_cells(lattice.pixels, lattice.known, degree=1).cell_px()))


def fitted_weights(found: list[Candidate], left_out: tuple[bool, str] | None = None) -> FloatArray:
    """Return the weights of the measures and the offset of a logistic regression; kinds of images weigh the same.

    `left_out` is a kind, of boards or not, that has no say.
    """
    used = [c for c in found if (c.board, c.kind) != left_out]
    measures, sign = np.array([c.measures() for c in used]), np.array([1.0 if c.board else -1.0 for c in used])
    counts = Counter((c.board, c.kind) for c in used)
    kinds = Counter(board for board, _ in counts)
    weight = np.array([0.5 / kinds[c.board] / counts[c.board, c.kind] for c in used])
    mean, spread = measures.mean(axis=0), measures.std(axis=0)
    scaled = (measures - mean) / spread

    def cost(p: FloatArray) -> tuple[float, FloatArray]:
        z = sign * (scaled @ p[:-1] + p[-1])
        slope = -sign * weight / (1.0 + np.exp(np.clip(z, -50.0, 50.0)))
        value = float(weight @ np.logaddexp(0.0, -z) + RIDGE * p[:-1] @ p[:-1])
        return value, np.append(scaled.T @ slope + 2.0 * RIDGE * p[:-1], slope.sum())

    limits: list[tuple[float | None, float | None]] = [(None, 0.0)] * len(SCORE) + [(None, None)]
    ragged = list(SCORE).index("raggedness")
    limits[ragged] = (-MAX_RAGGED * spread[ragged], 0.0)
    best = minimize(cost, np.zeros(len(SCORE) + 1), jac=True, bounds=limits, method="L-BFGS-B").x
    return np.append(best[:-1] / spread, best[-1] - mean @ (best[:-1] / spread))


def cross_validated(found: list[Candidate]) -> tuple[int, int]:
    """Return how many boards are refused, and other patterns taken for boards, where their own kind had no say."""
    wrong = Counter[bool]()
    for board, kind in {(c.board, c.kind) for c in found}:
        *weights, offset = fitted_weights(found, (board, kind))
        for c in found:
            if (c.board, c.kind) == (board, kind) and (np.dot(weights, c.measures()) + offset > 0.0) != board:
                wrong[board] += 1
    return wrong[True], wrong[False]


def circle_looks(
    folders: list[Path], without: list[Path], seeds: int, worse: int
) -> Iterator[tuple[str, bool, NDArray[np.uint8]]]:
    """Yield (name, whether it shows a grid of circles, pixels) of rendered and real images and of worse ones."""
    images: list[tuple[str, bool, NDArray[np.generic]]] = []
    for seed in range(seeds):
        for board in CIRCLE_BOARDS:
            rng = np.random.default_rng(seed)
            image = one_board(rng, lens=LENSES[seed % len(LENSES)], board=board).render(noise_levels=2.0, rng=rng)
            images.append((f"{board.board_id} {seed}", True, image))
        images += [
            (f"{name} {seed}", False, blank(name, np.random.default_rng(seed), SIZES_PX[seed % 3]))
            for name in BLANKS
            if name not in CIRCLE_BLANKS
        ]
    images += [(image, True, pixels) for _, image, _, pixels in real(folders, True)]
    images += [(image, False, pixels) for _, image, _, pixels in real(without, False)]
    for name, shows, pixels in images:
        for done, grey, _ in looks(name, pixels, worse):
            if done not in ("covered", "cut"):
                yield f"{name} {done}".strip(), shows, grey


def print_sizes(found: list[Candidate]) -> None:
    """Print which sizes other patterns have by chance, and what the size of a board that is declared is worth."""
    large = [frozenset(c.size) for c in found if not c.board and c.corners >= MIN_EXPECTED_CORNERS]
    print(f"sizes of the {len(large)} of other patterns with {MIN_EXPECTED_CORNERS} corners or more, and log odds:")
    for size, count in Counter(large).most_common(SHOWN):
        short, long = min(size), max(size)
        print(f"  {long} x {short}: {count}, {np.log(len(large) / count):.1f}")
    print(f"  none of another size: {np.log(max(len(large), 1)):.1f} and more; in use: {OF_EXPECTED_SIZE}")
    whole = sum(c.evidence.raggedness == 1.0 for c in found if not c.board and c.corners >= MIN_EXPECTED_CORNERS)
    print(f"  {whole} lack no corner: {np.log(len(large) / max(whole, 1)):.1f} or more; in use: {OF_WHOLE}")
    near = [c for c in found if c.corners >= MIN_EXPECTED_CORNERS and -OF_EXPECTED_SIZE < c.evidence.score <= 0.0]
    for board, what in ((True, "boards"), (False, "other patterns")):
        ends = [c.ends for c in near if c.board is board]
        print(f"  {sum(ends)} of the {len(ends)} {what} whose size would decide are seen to end")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--boards", type=Path, nargs="*", default=[], help="folders of images of boards")
    parser.add_argument("--without", type=Path, nargs="*", default=[], help="folders of images without boards")
    parser.add_argument("--seeds", type=int, default=12, help="rendered pictures of each kind")
    parser.add_argument("--worse", type=int, default=4, help="worse images made from each")
    parser.add_argument("--circles", action="store_true", help="measure what tells grids of circles instead")
    args = parser.parse_args()
    if args.circles:
        print_circle_margins(circle_looks(args.boards, args.without, args.seeds, args.worse))
        return
    images = (*rendered(args.seeds), *real(args.boards, True), *real(args.without, False))
    found = [candidate for image in images for candidate in judged(*image, args.worse)]
    tiny = sorted(c.evidence.score for c in found if c.board and c.cell_px < MIN_CELL_PX)
    found = [c for c in found if not c.board or c.cell_px >= MIN_CELL_PX]
    print(f"boards with squares under {MIN_CELL_PX:g} px: {len(tiny)}, scores", ", ".join(f"{s:.1f}" for s in tiny))
    for board, what in ((True, "boards"), (False, "other patterns")):
        print(f"{what}: {sum(c.board is board for c in found)} lattices reach the judgement")
    *weights, offset = fitted_weights(found)
    print("fitted:  ", ", ".join(f"{n} {w:.2f}" for n, w in zip(SCORE, weights, strict=True)), f"offset {offset:.2f}")
    refused, taken = cross_validated(found)
    print(f"without a say of their kind: {refused} boards refused, {taken} other patterns taken for boards")
    print_sizes(found)
    print("in use:  ", ", ".join(f"{n} {w:.2f}" for n, w in SCORE.items()), f"offset {OFFSET:.2f}")
    print(
        "\n| score | image | corners | sigma, cells | scatter | excess residual | spacing change "
        "| contrast change | raggedness | blur, cells |"
    )
    print("|--:|:--|--:|--:|--:|--:|--:|--:|--:|--:|")
    for board in (True, False):
        mine = [c for c in found if c.board is board]
        ranked = sorted(mine, key=lambda c: c.evidence.score, reverse=not board)
        for c in ranked[:SHOWN]:
            print(
                f"| {c.evidence.score:.2f} | {c.image} | {c.corners} |", " | ".join(f"{v:.4f}" for v in c.evidence), "|"
            )
    lowest = min(c.evidence.score for c in found if c.board)
    others = [c.evidence.score for c in found if not c.board]
    below = f"other patterns up to {max(others):.2f}" if others else "no other pattern reaches the judgement"
    print(f"\nmargin: boards from {lowest:.2f} upwards, {below}; the limit is 0")


if __name__ == "__main__":
    main()
