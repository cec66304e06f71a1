"""Parallel work: in threads if it is mostly C code, else in processes, none of which outlives the program; or on a Dask
cluster through joblib."""

from __future__ import annotations

import functools
import importlib
import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import (
    Executor,
    Future,
    InvalidStateError,
    ProcessPoolExecutor,
    ThreadPoolExecutor,
    as_completed,
)
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, nullcontext, suppress
from multiprocessing.reduction import ForkingPickler
from types import ModuleType
from typing import Any, ParamSpec, TypeVar

from rigkit.core.errors import InputError

Arguments = ParamSpec("Arguments")
Item = TypeVar("Item")
Result = TypeVar("Result")


def in_threads(work: Callable[[Item], Result], items: Iterable[Item]) -> Iterator[Result]:
    """Yield the result of `work` for each item, in order, computed in threads on all cores.

    For work that is mostly kernels, OpenCV and files, which release the interpreter lock: threads start at once,
    processes after a second of imports. Exceptions of `work` are raised here, and end items that have not begun.
    """
    with ThreadPoolExecutor(available_cores()) as pool:
        yield from pool.map(work, items)


def available_cores() -> int:
    """Return the number of cores that this process may use, which a container or `taskset` may limit."""
    allowed = getattr(os, "sched_getaffinity", None)
    return len(allowed(0)) if allowed else os.cpu_count() or 1


def process_count(jobs: int | None) -> int:
    """Return the number of processes for `jobs`; None means one for each core. Raises InputError for fewer than one.

    In a daemonic worker (of multiprocessing.Pool, of Dask), which cannot start processes, it is one.
    """
    if jobs is not None and jobs < 1:
        raise InputError(f"--jobs {jobs}: at least one process is needed")
    return 1 if multiprocessing.current_process().daemon else jobs or available_cores()


class SerialExecutor(Executor):
    """An executor that runs work in `submit`, in this process."""

    def submit(
        self, fn: Callable[Arguments, Result], /, *args: Arguments.args, **kwargs: Arguments.kwargs
    ) -> Future[Result]:
        future: Future[Result] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


@contextmanager
def _terminal_signals_blocked() -> Iterator[None]:
    """Block SIGINT and SIGHUP in processes that start here: the terminal sends them to the whole process group, and the
    parent handles them. Children inherit the mask; their own handlers would be set after a second of imports."""
    if not hasattr(signal, "pthread_sigmask"):
        # Windows has neither signal masks nor a signal for a closed terminal.
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGHUP})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def _without_main_module() -> Iterator[None]:
    """Prevent processes that start here from importing the caller's script: without `if __name__ == "__main__"` it
    would run again in each of them."""
    script = sys.modules["__main__"]
    sys.modules["__main__"] = ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = script


def _is_of_script(*work: Any) -> bool:
    """Return whether `work` refers to the caller's script, such as its functions, or cannot be pickled."""
    try:
        return b"__main__" in bytes(ForkingPickler.dumps(work))
    except Exception:
        return True


class _Pool(ProcessPoolExecutor):
    """A process pool that starts all its processes when the first work is submitted, with signals blocked.

    They import the caller's script only if that work refers to it.

    If they were started one by one, a process that starts while another is found dead would neither be terminated nor
    get work, and the pool would wait for it forever (CPython: `terminate_broken` does not know of it).
    """

    def __init__(self, count: int, initializer: Callable[[], None]) -> None:
        # "spawn": a fork after OpenCV has started its threads can hang.
        super().__init__(count, mp_context=multiprocessing.get_context("spawn"), initializer=initializer)
        self._safe_to_dynamically_spawn_children = False
        self._of_script: bool | None = None

    def submit(
        self, fn: Callable[Arguments, Result], /, *args: Arguments.args, **kwargs: Arguments.kwargs
    ) -> Future[Result]:
        if self._of_script is None:
            self._of_script = _is_of_script(fn, args, kwargs)
        with _terminal_signals_blocked():
            future = super().submit(fn, *args, **kwargs)
        # Pending futures are cancelled before the workers end; setting an exception on them would print a traceback.
        future.set_exception = functools.partial(_set_exception, future)  # type: ignore[method-assign]
        return future

    def _launch_processes(self) -> None:
        # Before the pool starts a thread, which would miss the script, too.
        with nullcontext() if self._of_script else _without_main_module():
            super()._launch_processes()  # type: ignore[misc]


def _set_exception(future: Future[Any], error: BaseException | None) -> None:
    with suppress(InvalidStateError):
        Future.set_exception(future, error)


@contextmanager
def worker_pool(count: int) -> Iterator[ProcessPoolExecutor]:
    """Context manager of a pool of `count` new processes.

    An exception in the block, also an interrupt, terminates running work. If this process is killed, its workers exit.
    Raises InputError if a worker is killed.
    """
    others = set(multiprocessing.active_children())
    with _terminal_signals_blocked():
        pool = _Pool(count, _end_with_parent)
    try:
        yield pool
    except BrokenProcessPool as error:
        raise InputError(
            "a process ended before its work was done, perhaps for want of memory; use fewer (-j 1), which shows any "
            "other reason too"
        ) from error
    except BaseException:
        for process in set(multiprocessing.active_children()) - others:
            process.terminate()
        # Waits for the pool's thread: at exit Python would write to the pipe that this thread closes.
        pool.shutdown(cancel_futures=True)
        raise
    pool.shutdown()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None

    def watch() -> None:
        parent.join()
        # A worker that waits for its next task holds both ends of the queue, and would never wake up.
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def over_items(
    function: Callable[[Item], Result], items: Sequence[Item], *, jobs: int | None = 1, cluster: str | None = None
) -> Iterator[tuple[int, Result]]:
    """Yield (index, function(item)) of every item, in any order.

    Raises InputError if `cluster` is given and joblib or distributed are not installed, or it cannot be reached.

    Parameters
    ----------
    jobs : processes on this machine; None: one a core.
    cluster : address of a Dask scheduler to use instead, such as "tcp://host:8786".
    """
    if not items:
        return
    count = min(process_count(jobs), len(items), available_cores())
    if cluster is not None:
        yield from enumerate(_on_cluster(function, items, cluster))
    elif count == 1:
        for place, item in enumerate(items):
            yield place, function(item)
    else:
        with worker_pool(count) as pool:
            waiting = {pool.submit(function, item): place for place, item in enumerate(items)}
            for future in as_completed(waiting):
                yield waiting[future], future.result()


def _on_cluster(function: Callable[[Item], Result], items: Sequence[Item], address: str) -> list[Result]:
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
