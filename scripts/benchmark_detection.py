#!/usr/bin/env python3
"""Measure corner detection on RENDERED scenes with exact truth, compared with other detectors and the Cramer-Rao bound.

    python scripts/benchmark_detection.py [--parts accuracy conditions peers speed pairs] [--poses 6] [--pairs 200]
                                          [--peers-python PYTHON] [--json FILE]

accuracy    errors at several blurs and noises, with the Cramer-Rao bound and the predicted sigmas
conditions  bad light, lens and sensor; boards cut, covered, small, many
peers       the same images through the detectors of scripts/detectors/peers.py, each in its own process
speed       image sizes, pictures without a board, memory
pairs       three identical boards in two rendered views: same corners, same indices

Prints Markdown tables, then a line for every requirement on the detector: required, measured, met or missed.
Distances are 2-D per corner (not per axis), in px; times are processor time of one thread, the least of several calls.
Other detectors are optional, and may be installed in another environment (--peers-python).
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import cv2
import numpy as np
from detection_bench.blanks import BLANKS, blank
from detection_bench.corner_bound import corner_information, position_bound
from detection_bench.pairs import EQUAL_BOARDS, PairVerdict, equal_boards_pair, evaluate_pair
from detection_bench.scenes import (
    BENCH_PHOTOMETRY,
    CONDITIONS,
    LENSES,
    SCENES,
    BenchScene,
    bench_field_deg,
    one_board,
    room,
    small_board,
    three_boards,
)
from detection_bench.score import FoundBoard, Score, score
from detectors.peers import DETECTORS, INSTALL, PEERS, Answer, Worker

from rigkit.core.errors import RigkitError
from rigkit.detection.detect import detect_boards
from rigkit.identification.identify import identify_pair
from rigkit.synthetic.photometry import develop
from rigkit.synthetic.render import Optics

PARTS = ("accuracy", "conditions", "peers", "speed", "pairs")
NOISES = {0.3: (0, 2), 0.7: (0, 2, 5, 10), 1.2: (2,), 2.0: (0, 5, 10)}
"""Noise levels measured at each blur (sigma, px)."""
ASKED_RMS_PX = {(0.3, 0): 0.003, (0.7, 0): 0.003, (0.7, 2): 0.008, (0.7, 5): 0.018, (2.0, 10): 0.075}
BOUND_FACTOR, BOUND_PX = 1.1, 0.002
SIGMA_BAND = 0.2
PLAIN = (0.7, 2)
"""Blur and noise of all parts that do not say otherwise."""
SIZES = {"640x480": (640, 480), "1600x1200": (1600, 1200), "12 MP": (4000, 3000), "20 MP": (5472, 3648)}
MAX_MS = {"640x480": 10.0, "1600x1200": 20.0, "12 MP": 60.0}


@dataclass(frozen=True)
class Asked:
    """A figure that is asked for, and what was measured."""

    what: str
    asked: str
    measured: str
    met: bool

    def line(self) -> str:
        return f"- {self.what}: asked {self.asked}, measured {self.measured}: {'met' if self.met else 'MISSED'}"


def at_most(what: str, limit: float, value: float, unit: str = "") -> Asked:
    return Asked(what, f"at most {limit:.4g}{unit}", f"{value:.4g}{unit}", value <= limit)


def at_least(what: str, limit: float, value: float) -> Asked:
    return Asked(what, f"at least {limit:.4g}", f"{value:.4g}", value >= limit)


class Tables:
    """Prints tables as they grow and keeps them for `--json`."""

    def __init__(self) -> None:
        self.rows: dict[str, list[dict[str, str | float]]] = {}

    def row(self, table: str, **cells: str | float) -> None:
        if table not in self.rows:
            self.rows[table] = []
            print(f"\n{table}\n\n| " + " | ".join(name.replace("_", " ") for name in cells) + " |")
            print("| " + " | ".join(":--" if isinstance(v, str) else "--:" for v in cells.values()) + " |")
        self.rows[table].append(cells)
        shown = (v if isinstance(v, str) else "" if np.isnan(v) else f"{v:.4g}" for v in cells.values())
        print("| " + " | ".join(shown) + " |", flush=True)


def images(scenes: Sequence[BenchScene], blur: float, noises: Iterable[int]) -> Iterator[tuple[int, list[np.ndarray]]]:
    """Yield (noise, an image of each scene)."""
    light = [scene.radiance(Optics(blur)) for scene in scenes]
    for noise in noises:
        rng = np.random.default_rng(1000 + noise)
        photometry = replace(BENCH_PHOTOMETRY, noise_levels=float(noise))
        yield noise, [np.asarray(develop(picture, photometry, rng)) for picture in light]


def measure(scenes: Sequence[BenchScene], pictures: Sequence[np.ndarray]) -> Score:
    pairs = zip(scenes, pictures, strict=True)
    return Score.sum([score(scene, [FoundBoard.of(d) for d in detect_boards(picture)]) for scene, picture in pairs])


def counts(total: Score) -> dict[str, str | float]:
    """Return the cells that say what was found."""
    return {
        "recall": total.recall,
        "whole_boards": f"{total.complete}/{total.boards}",
        "split": total.split,
        "false": total.false_boards,
        "wrong_index": total.wrong_indices,
    }


def accuracy(tables: Tables, poses: int) -> list[Asked]:
    """Errors beside the Cramer-Rao bound, over blur and noise."""
    kinds: dict[str, Callable[..., BenchScene]] = {"one board": one_board, "three boards": three_boards}
    totals: dict[tuple[str, str, float, int], tuple[Score, float]] = {}
    for lens in LENSES:
        for kind, make in kinds.items():
            scenes = [make(np.random.default_rng(seed), lens=lens) for seed in range(poses)]
            for blur, noises in NOISES.items():
                information = np.concatenate([x for scene in scenes for x in corner_information(scene, blur)])
                for noise, pictures in images(scenes, blur, noises):
                    total = measure(scenes, pictures)
                    trace = np.trace(position_bound(information, noise), axis1=1, axis2=2)
                    bound = float(np.sqrt(trace.mean()))
                    totals[kind, lens, blur, noise] = total, bound
                    tables.row(
                        f"## Accuracy, 640x480, {poses} poses",
                        scene=f"{kind}, {lens}",
                        blur=blur,
                        noise=noise,
                        **counts(total),
                        rms_px=total.rms_px,
                        bound_px=bound,
                        rms_over_bound=total.rms_px / bound,
                        worst_px=total.worst_px,
                        actual_over_predicted=total.actual_over_predicted if noise else float("nan"),
                    )
    out = []
    for (blur, noise), limit in ASKED_RMS_PX.items():
        what = f"blur {blur} noise {noise}, 640x480, px rms"
        out += [at_most(f"{k}, regular, {what}", limit, totals[k, "regular", blur, noise][0].rms_px) for k in kinds]
    for name, (total, bound) in totals.items():
        what = "{}, {}, blur {} noise {}, px rms, 1.1 bounds + 0.002".format(*name)
        limit = BOUND_FACTOR * bound + BOUND_PX
        if name[2:] in ASKED_RMS_PX or total.rms_px > limit:
            out.append(at_most(what, limit, total.rms_px))
    fisheye = totals["three boards", "fisheye", *PLAIN][0]
    out.append(at_most("three boards, fisheye, blur 0.7 noise 2, px rms", 0.012, fisheye.rms_px))
    out.append(at_most("the same, worst corner, px", 0.06, fisheye.worst_px))
    noisy = {name: total.actual_over_predicted for name, (total, _) in totals.items() if name[3] > 0}
    name, worst = max(noisy.items(), key=lambda item: abs(np.log(item[1])))
    what = "predicted sigma, actual / predicted, furthest from 1 ({}, {}, blur {} noise {})".format(*name)
    out.append(Asked(what, "0.8 to 1.2", f"{worst:.3f}", abs(worst - 1.0) <= SIGMA_BAND))
    for lens in LENSES:
        three = Score.sum([total for name, (total, _) in totals.items() if name[:2] == ("three boards", lens)])
        out.append(at_least(f"three boards, {lens}, all blurs and noises, recall", 1.0, three.recall))
        bad = three.false_boards + three.wrong_indices
        out.append(at_most(f"three boards, {lens}, false boards and wrong indices", 0, bad))
    return out


def conditions(tables: Tables, poses: int) -> list[Asked]:
    """Everything that is not plain."""
    out = []
    table = f"## Conditions, 640x480 (rooms 1600x1200), {poses} poses"

    def add(name: str, lens: str, total: Score) -> Score:
        sigma = total.actual_over_predicted
        tables.row(
            table,
            scene=f"{name}, {lens}",
            **counts(total),
            rms_px=total.rms_px,
            worst_px=total.worst_px,
            actual_over_predicted=sigma,
        )
        return total

    def drawn(make: object, lens: str, **settings: object) -> list[BenchScene]:
        return [make(np.random.default_rng(seed), lens=lens, **settings) for seed in range(poses)]  # type: ignore[operator]

    for lens in LENSES:
        scenes = drawn(three_boards, lens)
        for name, (optics, photometry) in CONDITIONS.items():
            light = [scene.radiance(optics) for scene in scenes]
            pictures = [develop(x, photometry, np.random.default_rng(seed)) for seed, x in enumerate(light)]
            total = add(f"three boards, {name}", lens, measure(scenes, pictures))
            out.append(at_least(f"three boards, {name}, {lens}, recall", 1.0, total.recall))
        for kind in ("partial", "covered"):
            scenes = drawn(SCENES[kind], lens)
            add(kind, lens, measure(scenes, next(images(scenes, PLAIN[0], PLAIN[1:]))[1]))
        for square_px in (5.0, 6.0):
            scenes = drawn(small_board, lens, square_px=square_px)
            total = add(f"squares of {square_px:g} px", lens, measure(scenes, next(images(scenes, 0.5, (2,)))[1]))
            out.append(at_least(f"squares of {square_px:g} px (blur 0.5 noise 2), {lens}, recall", 1.0, total.recall))
        scenes = [
            room(np.random.default_rng(seed), lens=lens, size_px=SIZES["1600x1200"], count=7 + seed % 6)
            for seed in range(poses)
        ]
        total = add("rooms of 7 to 12 boards", lens, measure(scenes, next(images(scenes, PLAIN[0], PLAIN[1:]))[1]))
        share = total.complete / total.boards
        out.append(at_least(f"rooms of 7 to 12 boards, {lens}, share of complete boards", 0.9, share))
        out.append(at_most("the same, false boards and wrong indices", 0, total.false_boards + total.wrong_indices))
    return out


def workers(names: Sequence[str], python: str) -> dict[str, Worker]:
    """Return the workers that can be had; says which cannot."""
    ours = ("rigkit", "OpenCV classic", "OpenCV SB")
    every = {name: Worker(name, sys.executable if name in ours else python) for name in names}
    missing = [name for name, worker in every.items() if worker.missing]
    if missing:
        reasons = "; ".join(f"{name}: {every[name].missing}" for name in missing)
        print(f"left out: {reasons} (to have them: {INSTALL})", file=sys.stderr)
    return {name: worker for name, worker in every.items() if name not in missing}


def peers(tables: Tables, poses: int, python: str) -> list[Asked]:
    """The same images through all detectors."""
    chosen = workers(("rigkit", *PEERS), python)
    scenes = {
        "one board, regular, 640x480": [one_board(np.random.default_rng(k)) for k in range(poses)],
        "three boards, regular, 640x480": [three_boards(np.random.default_rng(k)) for k in range(poses)],
        "three boards, fisheye, 640x480": [
            three_boards(np.random.default_rng(k), lens="fisheye") for k in range(poses)
        ],
        "three boards, regular, 1600x1200": [
            three_boards(np.random.default_rng(k), size_px=SIZES["1600x1200"]) for k in range(poses)
        ],
        "room of 9, fisheye, 1600x1200": [
            room(np.random.default_rng(k), lens="fisheye", size_px=SIZES["1600x1200"], count=9) for k in range(2)
        ],
        "three boards, regular, 12 MP": [three_boards(np.random.default_rng(0), size_px=SIZES["12 MP"])],
    }
    times: dict[tuple[str, str], float] = {}
    for name, group in scenes.items():
        pictures = next(images(group, PLAIN[0], PLAIN[1:]))[1]
        answers: dict[str, list[Answer]] = {detector: [] for detector in chosen}
        for scene, picture in zip(group, pictures, strict=True):
            for detector, worker in chosen.items():
                answers[detector].append(worker.run(picture, [b.board.size for b in scene.boards]))
        for detector, given in answers.items():
            total = Score.sum([score(s, [FoundBoard(*b) for b in a.boards]) for s, a in zip(group, given, strict=True)])
            times[name, detector] = 1e3 * float(np.median([a.cpu_s for a in given]))
            failed = sorted({a.failed for a in given} - {""})
            whole = f"{total.complete}/{total.boards}" if DETECTORS[detector].boards else "no boards"
            tables.row(
                f"## Beside other detectors, blur {PLAIN[0]} noise {PLAIN[1]}, {poses} poses",
                scene=name,
                detector=detector + "".join(f" ({reason})" for reason in failed),
                recall=total.recall,
                whole_boards=whole,
                false=total.false_boards,
                rms_px=total.rms_px,
                cpu_ms=times[name, detector],
                ratio_to_ours=times[name, detector] / times[name, "rigkit"],
            )
    for worker in chosen.values():
        worker.close()
    out = []
    for name in scenes:
        for peer, factor in (("libcbdetect", 10.0), ("calib-targets", 1.0)):
            if (name, peer) in times:
                ratio = times[name, peer] / times[name, "rigkit"]
                out.append(at_least(f"{name}: time of {peer} in ours", factor, ratio))
    return out


def speed(tables: Tables, poses: int) -> list[Asked]:
    """Image sizes, pictures without a board, memory."""
    out = []
    for size, size_px in SIZES.items():
        # A worker a size: its peak memory is that of the size.
        ours = Worker("rigkit")
        scenes = [three_boards(np.random.default_rng(k), size_px=size_px) for k in range(1 if "MP" in size else poses)]
        answers = [ours.run(p, [], budget_s=1.5) for p in next(images(scenes, PLAIN[0], PLAIN[1:]))[1]]
        with_boards = 1e3 * float(np.median([a.cpu_s for a in answers]))
        peak = answers[-1].peak_mb
        tables.row("## Speed and memory", picture=f"three boards, {size}", cpu_ms=with_boards, peak_mb=peak)
        if size in MAX_MS:
            out.append(at_most(f"three boards, {size}, time", MAX_MS[size], with_boards, " ms"))
        if size == "20 MP":
            out.append(at_most("20 MP, memory of the whole process", 1024.0, peak, " MB"))
        for name in BLANKS if size != "20 MP" else ():
            answer = ours.run(blank(name, np.random.default_rng(1), size_px), [], budget_s=0.7)
            without = 1e3 * answer.cpu_s
            tables.row("## Speed and memory", picture=f"{name}, {size}", cpu_ms=without, peak_mb=answer.peak_mb)
            what = f"no board ({name}), {size}"
            out.append(at_most(f"{what}: time over that with three boards", 1.0, without / with_boards))
            out.append(at_most(f"{what}: boards found", 0, len(answer.boards)))
        ours.close()
    return out


def pairs(tables: Tables, count: int) -> list[Asked]:
    """Three equal boards in two views."""
    verdicts: dict[str, dict[str, int]] = {}
    for seed in range(count):
        what, scene = equal_boards_pair(seed)
        views = scene.images(
            optics=Optics(PLAIN[0], field_deg=bench_field_deg(what.split(", ")[0])),
            photometry=replace(BENCH_PHOTOMETRY, noise_levels=float(PLAIN[1])),
            rng=np.random.default_rng(seed),
        )
        try:
            one, two = (detect_boards(v) for v in views)
            found = identify_pair(one, two, EQUAL_BOARDS, scene.camera1, scene.camera2)
            verdict = evaluate_pair(scene, found.pairs(), found.ambiguous)
        except RigkitError:
            verdict = PairVerdict.INCOMPLETE
        if verdict != PairVerdict.RIGHT:
            print(f"pair of seed {seed} ({what}): {verdict}", file=sys.stderr)
        group = verdicts.setdefault(what, dict.fromkeys(map(str, PairVerdict), 0))
        group[str(verdict)] += 1
    for what, group in verdicts.items():
        tables.row(f"## {count} pairs of three boards that look alike", views=what, **group)
    sums = {v: sum(group[v] for group in verdicts.values()) for v in map(str, PairVerdict)}
    tables.row(f"## {count} pairs of three boards that look alike", views="all", **sums)
    return [
        at_most(f"{count} pairs of three equal boards, wrong answers", 0, sums["wrong"]),
        at_least("the same, right or a stated tie", count, sums["right"] + sums["ambiguous"]),
    ]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--parts", nargs="+", default=list(PARTS), choices=PARTS)
    parser.add_argument("--poses", type=int, default=6, help="scenes a row")
    parser.add_argument("--pairs", type=int, default=200, help="pairs of three equal boards")
    parser.add_argument("--peers-python", default=sys.executable, help="interpreter that has the peers")
    parser.add_argument("--json", metavar="FILE", help="write the figures for programs")
    args = parser.parse_args()
    cv2.setNumThreads(1)
    tables = Tables()
    asked: list[Asked] = []
    for part in args.parts:
        if part == "accuracy":
            asked += accuracy(tables, args.poses)
        elif part == "conditions":
            asked += conditions(tables, args.poses)
        elif part == "peers":
            asked += peers(tables, args.poses, args.peers_python)
        elif part == "speed":
            asked += speed(tables, args.poses)
        else:
            asked += pairs(tables, args.pairs)
    print("\n## Asked\n")
    print("\n".join(item.line() for item in asked))
    missed = sum(not item.met for item in asked)
    print(f"\n{len(asked) - missed} of {len(asked)} met")
    if args.json:
        with open(args.json, "w", encoding="utf-8") as stream:
            json.dump({"tables": tables.rows, "asked": [vars(item) for item in asked]}, stream, indent=1)
    return 0


if __name__ == "__main__":
    sys.exit(main())
