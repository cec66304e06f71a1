"""Output of `rigkit validate`, as JSON and as text."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from rigkit.cli.console import note, print_json
from rigkit.cli.dataset_arguments import exit_code_of, failed_pairs
from rigkit.core.errors import ExitCode

if TYPE_CHECKING:
    from pathlib import Path

    from rigkit.validation.checks import ValidationReport
    from rigkit.validation.crosscheck import CrossCheckReport
    from rigkit.workflows.options.clouds import PaperOptions
    from rigkit.workflows.validation.paper import PaperValidation
    from rigkit.workflows.validation.validate import DatasetValidation


def show(done: DatasetValidation, out: Path, *, json: bool) -> int:
    """Print the validation of a data set, whose files are in `out`; return the exit code."""
    from rigkit.report.pages.validation_page import summary_table
    from rigkit.report.tables import tables_to_text

    if json:
        result = {
            "passed": done.passed,
            "output": str(out),
            "causes": [cause.text for cause in done.causes],
            "reports": [report.to_dict() for report in done.reports],
            "page": done.page.to_dict(),
        }
        print_json(result | failed_pairs(done.failures))
    else:
        print(tables_to_text([summary_table([pair.best for pair in done.pairs])]))
        _print_failures(done.reports, done.crosschecks)
        for cause in done.causes:
            if done.passed:
                note(f"to look at: {cause.text}")
            else:
                print(f"probable cause: {cause.text}")
        # Notes come after the causes, so that they are not mistaken for causes.
        _print_notes(done.reports, done.crosschecks)
        verdict = "NOT every pair was validated" if done.failures else done.page.badge
        page = "report.html" if "report.html" in done.files else "tables.md"
        print(f"{verdict}; {out / page}, {done.seconds:.1f} s")
    return exit_code_of(done.failures, ExitCode.WELL if done.passed else ExitCode.CHECK_FAILED)


def show_paper(done: PaperValidation, options: PaperOptions, *, json: bool) -> int:
    """Print the paper's tables; return the exit code, which does not depend on the paper's claims."""
    from rigkit.report.tables import tables_to_text
    from rigkit.workflows.validation.paper import NOT_CHECKED

    if json:
        result = {"output": str(options.output), "reports": [report.to_dict() for report in done.reports]}
        print_json(result | failed_pairs(done.failures))
    else:
        print(tables_to_text([table for table in done.tables if table.key != "estimators"]))
        print(f"{options.output}")
    note(NOT_CHECKED)
    return exit_code_of(done.failures, ExitCode.WELL)


def _print_failures(reports: Sequence[ValidationReport], compared: Sequence[CrossCheckReport]) -> None:
    from rigkit.report.pages.validation_verdict import failed_facts

    for fact in failed_facts(reports, compared):
        print(" ".join(filter(None, [fact.what, fact.pair_id, ",".join(fact.methods), fact.words])))


def note_skipped(compared: Sequence[CrossCheckReport]) -> None:
    """Log the independent methods that could not be used, and why."""
    for other in compared:
        for words in other.skipped:
            note(f"{other.pair_id}: not cross-checked by {words}")


def _print_notes(reports: Sequence[ValidationReport], compared: Sequence[CrossCheckReport]) -> None:
    note_skipped(compared)
    for words in dict.fromkeys(f"{report.pair_id}: {n}" for report in reports for n in report.notes):
        note(words)
