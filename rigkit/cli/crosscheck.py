"""`rigkit crosscheck`: the same pairs through pycolmap, planar PnP and the other chain."""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from typing import TYPE_CHECKING

from rigkit.cli.console import note, print_json, progress_on_stderr
from rigkit.cli.workflow import (
    add_dataset_arguments,
    exit_code_of,
    failed_pairs,
    load_cameras,
    match_images,
    output_folder,
    over_pairs,
    reconstruct_other_chain,
    reconstruct_with,
    select_dataset,
    shifts_of,
    write_results,
)
from rigkit.core.errors import ExitCode

if TYPE_CHECKING:
    from rigkit.cli.workflow import LoadedCamera
    from rigkit.io.manifest import Pair
    from rigkit.validation.crosscheck import CrossCheckReport

HELP = "the same pairs through pycolmap, planar PnP and the other chain; exit 1 if they disagree"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_dataset_arguments(parser)


@dataclass(frozen=True, eq=False, slots=True)
class PairJob:
    """What one process needs to know of one pair."""

    pair: Pair
    camera1: LoadedCamera
    camera2: LoadedCamera
    chain: str


def crosscheck_pair(job: PairJob) -> CrossCheckReport:
    """Reconstruct one pair and compare it with every other way."""
    from rigkit.validation.crosscheck import crosscheck

    matched, _, _ = match_images(job.pair, job.camera1.camera, job.camera2.camera, job.chain)
    other = reconstruct_other_chain(matched, job.pair)
    ours = reconstruct_with(matched, job.pair, "3SDIR")
    shifts = shifts_of(ours, job.camera1, job.camera2)
    return crosscheck(ours, other_chain=other, shifts=shifts)


def run(args: argparse.Namespace) -> int:
    from rigkit.report.tables import tables_to_json, tables_to_markdown, tables_to_text
    from rigkit.report.validation_page import crosscheck_table

    dataset = select_dataset(args)
    out = output_folder(args, dataset.name)
    progress = progress_on_stderr()
    cameras = load_cameras(dataset, recalibrate=args.recalibrate, progress=progress)
    jobs = [PairJob(p, cameras[p.camera1.camera_id], cameras[p.camera2.camera_id], args.chain) for p in dataset.pairs]
    reports, failures = over_pairs(crosscheck_pair, jobs, args.jobs, "cross-checking pairs", progress)
    table = crosscheck_table(reports)
    files: dict[str, str | bytes] = {
        "crosscheck.md": tables_to_markdown([table]),
        "crosscheck.json": tables_to_json([table]),
    }
    write_results(out, files, force=args.force, inputs=dataset.inputs)
    passed = not failures and all(report.passed for report in reports)
    if args.json:
        pairs = [report.to_dict() for report in reports]
        print_json({"passed": passed, "output": str(out), "pairs": pairs} | failed_pairs(failures))
    else:
        print(tables_to_text([table]))
        for report in reports:
            for words in report.suspects:
                print(f"{report.pair_id}: suspect {words}")
    for report in reports:
        for words in report.skipped:
            note(f"{report.pair_id}: {words}")
    return exit_code_of(failures, 0 if passed else ExitCode.CHECK_FAILED)
