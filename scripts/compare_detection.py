#!/usr/bin/env python3
"""Compare the number of boards that rigkit and other detectors find in images, and in degraded copies of them.

    python scripts/compare_detection.py BOARDS=FOLDER ... [--only blur motion] [--most 12] [--save DIR]
                                        [--peers-python PYTHON] [--json FILE]

BOARDS are as in `rigkit detect --board`, joined by "+" if a picture shows several: "9x6x25=left",
"3x3x1+6x4x1=pictures", "aprilgrid:6x6x88,spacing=0.3=grids". All detectors know the boards. The truth is what any of
the detectors finds in the original image; the degradation determines its corners in the degraded copy. A board is
"whole" if all of its corners inside the image are found, "part" if some are, and "wrong" if more than a tenth of the
found corners are not the board's.

Chessboards: OpenCV's two detectors, and libcbdetect and calib-targets (each finds one board) if --peers-python has
them. ChArUco boards: cv2.aruco. AprilGrids: cv2.aruco, and pupil-apriltags if installed. Circle grids:
cv2.findCirclesGrid. Images in which others find more than rigkit are listed; --save writes them.
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import sys
import zlib
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import cv2
import numpy as np
from detectors.degradations import SAME, degraded, eight_bit
from detectors.peers import Worker

from rigkit.core.arrays import FloatArray
from rigkit.core.boards import Board
from rigkit.core.patterns.aprilgrid import AprilGrid
from rigkit.core.patterns.charuco import Charuco
from rigkit.core.patterns.chessboard import Chessboard
from rigkit.core.patterns.circles import Circles
from rigkit.detection.detect import detect_boards
from rigkit.io.boards.board_words import board_of_words
from rigkit.io.media.images import IMAGE_ENDINGS, read_image

AS_IS = ("as it is", 0.0)
DEGRADATIONS = (
    AS_IS,
    *(("blur", sigma_px) for sigma_px in (1.5, 2.0, 3.0, 4.0, 6.0)),
    *(("motion", length_px) for length_px in (5.0, 10.0, 15.0)),
    *(("noise", levels) for levels in (10.0, 25.0)),
    *(("jpeg", quality) for quality in (30.0, 10.0)),
    *(("gamma", exponent) for exponent in (0.4, 2.5)),
    *(("size", factor) for factor in (0.5, 1.0 / 3.0, 0.25)),
    *(("glare", levels) for levels in (200.0, 400.0)),
    *(("run over", px) for px in (1.0, 2.0, 3.0, -1.0, -2.0, -3.0)),
    ("repeated", 1.5),
    *(("hot columns", count) for count in (3.0, 20.0)),
    ("vignetting", 0.1),
    ("faint", 0.15),
    ("webcam", 6.0),
    ("covered", 0.15),
    ("cut", 0.5),
    *(("turned", degrees) for degrees in (90.0, 180.0)),
    ("inverted", 0.0),
    ("bits", 12.0),
)
SAME_CELLS = 0.3
"""A corner found within so many of the board's smallest steps of the right place is that corner."""
WRONG_PART, SAME_PART = 0.1, 0.5
"""More corners than this part that are none make a board wrong; more than half in common make two boards one."""
MORE = 0.1
"""Others find more of an image where they find so much more of its corners."""
LIMIT_S = 20.0

Find = Callable[[np.ndarray, Sequence[Board]], list[FloatArray]]


def _for(name: str, image: np.ndarray) -> np.ndarray:
    """Return `image` as the detector `name` takes it."""
    return image if name == "rigkit" else eight_bit(image)


def by_rigkit(image: np.ndarray, boards: Sequence[Board]) -> list[FloatArray]:
    return [item.pixels for item in detect_boards(image, boards)]


def by_aruco(image: np.ndarray, boards: Sequence[Board]) -> list[FloatArray]:
    """Return the corners of ChArUco boards, or those of the tags of AprilGrids, by cv2.aruco."""
    out = []
    for board in boards:
        pattern = board.pattern
        if isinstance(pattern, Charuco):
            dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, pattern.dictionary))
            ids = pattern.first_marker + np.arange(len(pattern.places(*board.size)))
            size = (board.columns + 1, board.rows + 1)
            target = cv2.aruco.CharucoBoard(size, board.square_x_mm, pattern.marker_mm, dictionary, ids)
            target.setLegacyPattern(pattern.legacy)
            seen = 255 - image if pattern.inverted else image
            corners, *_ = cv2.aruco.CharucoDetector(target).detectBoard(np.ascontiguousarray(seen))
            out += [] if corners is None else [np.asarray(corners, np.float64).reshape(-1, 2)]
        elif isinstance(pattern, AprilGrid):
            parameters = cv2.aruco.DetectorParameters()
            parameters.markerBorderBits = pattern.border
            parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
            dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, pattern.dictionary))
            quads, numbers, _ = cv2.aruco.ArucoDetector(dictionary, parameters).detectMarkers(image)
            out += [
                of_board(
                    np.array(quads, np.float64), [] if numbers is None else [int(n) for n in np.ravel(numbers)], board
                )
            ]
    return [corners for corners in out if len(corners)]


def of_board(quads: FloatArray, numbers: Sequence[int], board: Board) -> FloatArray:
    """Return the corners (N, 2) of the tags (M, 4, 2) that are of `board`, each tag once."""
    pattern = board.pattern
    assert isinstance(pattern, AprilGrid)
    quads = quads.reshape(-1, 4, 2)
    own = {n: quad for quad, n in zip(quads, numbers, strict=True) if n in pattern.numbers(*board.size)}
    return np.array(list(own.values()), np.float64).reshape(-1, 2)


def by_pupil(image: np.ndarray, boards: Sequence[Board]) -> list[FloatArray]:
    pupil = importlib.import_module("pupil_apriltags")
    out = []
    for board in boards:
        if isinstance(board.pattern, AprilGrid):
            tags = pupil.Detector(families=board.pattern.family, nthreads=1).detect(image)
            corners = np.array([tag.corners for tag in tags], np.float64)
            out.append(of_board(corners, [int(tag.tag_id) for tag in tags], board))
    return [corners for corners in out if len(corners)]


def by_circles_grid(image: np.ndarray, boards: Sequence[Board]) -> list[FloatArray]:
    flags = {"regular": cv2.CALIB_CB_SYMMETRIC_GRID, "asymmetric": cv2.CALIB_CB_ASYMMETRIC_GRID}
    out = []
    for board in boards:
        pattern = board.pattern
        if not isinstance(pattern, Circles) or pattern.layout not in flags:
            continue
        dark = 255 - image if pattern.inverted else image
        for extra in (0, cv2.CALIB_CB_CLUSTERING):
            known, centres = cv2.findCirclesGrid(dark, board.size, flags=flags[pattern.layout] | extra)
            if known:
                out.append(np.asarray(centres, np.float64).reshape(-1, 2))
                break
    return out


def by_worker(name: str, python: str) -> Find | None:
    """Return a detector of chessboards in a process of its own; None where it cannot be had."""
    worker = Worker(name, python)
    if worker.missing:
        print(f"{name}: left out, {worker.missing}", file=sys.stderr)
        return None

    def find(image: np.ndarray, boards: Sequence[Board]) -> list[FloatArray]:
        sizes = [board.size for board in boards if board.pattern.type == Chessboard.type]
        answer = worker.run(image, sizes, budget_s=0.0, limit_s=LIMIT_S)
        return [np.asarray(pixels, np.float64) for pixels, *_ in answer.boards]

    return find


def peers_of(boards: Sequence[Board], peers_python: str) -> dict[str, Find]:
    """Return the detectors that know the kind of the first of `boards`."""
    kind = boards[0].pattern.type
    found: dict[str, Find | None] = {}
    if kind == Chessboard.type:
        ours = {"OpenCV classic": sys.executable, "OpenCV SB": sys.executable}
        others = {} if peers_python == "" else {"libcbdetect": peers_python, "calib-targets": peers_python}
        found = {name: by_worker(name, python) for name, python in (ours | others).items()}
    elif kind == Circles.type:
        found = {"cv2.findCirclesGrid": by_circles_grid}
    else:
        found = {"cv2.aruco": by_aruco}
        if kind == AprilGrid.type:
            try:
                by_pupil(np.zeros((32, 32), np.uint8), boards)
                found["pupil-apriltags"] = by_pupil
            except ImportError as error:
                print(f"pupil-apriltags: left out, {error}", file=sys.stderr)
    return {name: find for name, find in found.items() if find is not None}


@dataclass(eq=False)
class Score:
    """What a detector found of the boards of some images."""

    boards: int = 0
    whole: int = 0
    parts: int = 0
    wrong: int = 0
    corners: int = 0
    found: int = 0

    def add(self, other: Score) -> None:
        for name in vars(other):
            setattr(self, name, getattr(self, name) + getattr(other, name))


def step_px(corners: FloatArray) -> float:
    """Return the smaller steps between corners: the tenth percentile of the distances to the nearest."""
    apart = np.linalg.norm(corners[:, None] - corners, axis=2)
    np.fill_diagonal(apart, np.inf)
    return float(np.quantile(apart.min(axis=1), 0.1))


def matched(corners: FloatArray, right: FloatArray) -> np.ndarray:
    """Return which of the `right` corners are among `corners`."""
    off = np.linalg.norm(right[:, None] - corners, axis=2).min(axis=1, initial=np.inf)
    return np.asarray(off < SAME_CELLS * step_px(right))


def agreed(found: dict[str, list[FloatArray]], asked: Sequence[Board]) -> list[FloatArray]:
    """Return the boards of an image: those of every detector, each once, whole ones first, then the larger ones."""
    whole = {board.columns * board.rows for board in asked}
    every = [part for parts in found.values() for part in parts if len(part) > 8]
    every.sort(key=lambda part: (len(part) in whole, len(part)), reverse=True)
    boards: list[FloatArray] = []
    for part in every:
        if all(matched(board, part).mean() < SAME_PART for board in boards):
            boards.append(part)
    return boards


def scored(found: Sequence[FloatArray], right: Sequence[FloatArray], size_px: tuple[int, int]) -> Score:
    """Return what of the boards `right` (places in this image) is found."""
    score = Score()
    rest = list(found)
    for corners in right:
        inside = corners[((corners > 1.0) & (corners < np.array(size_px) - 2.0)).all(axis=1)]
        if len(inside) < 9:
            continue
        mine = [part for part in rest if len(part) > 1 and matched(corners, part).mean() > SAME_PART]
        rest = [part for part in rest if not any(part is one for one in mine)]
        every = np.concatenate([*mine, np.zeros((0, 2))])
        count = int(matched(every, inside).sum())
        score.add(Score(boards=1, corners=len(inside), found=count))
        # What lies beyond the corners that the detectors agreed on may well be of the board.
        bad = sum(int(matched(corners, part).mean() < 1.0 - WRONG_PART) for part in mine)
        score.wrong += bool(bad)
        score.whole += count == len(inside)
        score.parts += 0 < count < len(inside)
    score.wrong += len(rest)
    return score


@dataclass(eq=False)
class Comparison:
    """Scores by degradation and detector, and what others find and rigkit does not."""

    scores: dict[tuple[str, float], dict[str, Score]] = field(default_factory=lambda: defaultdict(dict))
    more: list[str] = field(default_factory=list)

    def add(self, done: tuple[str, float], name: str, score: Score) -> None:
        self.scores[done].setdefault(name, Score()).add(score)


def compare(
    paths: Sequence[Path], boards: Sequence[Board], finders: dict[str, Find], only: Sequence[str], save: Path | None
) -> Comparison:
    """Return what `finders`, rigkit among them, make of the images."""
    out = Comparison()
    for path in paths:
        stored = read_image(path)
        original = eight_bit(stored)
        right = agreed({name: find(_for(name, stored), boards) for name, find in finders.items()}, boards)
        for done in DEGRADATIONS:
            if only and done[0] not in only:
                continue
            rng = np.random.default_rng(zlib.crc32(f"{path.name} {done}".encode()))
            image, map_ = (stored, SAME) if done == AS_IS else degraded(*done, original, rng)
            places = [corners @ map_[:, :2].T + map_[:, 2] for corners in right]
            size_px = (image.shape[1], image.shape[0])
            scores = {name: scored(find(_for(name, image), boards), places, size_px) for name, find in finders.items()}
            for name, score in scores.items():
                out.add(done, name, score)
            own = scores["rigkit"]
            for name, score in scores.items():
                lost = score.found - own.found
                if score.whole > own.whole or lost > MORE * max(score.corners, 1) or own.wrong > score.wrong:
                    counts = f"{name} {score.found} of {score.corners} corners, rigkit {own.found}"
                    wrong = f", {own.wrong} wrong" if own.wrong else ""
                    out.more.append(f"{path.parent.name}/{path.name} {done[0]} {done[1]:g}: {counts}{wrong}")
                    if save is not None:
                        save.mkdir(parents=True, exist_ok=True)
                        name = f"{path.parent.name}-{path.stem}-{done[0]}-{done[1]:g}.png"
                        cv2.imwrite(str(save / name), np.asarray(image, image.dtype))
    return out


def table(scores: dict[tuple[str, float], dict[str, Score]]) -> str:
    """Return what was found as Markdown: whole + parts of all boards, what is wrong, and corners in per cent."""
    names = sorted({name for row in scores.values() for name in row}, key=lambda name: name != "rigkit")
    lines = ["| done to the images | boards | " + " | ".join(names) + " |", "|:--|--:|" + "--:|" * len(names)]
    for done, row in scores.items():
        cells = []
        for name in names:
            score = row.get(name)
            if score is None:
                cells.append("")
                continue
            wrong = f" ({score.wrong} wrong)" if score.wrong else ""
            cells.append(f"{score.whole}+{score.parts}{wrong}, {100 * score.found / max(score.corners, 1):.1f} %")
        what = done[0] if done[1] == 0.0 else f"{done[0]} {done[1]:.3g}"
        lines.append(f"| {what} | {max(score.boards for score in row.values())} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def images_of(place: Path, most: int | None) -> list[Path]:
    """Return the images of a folder, or the one; at most so many, evenly taken."""
    every = sorted(p for p in place.iterdir() if p.suffix.lower() in IMAGE_ENDINGS) if place.is_dir() else [place]
    if most is None or len(every) <= most:
        return every
    return [every[k * len(every) // most] for k in range(most)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sets", nargs="+", metavar="BOARDS=FOLDER")
    parser.add_argument("--only", nargs="+", default=[], help="degradations to do, by name")
    parser.add_argument("--most", type=int, help="images of each folder")
    parser.add_argument("--save", type=Path, help="folder for images of which others find more")
    parser.add_argument("--peers-python", default="", help="interpreter that has libcbdetect and calib-targets")
    parser.add_argument("--json", type=Path, help="file to which the scores of each folder are added, a line each")
    args = parser.parse_args()
    cv2.setNumThreads(1)
    total = Comparison()
    workers: dict[str, dict[str, Find]] = {}
    for words in args.sets:
        declared, _, place = words.rpartition("=")
        boards = [board_of_words(word) for word in declared.split("+")]
        kind = boards[0].pattern.type
        if kind not in workers:
            workers[kind] = peers_of(boards, args.peers_python)
        mine = compare(
            images_of(Path(place), args.most), boards, {"rigkit": by_rigkit} | workers[kind], args.only, args.save
        )
        print(f"{place}\n\n{table(mine.scores)}\n", flush=True)
        print("\n".join(mine.more), flush=True)
        if args.json is not None:
            scores = [[*done, name, vars(score)] for done, row in mine.scores.items() for name, score in row.items()]
            with args.json.open("a") as file:
                file.write(json.dumps({"set": place, "scores": scores}) + "\n")
        for done, row in mine.scores.items():
            for name, score in row.items():
                total.add(done, name, score)
        total.more += mine.more
    if len(args.sets) > 1:
        print(f"\nall\n\n{table(total.scores)}\n\n{len(total.more)} times another detector found more")


if __name__ == "__main__":
    main()
