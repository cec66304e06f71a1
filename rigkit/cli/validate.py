"""`rigkit validate`: validate reconstructed pairs against measured ground truth: report, tables, clouds.

Exit code 1 if a check fails.

examples:
  rigkit validate lab                             report, tables and clouds in out/lab
  rigkit validate lab -p first -o results --force
  rigkit validate monday tuesday wednesday        several data sets, one table
  rigkit validate lab --paper                     the paper's own pipeline, beside its printed tables
"""

from __future__ import annotations

import argparse
from pathlib import Path

from rigkit.cli.console import add_options, note, options_of, progress_on_stderr, require_existing
from rigkit.cli.dataset_arguments import (
    NO_DATASET,
    add_dataset_arguments,
    add_direction_arguments,
    add_planes_argument,
    has_directions,
    results_folder,
)
from rigkit.cli.validation_output import show, show_paper
from rigkit.core.errors import InputError
from rigkit.workflows.options.clouds import PaperOptions, ValidateOptions


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_dataset_arguments(parser, several=True)
    parser.add_argument(
        "--cluster", metavar="ADDRESS", help="with several data sets: Dask scheduler to use instead of processes"
    )
    add_direction_arguments(parser)
    add_planes_argument(parser, "planes used to check angles, normals and the baseline")
    parser.add_argument(
        "--no-pictures", dest="pictures", action="store_false", help="leave out PNG pictures and the HTML report"
    )
    parser.add_argument(
        "--figures", choices=("png", "pdf"), default="png", help="pdf: also write the pictures as vector graphics"
    )
    parser.add_argument(
        "--no-crosscheck", dest="crosscheck", action="store_false", help="leave out the comparison with pycolmap"
    )
    parser.add_argument(
        "--paper",
        action="store_true",
        help="run the paper's own pipeline instead (chords, equal weights, linear solvers, no refinement): its tables "
        "beside the printed ones, and whether its claims hold",
    )
    add_options(parser, PaperOptions, own_solvers="")


def run(args: argparse.Namespace) -> int:
    require_existing(*args.dataset, remedy=NO_DATASET)
    from rigkit.io.manifests.manifest import load_dataset
    from rigkit.workflows.validation.paper import validate_as_paper
    from rigkit.workflows.validation.validate import validate_dataset

    if len(args.dataset) > 1:
        return _validate_several(args)
    if args.cluster is not None:
        raise InputError("--cluster needs several data sets; for one use -j, the processors of this machine")
    dataset = load_dataset(args.dataset[0])
    out = results_folder(args, dataset.name)
    if args.paper and has_directions(args):
        raise InputError("--paper fixes directions and scale itself; leave --directions and --det-scale out")
    if args.paper and args.planes is not None:
        raise InputError("--paper fits planes by principal components; leave --planes out")
    if args.paper:
        options = options_of(PaperOptions, args, output=out)
        return show_paper(validate_as_paper(dataset, options, progress=progress_on_stderr()), options, json=args.json)
    if args.own_solvers:
        raise InputError("--own-solvers needs --paper; add that, or leave it out")
    done = validate_dataset(dataset, _options(args, out), progress=progress_on_stderr())
    return show(done, out, json=args.json)


def _options(args: argparse.Namespace, output: Path) -> ValidateOptions:

    return options_of(ValidateOptions, args, output=output, pdf=args.figures == "pdf")


def _validate_several(args: argparse.Namespace) -> int:
    """Validate several data sets, each in a folder of its own; print one table."""
    from dataclasses import replace

    from rigkit.core.processes import process_count
    from rigkit.report.tables import tables_to_json, tables_to_text
    from rigkit.workflows.validation.validate_many import validate_datasets

    if args.paper or args.own_solvers:
        raise InputError("--paper is for one data set at a time")
    out = results_folder(args, "datasets")
    jobs = process_count(args.jobs)
    progress = progress_on_stderr()
    done = validate_datasets(args.dataset, _options(args, out), jobs=jobs, cluster=args.cluster, progress=progress)
    # Sentences stand below the table, not in it.
    short = replace(done.table, columns=done.table.columns[:-1], rows=tuple(row[:-1] for row in done.table.rows))
    print(tables_to_json([done.table]) if args.json else tables_to_text([short]))
    for path, outcome in zip(args.dataset, done.outcomes, strict=True):
        if outcome.error:
            note(f"'{path}': {outcome.error}")
    note(f"{out / 'summary.html'}")
    return done.code
