#!/usr/bin/env python3
"""Measure corner detection on rendered scenes with exact truth: ours beside OpenCV's detectors and libcbdetect.

    python scripts/benchmark_detection.py [--scenes single trihedral fisheye room] [--poses 8] [--peers] [--json FILE]

Prints a Markdown table a scene: RMS of the corners found (px, per axis), recall, boards found complete, false boards,
predicted against actual error, CPU milliseconds of one thread. A corner counts as found within 1 px of the truth.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import cv2
import numpy as np
from scipy.spatial import cKDTree

from rigkit.boards import Board
from rigkit.cameras.base import Camera
from rigkit.cameras.kannala_brandt import KannalaBrandt
from rigkit.cameras.pinhole import Pinhole
from rigkit.corners.detect import detect_boards
from rigkit.geometry.rigid3 import Rigid3, cam_from_world_look_at
from rigkit.geometry.rotation import exp_so3
from rigkit.synthetic.photometry import Photometry, develop
from rigkit.synthetic.render import Optics, radiance
from rigkit.synthetic.scene import PlacedBoard, trihedral

FOUND_PX = 1.0
NOISES = {0.3: (0, 2, 5, 10), 0.7: (0, 2, 5, 10), 1.0: (0, 2, 5), 2.0: (0, 2, 5, 10)}


@dataclass(frozen=True)
class Found:
    """What a detector returns: corner sets, and sigma if it predicts one."""

    corners: list[np.ndarray]
    sigma_px: list[np.ndarray] | None = None


@dataclass(frozen=True)
class Scene:
    boards: tuple[PlacedBoard, ...]
    camera: Camera
    cam_from_world: Rigid3

    def truth(self) -> list[np.ndarray]:
        out = []
        for placed in self.boards:
            pixels, valid = placed.see(self.camera, self.cam_from_world)
            width, height = self.camera.size_px
            inside = valid & (pixels > 2.0).all(axis=1) & (pixels < [width - 3.0, height - 3.0]).all(axis=1)
            out.append(pixels[inside])
        return out


def regular(size_px: tuple[int, int]) -> Camera:
    width, height = size_px
    return Pinhole(size_px, np.array([0.85 * width, 0.85 * width, 0.5 * width - 0.5, 0.5 * height - 0.5]))


def fisheye(size_px: tuple[int, int]) -> Camera:
    width, height = size_px
    return KannalaBrandt(
        size_px,
        np.array([0.36 * width, 0.36 * width, 0.5 * width + 3.3, 0.5 * height - 2.7, -0.012, -0.004, 0.001, -0.0002]),
    )


def single(rng: np.random.Generator, size_px: tuple[int, int]) -> Scene:
    """One board of 10x10 corners that fills most of the image, tilted up to 40 degrees."""
    board = Board("b", 10, 10, 30.0, 30.0)
    while True:
        turn = exp_so3(np.array([*rng.uniform(-0.65, 0.65, 2), rng.uniform(-np.pi, np.pi)]))
        distance = rng.uniform(560.0, 720.0)
        centre = np.array([rng.uniform(-40, 40), rng.uniform(-30, 30), distance])
        placed = PlacedBoard(board, Rigid3(turn, centre - turn @ np.array([135.0, 135.0, 0.0])))
        scene = Scene((placed,), regular(size_px), Rigid3.identity())
        if len(scene.truth()[0]) == board.corner_count:
            return scene


def corner(rng: np.random.Generator, camera: Camera, near: float, far: float) -> Scene:
    """Three perpendicular boards of 8x6 corners."""
    boards = trihedral([Board(name, 8, 6, 50.0, 50.0) for name in "abc"])
    points = np.concatenate([b.points() for b in boards])
    while True:
        outward = np.mean([b.normal() for b in boards], axis=0) + rng.uniform(-0.22, 0.22, 3)
        target = points.mean(axis=0) + rng.uniform(-40, 40, 3)
        eye = target + outward / np.linalg.norm(outward) * rng.uniform(near, far)
        scene = Scene(boards, camera, cam_from_world_look_at(eye, target, -boards[1].normal()))
        if sum(map(len, scene.truth())) == 144:
            return scene


def room(rng: np.random.Generator, size_px: tuple[int, int]) -> Scene:
    """Nine boards of different sizes, some foreshortened, in a fisheye view."""
    camera = fisheye(size_px)
    placed = []
    for number in range(9):
        board = Board(f"r{number}", 7 + number % 2, 5 + number // 5, 55.0, 55.0)
        yaw, pitch = np.radians(-56.0 + 56.0 * (number % 3)), np.radians(-34.0 + 34.0 * (number // 3))
        ray = np.array([np.sin(yaw) * np.cos(pitch), np.sin(pitch), np.cos(yaw) * np.cos(pitch)])
        turn = cam_from_world_look_at(np.zeros(3), ray).rotation.T @ exp_so3(
            np.array([*rng.uniform(-0.6, 0.6, 2), rng.uniform(-0.4, 0.4)])
        )
        middle = np.array([27.5 * (board.columns - 1), 27.5 * (board.rows - 1), 0.0])
        placed.append(PlacedBoard(board, Rigid3(turn, ray * rng.uniform(1000, 1500) - turn @ middle)))
    return Scene(tuple(placed), camera, Rigid3.identity())


SCENES: dict[str, Callable[[np.random.Generator], Scene]] = {
    "single": lambda rng: single(rng, (640, 480)),
    "trihedral": lambda rng: corner(rng, regular((640, 480)), 1150.0, 1400.0),
    "trihedral-1600": lambda rng: corner(rng, regular((1600, 1200)), 1150.0, 1400.0),
    "fisheye": lambda rng: corner(rng, fisheye((640, 480)), 420.0, 540.0),
    "fisheye-1600": lambda rng: corner(rng, fisheye((1600, 1200)), 420.0, 560.0),
    "room": lambda rng: room(rng, (1600, 1200)),
}


def ours(image: np.ndarray, sizes: list[tuple[int, int]]) -> Found:
    del sizes
    found = detect_boards(image)
    return Found([item.pixels for item in found], [item.sigma_px for item in found])


def opencv(image: np.ndarray, sizes: list[tuple[int, int]], *, sector: bool) -> Found:
    """OpenCV's detectors, given the sizes; each board found is painted over before the next try."""
    image = image.copy()
    out = []
    for size in sizes:
        if sector:
            ok, corners = cv2.findChessboardCornersSB(image, size)
        else:
            ok, corners = cv2.findChessboardCorners(image, size)
        if not ok:
            continue
        corners = corners.reshape(-1, 1, 2).astype(np.float32)
        if not sector:
            grid = corners.reshape(size[1], size[0], 2)
            gaps = [np.linalg.norm(np.diff(grid, axis=axis), axis=2).min() for axis in (0, 1)]
            half = int(np.clip(0.4 * min(gaps), 2, 11))
            corners = cv2.cornerSubPix(image, corners, (half, half), (-1, -1), (3, 40, 1e-4))
        out.append(corners.reshape(-1, 2).astype(np.float64))
        cv2.fillConvexPoly(image, cv2.convexHull(corners).astype(np.int32), int(np.median(image)))
    return Found(out)


def libcbdetect(image: np.ndarray, sizes: list[tuple[int, int]]) -> Found:
    """libcbdetect as PyPI has it (pip install libcbdetect): it returns one board."""
    from libCBDetect import Checkerboard

    del sizes
    board = Checkerboard()
    board.show_processing = False
    board.array_norm_to_image(image / 255.0, *image.shape)
    board.find_corners()
    board.find_board_from_corners()
    u, v = np.zeros(board.rows * board.cols), np.zeros(board.rows * board.cols)
    if not len(u):
        return Found([])
    board.get_board_corners(u, v)
    return Found([np.stack([u, v], axis=1)])


def detectors(peers: bool) -> dict[str, Callable[[np.ndarray, list[tuple[int, int]]], Found]]:
    out: dict[str, Callable[[np.ndarray, list[tuple[int, int]]], Found]] = {"rigkit": ours}
    if peers:
        out["opencv classic + cornerSubPix"] = lambda image, sizes: opencv(image, sizes, sector=False)
        out["opencv SB"] = lambda image, sizes: opencv(image, sizes, sector=True)
        if importlib.util.find_spec("libCBDetect"):
            out["libcbdetect"] = libcbdetect
        else:
            print("libCBDetect is not importable (pip install libcbdetect): left out", file=sys.stderr)
    return out


@dataclass
class Score:
    errors: list[np.ndarray]
    ratios: list[np.ndarray]
    corners: int = 0
    found: int = 0
    boards: int = 0
    complete: int = 0
    false: int = 0
    images: int = 0
    seconds: float = 0.0

    def row(self) -> dict[str, float]:
        errors = np.concatenate(self.errors) if self.errors else np.full((1, 2), np.nan)
        ratios = np.concatenate(self.ratios) if self.ratios else np.full(1, np.nan)
        return {
            "rms_px": float(np.sqrt((errors**2).mean())),
            "worst_px": float(np.linalg.norm(errors, axis=1).max()),
            "recall": self.found / max(self.corners, 1),
            "complete": self.complete / max(self.boards, 1),
            "false_per_image": self.false / max(self.images, 1),
            "actual_over_predicted": float(np.sqrt((ratios**2).mean())),
            "cpu_ms": 1e3 * self.seconds / max(self.images, 1),
        }


def judge(score: Score, truth: list[np.ndarray], result: Found) -> None:
    every = np.concatenate(truth)
    tree = cKDTree(every)
    owner = np.repeat(np.arange(len(truth)), [len(t) for t in truth])
    hit = np.zeros(len(every), bool)
    for number, corners in enumerate(result.corners):
        distance, index = tree.query(corners)
        good = distance < FOUND_PX
        if good.mean() < 0.5:
            score.false += 1
            continue
        hit[index[good]] = True
        score.errors.append((corners - every[index])[good])
        if result.sigma_px is not None:
            score.ratios.append(((corners - every[index]) / result.sigma_px[number][:, None])[good].ravel())
    score.corners += len(every)
    score.found += int(hit.sum())
    score.boards += len(truth)
    score.complete += sum(bool(hit[owner == number].all()) for number in range(len(truth)))
    score.images += 1


def conditions(poses: list[Scene], only: list[int] | None) -> Iterator[tuple[str, list[np.ndarray]]]:
    """Yield (name, images) for every blur and noise."""
    for blur, noises in NOISES.items():
        light = [radiance(s.boards, s.camera, s.cam_from_world, optics=Optics(blur_px=blur)) for s in poses]
        for noise in noises if only is None else [n for n in noises if n in only]:
            photometry = Photometry(exposure=0.95, vignetting=0.25, gradient=(0.1, -0.05), noise_levels=float(noise))
            rng = np.random.default_rng(1000 + noise)
            yield f"blur {blur} noise {noise}", [np.asarray(develop(x, photometry, rng)) for x in light]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenes", nargs="+", default=["single", "trihedral", "fisheye"], choices=list(SCENES))
    parser.add_argument("--poses", type=int, default=6)
    parser.add_argument("--noise", nargs="+", type=int, help="only these noise levels")
    parser.add_argument("--peers", action="store_true", help="also run OpenCV's detectors and libcbdetect")
    parser.add_argument("--json", metavar="FILE", help="write the figures for programs")
    args = parser.parse_args()
    cv2.setNumThreads(1)
    chosen = detectors(args.peers)
    table: dict[str, dict[str, dict[str, dict[str, float]]]] = {}
    for name in args.scenes:
        rng = np.random.default_rng(7)
        poses = [SCENES[name](rng) for _ in range(args.poses)]
        print(f"\n## {name}, {args.poses} poses\n")
        head = None
        for condition, images in conditions(poses, args.noise):
            for detector, run in chosen.items():
                score = Score([], [])
                for scene, image in zip(poses, images, strict=True):
                    truth = scene.truth()
                    sizes = [placed.board.size for placed in scene.boards]
                    started = time.thread_time()
                    result = run(image, sizes)
                    score.seconds += time.thread_time() - started
                    judge(score, truth, result)
                row = score.row()
                if head is None:
                    head = ["condition", "detector", *row]
                    print("| " + " | ".join(head) + " |\n|" + "---|" * len(head))
                print(f"| {condition} | {detector} | " + " | ".join(f"{value:.4g}" for value in row.values()) + " |")
                table.setdefault(name, {}).setdefault(condition, {})[detector] = row
    if args.json:
        with open(args.json, "w", encoding="utf-8") as stream:
            json.dump(table, stream, indent=1)
    return 0


if __name__ == "__main__":
    sys.exit(main())
