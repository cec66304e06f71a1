"""`rigkit simulate`: synthetic studies in one process, several, or on a Dask cluster; interrupted runs are resumed."""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rigkit.core.errors import InputError
from rigkit.core.printing import brief
from rigkit.core.processes import over_items, process_count
from rigkit.core.progress import Progress, silent
from rigkit.io.corners.corner_cache import source_hash
from rigkit.io.disk.json_reader import json_text
from rigkit.io.disk.reading import about
from rigkit.io.disk.writing import ensure_writable, write_atomic, write_together
from rigkit.io.manifests.study_file import load_study
from rigkit.report.pages.study_page import cell_table, study_page, study_tables
from rigkit.report.pictures.study_figure import study_figure
from rigkit.report.tables import tables_to_csv, tables_to_markdown
from rigkit.study.study import Study, chunk_count, run_chunk
from rigkit.study.table import StudyTable, tabulate
from rigkit.workflows.options.cameras import StudyOptions
from rigkit.workflows.outputs.provenance import software_facts

Errors = NDArray[np.float32]


@dataclass(frozen=True, eq=False, slots=True)
class StudyResult:
    """A study, its table, and the written files."""

    study: Study
    table: StudyTable
    written: tuple[Path, ...]

    __repr__ = brief


def run_studies(
    paths: Sequence[str | Path], options: StudyOptions | None = None, *, progress: Progress = silent
) -> Iterator[StudyResult]:
    """Yield the result of every study file; each is written as soon as it is complete.

    Raises InputError, before the first study runs, if a file cannot be read or written or two studies share a name.
    """
    options = options or StudyOptions()
    process_count(options.jobs)  # an impossible number of jobs is refused before the work
    studies = [load_study(path) for path in paths]
    if options.trials is not None:
        studies = [replace(study, trials=options.trials) for study in studies]
    names = [study.name for study in studies]
    if len(set(names)) < len(names):
        raise InputError(f"simulate: two studies have the same name ({', '.join(sorted(names))}); rename one")
    for study in studies:
        ensure_writable(_files_of(study, options).values(), force=options.force, inputs=paths)
    for path, study in zip(paths, studies, strict=True):
        parts = None if options.output is None else options.output / f".{study.name}.parts"
        with about(path):
            errors = run_study(study, jobs=options.jobs, dask=options.dask, parts=parts, progress=progress)
            table = tabulate(study, errors)
            places = _files_of(study, options)
            if places:
                figure = study_figure(table, options.figure)
                contents: dict[str, str | bytes] = {
                    "csv": tables_to_csv([cell_table(table)]),
                    "json": json_text(table.to_dict()),
                    "md": tables_to_markdown(study_tables(table)),
                    options.figure: figure,
                    "html": study_page(table, software_facts(), drawn=figure if options.figure == "png" else None),
                }
                write_together({to: contents[suffix] for suffix, to in places.items()}, force=options.force)
        yield StudyResult(study, table, tuple(places.values()))


def _files_of(study: Study, options: StudyOptions) -> dict[str, Path]:
    """Return the paths of a study's files by ending."""
    if options.output is None:
        return {}
    return {
        suffix: options.output / f"{study.name}.{suffix}" for suffix in ("csv", "json", "md", "html", options.figure)
    }


def study_key(study: Study) -> str:
    """Return a hash of everything that determines the study's results, including rigkit's code."""
    text = json.dumps(study.to_dict() | {"name": "", "title": "", "code": source_hash()}, sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def run_study(
    study: Study, *, jobs: int = 1, dask: str | None = None, parts: Path | None = None, progress: Progress = silent
) -> list[Errors]:
    """Return the errors of every chunk of a study; they do not depend on `jobs` and `dask`.

    Raises InputError: Dask is not installed, or its scheduler cannot be reached.

    Parameters
    ----------
    jobs : processes on this machine.
    dask : address of a Dask scheduler to use instead, such as "tcp://host:8786".
    parts : folder for finished chunks. Chunks of an earlier run of the same study are used; they are removed when the
        study is complete.
    """
    total, key = chunk_count(study), study_key(study)
    places = [] if parts is None else [parts / f"{key}-{index:05d}.npy" for index in range(total)]
    earlier = {index: _read_chunk(place) for index, place in enumerate(places)}
    done = {index: errors for index, errors in earlier.items() if errors is not None}
    progress(study.name, len(done), total)
    missing = [index for index in range(total) if index not in done]
    for place, errors in over_items(partial(run_chunk, study), missing, jobs=jobs, cluster=dask):
        index = missing[place]
        done[index] = errors
        if places:
            write_atomic(places[index], _npy(errors), force=True)
        progress(study.name, len(done), total)
    for path in places:
        path.unlink(missing_ok=True)
    if parts is not None:
        with suppress(OSError):
            parts.rmdir()
    return [done[index] for index in range(total)]


def _read_chunk(path: Path) -> Errors | None:
    """Return a finished chunk, or None if it is missing or cannot be read."""
    try:
        return np.asarray(np.load(path), dtype=np.float32)
    except (OSError, ValueError, EOFError):
        return None


def _npy(errors: Errors) -> bytes:
    data = io.BytesIO()
    np.save(data, errors)
    return data.getvalue()
