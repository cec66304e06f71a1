"""Does the sentinel alarm when something moved, name what, and keep quiet otherwise?

Simulated corners: cameras calibrated from planned views, checked with three fresh ones held by hand where the planner
asks (for a lens of which nothing is known: so the three say most). Changes leave 0.15 px rms over the image after the
best rotation; mounts turn by 0.02 degrees. Real captures: calibrated from images at random but three, checked with
these three: nothing has changed.

    python scripts/bench_sentinel.py [--seeds 20] [--lens NAME ...] [--rig] [--real [SET ...]] [--noise 0.03]
"""

from __future__ import annotations

import argparse
import tempfile
from collections import Counter
from pathlib import Path

import numpy as np
from bench_planner import BOARD, LENSES, Lens, by_hand
from split_halves import load

from rigkit.calibration.calibrate import calibrate
from rigkit.calibration.rig.calibrate import calibrate_rig
from rigkit.cameras.base import Camera
from rigkit.core.detections import BoardView
from rigkit.core.errors import RigkitError
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3
from rigkit.planning.candidates import Reach
from rigkit.planning.goal import projection_goal
from rigkit.planning.information import CornerError, Knowledge
from rigkit.planning.plan import plan_views
from rigkit.validation.sentinel.evidence import FreshView, Watched
from rigkit.validation.sentinel.judge import SentinelCheck, check_views
from rigkit.validation.sentinel.watch import watched_camera

CHANGED_PX = 0.15
VIEWS, FRESH = 16, 3


def held(lens: Lens, count: int, rng: np.random.Generator) -> list[Rigid3]:
    """Return where boards are held for a calibration, or a check."""
    known = Knowledge.guessed(lens.camera, CornerError(0.1))
    goal = projection_goal(lens.camera, lens.field_deg)
    plan = plan_views(known, [BOARD], goal, count, reach=Reach(field_deg=lens.field_deg))
    return [by_hand(view.cam_from_board, BOARD, rng).world_from_board for view in plan.views]


def seen(camera: Camera, pose: Rigid3, name: str, noise_px: float, rng: np.random.Generator) -> BoardView | None:
    pixels, valid = camera.project(pose.apply(BOARD.points()))
    valid &= camera.on_image(pixels)
    if valid.sum() < 20:
        return None
    noisy = pixels[valid] + noise_px * rng.standard_normal((int(valid.sum()), 2))
    noisy = np.clip(noisy, -0.5, np.array(camera.size_px) - 0.5)
    return BoardView(name, BOARD, BOARD.grid()[valid], noisy, np.full(len(noisy), noise_px))


def views_of(lens: Lens, camera: Camera, count: int, noise_px: float, rng: np.random.Generator) -> list[BoardView]:
    poses = held(lens, count, rng)
    views = [seen(camera, pose, f"{k:02d}", noise_px, rng) for k, pose in enumerate(poses)]
    return [view for view in views if view is not None]


def changed(lens: Lens, what: str, rng: np.random.Generator) -> Camera:
    """Return the camera after a change that leaves 0.15 px rms after the best rotation."""
    camera = lens.camera
    step = np.zeros(camera.parameters.size)
    if what == "focus":
        step[:2] = camera.parameters[:2] * rng.choice([-1.0, 1.0])
    elif what == "principal point":
        angle = rng.uniform(0.0, 2.0 * np.pi)
        step[2:4] = np.cos(angle), np.sin(angle)
    elif what == "distortion":
        step[4] = rng.choice([-1.0, 1.0])
    else:
        return camera
    weight = projection_goal(camera, lens.field_deg).weight
    return camera.with_parameters(camera.parameters + step * CHANGED_PX / np.sqrt(step @ weight @ step))


def one_camera(name: str, seeds: int, noise_px: float) -> None:
    lens = LENSES[name]
    model = lens.camera.model
    for what in ("nothing", "focus", "principal point", "distortion"):
        checks = []
        for seed in range(seeds):
            rng = np.random.default_rng([seed, 11])
            views = views_of(lens, lens.camera, VIEWS, noise_px, rng)
            known = calibrate(
                views, lens.camera.size_px, model=model, degree=5 if model == "brown" else None, board="flat", folds=0
            )
            fresh = views_of(lens, changed(lens, what, rng), FRESH, noise_px, rng)
            checks.append(check_views(watched_camera(known, "camera"), [FreshView(v.image, 0, v) for v in fresh]))
        tell(f"{name}: {what}", checks, what)


def tell(title: str, checks: list[SentinelCheck], what: str) -> None:
    alarms = [c for c in checks if not c.holds]
    kinds = Counter("none" if c.change is None else c.change.cause.kind for c in alarms)
    right = sum(n for kind, n in kinds.items() if kind == what)
    print(
        f"{title:28s} {len(alarms):3d} of {len(checks)} alarm, {right} of them rightly named: {dict(kinds)}", flush=True
    )


def stereo(seeds: int, noise_px: float, name: str = "60") -> None:
    """A rig of two: mounts that turn, and one camera whose focus changes."""
    lens = LENSES[name]
    camera = lens.camera
    mount = Rigid3(exp_so3(np.array([0.0, -0.08, 0.01])), [-120.0, 1.0, 2.0])
    for what in ("nothing", "rotation", "focus", "scale"):
        checks = []
        for seed in range(seeds):
            rng = np.random.default_rng([seed, 13])

            def frames(
                count: int, second: Camera, pose: Rigid3, rng: np.random.Generator = rng
            ) -> list[list[BoardView | None]]:
                return [
                    [
                        seen(camera, board, f"{k:02d}", noise_px, rng),
                        seen(second, pose @ board, f"{k:02d}", noise_px, rng),
                    ]
                    for k, board in enumerate(held(lens, count, rng))
                ]

            both = frames(VIEWS, camera, mount)
            own = {c: [(v.image, v) for pair in both if (v := pair[k])] for k, c in enumerate(("left", "right"))}
            rig = calibrate_rig(own, {"left": camera.size_px, "right": camera.size_px}, model="brown")
            axis = rng.standard_normal(3)
            turn = exp_so3(np.radians(0.02) * axis / np.linalg.norm(axis))
            pose, second = mount, camera
            if what == "rotation":
                pose = Rigid3(turn @ mount.rotation, turn @ mount.translation_mm)
            elif what == "scale":
                pose = Rigid3(mount.rotation, 1.003 * mount.translation_mm)
            elif what == "focus":
                second = changed(lens, what, rng)
            fresh = frames(FRESH, second, pose)
            given = [FreshView(v.image, c, v) for pair in fresh for c, v in enumerate(pair) if v is not None]
            covariance = rig.covariance
            watched = Watched(
                names=("left", "right"),
                cameras=tuple(c.camera for c in rig.cameras),
                cam_from_rig=tuple(c.cam_from_rig for c in rig.cameras),
                covariance=covariance,
                sigma_px=rig.sigma_px,
                overdispersion=rig.overdispersion,
                freedom=rig.freedom,
            )
            checks.append(check_views(watched, given))
        tell(f"rig {name}: {what}", checks, what)


def real(name: str, data: Path, cache: Path, draws: int) -> None:
    found, size = load(name, data, cache)
    images = sorted(found)
    checks = []
    rng = np.random.default_rng(3)
    model = calibrate([v for own in found.values() for v in own], size, model="auto", board="flat").camera.model
    for _ in range(draws):
        names = rng.permutation(images).tolist()
        try:
            known = calibrate([v for n in names[FRESH:] for v in found[n]], size, model=model, board="auto")
            fresh = [FreshView(n, 0, v) for n in names[:FRESH] for v in found[n]]
            checks.append(check_views(watched_camera(known, "camera"), fresh))
        except RigkitError as error:
            print(f"{name}: {error}")
    tell(f"{name}: unchanged ({model})", checks, "nothing")
    for c in checks:
        if not c.holds:
            print(f"   chance {c.chance:.2g}, {c.change}, size {c.change.size_px if c.change else 0.0:.3f} px, rms "
                  f"{c.rms_px:.3f} -> {c.rms_fixed_px:.3f}, expected {c.expected_px:.3f}")  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--lens", nargs="+", choices=sorted(LENSES), default=list(LENSES))
    parser.add_argument("--noise", type=float, default=0.03, help="of a corner per coordinate, px")
    parser.add_argument("--rig", action="store_true", help="a rig of two instead")
    parser.add_argument("--real", nargs="*", metavar="SET", help="real captures instead (see scripts/split_halves.py)")
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--cache", type=Path, default=Path(tempfile.gettempdir()) / "split_halves")
    args = parser.parse_args()
    if args.real is not None:
        args.cache.mkdir(parents=True, exist_ok=True)
        for name in args.real or ("caliper", "camodocal", "ov-plane", "lab-regular", "lab-fisheye"):
            real(name, args.data, args.cache, args.seeds)
        return
    if args.rig:
        stereo(args.seeds, args.noise)
        return
    for name in args.lens:
        one_camera(name, args.seeds, args.noise)


if __name__ == "__main__":
    main()
