"""Measure how many pictures the planner saves, compared with sessions as people take them, and on real images.

SIMULATED: five lenses. Boards are held where the planner asks, with a human's error (5 degrees, 5 % of the distance,
2 % of it sideways), at random, or in a fixed pattern of twelve. Counted are the frames until the true projection error,
over the image and after the best rotation, reaches the final median of the random sessions. REAL: the planner chooses
some images of a capture, compared with as many at random; the error is the difference to the calibration from all
images. For comparison: plain greedy selection, and the figures for an exactly true covariance.

    python scripts/bench_planner.py [--seeds 20] [--lens NAME ...] [--real [--data DIR] [--cache DIR] [--draws 40]]
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from planner.real import GRID, REAL, Row, real, together

from rigkit.calibration.calibrate import calibrate
from rigkit.calibration.result import Calibration
from rigkit.cameras.base import Camera
from rigkit.cameras.brown import Brown
from rigkit.cameras.compare import compare_cameras, grid_pixels
from rigkit.cameras.kannala_brandt import KannalaBrandt
from rigkit.core.boards import Board
from rigkit.core.detections import BoardView
from rigkit.core.errors import RigkitError
from rigkit.core.reach import Reach
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3
from rigkit.planning.goal import projection_goal
from rigkit.planning.information import BoardPoses, CornerError, Knowledge
from rigkit.planning.plan import plan_views
from rigkit.synthetic.scene import PlacedBoard, place_board, sees_paper

SIZE = (1280, 960)
BOARD = Board("b", 9, 6, 25.0, 25.0)
NOISE_PX = 0.15
FREE_FRAMES = 20
FIRST_FRAMES = 3
"""Before so many there is no calibration: the planner goes by a guess of the lens that is 10 % wrong."""
HELD_DEG, HELD_DISTANCE, HELD_SIDEWAYS = 5.0, 0.05, 0.02


@dataclass(frozen=True, slots=True)
class Lens:
    """A lens, and how far it sees (None: over the whole image)."""

    camera: Camera
    field_deg: float | None = None


def _narrow(fov_deg: float, *distortion: float) -> Lens:
    f = 0.5 * SIZE[0] / np.tan(np.radians(0.5 * fov_deg))
    return Lens(Brown(SIZE, np.array([f, 1.001 * f, 651.0, 470.0, *distortion])))


def _wide(fov_deg: float, field_deg: float | None = None) -> Lens:
    f = 0.5 * (SIZE[0] if field_deg is None else SIZE[1] / 0.98) / np.radians(0.5 * fov_deg)
    return Lens(KannalaBrandt(SIZE, np.array([f, 1.001 * f, 648.0, 474.0, -0.015, 0.004, -0.001, 1e-4])), field_deg)


LENSES = {
    "tele-20": _narrow(20.0, 0.08, -0.5, 2e-4, -3e-4, 0.0),
    "60": _narrow(60.0, -0.19, 0.11, 3e-4, -2e-4, 0.0),
    "90": _narrow(90.0, -0.22, 0.06, 2e-4, -2e-4, -0.006),
    "120": _wide(120.0),
    "185": _wide(185.0, 185.0),
}


def see(placed: PlacedBoard, lens: Lens, image: str, rng: np.random.Generator) -> BoardView | None:
    """Return what the camera finds of a board: the corners in view, with noise; None where it is too little."""
    pixels, valid = placed.see(lens.camera, Rigid3.identity())
    if lens.field_deg is not None:
        points = placed.points()
        valid &= points[:, 2] >= np.cos(np.radians(0.5 * lens.field_deg)) * np.linalg.norm(points, axis=-1)
    if valid.sum() < 0.7 * len(valid):
        return None
    noisy = pixels[valid] + NOISE_PX * rng.standard_normal((int(valid.sum()), 2))
    noisy = np.clip(noisy, -0.5, np.array(lens.camera.size_px) - 0.5)
    return BoardView(image, placed.board, placed.board.grid()[valid], noisy, np.full(len(noisy), NOISE_PX))


def by_hand(pose: Rigid3, board: Board, rng: np.random.Generator) -> PlacedBoard:
    """Return the board held where it was asked for, as well as a person does."""
    middle = board.points().mean(axis=0)
    at = pose.apply(middle)
    axis = rng.standard_normal(3)
    turn = exp_so3(np.radians(HELD_DEG) * rng.standard_normal() * axis / np.linalg.norm(axis))
    far = float(np.linalg.norm(at))
    sideways = HELD_SIDEWAYS * far * rng.standard_normal(3)
    moved = at * (1.0 + HELD_DISTANCE * rng.standard_normal()) + sideways
    rotation = turn @ pose.rotation
    return PlacedBoard(board, Rigid3(rotation, moved - rotation @ middle))


def free_poses(lens: Lens, rng: np.random.Generator, board: Board = BOARD) -> Iterator[PlacedBoard]:
    """Yield boards as people hold them: mostly around the middle, near and far, moderately tilted."""
    width, height = lens.camera.size_px
    while True:
        spot = np.array([0.5 * width, 0.5 * height]) + np.array([0.22 * width, 0.22 * height]) * rng.standard_normal(2)
        square_px = height * rng.uniform(0.35, 0.9) / np.hypot(board.columns + 1, board.rows + 1)
        placed = place_board(board, lens.camera, spot, square_px, 40.0, rng)
        if placed is not None and sees_paper(placed, lens.camera, (0.0, 0.0), lens.camera.size_px):
            yield placed


def pattern_poses(lens: Lens, rng: np.random.Generator) -> Iterator[PlacedBoard]:
    """Yield the twelve of a usual instruction (nine places, each tilted a little, then three strong tilts in the
    middle), held by hand, and start again."""
    width, height = lens.camera.size_px
    places = [(u, v) for v in (0.28, 0.5, 0.72) for u in (0.28, 0.5, 0.72)] + [(0.5, 0.5)] * 3
    while True:
        for k, (u, v) in enumerate(places):
            for _ in range(40):
                square_px = height * (0.5 if k < 9 else 0.7) / np.hypot(BOARD.columns + 1, BOARD.rows + 1)
                placed = place_board(
                    BOARD, lens.camera, np.array([u * width, v * height]), square_px, 25.0 if k < 9 else 45.0, rng
                )
                if placed is None:
                    continue
                placed = by_hand(placed.world_from_board, BOARD, rng)
                if sees_paper(placed, lens.camera, (0.0, 0.0), lens.camera.size_px):
                    yield placed
                    break


def planned_poses(lens: Lens, rng: np.random.Generator, taken: list[BoardView]) -> Iterator[PlacedBoard]:
    """Yield the boards that the planner asks for, held by hand; `taken` grows while it is used."""
    wrong = lens.camera.parameters.copy()
    wrong[:2] *= 1.0 + 0.1 * rng.choice([-1.0, 1.0])
    wrong[2:4] = 0.5 * (np.array(SIZE) - 1.0)
    wrong[4:] = 0.0
    guess = lens.camera.with_parameters(wrong)
    reach = Reach(field_deg=lens.field_deg)
    held: list[Rigid3] = []
    whole = np.ones((1, BOARD.corner_count), dtype=bool)
    while True:
        calibration = solved(taken, lens) if len(taken) >= FIRST_FRAMES else None
        if calibration is None:
            knowledge = Knowledge.guessed(guess, CornerError(NOISE_PX))
            for pose in held:
                known = BoardPoses(BOARD.points(), pose.rotation[None], pose.translation_mm[None], whole)
                knowledge = knowledge.with_views(known)
        else:
            knowledge = Knowledge.of(calibration)
        goal = projection_goal(knowledge.camera, lens.field_deg)
        TIMES.append(-time.process_time())
        plan = plan_views(knowledge, [BOARD], goal, 1, reach=reach, last=held[-1] if held else None)
        TIMES[-1] += time.process_time()
        held.append(plan.views[0].cam_from_board)
        yield by_hand(held[-1], BOARD, rng)


TIMES: list[float] = []
"""CPU seconds of every suggestion."""


def solved(views: list[BoardView], lens: Lens) -> Calibration | None:
    """Return the calibration from `views`, None where they do not determine it."""
    model = lens.camera.model
    try:
        return calibrate(views, SIZE, model=model, degree=5 if model == "brown" else None, board="flat", folds=0)
    except RigkitError:
        return None


def true_error(lens: Lens, camera: Camera) -> float:
    """Return the rms error of the projection over what the lens sees, px, after the best rotation."""
    pixels = grid_pixels(SIZE, GRID)
    rays, valid = lens.camera.unproject(pixels)
    if lens.field_deg is not None:
        valid &= rays[..., 2] >= np.cos(np.radians(0.5 * lens.field_deg))
    try:
        return compare_cameras(lens.camera, camera, grid=GRID, mask=valid).rms_px
    except RigkitError:
        return np.inf


def errors_of(
    lens: Lens, frames: int, rng: np.random.Generator, poses: Callable[[list[BoardView]], Iterator[PlacedBoard]]
) -> np.ndarray:
    """Return the true error after each of `frames` pictures; infinite where there is no calibration yet."""
    taken: list[BoardView] = []
    out = np.full(frames, np.inf)
    for k, placed in zip(range(frames), poses(taken), strict=False):
        view = see(placed, lens, f"{k:03d}", rng)
        if view is not None:
            taken.append(view)
        calibration = solved(taken, lens) if len(taken) >= FIRST_FRAMES else None
        if calibration is not None:
            out[k] = true_error(lens, calibration.camera)
    return out


def frames_until(errors: np.ndarray, target: float) -> float:
    """Return how many frames it takes until the error is within `target` and stays there."""
    beyond = np.flatnonzero(errors > target)
    count = beyond[-1] + 2 if len(beyond) else 1
    return float(count) if count <= len(errors) else np.inf


def simulate(name: str, seeds: int) -> None:
    lens = LENSES[name]
    kinds: dict[str, Callable[[np.random.Generator], Callable[[list[BoardView]], Iterator[PlacedBoard]]]] = {
        "planned": lambda rng: lambda taken: planned_poses(lens, rng, taken),
        "random": lambda rng: lambda _: free_poses(lens, rng),
        "pattern": lambda rng: lambda _: pattern_poses(lens, rng),
    }
    found = {}
    for k, (kind, poses) in enumerate(kinds.items()):
        rngs = [np.random.default_rng([seed, k, 7]) for seed in range(seeds)]
        found[kind] = np.array([errors_of(lens, FREE_FRAMES, rng, poses(rng)) for rng in rngs])
    for kind, frames in (("random", FREE_FRAMES), ("pattern", 12)):
        target = float(np.median(found[kind][:, frames - 1]))
        free = np.median([frames_until(e[: 2 * frames], target) for e in found[kind]])
        planned = np.array([frames_until(e, target) for e in found["planned"]])
        ratio = np.median(planned) / min(free, frames)
        print(
            f"{name:8s} {kind:8s} target {target:6.3f} px: free {free:4.1f}, planned {np.median(planned):4.1f} "
            f"(worst {planned.max():4.1f}), ratio {ratio:.2f}",
            flush=True,
        )
    middle = {kind: np.median(e, axis=0) for kind, e in found.items()}
    for kind, e in middle.items():
        print(f"    {kind:8s} median error after 4, 6, 8, 10, 12, 20: {np.round(e[[3, 5, 7, 9, 11, 19]], 3).tolist()}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--lens", nargs="+", choices=sorted(LENSES), default=list(LENSES))
    parser.add_argument("--real", nargs="*", metavar="SET", help="real captures instead (see scripts/split_halves.py)")
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--cache", type=Path, default=Path(tempfile.gettempdir()) / "split_halves")
    parser.add_argument("--draws", type=int, default=40)
    args = parser.parse_args()
    if args.real is not None:
        args.cache.mkdir(parents=True, exist_ok=True)
        rows: dict[str, list[Row]] = {}
        for name in args.real or REAL:
            real(name, args.data, args.cache, args.draws, rows)
        together(rows)
        return
    for name in args.lens:
        simulate(name, args.seeds)
    print(f"one suggestion: median {1e3 * np.median(TIMES):.0f} ms, at most {1e3 * max(TIMES):.0f} ms of CPU")


if __name__ == "__main__":
    main()
