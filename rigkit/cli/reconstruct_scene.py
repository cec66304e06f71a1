"""`rigkit reconstruct --images A B` and `--correspondences FILE`: any scene without boards, by two views or more."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from rigkit.cli.console import add_options, note, options_of, print_json, progress_on_stderr, require_existing
from rigkit.cli.dataset_arguments import results_folder
from rigkit.core.errors import ExitCode, InputError
from rigkit.core.posetype import PoseType
from rigkit.workflows.options.clouds import RigSceneOptions, SceneOptions


def add_scene_arguments(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("a textured scene without boards, instead of DATASET")
    group.add_argument(
        "--images",
        nargs="+",
        type=Path,
        metavar="IMAGE",
        help="match affine features of two images; with --rig three or more, whose pairwise clouds are fused",
    )
    add_options(group, SceneOptions, correspondences="FILE", camera="CALIB", camera2="CALIB", rig="RIG")
    group.add_argument(
        "--names",
        nargs="+",
        metavar="CAMERA",
        help="which cameras of the rig took the images, in order (default: the first ones)",
    )
    add_options(group, SceneOptions, pose="FILE", baseline_mm="MM")
    group.add_argument(
        "--pose-type",
        choices=tuple(map(str, PoseType)),
        help="motion between the images (default: general, or that of a rectified pair)",
    )
    group.add_argument("--sparse", dest="grow", action="store_false", help="keep matched features only; no dense cloud")
    add_options(group, SceneOptions, single_precision="--float", confidence="", level_sigma_deg="DEG")


def is_scene(args: argparse.Namespace) -> bool:
    """Return whether a scene is given; raises InputError for both or neither of scene and data set."""
    scene = bool(args.images or args.correspondences)
    if args.dataset and (scene or len(args.dataset) > 1):
        raise InputError(
            f"reconstruct: give either a DATASET or a scene: '{args.dataset[0]}' is taken for a DATASET; images follow "
            "--images together, and the second image's camera is --camera2"
        )
    if scene == bool(args.dataset):
        raise InputError("reconstruct: give either a DATASET, or --images A B or --correspondences FILE with --camera")
    if scene and not (args.camera or args.rig):
        raise InputError(
            "reconstruct: a scene needs --camera CALIB, a calibration file such as `rigkit calibrate` writes from "
            "pictures of a board with the same zoom and focus, or --rig"
        )
    return scene


def run_scene(args: argparse.Namespace) -> int:
    require_existing(*args.images or (), args.correspondences, args.camera, args.camera2, args.rig, args.pose)
    if args.images and len(args.images) > 2:
        return _run_rig(args)
    from rigkit.workflows.reconstruction.reconstruct_scene import CLOUD, reconstruct_views

    for option, given in (("--images", args.images), ("--names", args.names)):
        if given and len(given) != 2:
            raise InputError(f"reconstruct: {option} names two, or with --rig three and more; got {len(given)}")
    name = (args.correspondences or args.images[0]).stem
    out = results_folder(args, name)
    done = reconstruct_views(options_of(SceneOptions, args, output=out), progress=progress_on_stderr())
    scene, r = done.scene, done.scene.reconstruction
    summary = (
        f"{len(r.cloud)} points ({scene.unit}) of {len(done.correspondences)} correspondences, {scene.inliers.sum()} "
        f"inliers, Sampson rms {r.sampson_rms_px:.3f} px, {r.pose_type}"
    )
    return _show(name, out / CLOUD, summary, done.figures(), json=args.json)


def _show(name: str, cloud: Path, summary: str, figures: dict[str, Any], *, json: bool) -> int:
    """Print the results of the scene `name`, whose cloud was written to the file `cloud`; return the exit code."""
    for words in figures["notes"]:
        note(f"{name}: {words}")
    if json:
        print_json({"output": str(cloud.parent), "ply": cloud.name, **figures})
    else:
        print(f"{cloud}: {summary}")
    return ExitCode.WELL


def _run_rig(args: argparse.Namespace) -> int:
    from rigkit.workflows.reconstruction.reconstruct_rig import reconstruct_rig_views
    from rigkit.workflows.reconstruction.reconstruct_scene import CLOUD

    if not args.rig:
        raise InputError(
            f"reconstruct: {len(args.images)} images need --rig RIG, a file that says where their cameras stand; or "
            "give two of them with --camera"
        )
    of_two = ("correspondences", "camera", "camera2", "pose", "baseline_mm", "pose_type")
    given = [option.replace("_", "-") for option in of_two if getattr(args, option)]
    for word in given or ["sparse"] * (not args.grow):
        raise InputError(f"reconstruct: --{word} applies to two images only; leave it out, the rig's file states it")
    name = args.rig.stem
    out = results_folder(args, name)
    done = reconstruct_rig_views(options_of(RigSceneOptions, args, output=out), progress=progress_on_stderr())
    summary = f"{len(done.cloud)} points (mm) of {len(done.pairs)} pairs, {done.merged} seen in more than one of them"
    return _show(name, out / CLOUD, summary, done.figures(), json=args.json)
