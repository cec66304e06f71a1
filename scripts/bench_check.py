"""Measure the power and the false alarms of `rigkit check`, and whether it names the right change.

lens, rig: simulated corners. Cameras are calibrated from planned views and checked with three new ones, held by hand
where `rigkit plan --check` asks ("advised"); lenses also with three as people take them ("free"). Changes are 0.15 px
RMS over the image after the best rotation; extrinsics rotate by 0.02 degrees. The upper bound of the power is that of a
test that knows the direction of the change. `--board` chooses another board.
departs: lenses that no model fits, calibrated with boards in the left part of the image and checked with three in the
right: their deviation from the model there is no change.
rendered: detected pictures of all five lenses; three or half of them are checked against the rest, and three pictures
after a change.
pupil: simulated fisheye lenses with moving entrance pupils (`measure_pupil.py`), calibrated from 20 near boards,
checked with three.
scene: a rig in front of rendered textured walls; the extrinsics rotate by 0.05 degrees.
pairs: real pairs of textured scenes with known cameras and pose; without change, or with extrinsics rotated by 0.05
degrees, checked as published, or against the rig's other pairs (`--before`).
real: real captures; three, or half, of the images are checked against a calibration from the others.
ordered: real captures; the first or last images are checked against a calibration from the others.
since: the same as real, and real rigs whose mount turned, since others of these images (`--before`).

    python scripts/bench_check.py [lens] [rig] [departs] [pupil] [rendered] [scene] [pairs] [real] [ordered] [since]
        [--seeds 20] [--lens NAME ...] [--board 9x6x25] [--parameters-alone]
"""

from __future__ import annotations

import argparse
import pickle
import sys
import tempfile
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import bench_planner
import numpy as np
from bench_planner import LENSES, Lens, by_hand, free_poses, see
from checking.captures import SAID, left_out, ordered, real
from checking.pupils import pupils
from checking.scenes import pairs
from checking.since import RIGS, since_cameras, since_rigs
from checking.tally import CHANGED_PX, COUNTED, FRESH, KINDS, SCENE_TURNED_DEG, TALLY, checked, tell, turned, unchanged
from halves.captures import identified
from scipy.special import ndtr, ndtri

from rigkit.calibration.calibrate import calibrate
from rigkit.calibration.certainty.displaced import DisplacedCamera
from rigkit.calibration.result import Calibration
from rigkit.calibration.rig.calibrate import calibrate_rig
from rigkit.calibration.views.usable import views_of_image
from rigkit.cameras.base import Camera
from rigkit.core.arrays import FloatArray
from rigkit.core.boards import Board
from rigkit.core.detections import BoardView
from rigkit.core.reach import Reach
from rigkit.detection.detect import detect_boards
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3, unit
from rigkit.kernels.departures import DISPLACEMENTS
from rigkit.planning.goal import projection_goal
from rigkit.planning.information import CornerError, Knowledge
from rigkit.planning.plan import plan_views
from rigkit.synthetic.photometry import Photometry
from rigkit.synthetic.render import Optics, render
from rigkit.synthetic.scene import PlacedBoard
from rigkit.validation.monitoring.change_aim import informative_views
from rigkit.validation.monitoring.epipolar import check_matches, matches_of_scenes
from rigkit.validation.monitoring.evidence import FreshView, Monitored, evidence_of
from rigkit.validation.monitoring.verdict import ALARM_CHANCE, CalibrationCheck, check_views
from rigkit.validation.monitoring.watch import monitored_camera, monitored_rig
from rigkit.validation.monitoring.whitened import Whitened

BOARD = bench_planner.BOARD
"""Another by `--board`."""
TURNED_DEG, STRETCHED = 0.02, 1.003
DEPARTS_PX, LONGER, DEPARTING_VIEWS = 0.1, 1.01, 90
"""At the corners of the image; and boards of which some are left, and three right of the middle."""
DEPARTING = ("reg", "wide", "fish")
VIEWS = 16
RENDERED_PLANNED, RENDERED_FREE = 16, 12
MOUNT = Rigid3(exp_so3(np.array([0.0, -0.08, 0.01])), [-120.0, 1.0, 2.0])


def held(lens: Lens, count: int, rng: np.random.Generator) -> list[Rigid3]:
    """Return where boards are held for a calibration, or a check."""
    known = Knowledge.guessed(lens.camera, CornerError(0.1))
    goal = projection_goal(lens.camera, lens.field_deg)
    plan = plan_views(known, [BOARD], goal, count, reach=Reach(field_deg=lens.field_deg))
    return [by_hand(view.cam_from_board, BOARD, rng).world_from_board for view in plan.views]


def fresh_poses(lens: Lens, known: Calibration, rng: np.random.Generator) -> list[Rigid3]:
    """Return where boards are held for a check: where they tell changes best, as well as hands do."""
    plan, _ = informative_views(monitored_camera(known, "camera"), [BOARD], FRESH, Reach(field_deg=lens.field_deg))
    return [by_hand(view.cam_from_board, BOARD, rng).world_from_board for view in plan.views]


def fresh_rig_poses(lens: Lens, monitored: Monitored, rng: np.random.Generator) -> list[Rigid3]:
    """Return where boards are held for a check of a rig, in its frame."""
    plan, _ = informative_views(monitored, [BOARD], FRESH, Reach(field_deg=lens.field_deg))
    return [
        monitored.cam_from_rig[monitored.names.index(view.seen_by[0])].inverse()
        @ by_hand(view.cam_from_board, BOARD, rng).world_from_board
        for view in plan.views
    ]


def seen(
    camera: Camera,
    pose: Rigid3,
    name: str,
    noise_px: float,
    rng: np.random.Generator,
    *,
    board: Board = BOARD,
    least: int = 20,
) -> BoardView | None:
    """Return a noisy view of all corners that are on the image; None of fewer than `least`."""
    pixels, valid = camera.project(pose.apply(board.points()))
    valid &= camera.on_image(pixels)
    if valid.sum() < least:
        return None
    noisy = pixels[valid] + noise_px * rng.standard_normal((int(valid.sum()), 2))
    noisy = np.clip(noisy, -0.5, np.array(camera.size_px) - 0.5)
    return BoardView(name, board, board.grid()[valid], noisy, np.full(len(noisy), noise_px))


def views_of(
    camera: Camera,
    poses: Sequence[Rigid3],
    noise_px: float,
    rng: np.random.Generator,
    *,
    board: Board = BOARD,
    least: int = 20,
) -> list[BoardView]:
    views = [seen(camera, p, f"{k:02d}", noise_px, rng, board=board, least=least) for k, p in enumerate(poses)]
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


def known_of(lens: Lens, views: Sequence[BoardView]) -> Calibration:
    model = lens.camera.model
    degree = 5 if model == "brown" else None
    return calibrate(views, lens.camera.size_px, model=model, degree=degree, board="flat", folds=0)


def one_camera(name: str, seeds: int, noise_px: float) -> None:
    lens = LENSES[name]
    for how in ("advised", "free"):
        found: dict[str, list[CalibrationCheck]] = {what: [] for what in ("nothing", *KINDS)}
        most: dict[str, list[float]] = {what: [] for what in KINDS}
        for seed in range(seeds):
            rng = np.random.default_rng([seed, 11])
            known = known_of(lens, views_of(lens.camera, held(lens, VIEWS, rng), noise_px, rng))
            unplanned = free_poses(lens, rng, BOARD)
            for what, checks in found.items():
                camera = changed(lens, what, rng)
                poses = (
                    fresh_poses(lens, known, rng)
                    if how == "advised"
                    else [next(unplanned).world_from_board for _ in range(FRESH)]
                )
                views = views_of(camera, poses, noise_px, rng)
                checks.append(checked(known, views))
                if what in most:
                    most[what].append(best_chance(known, views, camera.parameters - lens.camera.parameters))
        for what, checks in found.items():
            tell(f"{name}, {how}: {what}", checks, what, how)
            if what in most:
                print(f"   no test finds it more often than {np.mean(most[what]):.2f}")
                BEST.setdefault(how, []).extend(most[what])


def with_model_inadequacy(name: str, seeds: int, noise_px: float) -> None:
    """A lens that departs from its model, unchanged and with a longer focal length, where the calibration had no
    boards; and the same where what lenses may do beyond their models is not counted."""
    sys.path.append(str(Path(__file__).parents[1] / "tests"))
    from helpers.calibration_scenes import REACH_DEG, random_views
    from helpers.calibration_scenes import lens as scene_lens

    found: dict[tuple[str, bool], list[CalibrationCheck]] = {}
    for seed in range(seeds):
        rng = np.random.default_rng([seed, 5])
        amounts = DEPARTS_PX * rng.normal(size=DISPLACEMENTS)
        model = scene_lens(name)
        size = model.size_px
        camera = DisplacedCamera(size, np.append(model.parameters, amounts), model, np.eye(DISPLACEMENTS))
        reach = 0.95 * REACH_DEG[name]
        views, rotations, shifts = random_views(camera, DEPARTING_VIEWS, rng, reach_deg=reach, noise_px=noise_px)
        left = [view for view in views if view.pixels[:, 0].max() < 0.6 * size[0]][:VIEWS]
        right = [k for k, view in enumerate(views) if view.pixels[:, 0].min() > 0.5 * size[0]][:FRESH]
        known = calibrate(left, size, model=model.model, board="flat", folds=0)
        longer = model.with_parameters(model.parameters * np.where(np.arange(model.parameters.size) < 2, LONGER, 1.0))
        changed = DisplacedCamera(size, np.append(longer.parameters, amounts), longer, camera.modes)
        poses = [Rigid3(rotations[k], shifts[k]) for k in right]
        fresh = {
            "nothing": [views[k] for k in right],
            "focus": views_of(changed, poses, noise_px, rng, board=views[0].board, least=0),
        }
        for what, own in fresh.items():
            for beyond in (False, True):
                monitored = monitored_camera(known, "camera", beyond_model=beyond)
                check = check_views(monitored, [FreshView(v.image, 0, v) for v in own])
                found.setdefault((what, beyond), []).append(check)
    for (what, beyond), checks in found.items():
        counted = "counted" if beyond else "not counted"
        tell(f"{name} departs, {counted}: {what}", checks, what, f"departing lens ({counted}),")


def best_chance(known: Calibration, views: Sequence[BoardView], change: FloatArray) -> float:
    """Return how often the best test of all, which knows the change but for its sign, finds it with as few alarms."""
    monitored = monitored_camera(known, "camera")
    whitened = Whitened.of(monitored, evidence_of(monitored, [FreshView(v.image, 0, v) for v in views]))
    moved = whitened.by_theta[:, : len(change)] @ change
    size = float(np.sqrt(moved @ np.linalg.solve(whitened.covariance, moved)))
    limit = float(-ndtri(0.5 * ALARM_CHANCE))
    return float(ndtr(size - limit) + ndtr(-size - limit))


BEST: dict[str, list[float]] = {}
"""Of changes of simulated lenses, the chance with which the best test finds them, advised and free."""


def stereo(seeds: int, noise_px: float, name: str) -> None:
    """A rig of two: mounts that turn or stretch, and one camera that changes."""
    lens = LENSES[name]
    camera = lens.camera
    found: dict[str, list[CalibrationCheck]] = {what: [] for what in ("nothing", "rotation", "scale", "focus")}
    for seed in range(seeds):
        rng = np.random.default_rng([seed, 13])

        def frames(
            poses: Sequence[Rigid3], second: Camera, mount: Rigid3, rng: np.random.Generator = rng
        ) -> list[FreshView]:
            both = [
                (f"{k:02d}", c, seen(own, pose @ board, f"{k:02d}", noise_px, rng))
                for k, board in enumerate(poses)
                for c, (own, pose) in enumerate(((camera, Rigid3.identity()), (second, mount)))
            ]
            return [FreshView(frame, c, view) for frame, c, view in both if view is not None]

        monitored = calibrated_rig(frames(held(lens, VIEWS, rng), camera, MOUNT), camera)
        turn = exp_so3(np.radians(TURNED_DEG) * unit(rng.standard_normal(3)))
        poses = {
            "rotation": Rigid3(turn @ MOUNT.rotation, turn @ MOUNT.translation_mm),
            "scale": Rigid3(MOUNT.rotation, STRETCHED * MOUNT.translation_mm),
        }
        for what, checks in found.items():
            second = changed(lens, what, rng)
            fresh = fresh_rig_poses(lens, monitored, rng)
            checks.append(check_views(monitored, frames(fresh, second, poses.get(what, MOUNT))))
    for what, checks in found.items():
        tell(f"rig {name}: {what}", checks, what)


def calibrated_rig(views: Sequence[FreshView], camera: Camera) -> Monitored:
    """Return a rig of two as `views` calibrate it."""
    names = ("left", "right")
    own = {name: [(v.frame, v.view) for v in views if v.camera == c] for c, name in enumerate(names)}
    return monitored_rig(calibrate_rig(own, dict.fromkeys(names, camera.size_px), model=camera.model).mounted)


def rendered_view(camera: Camera, pose: Rigid3, name: str, rng: np.random.Generator) -> BoardView | None:
    """Return what is found of a board in a rendered picture."""
    image = render(
        [PlacedBoard(BOARD, pose)],
        camera,
        Rigid3.identity(),
        optics=Optics(0.6),
        photometry=Photometry(noise_levels=1.5),
        rng=rng,
    )
    views, _ = views_of_image(name, detect_boards(image, [BOARD]), [BOARD])
    return views[0] if views else None


def rendered(name: str, seeds: int, cache: Path) -> None:
    """Pictures of one lens, unchanged and changed."""
    lens, kept = LENSES[name], cache / f"bench-check-told-{name}-{seeds}.pickle"
    if not kept.is_file():
        rng = np.random.default_rng(17)
        free = free_poses(lens, rng)
        poses = held(lens, RENDERED_PLANNED, rng)
        while len(poses) < RENDERED_PLANNED + RENDERED_FREE:
            placed = next(free)
            if see(placed, lens, "", rng) is not None:
                poses.append(placed.world_from_board)
        before = [rendered_view(lens.camera, pose, f"{k:02d}", rng) for k, pose in enumerate(poses)]
        known = known_of(lens, [view for view in before if view is not None][:VIEWS])
        after = {
            what: [
                [rendered_view(camera, pose, f"f{k}", rng) for k, pose in enumerate(fresh_poses(lens, known, rng))]
                for camera in (changed(lens, what, rng) for _ in range(max(seeds // 4, 2)))
            ]
            for what in KINDS
        }
        kept.write_bytes(pickle.dumps((before, after)))
    before, after = pickle.loads(kept.read_bytes())
    views = [view for view in before if view is not None]
    unchanged(f"rendered {name}", [[v] for v in views], seeds, lambda own: known_of(lens, own))
    known = known_of(lens, views[:VIEWS])
    for what, sessions in after.items():
        tell(f"rendered {name}: {what}", [checked(known, [v for v in s if v is not None]) for s in sessions], what)


def scene(seeds: int, noise_px: float, name: str) -> None:
    """A rig before rendered textured walls, without boards."""
    sys.path.append(str(Path(__file__).parents[1] / "tests"))
    from helpers.textured_scene import Corner

    lens = LENSES[name]
    camera = lens.camera
    found: dict[str, list[CalibrationCheck]] = {"nothing": [], "rotation": []}
    for seed in range(seeds):
        rng = np.random.default_rng([seed, 19])
        views = []
        for k, board in enumerate(held(lens, VIEWS, rng)):
            for c, mount in enumerate((Rigid3.identity(), MOUNT)):
                view = seen(camera, mount @ board, f"{k:02d}", noise_px, rng)
                views += [] if view is None else [FreshView(f"{k:02d}", c, view)]
        monitored, walls = calibrated_rig(views, camera), Corner.of_a_room(seed)
        left = walls.image(camera, Rigid3.identity(), rng)
        for what, checks in found.items():
            pose = turned(MOUNT, SCENE_TURNED_DEG if what == "rotation" else 0.0, rng)
            checks.append(
                check_matches(monitored, matches_of_scenes(monitored, [[left, walls.image(camera, pose, rng)]]))
            )
    for what, checks in found.items():
        tell(f"scene {name}: {what}", checks, what)


REAL = ("caliper", "camodocal", "ov-plane", "ocam", "fisheye-chess", "cylinder", "bouguet-left", "bouguet-right",
        "charuco-lifecam", "aprilgrid-mocap", "lab-regular", "lab-fisheye")  # fmt: skip


def main() -> None:
    kinds = ("lens", "rig", "departs", "pupil", "rendered", "scene", "pairs", "real", "ordered", "since")
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kinds", nargs="*", choices=[*kinds, []], help="default all")
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--lens", nargs="+", choices=sorted(LENSES), default=list(LENSES))
    parser.add_argument("--sets", nargs="+", default=REAL, metavar="SET", help="of split_halves.py")
    parser.add_argument("--noise", type=float, default=0.03, help="of a simulated corner per coordinate, px")
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--cache", type=Path, default=Path(tempfile.gettempdir()) / "split_halves")
    parser.add_argument("--board", type=identified, default=BOARD, metavar="CxRxMM", help="default 9x6x25")
    parser.add_argument("--parameters-alone", action="store_true", help="lenses do nothing beyond their models")
    args = parser.parse_args()
    globals()["BOARD"] = args.board
    COUNTED["beyond_model"] = not args.parameters_alone
    args.cache.mkdir(parents=True, exist_ok=True)
    work: dict[str, list[Callable[[], None]]] = {
        "lens": [partial(one_camera, n, args.seeds, args.noise) for n in args.lens],
        "rig": [partial(stereo, args.seeds, args.noise, n) for n in args.lens],
        "departs": [partial(with_model_inadequacy, n, args.seeds, args.noise) for n in DEPARTING],
        "pupil": [partial(pupils, args.seeds)],
        "rendered": [partial(rendered, n, args.seeds, args.cache) for n in args.lens],
        "scene": [partial(scene, args.seeds, args.noise, n) for n in args.lens],
        "pairs": [partial(pairs, args.data, args.seeds)],
        "real": [partial(real, n, args.data, args.cache, args.seeds) for n in args.sets],
        "ordered": [partial(ordered, n, args.data, args.cache) for n in args.sets],
        "since": [
            *(partial(since_rigs, n, args.data, args.cache, args.seeds) for n in RIGS),
            *(partial(since_cameras, n, args.data, args.cache, args.seeds) for n in args.sets),
        ],
    }
    for kind in args.kinds or kinds:
        TALLY.clear()
        for part in work[kind]:
            part()
        for what, (alarms, count, right) in TALLY.items():
            print(f"== {kind}: {what}: {alarms} of {count} alarm, {right} named rightly", flush=True)
        if kind == "lens":
            for how, best in BEST.items():
                print(f"== lens: the best test of all would find {np.mean(best):.3f} of the changes ({how} pictures)")
        if kind == "real":
            print(f"== real: changes were said to be found with chance {np.mean(SAID):.2f}")
            left_out()


if __name__ == "__main__":
    main()
