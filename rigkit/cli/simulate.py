"""`rigkit simulate`: run synthetic studies: from a study file to tables and box plots."""

from __future__ import annotations

import argparse
from pathlib import Path


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("studies", nargs="+", metavar="STUDY.toml", help="one or more study files")
    parser.add_argument("-o", "--output", default="out/studies", metavar="FOLDER", help="default: out/studies")
    parser.add_argument("--trials", type=int, metavar="N", help="number of trials (default: that of the file)")
    parser.add_argument(
        "-j", "--jobs", type=int, default=1, metavar="N", help="number of processes; does not change the results"
    )
    parser.add_argument("--dask", metavar="ADDRESS", help="a Dask scheduler to use instead of processes")
    parser.add_argument("--format", choices=("png", "pdf", "svg"), default="png", help="format of the figures")
    parser.add_argument("--json", action="store_true", help="print the tables as JSON instead of Markdown")
    parser.add_argument("--force", action="store_true", help="replace existing files")


def run(args: argparse.Namespace) -> int:
    from rigkit.cli.console import note, options_of, print_json, progress_on_stderr
    from rigkit.core.errors import ExitCode
    from rigkit.report.pages.study_page import study_tables
    from rigkit.report.tables import tables_to_markdown
    from rigkit.workflows.study import StudyOptions, run_studies

    options = options_of(StudyOptions, args, output=Path(args.output), figure=args.format)
    results = []
    for done in run_studies(args.studies, options, progress=progress_on_stderr()):
        results.append(done.table.to_dict())
        if not args.json:
            print(tables_to_markdown(study_tables(done.table)))
        note(f"{done.study.name}: {', '.join(map(str, done.written))}")
    if args.json:
        print_json(results)
    return ExitCode.WELL
