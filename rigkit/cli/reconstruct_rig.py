"""`rigkit reconstruct --rig RIG --images A B C ...`: one cloud of three and more views by the cameras of a rig."""

from __future__ import annotations

import argparse

from rigkit.cli.console import note, print_json, progress_on_stderr
from rigkit.cli.dataset_arguments import results_folder
from rigkit.core.errors import ExitCode, InputError


def run_rig(args: argparse.Namespace) -> int:
    from rigkit.workflows.reconstruct_rig import RigSceneOptions, reconstruct_rig_views
    from rigkit.workflows.reconstruct_scene import CLOUD

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
    options = RigSceneOptions(
        rig=args.rig,
        images=tuple(args.images),
        names=tuple(args.names) if args.names else None,
        output=out,
        force=args.force,
        single_precision=args.float,
        confidence=args.confidence,
        pictures=not args.no_pictures,
    )
    done = reconstruct_rig_views(options, progress=progress_on_stderr())
    for words in done.notes:
        note(f"{name}: {words}")
    if args.json:
        print_json({"output": str(out), "ply": CLOUD, **done.figures()})
    else:
        print(
            f"{out / CLOUD}: {len(done.cloud)} points (mm) of {len(done.pairs)} pairs, {done.merged} seen by more "
            "than one of them"
        )
    return ExitCode.WELL
