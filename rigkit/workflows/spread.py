"""Work on many items: in this process, in several, or on a Dask cluster through joblib."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import as_completed
from typing import Any, TypeVar

from rigkit.core.errors import InputError
from rigkit.core.processes import available_cores, worker_pool

Item = TypeVar("Item")
Outcome = TypeVar("Outcome")


def over_items(
    function: Callable[[Item], Outcome], items: Sequence[Item], *, jobs: int = 1, cluster: str | None = None
) -> Iterator[tuple[int, Outcome]]:
    """Yield (place, function(item)) of every item, in any order.

    Raises InputError: a cluster is asked for but joblib or distributed are not installed, or it cannot be reached.

    Parameters
    ----------
    jobs : processes on this machine.
    cluster : address of a Dask scheduler to use instead, such as "tcp://host:8786".
    """
    if not items:
        return
    if cluster is not None:
        yield from enumerate(_on_cluster(function, items, cluster))
    elif jobs == 1 or len(items) == 1:
        for place, item in enumerate(items):
            yield place, function(item)
    else:
        with worker_pool(min(jobs, len(items), available_cores())) as pool:
            waiting = {pool.submit(function, item): place for place, item in enumerate(items)}
            for future in as_completed(waiting):
                yield waiting[future], future.result()


def _on_cluster(function: Callable[[Item], Outcome], items: Sequence[Item], address: str) -> list[Outcome]:
    try:
        distributed, joblib = (importlib.import_module(name) for name in ("distributed", "joblib"))
    except ImportError as error:
        raise InputError(f"a cluster needs {error.name}; pip install joblib distributed") from error
    try:
        client: Any = distributed.Client(address, timeout="10s")
    except (OSError, ValueError) as error:
        raise InputError(f"no Dask scheduler answers at '{address}'; check the address") from error
    with client, joblib.parallel_config(backend="dask"):
        return list(joblib.Parallel(return_as="list")(joblib.delayed(function)(item) for item in items))
