"""Interrupted or killed programs: one line, the exit code of the signal, no process and no partial file left."""

from __future__ import annotations

import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rigkit.cli import diff
from rigkit.cli.main import main
from rigkit.core.errors import InputError
from rigkit.core.processes import over_items, process_count, worker_pool
from rigkit.workflows.reconstruction.datasets import _attempt

TASK = """
import os, time
from pathlib import Path

def work(path):
    Path(path).write_text(str(os.getpid()))
    time.sleep(600)
"""
WORK = """
import sys
from pathlib import Path
from task import work
from rigkit.cli.main import main
from rigkit.core.processes import over_items, process_count, worker_pool

def run(args):
    folder = Path(args.output)
    with worker_pool(2) as pool:
        list(pool.map(work, [folder / str(k) for k in range(8)]))

if __name__ == "__main__":
    import rigkit.cli.diff as verb
    verb.run = run
    sys.exit(main(["diff", "a", "b", "-o", sys.argv[1]]))
"""
"""The program with a verb that works for ten minutes in two processes, and has more to do."""

PATIENCE_S = 60.0


def alive(pid: int) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0]
    except OSError:
        return False
    return state != "Z"


def _heeds_signals() -> None:
    """Undo what a test run in the background or under nohup passes on: signals that are ignored."""
    for number in (signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGKILL], ids=lambda s: s.name)
@pytest.mark.parametrize("to_all", [True, False], ids=["group", "process"])
def test_workers_end_with_the_program(tmp_path: Path, how: signal.Signals, to_all: bool) -> None:
    (tmp_path / "task.py").write_text(TASK)
    (tmp_path / "work.py").write_text(WORK)
    program = subprocess.Popen(
        [sys.executable, str(tmp_path / "work.py"), str(tmp_path)],
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        preexec_fn=_heeds_signals,
    )
    notes = [tmp_path / "0", tmp_path / "1"]
    end = time.monotonic() + PATIENCE_S
    while not all(note.exists() and note.read_text() for note in notes):
        assert time.monotonic() < end and program.poll() is None
        time.sleep(0.02)
    (os.killpg if to_all else os.kill)(program.pid, how)
    _, words = program.communicate(timeout=PATIENCE_S)
    if how is signal.SIGKILL:
        assert program.returncode == -how
    else:
        assert program.returncode == 128 + how
        assert words.splitlines() == ["rigkit: interrupted"]
    while any(alive(int(note.read_text())) for note in notes):
        assert time.monotonic() < end
        time.sleep(0.02)


def test_a_full_disk_is_not_reported_as_a_bug(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def full(args: object) -> int:
        raise OSError(28, "No space left on device", "results/cloud.ply")

    monkeypatch.setattr("rigkit.cli.diff.run", full)
    assert main(["diff", "a", "b"]) == 2
    assert "'results/cloud.ply': No space left on device" in capsys.readouterr().err


def test_too_little_memory_is_not_reported_as_a_bug(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def large(args: object) -> int:
        np.empty((10**9, 10**6))
        return 0

    monkeypatch.setattr("rigkit.cli.diff.run", large)
    assert main(["diff", "a", "b"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "Unable to allocate" in line and "-j 1" in line


def _ends(_: int) -> None:
    os._exit(1)


def test_a_killed_worker_is_one_line() -> None:
    with pytest.raises(InputError, match="-j 1"), worker_pool(1) as pool:
        list(pool.map(_ends, [0]))


def test_a_worker_killed_while_another_starts_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    """The pool would close its queues under the one that starts, or wait for it for ever."""
    start = ProcessPoolExecutor._spawn_process  # type: ignore[attr-defined]

    def late(pool: Any) -> None:
        for process in pool._processes.values():
            process.kill()
            process.join()
            # Time enough for the pool to see it.
            time.sleep(0.5)
        start(pool)

    monkeypatch.setattr(ProcessPoolExecutor, "_spawn_process", late)
    with pytest.raises(InputError, match="-j 1"), worker_pool(2) as pool:
        list(pool.map(_twice, range(4)))


def _twice(number: int) -> int:
    return 2 * number


SCRIPT = """
print("begun")
from rigkit.core.processes import over_items, process_count, worker_pool
with worker_pool(2) as pool:
    print(*pool.map(abs, [-1, -2]))
"""


@pytest.mark.parametrize("file", ["script.py", "-"])
def test_a_plain_script_is_not_run_again_by_workers(tmp_path: Path, file: str) -> None:
    """Nothing in it asks for its name, as in the documentation's examples; - is read from stdin."""
    (tmp_path / "script.py").write_text(SCRIPT)
    command = [sys.executable, file]
    done = subprocess.run(command, input=SCRIPT, cwd=tmp_path, capture_output=True, text=True, timeout=PATIENCE_S)
    assert (done.stdout.split(), done.stderr) == (["begun", "1", "2"], "")


OWN_WORK = """
from rigkit.core.processes import worker_pool

def own(number):
    return -number

if __name__ == "__main__":
    with worker_pool(2) as pool:
        print(*pool.map(own, [-1, -2]))
"""


def test_workers_know_the_functions_of_a_script(tmp_path: Path) -> None:
    (tmp_path / "script.py").write_text(OWN_WORK)
    command = [sys.executable, "script.py"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=PATIENCE_S)
    assert (done.stdout.split(), done.stderr) == (["1", "2"], "")


@pytest.mark.parametrize("jobs", [None, 2])
def test_a_worker_of_the_callers_works_alone(monkeypatch: pytest.MonkeyPatch, jobs: int | None) -> None:
    """Those of multiprocessing.Pool may start no processes."""
    monkeypatch.setitem(multiprocessing.current_process()._config, "daemon", True)  # type: ignore[attr-defined]
    with pytest.raises(AssertionError, match="daemonic"), worker_pool(1) as pool:
        pool.submit(_twice, 1)
    assert process_count(jobs) == 1
    assert list(over_items(lambda k: 2 * k, [1, 2], jobs=2)) == [(0, 2), (1, 4)]


@pytest.mark.parametrize("works", [[], [1, 2]], ids=["no work", "work"])
def test_a_system_without_these_signals_works(
    works: list[int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Windows has no SIGHUP and no signal masks. The first work starts a process, which imports everything anew."""
    monkeypatch.delattr(signal, "SIGHUP")
    monkeypatch.delattr(signal, "pthread_sigmask")
    assert main(["board", "5x4", "--square-mm", "30", "-o", str(tmp_path / "board")]) == 0
    with worker_pool(1) as pool:
        assert list(pool.map(_twice, works)) == [2 * k for k in works]


def test_the_version_says_what_is_installed(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["--version"])
    assert stop.value.code == 0
    first, second, third = capsys.readouterr().out.splitlines()
    assert first.startswith("rigkit ")
    assert second.split()[0] == "kernels" and len(second.split()[1].rstrip(",")) == 16
    assert "Python 3." in third


@pytest.mark.parametrize("printed", [ImportError("initialization failed"), InputError("a library cannot be loaded")])
def test_a_library_interrupted_while_it_is_loaded(
    printed: Exception, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """It says that it could not be loaded, of which the interruption is the cause."""

    def work(_: object) -> int:
        try:
            raise KeyboardInterrupt
        except KeyboardInterrupt as stop:
            raise printed from stop

    monkeypatch.setattr(diff, "run", work)
    assert main(["diff", "a.json", "b.json"]) == 128 + signal.SIGINT
    assert capsys.readouterr().err == "rigkit: interrupted\n"
    job: Any = None
    with pytest.raises(KeyboardInterrupt):
        _attempt(work, job)


def test_an_error_among_its_own_causes(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Its causes are not followed for ever."""
    first, second = InputError("a.json: it is empty; write it again"), ValueError("empty")

    def work(_: object) -> int:
        second.__cause__ = first
        raise first from second

    monkeypatch.setattr(diff, "run", work)
    assert main(["diff", "a.json", "b.json"]) == first.exit_code
    assert capsys.readouterr().err == "rigkit: a.json: it is empty; write it again\n"


def test_an_interrupted_pool_leaves_no_thread() -> None:
    """Python itself stumbles at its end over the thread of a pool that closes just then."""
    before = set(threading.enumerate())
    with pytest.raises(KeyboardInterrupt), worker_pool(2) as pool:
        waiting = [pool.submit(time.sleep, 600) for _ in range(8)]
        raise KeyboardInterrupt
    assert all(future.done() for future in waiting)
    assert set(threading.enumerate()) <= before  # a thread of an earlier test may end meanwhile
