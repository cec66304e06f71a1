"""Compare the coach's final error with that which `calibrate` states, and with the true error.

SIMULATED: five lenses and boards that are not flat. Each board is held where the coach asks, with a human's error,
until the coach says "enough". REAL: the images of a capture, in random order, are offered to the coach like photos in a
watched folder, until it says so. The truth is the lens, or the calibration from all images where boards were. `--rig`:
SIMULATED rigs of two equal lenses, 60 mm apart; errors are the largest of either lens and of both projections where
boards were, including the extrinsics. `--follow`: SIMULATED sessions continue to N frames whatever the coach says.

    python scripts/bench_coach.py [--seeds 5] [--lens NAME ...] [--goal 0.1]
        [--follow N | --rig | --real SET ... [--data DIR] [--cache DIR]]
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from bench_planner import BOARD, LENSES, NOISE_PX, SIZE, Lens, by_hand, true_error
from bench_rig_planner import MOUNT, NAMES
from halves.captures import CAPTURES
from planner.real import GRID, Images
from scipy.optimize import least_squares

from rigkit.calibration.calibrate import calibrate
from rigkit.calibration.certainty.displaced import uncertain_camera
from rigkit.calibration.result import Calibration
from rigkit.calibration.rig.result import RigCalibration
from rigkit.cameras.board_pose import cam_from_seen_board
from rigkit.cameras.compare import compare_cameras, grid_pixels
from rigkit.coach.full_rig_calibration import full_rig_calibration, remaining_errors_of_rig
from rigkit.coach.guide import Advice, CaptureGuide, GuideOptions
from rigkit.coach.look import FrameObservation
from rigkit.coach.rig import RigGuide
from rigkit.core.arrays import FloatArray, Pixels
from rigkit.core.detections import BoardView
from rigkit.core.reach import Reach
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3
from rigkit.planning.candidates import outline_mm
from rigkit.planning.goal import GOAL_GRID, projection_goal, rays_within
from rigkit.synthetic.scene import PlacedBoard

BOW_MM, TWIST_MM, WAVE_MM = 0.4, 0.12, 0.06
"""How far boards of 200 mm are from flat: bowed, twisted, and wavy as no warp is."""
WIDTH_DEG = {"tele-20": 20.0, "60": 60.0, "90": 90.0, "120": 120.0, "185": 240.0}
GUESSED_WRONG = 0.1
MAX_FRAMES, TRIES = 60, 5
GOALS_PX = (0.1, 0.12, 0.14, 0.17, 0.2, 0.25)
"""Of sessions that are followed: what is planned does not depend on the goal."""
SAME = 1.03
"""Goal reached, but all of `calibrate` states more than this part of it: said too early."""


@dataclass(frozen=True, slots=True)
class Session:
    """What was said at the end, what `calibrate` states, and what is true, px."""

    frames: int
    words: str
    said: float
    stated: float
    true: float
    model: str
    seconds: float

    @property
    def reached(self) -> bool:
        return self.words.startswith("Enough") and ", not " not in self.words

    def __str__(self) -> str:
        return (
            f"{self.frames:2d} frames, {'reached' if self.reached else 'not reached'}: said {self.said:.3f}, calibrate "
            f"states {self.stated:.3f}, true {self.true:.3f} px; {self.model}, longest wait {self.seconds:.1f} s"
        )


def see(placed: PlacedBoard, lens: Lens, image: str, rng: np.random.Generator) -> BoardView | None:
    """Return what a camera finds of a board that is not flat; None where it is too little."""
    points = BOARD.points().copy()
    along = points[:, :2] - points[:, :2].mean(axis=0)
    x, y = (2.0 * along / np.ptp(points[:, :2], axis=0)).T
    points[:, 2] += BOW_MM * (1.0 - x**2) + TWIST_MM * x * y + WAVE_MM * np.sin(1.5 * np.pi * y)
    there = placed.world_from_board.apply(points)
    pixels, valid = lens.camera.project(there)
    valid &= lens.camera.on_image(pixels)
    if lens.field_deg is not None:
        valid &= there[:, 2] >= np.cos(np.radians(0.5 * lens.field_deg)) * np.linalg.norm(there, axis=-1)
    if valid.sum() < 0.7 * len(valid):
        return None
    noisy = pixels[valid] + NOISE_PX * rng.standard_normal((int(valid.sum()), 2))
    noisy = np.clip(noisy, -0.5, np.array(SIZE) - 0.5)
    return BoardView(image, BOARD, BOARD.grid()[valid], noisy, np.full(len(noisy), NOISE_PX))


def ended(
    guide: CaptureGuide, advice: Advice, field_deg: float | None, seconds: float
) -> tuple[Calibration, dict[str, object]]:
    """Return the session's calibration, and what is to be said of it but the truth."""
    assert guide.size_px is not None
    found = calibrate(guide.views, guide.size_px, model="auto")
    known = uncertain_camera(found)
    stated = float(projection_goal(known.camera, field_deg).error(known.covariance))
    said = advice.remaining[0].error if advice.remaining else float("nan")
    return found, {
        "frames": len(guide.views),
        "words": advice.words,
        "said": said,
        "stated": stated,
        "model": found.camera.model,
        "seconds": seconds,
    }


def guided(name: str, goal_px: float, rng: np.random.Generator) -> Iterator[tuple[CaptureGuide, Advice, float]]:
    """Hold boards where the coach asks; yield it, what it says after each, and how long that took (s)."""
    lens = LENSES[name]
    width_deg = WIDTH_DEG[name] * (1.0 + GUESSED_WRONG * rng.uniform(-1.0, 1.0))
    reach = Reach(field_deg=lens.field_deg)
    guide = CaptureGuide(GuideOptions(boards=(BOARD,), hfov_deg=width_deg, goal_px=goal_px, reach=reach))
    nothing = FrameObservation(size_px=SIZE, view=None)
    for k in range(MAX_FRAMES):
        began = time.process_time()
        advice = guide.advise(nothing)
        yield guide, advice, time.process_time() - began
        asked = guide.requested_view(SIZE)
        held = (see(by_hand(asked.cam_from_board, BOARD, rng), lens, f"{k:03d}", rng) for _ in range(TRIES))
        view = next((one for one in held if one is not None), None)
        if view is not None:
            guide.add(view, SIZE)


def simulated(name: str, goal_px: float, rng: np.random.Generator) -> Session:
    lens, longest = LENSES[name], 0.0
    for guide, advice, seconds in guided(name, goal_px, rng):  # noqa: B007
        longest = max(longest, seconds)
        if advice.enough:
            break
    found, said = ended(guide, advice, lens.field_deg, longest)
    return Session(true=true_error(lens, found.camera), **said)  # type: ignore[arg-type]


def followed(name: str, frames: int, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Go on to so many frames, whatever is said; return true over stated errors after each from the first at which
    there may be enough, and where what is stated is first within each of GOALS_PX."""
    lens, errors = LENSES[name], list[tuple[float, float]]()
    for guide, advice, _ in guided(name, min(GOALS_PX), rng):
        if guide.has_many and guide.calibration is not None:
            errors.append((advice.remaining[0].error, true_error(lens, guide.calibration.camera)))
        if len(guide.views) >= frames:
            break
    first = [next((true / said for said, true in errors if said <= goal), np.nan) for goal in GOALS_PX]
    return np.array([true / said for said, true in errors]), np.array(first)[np.isfinite(first)]


def simulated_rig(name: str, goal_px: float, rng: np.random.Generator) -> Session:
    """Hold boards into the outlines that the coach of a pair of cameras shows, until it says that there are enough."""
    lens, empty = LENSES[name], FrameObservation(size_px=SIZE, view=None)
    options = GuideOptions(
        boards=(BOARD,), hfov_deg=WIDTH_DEG[name], goal_px=goal_px, reach=Reach(field_deg=lens.field_deg)
    )
    guide, longest = RigGuide(NAMES, options), 0.0
    for k in range(MAX_FRAMES):
        began = time.process_time()
        advice = guide.advise([empty, empty])
        longest = max(longest, time.process_time() - began)
        if advice.enough:
            break
        asked = shown_pose(lens, advice.targets)
        for _ in range(TRIES):
            held = by_hand(asked, BOARD, rng)
            views = [
                see(PlacedBoard(BOARD, pose @ held.world_from_board), lens, f"{own}-{k:03d}", rng)
                for own, pose in zip(NAMES, (Rigid3.identity(), MOUNT), strict=True)
            ]
            if any(view is not None for view in views):
                guide.add([FrameObservation(size_px=SIZE, view=view) for view in views])
                break
    whole = full_rig_calibration(
        [[frame_observation.view for frame_observation in frame] for frame in guide.frames], NAMES, [SIZE, SIZE]
    )
    assert whole is not None
    left = remaining_errors_of_rig(whole, options)
    return Session(
        frames=len(guide.frames),
        words=advice.words,
        said=max(own.error for own in advice.remaining) if advice.remaining else float("nan"),
        stated=max(own.error for own in left),
        true=max(true_error_of_rig(lens, whole), *(true_error(lens, own.camera) for own in whole.cameras)),
        model="/".join(own.camera.model for own in whole.cameras),
        seconds=longest,
    )


def shown_pose(lens: Lens, targets: Sequence[Pixels | None]) -> Rigid3:
    """Return where a board before a pair fills the first outline that is shown."""
    c, outline = next((c, target) for c, target in enumerate(targets) if target is not None)
    paper = outline_mm(BOARD)
    corners = outline[:: len(outline) // len(paper)]
    shown = np.isfinite(corners).all(axis=1)
    return (Rigid3.identity(), MOUNT)[c].inverse() @ cam_from_seen_board(lens.camera, corners[shown], paper[shown])


def true_error_of_rig(lens: Lens, rig: RigCalibration) -> float:
    """Return the rms error of the projections of a pair, px, of what lies before both cameras where boards were, after
    the best motion of the world."""
    boards = [view.cam_from_board.translation_mm for own in rig.cameras for view in own.calibration.views]
    rays = rays_within(lens.camera, grid_pixels(SIZE, GOAL_GRID).reshape(-1, 2), lens.field_deg)
    before = float(np.median(np.linalg.norm(boards, axis=-1))) * rays
    points = np.concatenate([before, MOUNT.inverse().apply(before)])
    poses = (Rigid3.identity(), MOUNT)
    exact = [lens.camera.project(pose.apply(points)) for pose in poses]
    seen = [valid & lens.camera.on_image(pixels) for pixels, valid in exact]

    def off(motion: FloatArray) -> FloatArray:
        moved = points @ exp_so3(motion[:3]).T + 100.0 * motion[3:]
        shown = [own.camera.project(own.cam_from_rig.apply(moved))[0] for own in rig.cameras]
        rows = [(a - b)[own] for a, (b, _), own in zip(shown, exact, seen, strict=True)]
        return np.nan_to_num(np.concatenate(rows)).ravel()

    found = least_squares(off, np.zeros(6))
    return float(np.sqrt(2.0 * (found.fun**2).mean()))


def real(images: Images, goal_px: float, rng: np.random.Generator) -> Session:
    """Offer the images of a capture, those left over once more, as long as some are taken."""
    size_px = images.full.camera.size_px
    board = images.views[0].board
    guide = CaptureGuide(GuideOptions(boards=(board,), hfov_deg=CAPTURES_DEG.get(images.name, 70.0), goal_px=goal_px))
    left: Sequence[int] = rng.permutation(len(images.views)).tolist()
    advice, longest = guide.advise(FrameObservation(size_px=size_px, view=None)), 0.0
    while left and not advice.enough:
        again = []
        for k in left:
            began = time.process_time()
            seen = FrameObservation(size_px=size_px, view=images.views[k], edge_px=2.0, moved_px=0.0, contrast=150.0)
            advice = guide.advise(seen, photo=True)
            longest = max(longest, time.process_time() - began)
            if advice.enough:
                break
            if advice.take:
                guide.add(images.views[k], size_px)
            else:
                again.append(k)
        if len(again) == len(left):
            break
        left = again
    advice = guide.advise(FrameObservation(size_px=size_px, view=None))
    found, said = ended(guide, advice, None, longest)
    true = compare_cameras(images.full.camera, found.camera, grid=GRID, mask=images.mask).rms_px
    return Session(true=true, **said)  # type: ignore[arg-type]


CAPTURES_DEG = {"camodocal": 180.0, "ocam": 180.0, "fisheye-chess": 180.0, "ov-plane": 120.0}
"""Fields of view as somebody would tell them, where they are not usual."""


def together(name: str, sessions: Sequence[Session]) -> None:
    reached = [s for s in sessions if s.reached]
    early = sum(s.stated > SAME * s.said for s in reached)
    ratio = np.array([s.stated / s.said for s in sessions])
    print(
        f"== {name}: {np.median([s.frames for s in sessions]):.0f} frames (median), goal reached in {len(reached)} of "
        f"{len(sessions)}, in {early} of these `calibrate` states more; stated over said {np.median(ratio):.2f} "
        f"(at most {ratio.max():.2f}), true over stated {np.median([s.true / s.stated for s in sessions]):.2f} "
        f"(at most {max(s.true / s.stated for s in sessions):.2f})",
        flush=True,
    )


def follow(name: str, frames: int, seeds: int) -> None:
    each = [followed(name, frames, np.random.default_rng([seed, 5])) for seed in range(seeds)]
    for what, k in (("at each frame", 0), ("where it is first within a goal", 1)):
        ratio = np.concatenate([one[k] for one in each])
        print(
            f"{name}: true over stated error {what} ({len(ratio)} in {seeds} sessions): rms "
            f"{np.sqrt((ratio**2).mean()):.2f}, within it {(ratio <= 1.0).mean():.2f}, within 1.5 times "
            f"{(ratio <= 1.5).mean():.2f}",
            flush=True,
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--lens", nargs="+", choices=sorted(LENSES), default=list(LENSES))
    parser.add_argument("--goal", type=float, default=0.1, help="px")
    parser.add_argument("--follow", type=int, metavar="N", help="go on to N frames instead, whatever the coach says")
    parser.add_argument("--rig", action="store_true", help="pairs of cameras instead")
    parser.add_argument("--real", nargs="+", choices=sorted(CAPTURES), metavar="SET", help="of split_halves.py instead")
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--cache", type=Path, default=Path(tempfile.gettempdir()) / "split_halves")
    args = parser.parse_args()
    if args.follow:
        for name in args.lens:
            follow(name, args.follow, args.seeds)
        return
    for name in args.lens if args.real is None else args.real:
        images = None if args.real is None else Images.of(name, args.data, args.cache)
        sessions = []
        for seed in range(args.seeds):
            rng = np.random.default_rng([seed, 5])
            one = simulated_rig if args.rig else simulated
            sessions.append(one(name, args.goal, rng) if images is None else real(images, args.goal, rng))
            print(f"{name:8s} {seed}: {sessions[-1]}", flush=True)
        together(name, sessions)


if __name__ == "__main__":
    main()
