"""Measure how many pictures `rigkit plan rig.json` saves for SIMULATED rigs of two equal lenses.

Both cameras see the board in six frames. Then three more are taken, held where the plan asks, with a human's error, or
at random. The goal is the error of both cameras' projections where boards are, including the extrinsics: "stated" is
from the rig's covariance, "true" from the true errors of its parameters.

    python scripts/bench_rig_planner.py [--seeds 8] [--lens NAME ...]
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable

import numpy as np
from bench_planner import BOARD, LENSES, SIZE, Lens, by_hand, free_poses, see

from rigkit.calibration.rig.calibrate import calibrate_rig
from rigkit.calibration.rig.result import RigCalibration
from rigkit.core.arrays import FloatArray
from rigkit.core.detections import BoardView
from rigkit.core.errors import RigkitError
from rigkit.core.reach import Reach
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3, log_so3
from rigkit.synthetic.scene import PlacedBoard
from rigkit.validation.monitoring.evidence import Monitored
from rigkit.workflows.calibration.next_pictures import next_frames

NAMES = ("left", "right")
MOUNT = Rigid3(exp_so3(np.array([0.01, -0.03, 0.02])), [-60.0, 2.0, 3.0])
FRAMES, MORE = 6, 3

Views = dict[str, list[tuple[str, BoardView]]]


def seen(frames: Iterable[tuple[str, PlacedBoard]], lens: Lens, rng: np.random.Generator) -> Views:
    """Return what both cameras see of boards, which are placed before the left one."""
    views: Views = {name: [] for name in NAMES}
    for frame, placed in frames:
        for name, pose in zip(NAMES, (Rigid3.identity(), MOUNT), strict=True):
            own = PlacedBoard(placed.board, pose @ placed.world_from_board)
            view = see(own, lens, f"{name}-{frame}", rng)
            if view is not None:
                views[name].append((frame, view))
    return views


def together(*parts: Views) -> Views:
    return {name: [entry for part in parts for entry in part[name]] for name in NAMES}


def calibrated(views: Views, lens: Lens) -> RigCalibration:
    degree = 5 if lens.camera.model == "brown" else None
    return calibrate_rig(views, dict.fromkeys(NAMES, SIZE), model=lens.camera.model, degree=degree, folds=0)


def monitored(rig: RigCalibration) -> Monitored:
    """Return a rig as its file would have it."""
    return Monitored(
        names=tuple(c.name for c in rig.cameras),
        cameras=tuple(c.camera for c in rig.cameras),
        cam_from_rig=tuple(c.cam_from_rig for c in rig.cameras),
        covariance=rig.covariance,
        sigma_px=rig.sigma_px,
        overdispersion=rig.overdispersion,
        freedom=rig.freedom,
    )


def off(rig: RigCalibration, lens: Lens) -> FloatArray:
    """Return by how much parameters and mount are off."""
    lenses = [c.camera.parameters - lens.camera.parameters for c in rig.cameras]
    pose = rig.cameras[1].cam_from_rig
    turn = log_so3(pose.rotation @ MOUNT.rotation.T)
    return np.concatenate([*lenses, turn, pose.translation_mm - MOUNT.translation_mm])


def session(lens: Lens, rng: np.random.Generator) -> list[float]:
    """Return what is stated and what is true after the first frames, with planned and with free ones, and what the plan
    promised."""
    free = free_poses(lens, rng)
    first = seen(((f"{k:03d}", next(free)) for k in range(FRAMES)), lens, rng)
    rig = calibrated(first, lens)
    plan = next_frames(monitored(rig), [BOARD], MORE, reach=Reach(field_deg=lens.field_deg))
    held = []
    for k, view in enumerate(plan.views):
        back = rig.cameras[NAMES.index(view.seen_by[0])].cam_from_rig.inverse()
        held.append((f"planned {k}", by_hand(back @ view.cam_from_board, BOARD, rng)))
    others = [(f"free {k}", next(free)) for k in range(MORE)]
    out = [plan.views[-1].error]
    for more in ([], held, others):
        now = calibrated(together(first, seen(more, lens, rng)), lens)
        change = off(now, lens)
        out += [float(plan.goal.error(now.covariance)), float(plan.goal.error(np.outer(change, change)))]
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=8)
    parser.add_argument("--lens", nargs="+", choices=sorted(LENSES), default=list(LENSES))
    args = parser.parse_args()
    print(f"| lens | promised | after {FRAMES} frames | {MORE} planned more | {MORE} free ones more |")
    print("| :-- | --: | --: | --: | --: |")
    for name in args.lens:
        rows = []
        for seed in range(args.seeds):
            try:
                rows.append(session(LENSES[name], np.random.default_rng([seed, 11])))
            except RigkitError as error:
                print(f"{name}, seed {seed}: {error}", flush=True)
        promised, *each = np.median(np.array(rows), axis=0)
        pairs = zip(each[::2], each[1::2], strict=True)
        cells = [f"{stated:.3f}, {true:.3f}" for stated, true in pairs]
        print(f"| {name} | {promised:.3f} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
