"""`rigkit simulate`: run synthetic studies: from a study file to tables and box plots.

examples:
  rigkit simulate study.toml -o results
  rigkit simulate study.toml --trials 20 --format pdf      fewer trials; vector graphics
"""

from __future__ import annotations

import argparse
from pathlib import Path

from rigkit.cli.console import add_options, note, options_of, print_json, progress_on_stderr
from rigkit.workflows.options.cameras import StudyOptions


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("studies", nargs="+", metavar="STUDY.toml", help="one or more study files")
    parser.add_argument("-o", "--output", default="out/studies", metavar="FOLDER", help="default: out/studies")
    add_options(parser, StudyOptions, trials="N", jobs="-j N", dask="ADDRESS", figure="--format", force="")
    parser.add_argument("--json", action="store_true", help="print the tables as JSON instead of Markdown")


def run(args: argparse.Namespace) -> int:
    from rigkit.core.errors import ExitCode
    from rigkit.report.pages.study_page import study_tables
    from rigkit.report.tables import tables_to_markdown
    from rigkit.workflows.study import run_studies

    options = options_of(StudyOptions, args, output=Path(args.output))
    results = []
    for done in run_studies(args.studies, options, progress=progress_on_stderr()):
        results.append(done.table.to_dict())
        if not args.json:
            print(tables_to_markdown(study_tables(done.table)))
        note(f"{done.study.name}: {', '.join(map(str, done.written))}")
    if args.json:
        print_json(results)
    return ExitCode.WELL
