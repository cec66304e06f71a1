"""`rigkit reconstruct`: oriented clouds of every pair of a data set, or of one scene; needs no measured truth."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rigkit.cli.console import note, options_of, print_json, progress_on_stderr
from rigkit.cli.dataset_arguments import (
    add_dataset_arguments,
    add_direction_arguments,
    add_planes_argument,
    dataset_options,
    direction_options,
    exit_code_of,
    failed_pairs,
    results_folder,
)
from rigkit.core.errors import ExitCode, InputError
from rigkit.core.posetype import PoseType

if TYPE_CHECKING:
    from rigkit.workflows.reconstruction.reconstruct import PairReconstruction

METHODS = ("F2UDIR", "F3UDIR", "DET3UDIR", "2SDIR", "3SDIR")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_dataset_arguments(parser, optional=True)
    add_direction_arguments(parser)
    _add_scene_arguments(parser)
    parser.add_argument("--method", choices=METHODS, default="3SDIR", help="affine estimator (default 3SDIR)")
    add_planes_argument(parser, "points and normals")
    parser.add_argument("--no-pictures", action="store_true", help="leave out PNG pictures")


def run(args: argparse.Namespace) -> int:
    if _is_scene(args):
        if args.planes is not None:
            raise InputError("reconstruct: --planes is about boards, and a scene has none")
        if direction_options(args):
            raise InputError("reconstruct: --directions and --det-scale are about boards, and a scene has none")
        return _run_scene(args)
    from rigkit.io.manifests.manifest import load_dataset
    from rigkit.report.tables import measured_words
    from rigkit.workflows.reconstruction.reconstruct import ReconstructOptions, reconstruct_dataset

    dataset = load_dataset(args.dataset)
    common = dataset_options(args, dataset.name)
    options = ReconstructOptions(
        **common, **direction_options(args), method=args.method, planes=args.planes, pictures=not args.no_pictures
    )
    done = reconstruct_dataset(dataset, options, progress=progress_on_stderr())
    results = [_summary(pair) for pair in done.pairs]
    for r in results:
        for words in r["notes"]:
            note(f"{r['pair']}: {words}")
    if args.json:
        print_json({"output": str(options.output), "pairs": results} | failed_pairs(done.failures))
    else:
        for r in results:
            print(
                f"{common['output'] / r['ply']}: {r['points']} points, {len(r['boards'])} boards, baseline "
                f"{measured_words(r['baseline_mm'], r['baseline_sigma_mm'], 3)} mm, "
                f"Sampson rms {r['sampson_rms_px']:.3f} px, {r['pose_type']}"
            )
    return exit_code_of(done.failures, ExitCode.WELL)


def _summary(pair: PairReconstruction) -> dict[str, Any]:
    """Return the results of a pair as JSON values."""
    r = pair.reconstruction
    return {
        "pair": r.pair_id,
        "ply": pair.ply,
        "pose_type": str(r.pose_type),
        "affine_method": r.affine_method,
        "points": len(r.cloud),
        "boards": [board.board_id for board in r.boards],
        "cam2_from_cam1": r.cam2_from_cam1.matrix().tolist(),
        "baseline_mm": r.baseline_mm,
        "baseline_sigma_mm": r.baseline_sigma_mm,
        "sampson_rms_px": r.sampson_rms_px,
        "notes": list(r.notes),
    }


def _add_scene_arguments(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("a textured scene without boards, instead of DATASET")
    group.add_argument(
        "--images",
        nargs="+",
        type=Path,
        metavar="IMAGE",
        help="match affine features of these two images; of three and more, of a --rig, fuse the clouds of near pairs",
    )
    group.add_argument(
        "--correspondences",
        type=Path,
        metavar="FILE",
        help="CSV, NPZ or AffineExtractor text with affinities or directions, a matcher's NPZ or COLMAP's database; "
        "with --images these align bare points, the cloud grows and has colours",
    )
    group.add_argument("--camera", type=Path, metavar="CALIB", help="calibration of the camera (of image A)")
    group.add_argument("--camera2", type=Path, metavar="CALIB", help="the same of image B (default: that of image A)")
    group.add_argument(
        "--rig", type=Path, metavar="RIG", help="the rig that took both images, instead of --camera; its pose is kept"
    )
    group.add_argument("--names", nargs="+", metavar="CAMERA", help="cameras of the images (default: the rig's first)")
    group.add_argument(
        "--pose", type=Path, metavar="FILE", help="measured cam2_from_cam1, 3x4 or 4x4 numbers, mm; it is kept"
    )
    group.add_argument("--baseline-mm", type=float, metavar="MM", help="measured baseline (default: it is the unit)")
    group.add_argument(
        "--pose-type", choices=tuple(map(str, PoseType)), help="of the views (default general, or a rectified pair's)"
    )
    group.add_argument("--sparse", action="store_true", help="only the matched features; do not grow a dense cloud")
    group.add_argument("--float", action="store_true", help="write the cloud in single precision")
    group.add_argument("--confidence", action="store_true", help="the length of a normal says how sure it is")
    group.add_argument("--level-sigma-deg", type=float, metavar="DEG", help="how well that pose type holds")


def _is_scene(args: argparse.Namespace) -> bool:
    """Return whether a scene is given; raises InputError for both or neither of scene and data set."""
    scene = bool(args.images or args.correspondences)
    if scene == bool(args.dataset):
        raise InputError("reconstruct: give either a DATASET, or --images A B or --correspondences FILE with --camera")
    if scene and not (args.camera or args.rig):
        raise InputError(
            "reconstruct: a scene needs --camera CALIB, a calibration file such as `rigkit calibrate` writes from "
            "pictures of a board with the same zoom and focus, or --rig"
        )
    return scene


def _run_scene(args: argparse.Namespace) -> int:
    if args.images and len(args.images) > 2:
        return _run_rig(args)
    from rigkit.workflows.reconstruction.reconstruct_scene import CLOUD, SceneOptions, reconstruct_views

    for option, given in (("--images", args.images), ("--names", args.names)):
        if given and len(given) != 2:
            raise InputError(f"reconstruct: {option} names two, or with --rig three and more; got {len(given)}")
    name = (args.correspondences or args.images[0]).stem
    out = results_folder(args, name)
    passed_on = {"output": out, "rig_names": tuple(args.names) if args.names else None, "grow": not args.sparse}
    options = options_of(SceneOptions, args, **passed_on, **_written(args))
    done = reconstruct_views(options, progress=progress_on_stderr())
    scene, r = done.scene, done.scene.reconstruction
    summary = (
        f"{len(r.cloud)} points ({scene.unit}) of {len(done.correspondences)} correspondences, "
        f"{scene.inliers.sum()} of which agree, Sampson rms {r.sampson_rms_px:.3f} px, {r.pose_type}"
    )
    return _show(name, out / CLOUD, summary, done.figures(), json=args.json)


def _written(args: argparse.Namespace) -> dict[str, bool]:
    return {"pictures": not args.no_pictures, "single_precision": args.float}


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
    from rigkit.workflows.reconstruction.reconstruct_rig import RigSceneOptions, reconstruct_rig_views
    from rigkit.workflows.reconstruction.reconstruct_scene import CLOUD

    if not args.rig:
        raise InputError(
            f"reconstruct: {len(args.images)} images need --rig RIG, a file that says where their cameras stand; or "
            "give two of them with --camera"
        )
    for option in ("correspondences", "camera", "camera2", "pose", "baseline_mm", "pose_type", "sparse"):
        if getattr(args, option):
            word = option.replace("_", "-")
            raise InputError(f"reconstruct: --{word} is for two images; with three and more the rig's file says it all")
    name = args.rig.stem
    out = results_folder(args, name)
    options = options_of(RigSceneOptions, args, output=out, **_written(args))
    done = reconstruct_rig_views(options, progress=progress_on_stderr())
    summary = f"{len(done.cloud)} points (mm) of {len(done.pairs)} pairs, {done.merged} seen by more than one of them"
    return _show(name, out / CLOUD, summary, done.figures(), json=args.json)
