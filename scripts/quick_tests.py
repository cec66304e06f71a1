"""Choose the tests that `./scripts/test` leaves to `./scripts/test --thorough`, and write them to tests/thorough.txt.

    python scripts/quick_tests.py [--total 200] [--data FILE ...] [--tests PATH ...]

Runs all tests but the slow ones under coverage (a quarter of an hour of one quiet core), each a context of its own. The
quick run can do without a test where its other tests reach every line and every branch of rigkit that it reaches. Left
out are the dearest of these, until the rest takes --total seconds of processor time: of the tests that take longer than
a limit, which falls until that is so, the quick run keeps those that together reach what the shorter ones do not,
chosen one after the other by what they add a second (Chvatal, Mathematics of Operations Research 4, 1979). It also
keeps `KEPT`, and tests that fail or start processes under coverage: what these reach is not seen. Prints seconds,
lines and branches of both.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import sqlite3
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import coverage
import numpy as np
import pytest
from numpy.typing import NDArray

ROOT = Path(__file__).resolve().parents[1]
CHOSEN = ROOT / "tests" / "thorough.txt"
KEPT = (
    # What the package is for, on captures with truth; nothing may rest on them, for not everybody has the captures.
    "tests/real/",
    # Branches of C are not counted.
    "tests/kernels/",
)
MAY_BE_MISSING = ("tests/real/", "test_own_readers.py", "_in_browser.py", "test_accessible.py")
"""Tests that are skipped where captures, a browser or another program are missing: others have to reach their lines."""
HEAD = """\
# The tests that the quick run leaves out: scripts/quick_tests.py chose them, ./scripts/test --thorough runs them too.
# The quick tests reach every line and branch of rigkit that these reach.
"""
LIMITS_S = (5.0, 3.0, 2.0, 1.5, 1.0, 0.7, 0.5, 0.3, 0.2, 0.1)
MAX_STARTED_S = 0.05
"""Of a test's processes: even one of Python takes so much."""
Fixture = pytest.FixtureDef[object]
WHOSE = (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)


def _processor_s(who: int) -> float:
    used = resource.getrusage(who)
    return used.ru_utime + used.ru_stime


class Recorder:
    """Of pytest: every test is a context of the coverage, and is timed.

    Attributes
    ----------
    seconds : of a test, processor time here but for fixtures that others use too, and in processes that it started;
        the latter infinite of a test that failed.
    shared : of a fixture that several tests use, the time that it takes to make.
    uses : which of these a test uses.
    """

    def __init__(self, measured: coverage.Coverage) -> None:
        self.measured = measured
        self.seconds: dict[str, tuple[float, float]] = {}
        self.shared: dict[str, float] = {}
        self.uses: dict[str, list[str]] = {}
        self._made = 0.0

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Function) -> Iterator[None]:
        self.measured.switch_context(item.nodeid)
        begun, self._made = [_processor_s(who) for who in WHOSE], 0.0
        yield
        here, started = (_processor_s(who) - then for who, then in zip(WHOSE, begun, strict=True))
        self.seconds.setdefault(item.nodeid, (round(here - self._made, 3), round(started, 3)))
        self.measured.switch_context("")

    @pytest.hookimpl(wrapper=True)
    def pytest_fixture_setup(
        self, fixturedef: pytest.FixtureDef[object], request: pytest.FixtureRequest
    ) -> Iterator[None]:
        begun = _processor_s(resource.RUSAGE_SELF)
        result = yield
        if fixturedef.scope != "function":
            took = _processor_s(resource.RUSAGE_SELF) - begun
            self.shared[_name_of(fixturedef, getattr(request, "param", ""))] = took
            self._made += took
        return result

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtest_call(self, item: pytest.Function) -> None:
        params = item.callspec.params if hasattr(item, "callspec") else {}
        # Which fixture a name stands for, pytest says nowhere in public.
        used = {name: defs[-1] for name, defs in item._fixtureinfo.name2fixturedefs.items()}
        names = [_name_of(one, params.get(name, "")) for name, one in used.items() if one.scope != "function"]
        self.uses[item.nodeid] = [name for name in names if name in self.shared]

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.failed:
            self.seconds[report.nodeid] = (0.0, float("inf"))


def _name_of(fixture: Fixture, param: object) -> str:
    return f"{fixture.baseid}::{fixture.argname}[{param}]"


def record(data: Path, tests: Sequence[str]) -> None:
    """Run the tests; write what they reach to `data`, and what they take to `data`.json."""
    measured = coverage.Coverage(data_file=str(data))
    # As `python -m pytest` has it: processes that a test starts import its module.
    sys.path.insert(0, str(ROOT))
    measured.start()
    recorder = Recorder(measured)
    pytest.main(["--rootdir", str(ROOT), "-q", *(tests or ["tests"])], plugins=[recorder])
    measured.stop()
    measured.save()
    told = {"seconds": recorder.seconds, "shared": recorder.shared, "uses": recorder.uses}
    data.with_suffix(".json").write_text(json.dumps(told))


@dataclass(frozen=True, eq=False)
class Reach:
    """What each test takes and reaches.

    Attributes
    ----------
    tests : their names.
    seconds : (T, 2) of processor time, here and in processes that it started; see `Recorder`.
    shared : (F,) of the fixtures that several tests use.
    uses : (T, F), which test uses which.
    steps : (T, S), whether the test makes the step from one line of a file to the next.
    imported : (S,), steps that are made before the first test.
    lines : (S,), a number for the line that each step leads to.
    """

    tests: tuple[str, ...]
    seconds: NDArray[np.float64]
    shared: NDArray[np.float64]
    uses: NDArray[np.bool_]
    steps: NDArray[np.bool_]
    imported: NDArray[np.bool_]
    lines: NDArray[np.int64]

    @classmethod
    def of(cls, paths: Sequence[Path]) -> Reach:
        seconds: dict[str, tuple[float, float]] = {}
        shared: dict[str, float] = {}
        used: dict[str, list[str]] = {}
        made: list[tuple[str, tuple[str, int, int]]] = []
        query = (
            "select context.context, file.path, fromno, tono from arc "
            "join context on context.id = context_id join file on file.id = file_id"
        )
        for path in paths:
            told = json.loads(path.with_suffix(".json").read_text())
            seconds, shared, used = seconds | told["seconds"], shared | told["shared"], used | told["uses"]
            with sqlite3.connect(path) as base:
                made += ((test, (str(file), start, end)) for test, file, start, end in base.execute(query))
        tests = {test: k for k, test in enumerate(seconds)}
        steps = {step: k for k, step in enumerate(dict.fromkeys(step for _, step in made))}
        reached = np.zeros((len(tests) + 1, len(steps)), dtype=bool)
        # Whatever is no test stands last.
        reached[[tests.get(test, len(tests)) for test, _ in made], [steps[step] for _, step in made]] = True
        uses = np.array([[name in used.get(test, ()) for name in shared] for test in seconds], dtype=bool)
        lines = {line: k for k, line in enumerate(dict.fromkeys((file, abs(end)) for file, _, end in steps))}
        return cls(
            tuple(tests),
            np.array(list(seconds.values()), dtype=np.float64),
            np.array(list(shared.values()), dtype=np.float64),
            uses,
            reached[:-1],
            reached[-1],
            np.array([lines[file, abs(end)] for file, _, end in steps]),
        )

    def left_out(self, limit_s: float) -> NDArray[np.bool_]:
        """Return the mask of the tests, of those that take more than `limit_s` with their share of what they use, that
        the others make needless."""
        missing = np.array([any(part in test for part in MAY_BE_MISSING) for test in self.tests])
        fixed = np.array([test.startswith(KEPT) for test in self.tests]) | (self.seconds[:, 1] > MAX_STARTED_S)
        each_s = self.seconds[:, 0] + self.uses @ (self.shared / np.maximum(self.uses.sum(axis=0), 1))
        out = (each_s > limit_s) & ~fixed
        wanted = self.steps.any(axis=0) & ~self.imported & ~self.steps[~out & ~missing].any(axis=0)
        open_tests = np.flatnonzero(out & ~missing)
        while wanted.any() and len(open_tests):
            adds = self.steps[open_tests][:, wanted].sum(axis=1)
            best = open_tests[(adds / each_s[open_tests]).argmax()]
            if not adds.any():
                break
            out[best] = False
            wanted &= ~self.steps[best]
            open_tests = open_tests[open_tests != best]
        return out

    def describe(self, name: str, chosen: NDArray[np.bool_]) -> str:
        """Return in words what tests take and reach."""
        steps = self.steps[chosen].any(axis=0) | self.imported
        total = self.total_s(chosen)
        return f"{name}: {chosen.sum()} tests, {total:.0f} s, {len(set(self.lines[steps]))} lines, {steps.sum()} steps"

    def total_s(self, chosen: NDArray[np.bool_]) -> float:
        """Return the seconds of tests, but for those that failed, and of what they use."""
        seconds = self.seconds[chosen]
        return float(seconds[np.isfinite(seconds)].sum() + self.shared[self.uses[chosen].any(axis=0)].sum())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--total", type=float, default=200.0, help="seconds that the quick tests may take, of one core")
    parser.add_argument("--data", type=Path, nargs="+", default=[ROOT / "out" / "quick-tests.db"], help="used if there")
    parser.add_argument("--tests", nargs="+", default=[], help="instead of all: into the first of --data")
    args = parser.parse_args()
    os.chdir(ROOT)
    if not args.data[0].exists():
        args.data[0].parent.mkdir(parents=True, exist_ok=True)
        record(args.data[0], args.tests)
    reach = Reach.of(args.data)
    for limit in LIMITS_S:
        out = reach.left_out(limit)
        if reach.total_s(~out) <= args.total:
            break
    names = sorted(test for test, is_out in zip(reach.tests, out, strict=True) if is_out)
    CHOSEN.write_text(HEAD + "".join(f"{name}\n" for name in names), encoding="utf-8")
    failed = [test for test, (_, started) in zip(reach.tests, reach.seconds, strict=True) if not np.isfinite(started)]
    print(f"tests of more than {limit} s; {len(failed)} failed under coverage and stay {' '.join(failed)}")
    print(reach.describe("thorough", np.ones(len(reach.tests), dtype=bool)))
    print(reach.describe("quick", ~out))


if __name__ == "__main__":
    main()
