"""`rigkit crosscheck`: compare pairs with pycolmap, planar PnP and the other chain (raw or rectified pixels).

Exit code 1 if they disagree.

examples:
  rigkit crosscheck lab
  rigkit crosscheck lab -p first --json
"""

from __future__ import annotations

import argparse

from rigkit.cli.console import options_of, print_json, progress_on_stderr, require_existing
from rigkit.cli.dataset_arguments import NO_DATASET, add_dataset_arguments, exit_code_of, failed_pairs, results_folder
from rigkit.cli.validation_output import note_skipped
from rigkit.core.errors import ExitCode
from rigkit.workflows.options.clouds import DatasetOptions


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_dataset_arguments(parser)


def run(args: argparse.Namespace) -> int:
    require_existing(args.dataset, remedy=NO_DATASET)
    from rigkit.io.manifests.manifest import load_dataset
    from rigkit.report.tables import tables_to_text
    from rigkit.workflows.validation.crosscheck import crosscheck_dataset

    dataset = load_dataset(args.dataset)
    options = options_of(DatasetOptions, args, output=results_folder(args, dataset.name))
    done = crosscheck_dataset(dataset, options, progress=progress_on_stderr())
    if args.json:
        pairs = [report.to_dict() for report in done.reports]
        print_json({"passed": done.passed, "output": str(options.output), "pairs": pairs} | failed_pairs(done.failures))
    else:
        print(tables_to_text([done.table]))
        for report in done.reports:
            for words in report.diagnosis:
                print(f"{report.pair_id}: suspect {words}")
    note_skipped(done.reports)
    return exit_code_of(done.failures, ExitCode.WELL if done.passed else ExitCode.CHECK_FAILED)
