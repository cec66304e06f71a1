"""`rigkit reconstruct`: oriented point clouds of the pairs of a data set, or of one scene; needs no ground truth.

examples:
  rigkit reconstruct lab                          the pairs of lab/dataset.toml (rigkit init writes one)
  rigkit reconstruct lab -p first --planes lattice
  rigkit reconstruct --images left.png right.png --rig rig.json -o scene
  rigkit reconstruct --images a.png b.png --camera calibration.json --baseline-mm 250 -o scene
"""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from rigkit.cli.console import note, options_of, print_json, progress_on_stderr, require_existing
from rigkit.cli.dataset_arguments import (
    NO_DATASET,
    add_dataset_arguments,
    add_direction_arguments,
    add_planes_argument,
    exit_code_of,
    failed_pairs,
    has_directions,
    results_folder,
)
from rigkit.cli.reconstruct_scene import add_scene_arguments, is_scene, run_scene
from rigkit.core.errors import ExitCode, InputError
from rigkit.workflows.options.clouds import ReconstructOptions

if TYPE_CHECKING:
    from rigkit.workflows.reconstruction.reconstruct import PairReconstruction

METHODS = ("F2UDIR", "F3UDIR", "DET3UDIR", "2SDIR", "3SDIR")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_dataset_arguments(parser, optional=True)
    add_direction_arguments(parser)
    add_scene_arguments(parser)
    parser.add_argument("--method", choices=METHODS, default="3SDIR", help="affine estimator (default 3SDIR)")
    add_planes_argument(parser, "points and normals")
    parser.add_argument("--no-pictures", dest="pictures", action="store_false", help="leave out PNG pictures")


def run(args: argparse.Namespace) -> int:
    if is_scene(args):
        if args.planes is not None:
            raise InputError("reconstruct: --planes needs boards, and a scene has none; leave it out")
        if has_directions(args):
            raise InputError(
                "reconstruct: --directions and --det-scale need boards, and a scene has none; leave them out"
            )
        return run_scene(args)
    require_existing(args.dataset[0], remedy=NO_DATASET)
    from rigkit.io.manifests.manifest import load_dataset
    from rigkit.report.tables import measured_words
    from rigkit.workflows.reconstruction.reconstruct import reconstruct_dataset

    dataset = load_dataset(args.dataset[0])
    out = results_folder(args, dataset.name)
    options = options_of(ReconstructOptions, args, output=out)
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
                f"{out / r['ply']}: {r['points']} points, {len(r['boards'])} boards, baseline "
                f"{measured_words(r['baseline_mm'], r['baseline_sigma_mm'], 3)} mm, Sampson rms "
                f"{r['sampson_rms_px']:.3f} px, {r['pose_type']}"
            )
    return exit_code_of(done.failures, ExitCode.WELL)


def _summary(pair: PairReconstruction) -> dict[str, Any]:
    """Return the figures for programs."""
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
