"""Running a study: in one process, several, or on a Dask cluster; an interrupted run goes on where it stopped."""

from __future__ import annotations

import hashlib
import importlib
import io
import json
import os
from collections.abc import Iterable, Iterator
from concurrent.futures import as_completed
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rigkit.core.errors import InputError
from rigkit.core.processes import worker_pool
from rigkit.core.progress import Progress, silent
from rigkit.io.files import write_atomic
from rigkit.io.sources import source_hash
from rigkit.study.study import Study, chunk_count, run_chunk

__all__ = ["run_study", "study_key"]

Errors = NDArray[np.float32]


def study_key(study: Study) -> str:
    """Return a name for everything that determines the study's numbers, rigkit's own code among it."""
    text = json.dumps(study.to_dict() | {"name": "", "title": "", "code": source_hash()}, sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def run_study(
    study: Study,
    *,
    jobs: int = 1,
    dask: str | None = None,
    parts: Path | None = None,
    progress: Progress = silent,
) -> list[Errors]:
    """Return the errors of every chunk of a study; the numbers do not depend on who computes them.

    Parameters
    ----------
    jobs : processes on this machine.
    dask : address of a Dask scheduler to use instead, such as "tcp://host:8786".
    parts : folder for finished chunks. What an earlier run of the same study left there is used; everything is removed
        when the study is complete.

    Raises
    ------
    InputError
        Dask is asked for but not installed, or a cluster cannot be reached.
    """
    total = chunk_count(study)
    key = study_key(study)
    done: dict[int, Errors] = {}
    for index in range(total) if parts is not None else ():
        earlier = _read(_part(parts, key, index))
        if earlier is not None:
            done[index] = earlier
    progress(study.name, len(done), total)
    missing = [index for index in range(total) if index not in done]
    for index, errors in _compute(study, missing, jobs, dask):
        done[index] = errors
        if parts is not None:
            write_atomic(_part(parts, key, index), _npy(errors), force=True)
        progress(study.name, len(done), total)
    if parts is not None:
        for index in range(total):
            _part(parts, key, index).unlink(missing_ok=True)
        with suppress(OSError):
            parts.rmdir()
    return [done[index] for index in range(total)]


def _part(parts: Path | None, key: str, index: int) -> Path:
    assert parts is not None
    return parts / f"{key}-{index:05d}.npy"


def _read(path: Path) -> Errors | None:
    """Return a finished chunk, or None where there is none (or none that can be read: it is computed again)."""
    try:
        return np.asarray(np.load(path), dtype=np.float32)
    except (OSError, ValueError, EOFError):
        return None


def _npy(errors: Errors) -> bytes:
    data = io.BytesIO()
    np.save(data, errors)
    return data.getvalue()


def _compute(study: Study, indices: list[int], jobs: int, dask: str | None) -> Iterator[tuple[int, Errors]]:
    if not indices:
        return
    if dask is not None:
        yield from _on_dask(study, indices, dask)
    elif jobs == 1 or len(indices) == 1:
        for index in indices:
            yield index, run_chunk(study, index)
    else:
        with worker_pool(min(jobs, len(indices), os.cpu_count() or 1)) as pool:
            waiting = {pool.submit(run_chunk, study, index): index for index in indices}
            for future in as_completed(waiting):
                yield waiting[future], future.result()


def _on_dask(study: Study, indices: list[int], address: str) -> Iterable[tuple[int, Errors]]:
    """Compute through joblib's Dask backend."""
    try:
        distributed, joblib = (importlib.import_module(name) for name in ("distributed", "joblib"))
    except ImportError as error:
        raise InputError(f"simulate: --dask needs {error.name}; pip install joblib distributed") from error
    try:
        client: Any = distributed.Client(address, timeout="10s")
    except (OSError, ValueError) as error:
        raise InputError(f"simulate: no Dask scheduler answers at '{address}'; check the address") from error
    with client, joblib.parallel_config(backend="dask"):
        run = joblib.Parallel(return_as="list")
        results = run(joblib.delayed(partial(run_chunk, study))(index) for index in indices)
    return zip(indices, results, strict=True)
