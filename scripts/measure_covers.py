#!/usr/bin/env python3
"""Measure recall and false corners on REAL boards that are half covered.

    python scripts/measure_covers.py BOARD=FOLDER ... [--most 14] [--kinds flat texture hand] [--share 0.5] [--list]

BOARD is as in `rigkit detect --board`. In each image that shows nine tenths of its corners, half of the board is
covered in a random direction: by a straight cover of one grey level or random texture, or by a hand from one side. The
truth is the corners found without the cover. A corner is in view if the cover is more than half a square away; it is
false if it is more than a tenth of a square, or a pixel, from every true corner. Prints for each set and kind: boards
found (half of 12 corners or more in view), corners found of those in view, false ones and the worst of them, corners
whose sigma is a twentieth of the square or more, and of all others RMS error over sigma and how many are further off
than FAR_SIGMAS.
"""

from __future__ import annotations

import argparse
import os
import zlib
from dataclasses import dataclass
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import cv2
import numpy as np
from compare_detection import images_of
from detectors.degradations import Grey, eight_bit
from numpy.typing import NDArray

from rigkit.core.arrays import BoolArray, FloatArray
from rigkit.core.boards import Board
from rigkit.core.detections import BoardDetection
from rigkit.detection.detect import detect_boards
from rigkit.detection.lattice.local_fit import fit_cells
from rigkit.io.boards.board_words import board_of_words
from rigkit.io.media.images import read_image

KINDS = ("flat", "texture", "hand")
IN_VIEW, FALSE_CELLS, FALSE_PX, UNSURE_CELLS = 0.5, 0.1, 1.0, 0.05
"""As the head of this file says, in squares and px."""
FAR_SIGMAS = 5.0
NEARLY_ALL, FEWEST = 0.9, 12
"""Part of the corners by which a board is whole, and corners in view by which it is to be found."""
BEYOND_CELLS = 1.6
"""A straight cover goes so far beyond the board, in squares."""
FINGERS, FINGER_CELLS = 4, 1.1
"""Of a hand, and how wide one is, in squares."""


@dataclass(eq=False)
class Score:
    images: int = 0
    boards: int = 0
    in_view: int = 0
    found: int = 0
    false: int = 0
    unsure: int = 0
    worst_px: float = 0.0
    squared: float = 0.0
    counted: int = 0
    far: int = 0

    def add(self, other: Score) -> None:
        for name in vars(other):
            more = max if name == "worst_px" else float.__add__ if name == "squared" else int.__add__
            setattr(self, name, more(getattr(self, name), getattr(other, name)))

    def row(self) -> str:
        rms = f"{(self.squared / self.counted) ** 0.5:.2f}" if self.counted else ""
        worst = f" ({self.worst_px:.1f} px)" if self.false else ""
        seen = f"{self.found} of {self.in_view}"
        far = f"{self.far} of {self.counted}"
        return f"{self.boards} of {self.images} | {seen} | {self.false}{worst} | {self.unsure} | {rms} | {far}"


def cover(
    grey: Grey, truth: FloatArray, side_px: float, kind: str, share: float, rng: np.random.Generator
) -> BoolArray:
    """Return which pixels a cover lies on that takes about the part `share` of the corners `truth` (N, 2)."""
    angle = rng.uniform(0.0, 2.0 * np.pi)
    out = np.array([np.cos(angle), np.sin(angle)])
    along, across = truth @ out, truth @ np.array([-out[1], out[0]])
    edge = float(np.quantile(along, 1.0 - share))
    mask: NDArray[np.uint8] = np.zeros(grey.shape, np.uint8)
    v, u = np.mgrid[: grey.shape[0], : grey.shape[1]]
    if kind != "hand":
        hull = cv2.convexHull(truth.astype(np.float32)).reshape(-1, 2)
        cv2.fillConvexPoly(mask, np.rint(hull).astype(np.int32), 1)
        reach = 2 * int(BEYOND_CELLS * side_px) + 1
        wide = cv2.dilate(mask, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (reach, reach)))
        return np.asarray((wide > 0) & (out[0] * u + out[1] * v > edge))
    # Fingers of different lengths come from a palm beyond them.
    middle, low, high = float(np.median(across)), *(float(x) for x in np.quantile(across, (0.15, 0.85)))
    palm = edge + 0.5 * (float(along.max()) - edge)
    thick = max(int(FINGER_CELLS * side_px), 3)
    for place in np.linspace(low, high, FINGERS):
        tip = edge + rng.uniform(-0.5, 1.0) * side_px
        ends = [at * out + place * np.array([-out[1], out[0]]) for at in (tip, float(along.max()) + 3.0 * side_px)]
        first, last = (tuple(int(x) for x in np.rint(end)) for end in ends)
        cv2.line(mask, first, last, 1, thick)
    centre = (palm + 0.5 * (high - low)) * out + middle * np.array([-out[1], out[0]])
    size = 0.62 * np.array([high - low + thick, high - low + thick])
    box = (tuple(centre.tolist()), tuple((2.0 * size).tolist()), float(np.degrees(angle)))
    cv2.ellipse(mask, box, 1, -1)
    return np.asarray(mask > 0)


def laid_over(grey: Grey, mask: BoolArray, kind: str, rng: np.random.Generator) -> Grey:
    """Return the image with the cover: seen as sharply as the board, with a little noise."""
    height, width = grey.shape
    if kind == "flat":
        thing = np.full(grey.shape, rng.uniform(30.0, 220.0))
    elif kind == "texture":
        coarse, fine = (
            cv2.resize(rng.uniform(0.0, 255.0, (height // step + 1, width // step + 1)), (width, height))
            for step in (12, 4)
        )
        thing = np.asarray(0.6 * coarse + 0.4 * fine)
    else:
        inside = cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, 5)
        round_off = np.sqrt(np.clip(inside / max(float(inside.max()), 1.0), 0.0, 1.0))
        grain = cv2.GaussianBlur(rng.standard_normal(grey.shape), (0, 0), 2.0)
        thing = rng.uniform(90.0, 190.0) * (0.55 + 0.45 * round_off) + 12.0 * grain
    share = cv2.GaussianBlur(mask.astype(np.float64), (0, 0), 0.8)
    image = grey * (1.0 - share) + share * (thing + 1.5 * rng.standard_normal(grey.shape))
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def scored(found: list[BoardDetection], truth: FloatArray, sides: FloatArray, mask: BoolArray) -> Score:
    """Return what is right of `found`; `sides` (N,) of the squares at the corners `truth` (N, 2), px."""
    clear = cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, 5)
    column, row = np.rint(truth).astype(int).T
    in_view = clear[row, column] > IN_VIEW * sides
    # Fewer corners than rigkit reports are nobody's loss.
    least = int(in_view.sum()) >= FEWEST
    score = Score(images=int(least), in_view=int(in_view.sum()) if least else 0)
    seen = np.zeros(len(truth), np.bool_)
    for item in found:
        apart = np.linalg.norm(item.pixels[:, None] - truth, axis=2)
        nearest = apart.argmin(axis=1)
        off, side = apart.min(axis=1), sides[nearest]
        false = off > np.maximum(FALSE_CELLS * side, FALSE_PX)
        unsure = item.sigma_px > UNSURE_CELLS * side
        typical = ~false & ~unsure
        seen[nearest[~false]] = True
        score.add(
            Score(
                false=int(false.sum()),
                unsure=int(unsure.sum()),
                worst_px=float(off[false].max(initial=0.0)),
                squared=float((0.5 * (off / item.sigma_px)[typical] ** 2).sum()),
                counted=int(typical.sum()),
                far=int((off / item.sigma_px > FAR_SIGMAS)[typical].sum()),
            )
        )
    score.found = int((seen & in_view).sum()) if least else 0
    score.boards = int(least and 2 * score.found > score.in_view)
    return score


def measured(path: Path, board: Board, kinds: list[str], share: float) -> dict[str, Score]:
    """Return the scores of an image by kind of cover; none where the whole board is not seen without one."""
    grey = eight_bit(read_image(path))
    found = [item for item in detect_boards(grey, [board]) if (item.columns, item.rows) == board.size]
    lattice = max(found, key=lambda item: len(item.grid)).lattice() if found else np.full((1, 1, 2), np.nan)
    known = np.isfinite(lattice[..., 0])
    if known.mean() < NEARLY_ALL:
        return {}
    truth, sides = lattice[known], fit_cells(lattice, known).cell_px()
    out = {}
    for kind in kinds:
        rng = np.random.default_rng(zlib.crc32(f"{path.name} {kind}".encode()))
        mask = cover(grey, truth, float(np.median(sides)), kind, share, rng)
        image = laid_over(grey, mask, kind, rng)
        out[kind] = scored(list(detect_boards(image, [board])), truth, sides, mask)
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sets", nargs="+", metavar="BOARD=FOLDER")
    parser.add_argument("--most", type=int, default=14, help="images of each folder")
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=list(KINDS))
    parser.add_argument("--share", type=float, default=0.5, help="part of the board that is covered")
    parser.add_argument("--list", action="store_true", help="a line for each image that is not all right")
    args = parser.parse_args()
    cv2.setNumThreads(1)
    print("| set | cover | boards | in view | false (worst) | unsure | error / sigma | far |")
    print("|:--|:--|--:|--:|--:|--:|--:|--:|")
    total = {kind: Score() for kind in args.kinds}
    for words in args.sets:
        determined, _, place = words.rpartition("=")
        board = board_of_words(determined)
        mine = {kind: Score() for kind in args.kinds}
        for path in images_of(Path(place), args.most):
            for kind, score in measured(path, board, args.kinds, args.share).items():
                mine[kind].add(score)
                if args.list and (score.false or score.unsure or score.boards < score.images):
                    print(f"{path.parent.name}/{path.name}, {kind}: {score.row()}")
        for kind, score in mine.items():
            print(f"| {Path(place).name} {board.columns} x {board.rows} | {kind} | {score.row()} |", flush=True)
            total[kind].add(score)
    for kind, score in total.items():
        print(f"| all | {kind} | {score.row()} |")


if __name__ == "__main__":
    main()
