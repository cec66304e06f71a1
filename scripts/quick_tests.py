"""Choose the tests that `./scripts/test` leaves to `./scripts/test --thorough`, and write them to tests/thorough.txt.

    python scripts/quick_tests.py [--seconds 0.5] [--data FILE] [PYTEST_ARGUMENT...]

Runs all tests but the slow ones under coverage (twice as long as without), each a context of its own. A test may be
left out of the quick run where it takes more than --seconds of processor time and the quick ones reach every line and
every branch of rigkit that it reaches. Of the tests that take longer, the quick run keeps those that together reach
what is missing, chosen one after the other by what they add a second (Chvatal, Mathematics of Operations Research 4,
1979). It also keeps `KEPT`, and tests that start processes: what these reach is not seen. Prints seconds, lines and
branches of both.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import sqlite3
import sys
from collections import defaultdict
from collections.abc import Iterator, Mapping
from pathlib import Path

import coverage
import pytest

ROOT = Path(__file__).resolve().parents[1]
CHOSEN = ROOT / "tests" / "thorough.txt"
KEPT = (
    # What the package is for, on captures with truth; nothing may rest on them, for not everybody has the captures.
    "tests/real/",
    # Branches of C are not counted.
    "tests/kernels/",
)
MAY_BE_MISSING = (
    "tests/real/",
    "tests/interop/test_own_readers.py",
    "_in_browser.py",
    "tests/report/test_accessible.py",
)
"""Tests that are skipped where captures, a browser or another program are missing: others have to reach their lines."""
HEAD = """\
# The tests that the quick run leaves out: scripts/quick_tests.py chose them, ./scripts/test --thorough runs them too.
# Each takes long, and the quick tests reach every line and branch of rigkit that it reaches.
"""
MAX_STARTED_S = 0.05
"""Of a test's processes: even one of Python takes so much."""
WHOSE = (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
Place = tuple[str, int, int]
"""A step from one line of a file to the next; to or from -n is the entry or exit of what begins in line n."""


def _processor_s(who: int) -> float:
    used = resource.getrusage(who)
    return used.ru_utime + used.ru_stime


class Recorder:
    """Of pytest: every test is a context of the coverage, and is timed: processor seconds here, and of processes that
    it started."""

    def __init__(self, measured: coverage.Coverage) -> None:
        self.measured, self.seconds = measured, dict[str, tuple[float, float]]()

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Iterator[None]:
        self.measured.switch_context(item.nodeid)
        begun = [_processor_s(who) for who in WHOSE]
        yield
        here, started = (_processor_s(who) - then for who, then in zip(WHOSE, begun, strict=True))
        self.seconds[item.nodeid] = round(here, 3), round(started, 3)
        self.measured.switch_context("")


def record(data: Path, arguments: list[str]) -> None:
    """Run the tests; write what they reach to `data`, and what they take to `data`.json."""
    measured = coverage.Coverage(data_file=str(data))
    # As `python -m pytest` has it: processes that a test starts import its module.
    sys.path.insert(0, str(ROOT))
    measured.start()
    recorder = Recorder(measured)
    code = pytest.main(["--rootdir", str(ROOT), "-q", *(arguments or [str(ROOT / "tests")])], plugins=[recorder])
    measured.stop()
    measured.save()
    data.with_suffix(".json").write_text(json.dumps(recorder.seconds))
    if code:
        sys.exit(f"the tests failed ({code}): nothing is chosen")


def reached(data: Path) -> dict[str, set[Place]]:
    """Return by test the steps that it reaches."""
    found: dict[str, set[Place]] = defaultdict(set)
    query = (
        "select context.context, file.path, fromno, tono from arc "
        "join context on context.id = context_id join file on file.id = file_id"
    )
    with sqlite3.connect(data) as base:
        for test, path, start, end in base.execute(query):
            found[test].add((path, start, end))
    return found


def left_out(seconds: Mapping[str, tuple[float, float]], places: Mapping[str, set[Place]], limit_s: float) -> list[str]:
    """Return the tests that the quick run can do without."""
    took = {test: here for test, (here, started) in seconds.items() if started < MAX_STARTED_S}
    dear = {test for test, s in took.items() if s > limit_s and not test.startswith(KEPT)}
    # What is reached before the first test, by imports, is reached in any run.
    there = set().union(*(steps for test, steps in places.items() if test not in dear and not _may_be_missing(test)))
    wanted = set().union(*places.values()) - there
    adds = {test: places.get(test, set()) & wanted for test in dear if not _may_be_missing(test)}
    while best := max(adds, key=lambda test: len(adds[test]) / took[test], default=None):
        new = adds.pop(best)
        if not new:
            break
        dear.discard(best)
        adds = {test: steps - new for test, steps in adds.items()}
    return sorted(dear)


def _may_be_missing(test: str) -> bool:
    return any(part in test for part in MAY_BE_MISSING)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=0.5, help="shorter tests stay (default 0.5)")
    parser.add_argument("--data", type=Path, default=ROOT / "out" / "quick-tests.db", help="kept; used again if there")
    args, arguments = parser.parse_known_args()
    os.chdir(ROOT)
    if not args.data.exists():
        args.data.parent.mkdir(parents=True, exist_ok=True)
        record(args.data, arguments)
    seconds, places = json.loads(args.data.with_suffix(".json").read_text()), reached(args.data)
    out = left_out(seconds, places, args.seconds)
    CHOSEN.write_text(HEAD + "".join(f"{test}\n" for test in out), encoding="utf-8")
    tests = {"quick": set(seconds) - set(out), "thorough": set(seconds)}
    for name, chosen in tests.items():
        steps = set().union(*(places.get(test, set()) for test in (*chosen, "")))
        lines = {(path, line) for path, *ends in steps for line in ends if line > 0}
        total = sum(sum(seconds[test]) for test in chosen)
        print(f"{name}: {len(chosen)} tests, {total:.0f} s under coverage, {len(lines)} lines, {len(steps)} steps")


if __name__ == "__main__":
    main()
