"""`rigkit reconstruct`: oriented clouds of every pair of a data set, or of one scene; needs no measured truth."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from rigkit.cli.console import note, print_json, progress_on_stderr
from rigkit.cli.reconstruct_scene import add_scene_arguments, is_scene, run_scene
from rigkit.cli.workflow import (
    add_dataset_arguments,
    exit_code_of,
    failed_pairs,
    load_cameras,
    match_images,
    output_folder,
    over_pairs,
    reconstruct_with,
    select_dataset,
    write_results,
)

if TYPE_CHECKING:
    from rigkit.cameras.base import Camera
    from rigkit.io.manifest import Pair

HELP = "oriented clouds (PLY) and pictures of every pair"

METHODS = ("F2UDIR", "F3UDIR", "DET3UDIR", "2SDIR", "3SDIR")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_dataset_arguments(parser, optional=True)
    add_scene_arguments(parser)
    parser.add_argument("--method", choices=METHODS, default="3SDIR", help="affine estimator (default 3SDIR)")
    parser.add_argument("--no-pictures", action="store_true", help="leave out PNG pictures")


def run(args: argparse.Namespace) -> int:
    if is_scene(args):
        return run_scene(args)
    dataset = select_dataset(args)
    out = output_folder(args, dataset.name)
    progress = progress_on_stderr()
    cameras = load_cameras(dataset, recalibrate=args.recalibrate, progress=progress)
    jobs = [
        PairJob(
            pair,
            cameras[pair.camera1.camera_id].camera,
            cameras[pair.camera2.camera_id].camera,
            args.chain,
            args.method,
            not args.no_pictures,
        )
        for pair in dataset.pairs
    ]
    outcomes, failures = over_pairs(reconstruct_files, jobs, args.jobs, "reconstructing pairs", progress)
    files: dict[str, str | bytes] = {}
    for outcome in outcomes:
        files.update(outcome.files)
    write_results(out, files, force=args.force, inputs=dataset.inputs)
    for outcome in outcomes:
        for words in outcome.result["notes"]:
            note(f"{outcome.result['pair']}: {words}")
    if args.json:
        print_json({"output": str(out), "pairs": [outcome.result for outcome in outcomes]} | failed_pairs(failures))
    else:
        for outcome in outcomes:
            r = outcome.result
            print(
                f"{out / r['ply']}: {r['points']} points, {len(r['boards'])} boards, baseline {r['baseline_mm']:.3f} ± "
                f"{r['baseline_sigma_mm']:.3f} mm, Sampson rms {r['sampson_rms_px']:.3f} px, {r['pose_type']}"
            )
    return exit_code_of(failures, 0)


@dataclass(frozen=True, eq=False, slots=True)
class PairJob:
    """What one process needs to know of one pair."""

    pair: Pair
    camera1: Camera
    camera2: Camera
    chain: str
    method: str
    pictures: bool


@dataclass(frozen=True, eq=False, slots=True)
class PairOutcome:
    """Figures for people and programs, and files by relative path."""

    result: dict[str, Any]
    files: Mapping[str, bytes]


def reconstruct_files(job: PairJob) -> PairOutcome:
    """Reconstruct one pair and render its files."""
    from rigkit.io.ply import ply_bytes
    from rigkit.report.figures import cloud_png, corners_png, epipolar_png

    pair = job.pair
    matched, image1, image2 = match_images(pair, job.camera1, job.camera2, job.chain)
    r = reconstruct_with(matched, pair, job.method, image1)
    ply = f"{pair.pair_id}/{job.method}.ply"
    files = {ply: ply_bytes(r.cloud)}
    if job.pictures:
        files[f"{pair.pair_id}/corners.png"] = corners_png(r, image1, image2)
        files[f"{pair.pair_id}/epipolar.png"] = epipolar_png(r, image1, image2)
        files[f"{pair.pair_id}/cloud.png"] = cloud_png(r)
    result = {
        "pair": pair.pair_id,
        "ply": ply,
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
    return PairOutcome(result, files)
