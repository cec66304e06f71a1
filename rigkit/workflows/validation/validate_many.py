"""`rigkit validate` of several data sets, each on its own, with one summary table."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from rigkit.core.errors import DegenerateError, ExitCode, InputError, RigkitError
from rigkit.core.printing import brief
from rigkit.core.processes import over_items
from rigkit.core.progress import Progress, silent
from rigkit.core.tables import Cell, Table, cells, columns
from rigkit.io.manifests.manifest import load_dataset
from rigkit.report.pages.page_facts import PageFacts, build_facts_page
from rigkit.report.tables import table_files
from rigkit.validation.tables import mean_normal_error
from rigkit.workflows.options.clouds import ValidateOptions
from rigkit.workflows.outputs.provenance import software_facts
from rigkit.workflows.outputs.results import require_folder, write_results
from rigkit.workflows.validation.validate import validate_dataset


@dataclass(frozen=True, slots=True, kw_only=True)
class SetOutcome:
    """The outcome of one data set.

    Attributes
    ----------
    name : name of the data set and of its folder of results.
    code : its exit code if it were validated alone.
    error : its error, its failed pairs, or the probable cause of failed checks; empty if all passed.
    pairs, checks_failed : numbers of pairs and of failed checks.
    worst_angle_deg, mean_normal_deg, worst_baseline_sigmas : over the pairs' best estimators; None if unknown.
    """

    name: str
    code: int
    error: str = ""
    pairs: int = 0
    checks_failed: int = 0
    worst_angle_deg: float | None = None
    mean_normal_deg: float | None = None
    worst_baseline_sigmas: float | None = None


@dataclass(frozen=True, eq=False, slots=True)
class ManyValidation:
    """The outcomes of all data sets in the order given, their table, and the files of the summary."""

    outcomes: tuple[SetOutcome, ...]
    table: Table
    written: tuple[Path, ...]

    __repr__ = brief

    @property
    def code(self) -> int:
        """The largest exit code: bad input before failed checks."""
        return max((outcome.code for outcome in self.outcomes), default=ExitCode.WELL)


def validate_datasets(
    datasets: Sequence[str | Path],
    options: ValidateOptions,
    *,
    jobs: int = 1,
    cluster: str | None = None,
    progress: Progress = silent,
) -> ManyValidation:
    """Validate each data set by `validate_dataset` into a folder of its name in `options.output`, and write a summary
    there.

    A data set that fails does not stop the others. Raises InputError: two data sets of the same name, no folder for
    results, or one that cannot be written; a cluster that does not answer.

    Parameters
    ----------
    jobs : number of processes on this machine, one data set each.
    cluster : address of a Dask scheduler to use instead; it must see the same files.
    """
    if options.output is None:
        raise InputError("several data sets need a folder for their results")
    named = [(_name_of(path), Path(path).resolve()) for path in datasets]
    names = [name for name, _ in named]
    twice = [name for name in names if names.count(name) > 1]
    if twice:
        raise InputError(
            f"two data sets are called '{twice[0]}', as is the folder of results; change `name` in one's dataset.toml"
        )
    require_folder(options.output, force=options.force)
    work = partial(_validate_one, options=replace(options, output=options.output.resolve(), jobs=1))
    found: dict[int, SetOutcome] = {}
    for place, outcome in over_items(work, named, jobs=jobs, cluster=cluster):
        found[place] = outcome
        progress("data sets", len(found), len(named))
    outcomes = tuple(found[place] for place in range(len(named)))
    table = _table(outcomes)
    files = {**table_files([table], "summary", "md", "csv", "json"), "summary.html": _page(outcomes, table)}
    return ManyValidation(outcomes, table, write_results(options.output, files, force=True))


def _name_of(path: str | Path) -> str:
    """Return the name in the manifest, or that of its folder if the manifest cannot be read."""
    try:
        return load_dataset(path).name
    except (InputError, DegenerateError):
        whole = Path(path).resolve()
        return (whole.parent if whole.suffix == ".toml" else whole).name


def _validate_one(named: tuple[str, Path], *, options: ValidateOptions) -> SetOutcome:
    name, path = named
    assert options.output is not None
    try:
        done = validate_dataset(path, replace(options, output=options.output / name))
    except RigkitError as error:
        return SetOutcome(name=name, code=error.exit_code, error=str(error))
    best = [pair.best for pair in done.pairs]
    checked = [*(report.checks for report in best), *(other.checks for other in done.crosschecks)]
    angles = [a.error_deg for report in best for a in report.angles if a.error_deg is not None]
    baselines = [c.k for report in best for c in report.checks if c.kind == "baseline"]
    why = [*map(str, done.failures), *(cause.text for cause in done.causes)]
    more = f" (and {len(why) - 1} more on its page)" if len(why) > 1 else ""
    failed = done.failures[0].error.exit_code if done.failures else ExitCode.CHECK_FAILED
    return SetOutcome(
        name=name,
        code=ExitCode.WELL if done.passed else failed,
        error="".join([*why[:1], more]),
        pairs=len(done.pairs),
        checks_failed=sum(not c.passed for checks in checked for c in checks),
        worst_angle_deg=max(angles, default=None),
        mean_normal_deg=mean_normal_error(best),
        worst_baseline_sigmas=max(map(float, np.abs(baselines)), default=None),
    )


def _table(outcomes: Sequence[SetOutcome]) -> Table:
    heads = columns(
        "data set | pairs .0 | checks failed .0 | worst angle error [deg] | mean normal error [deg] | worst baseline "
        "[sigmas] .1 | verdict | why"
    )
    words = {ExitCode.WELL: "pass", ExitCode.CHECK_FAILED: "FAIL"}
    verdicts = [Cell(words.get(ExitCode(o.code), "not validated"), failed=o.code != ExitCode.WELL) for o in outcomes]
    rows = tuple(
        cells(o.name, o.pairs, o.checks_failed, o.worst_angle_deg, o.mean_normal_deg, o.worst_baseline_sigmas)
        + cells(verdict, o.error)
        for o, verdict in zip(outcomes, verdicts, strict=True)
    )
    return Table("datasets", "Data sets, each pair with its best estimator", heads, rows)


def _page(outcomes: Sequence[SetOutcome], table: Table) -> str:
    passed = sum(outcome.code == ExitCode.WELL for outcome in outcomes)
    return build_facts_page(
        "rigkit validation: many data sets",
        PageFacts(
            headline=f"{passed} of {len(outcomes)} data sets pass",
            badge="all checks passed" if passed == len(outcomes) else "some data sets failed",
            passed=passed == len(outcomes),
            tables=(table,),
        ),
        software_facts(),
        links=[(o.name, f"{o.name}/report.html") for o in outcomes if o.pairs],
    )
