"""Choose the tests that `./scripts/test` leaves to `./scripts/test --thorough`, and write them to tests/thorough.txt.

    python scripts/quick_tests.py [--total 200] [--further] [--data FILE ...] [--tests PATH ...]

Runs all tests but the slow ones under coverage (15 minutes of one idle core), each in its own context. A test can be
left out of the quick run if its other tests reach every line and branch of rigkit that it reaches. The slowest of these
are left out until the rest takes --total seconds of processor time: a limit on a test's time is lowered until then. Of
the tests above the limit, a set is kept that reaches what the shorter ones do not. It is chosen greedily by the lines
and branches added per second (Chvatal, Mathematics of Operations Research 4, 1979), without those that later choices
make redundant. Files of `WHOLE` are left out. Also kept are a short test of every file and function, `KEPT`, tests
that fail under coverage, and those that start programs other than Python, whose coverage is unknown. With --further
only the present quick tests are run, in half the time, and more of them are left out. Prints seconds, lines and
branches of both.
"""

from __future__ import annotations

import argparse
import ast
import contextlib
import json
import os
import resource
import sqlite3
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import coverage
import numpy as np
import pytest
from coverage.parser import PythonParser
from numpy.typing import NDArray

ROOT = Path(__file__).resolve().parents[1]
CHOSEN = ROOT / "tests" / "thorough.txt"
KEPT = (
    # What the package is for, on captures with truth; nothing may rest on them, for not everybody has the captures.
    "tests/real/",
    # Branches of C are not counted.
    "tests/kernels/",
    # These look at the code, they do not run it.
    "tests/architecture/",
)
MAY_BE_MISSING = ("tests/real/", "_own_readers.py", "_in_browser.py", "_accessible.py")
"""Tests that are skipped where captures, a browser or another program are missing: others have to reach their lines."""
WHOLE = ("tests/contracts/test_round_trips.py",)
"""Files left out as a whole, which the quick run need not even import: before its first test Hypothesis reads the
numbers in all modules, 3 s of each process in a fresh clone. Others have to reach their lines, too."""
HEAD = """\
# The tests that the quick run leaves out: scripts/quick_tests.py chose them, ./scripts/test --thorough runs them too.
# The quick tests reach every line and branch of rigkit that these reach.
"""
LIMITS_S = (5.0, 3.0, 2.0, 1.5, 1.0, 0.7, 0.5, 0.3, 0.2, 0.1, 0.05)
MAX_STARTED_S = 0.05
"""Of a test's processes that are not seen: a browser takes more."""
MAX_OF_FILE_S = 1.0
"""A longer test does not stay for its file alone."""
MAX_OF_FUNCTION_S = 0.02
"""A longer test, with all fixtures, does not stay for its function alone: 33 functions of ten folders took 0.4 s."""
OF_PROCESSES = """\
[run]
branch = true
source_pkgs = rigkit
parallel = true
context = ${RIGKIT_TEST}
data_file = %s
"""
"""How coverage sees processes of Python that a test starts: each is of the test's context."""
Fixture = pytest.FixtureDef[object]
STEPS = (
    "select context.context, file.path, fromno, tono from arc "
    "join context on context.id = context_id join file on file.id = file_id"
)
Part = tuple[str, int] | tuple[str, int, int]
"""A line of a file, or the branch from one line to another."""
WHOSE = (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)


def _processor_s(who: int) -> float:
    used = resource.getrusage(who)
    return used.ru_utime + used.ru_stime


class Recorder:
    """Of pytest: every test is a context of the coverage, and is timed.

    Attributes
    ----------
    seconds : of a test, processor time here but for fixtures that others use too and in processes that coverage saw,
        and that in others; the latter infinite of a test that failed.
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
        os.environ["RIGKIT_TEST"] = item.nodeid
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

    def see(self, tests: set[str]) -> None:
        """Count the processes of tests with what is seen."""
        for test in tests & self.seconds.keys():
            here, started = self.seconds[test]
            if np.isfinite(started):
                self.seconds[test] = (here + started, 0.0)

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.failed:
            self.seconds[report.nodeid] = (0.0, float("inf"))


def _name_of(fixture: Fixture, param: object) -> str:
    return f"{fixture.baseid}::{fixture.argname}[{param}]"


class Source:
    """A file of rigkit: which of its lines and branches coverage counts.

    What a process runs once, at import or by the first call of a function with a cache, counts for no test: whichever
    comes first would have it.
    """

    def __init__(self, path: str) -> None:
        self.path = path
        self.parser = PythonParser(filename=path)
        self.parser.parse_source()
        tree = ast.parse(Path(path).read_text(encoding="utf-8"))
        functions = [node for node in ast.walk(tree) if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef))]
        called = [f for f in functions if not any("cache" in ast.unparse(one) for one in f.decorator_list)]
        # `def name(self) -> float: ...` is run at import, too.
        called = [f for f in called if f.body[0].lineno > f.lineno]
        self.lines = self.parser.statements & {
            line for f in called for line in range(f.body[0].lineno, (f.end_lineno or f.lineno) + 1)
        }
        exits = self.parser.exit_counts()
        self.branches = {arc for arc in self.parser.arcs() if arc[0] in self.lines and exits[arc[0]] > 1}

    def parts(self, start: int, end: int) -> list[Part]:
        """Return what the step from one line to the next (negative: from or to outside) reaches."""
        branch = (self.parser.first_line(start), self.parser.first_line(end))
        out: list[Part] = [(self.path, *branch)] if branch in self.branches else []
        return [*out, (self.path, branch[1])] if branch[1] in self.lines else out


def record(data: Path, tests: Sequence[str]) -> None:
    """Run the tests; write what they reach to `data`, and what they take to `data`.json."""
    measured = coverage.Coverage(data_file=str(data))
    # As `python -m pytest` has it: processes that a test starts import its module.
    sys.path.insert(0, str(ROOT))
    measured.start()
    recorder = Recorder(measured)
    with tempfile.TemporaryDirectory() as folder:
        started = Path(folder, "coveragerc")
        started.write_text(OF_PROCESSES % Path(folder, "started"))
        os.environ["COVERAGE_PROCESS_START"] = str(started)
        pytest.main(["--rootdir", str(ROOT), "-q", *tests], plugins=[recorder])
        del os.environ["COVERAGE_PROCESS_START"]
        measured.stop()
        measured.save()
        for path in Path(folder).glob("started.*"):
            of_process = coverage.CoverageData(str(path))
            # One that was killed leaves half of its data.
            with contextlib.suppress(coverage.exceptions.DataError):
                of_process.read()
                recorder.see(of_process.measured_contexts())
                measured.get_data().update(of_process)
    measured.save()
    reported = {"seconds": recorder.seconds, "shared": recorder.shared, "uses": recorder.uses}
    data.with_suffix(".json").write_text(json.dumps(reported))


@dataclass(frozen=True, eq=False)
class Reach:
    """What each test takes and reaches.

    Attributes
    ----------
    tests : their names.
    seconds : (T, 2) of processor time, seen and not; see `Recorder`.
    shared : (F,) of the fixtures that several tests use.
    uses : (T, F), which test uses which.
    parts : (T, P), whether the test reaches the line or branch.
    is_line : (P,), whether it is a line.
    """

    tests: tuple[str, ...]
    seconds: NDArray[np.float64]
    shared: NDArray[np.float64]
    uses: NDArray[np.bool_]
    parts: NDArray[np.bool_]
    is_line: NDArray[np.bool_]

    @classmethod
    def of(cls, paths: Sequence[Path]) -> Reach:
        seconds: dict[str, tuple[float, float]] = {}
        shared: dict[str, float] = {}
        used: dict[str, list[str]] = {}
        steps: list[tuple[str, str, int, int]] = []
        for data in paths:
            reported = json.loads(data.with_suffix(".json").read_text())
            seconds, shared, used = seconds | reported["seconds"], shared | reported["shared"], used | reported["uses"]
            with sqlite3.connect(data) as base:
                steps += base.execute(STEPS)
        tests = {test: k for k, test in enumerate(seconds)}
        sources = {path: Source(path) for path in {path for _, path, *_ in steps}}
        of_step = {step: sources[step[0]].parts(*step[1:]) for step in {step[1:] for step in steps}}
        columns = {part: k for k, part in enumerate({part for parts in of_step.values() for part in parts})}
        reached = np.zeros((len(tests), len(columns)), dtype=bool)
        for test, path, start, end in steps:
            if test in tests:
                reached[tests[test], [columns[part] for part in of_step[path, start, end]]] = True
        return cls(
            tuple(tests),
            np.array(list(seconds.values()), dtype=np.float64),
            np.array(list(shared.values()), dtype=np.float64),
            np.array([[name in used.get(test, ()) for name in shared] for test in seconds], dtype=bool),
            reached,
            np.array([len(part) == 2 for part in columns]),
        )

    def left_out(self, limit_s: float) -> NDArray[np.bool_]:
        """Return the mask of the tests, of those that take more than `limit_s` with their share of what they use, that
        the others make needless."""
        whole = np.array([test.startswith(WHOLE) for test in self.tests])
        missing = whole | np.array([any(part in test for part in MAY_BE_MISSING) for test in self.tests])
        fixed = np.array([test.startswith(KEPT) for test in self.tests]) | (self.seconds[:, 1] > MAX_STARTED_S)
        each_s = self.seconds[:, 0] + self.uses @ (self.shared / np.maximum(self.uses.sum(axis=0), 1))
        out = whole | (each_s > limit_s) & ~fixed
        wanted = self.parts.any(axis=0) & ~self.parts[~out & ~missing].any(axis=0)
        open_tests = np.flatnonzero(out & ~missing)
        while wanted.any() and len(open_tests):
            adds = self.parts[open_tests][:, wanted].sum(axis=1)
            best = open_tests[(adds / each_s[open_tests]).argmax()]
            if not adds.any():
                break
            out[best] = False
            wanted &= ~self.parts[best]
            open_tests = open_tests[open_tests != best]
        # What was chosen early may be reached by what was chosen later: the dearest go first.
        dear = np.flatnonzero((each_s > limit_s) & ~fixed & ~out & ~missing)
        times = self.parts[~out & ~missing].sum(axis=0)
        for test in dear[np.argsort(-each_s[dear])]:
            if (times[self.parts[test]] > 1).all():
                out[test] = True
                times -= self.parts[test]
        # Of every file at least one stays, if it is short: what it is about is looked at.
        files = np.array([test.partition("::")[0] for test in self.tests])
        for file in set(files) - set(files[~out]) - set(WHOLE):
            own = np.flatnonzero(files == file)
            shortest = own[each_s[own].argmin()]
            out[shortest] = each_s[shortest] > MAX_OF_FILE_S
        # Of every function one stays that costs next to nothing: to reach a line is not to check what it computes.
        functions = np.array([function_of(test) for test in self.tests])
        alone_s = self.seconds.sum(axis=1) + self.uses @ self.shared
        for function in set(functions[out & ~whole]) - set(functions[~out]):
            own = np.flatnonzero(functions == function)
            shortest = own[alone_s[own].argmin()]
            out[shortest] = alone_s[shortest] > MAX_OF_FUNCTION_S
        return out

    def describe(self, name: str, chosen: NDArray[np.bool_]) -> str:
        """Return in words what tests take and reach."""
        found = self.parts[chosen].any(axis=0)
        lines, branches = (found & self.is_line).sum(), (found & ~self.is_line).sum()
        return f"{name}: {chosen.sum()} tests, {self.total_s(chosen):.0f} s, {lines} lines and {branches} branches"

    def total_s(self, chosen: NDArray[np.bool_]) -> float:
        """Return the seconds of tests, but for those that failed, and of what they use."""
        seconds = self.seconds[chosen]
        return float(seconds[np.isfinite(seconds)].sum() + self.shared[self.uses[chosen].any(axis=0)].sum())


def function_of(test: str) -> str:
    """Return the id of a test without its parameters."""
    return test.partition("[")[0]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--total", type=float, default=200.0, help="seconds that the quick tests may take, of one core")
    parser.add_argument("--data", type=Path, nargs="+", default=[ROOT / "out" / "quick-tests.db"], help="used if there")
    parser.add_argument("--further", action="store_true", help="run the quick tests of now alone, leave out more")
    parser.add_argument("--tests", nargs="+", default=[], help="instead of all: into the first of --data")
    args = parser.parse_args()
    os.chdir(ROOT)
    if not args.data[0].exists():
        args.data[0].parent.mkdir(parents=True, exist_ok=True)
        quick = ["-m", "not slow and not thorough"] if args.further else []
        record(args.data[0], [*(args.tests or ["tests"]), *quick])
    reach = Reach.of(args.data)
    for limit in LIMITS_S:
        out = reach.left_out(limit)
        if reach.total_s(~out) <= args.total:
            break
    left = {test for test, is_out in zip(reach.tests, out, strict=True) if is_out and not test.startswith(WHOLE)}
    left |= set(WHOLE)
    if args.further:
        before = {line for line in CHOSEN.read_text(encoding="utf-8").splitlines() if not line.startswith("#")}
        left |= before - set(reach.tests)
    # Of a function that is left out with all its parameters, no test is made.
    stays = {function_of(test) for test in reach.tests if test not in left}
    names = sorted({test if function_of(test) in stays else function_of(test) for test in left})
    CHOSEN.write_text(HEAD + "".join(f"{name}\n" for name in names), encoding="utf-8")
    failed = [test for test, (_, started) in zip(reach.tests, reach.seconds, strict=True) if not np.isfinite(started)]
    print(f"tests of more than {limit} s; {len(failed)} failed under coverage and stay {' '.join(failed)}")
    print(reach.describe("thorough", np.ones(len(reach.tests), dtype=bool)))
    print(reach.describe("quick", ~out))


if __name__ == "__main__":
    main()
