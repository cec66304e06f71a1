"""Faults of the environment: a kill at any moment, a full disk, a read-only folder, two runs at once, a worker that
dies. Files are whole or absent, and the error is one line."""

from __future__ import annotations

import io
import json
import os
import random
import resource
import shutil
import signal
import stat
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from pathlib import Path

import pytest

from rigkit.cli.main import main
from rigkit.core.errors import RigkitError
from rigkit.io.corners.corners_file import read_corners
from rigkit.io.media.images import read_image

QUICK = (
    "detect -j 1 --board floor.toml image.png -o out/corners.csv --overlay out",
    "rectify image.png --camera calibration.json -o out/rectified.png",
    "export rig.json --to kalibr -o out/rig.yaml",
    "export opencv.yaml --to rigkit -o out/camera.json",
    "board 5x4 --square-mm 20 -o out/board",
)
LONGER = (
    "diff calibration.json calibration.json -o out/diff.png",
    "certify calibration.json --length 3 --distance 500 -r out/page.html --pdf out/sheet.pdf",
)
COMMANDS = [*QUICK, *(pytest.param(words, marks=pytest.mark.slow) for words in LONGER)]
RESULTS = 8
"""Files that the quick ones write."""
LOOP = f"""
import sys
from rigkit.cli.main import main
while True:
    for words in {QUICK!r}:
        assert main([*words.split(), "--force"]) == 0
    print("again", flush=True)
"""
"""A program that writes its results anew without end."""
PATIENCE_S = 60.0
NOBODY = 65534
READERS: dict[str, Callable[[Path], object]] = {
    ".csv": read_corners,
    ".png": read_image,
    ".json": lambda path: json.loads(path.read_text()),
    ".toml": lambda path: tomllib.loads(path.read_text()),
}


def whole(path: Path) -> bool:
    """Return whether a result is whole, read by its reader."""
    data = path.read_bytes()
    text = data.decode(errors="replace").rstrip()
    kind = path.suffix
    if kind in (".html", ".svg", ".pdf"):
        return text.endswith({".html": "</html>", ".svg": "</svg>", ".pdf": "%%EOF"}[kind])
    if kind == ".yaml":
        return data.endswith(b"\n") and "cam1:" in text
    try:
        READERS[kind](path)
    except (ValueError, RigkitError):
        return False
    return True


def rigkit(*words: str, **options: object) -> subprocess.Popen[str]:
    """Start the program in the present folder."""
    command = [sys.executable, "-m", "rigkit", *words]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **options)  # type: ignore[call-overload]


def ended(program: subprocess.Popen[str]) -> tuple[int, list[str]]:
    """Return the exit code, and what was said of an error."""
    _, printed = program.communicate(timeout=PATIENCE_S)
    return program.returncode, [line for line in printed.splitlines() if line.startswith("rigkit: ") or "Error" in line]


@pytest.mark.parametrize("kills", [1, pytest.param(60, marks=pytest.mark.slow)])
def test_a_kill_at_any_moment_leaves_files_whole(kills: int, place: Path) -> None:
    moments = random.Random(kills)
    checked = 0
    for _ in range(kills):
        program = subprocess.Popen(
            [sys.executable, "-c", LOOP], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
        )
        assert program.stdout is not None
        while program.stdout.readline() != "again\n":
            assert program.poll() is None
        time.sleep(moments.uniform(0.0, 0.5))
        assert program.poll() is None
        program.kill()
        program.wait()
        program.stdout.close()
        # A temporary file that no name was given to may stay; nothing reads it.
        results = [p for p in (place / "out").glob("*") if not p.name.startswith(".")]
        for path in results:
            assert whole(path), path
        checked += len(results)
    assert checked >= RESULTS * kills


def _small_files() -> None:
    resource.setrlimit(resource.RLIMIT_FSIZE, (600, resource.getrlimit(resource.RLIMIT_FSIZE)[1]))


@contextmanager
def small_files() -> Iterator[None]:
    """No file of this process may have more than 600 bytes."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    _small_files()
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.mark.parametrize("words", COMMANDS)
def test_a_full_disk(words: str, place: Path) -> None:
    """No file may have more than 600 bytes: what is longer cannot be written, and nothing of it stays.

    In this process, whose own output goes to memory meanwhile: starting one takes longer than all the rest.
    """
    before, text = sorted(place.rglob("*")), io.StringIO()
    with redirect_stdout(text), redirect_stderr(text), small_files():
        code = main(words.split())
    printed = [line for line in text.getvalue().splitlines() if line.startswith("rigkit: ") or "Error" in line]
    if code == 0:
        for path in set(place.rglob("*")) - set(before):
            assert path.is_dir() or path.stat().st_size <= 600
        return
    assert code == 2 and len(printed) == 1 and "File too large" in printed[0] and "out/" in printed[0]
    assert sorted(place.rglob("*")) == before


def test_a_log_that_cannot_grow_does_not_end_the_work(place: Path) -> None:
    words = "board 5x4 --square-mm 20 -o q --log-file run.log"
    (place / "run.log").write_text("2026-01-01 00:00:00,000 DEBUG rigkit.cli.main: " + 552 * "x" + "\n")
    with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()) as text, small_files():
        main(words.split())
    printed = text.getvalue()
    assert "Traceback" not in printed and "Logging error" not in printed and printed.count("the log ends here") == 1


@pytest.mark.parametrize("words", COMMANDS)
def test_a_folder_that_may_not_be_written(words: str, seeds: Path) -> None:
    """As nobody, where the tests are run by root, who may write everywhere."""
    place = Path(tempfile.mkdtemp(prefix="read-only-"))
    try:
        shutil.copytree(seeds, place, dirs_exist_ok=True)
        for path in (place, *place.rglob("*")):
            path.chmod(0o555 if path.is_dir() else 0o444)
        user = {"user": NOBODY} if os.getuid() == 0 else {}
        python = Path(sys.executable)
        if user and not all(p.stat().st_mode & stat.S_IXOTH for p in (*python.parents, *python.resolve().parents)):
            pytest.skip("nobody may run this Python")
        code, printed = ended(rigkit(*words.split(), cwd=place, **user))
        assert code == 2 and len(printed) == 1 and "no permission" in printed[0] and "out" in printed[0]
    finally:
        for path in (place, *place.rglob("*")):
            path.chmod(0o755)
        shutil.rmtree(place)


@pytest.mark.parametrize("force", [False, True])
def test_two_runs_at_once(force: bool, place: Path) -> None:
    words = [*QUICK[-1].split(), *(["--force"] if force else [])]
    outcomes = [ended(program) for program in [rigkit(*words) for _ in range(3)]]
    codes = sorted(code for code, _ in outcomes)
    assert codes == ([0, 0, 0] if force else [0, 2, 2])
    assert all(len(printed) == 1 and "--force" in printed[0] for code, printed in outcomes if code)
    results = sorted((place / "out").iterdir())
    assert [p.name for p in results] == ["board.pdf", "board.svg", "board.toml"]
    assert all(map(whole, results))


def test_two_calibrations_share_their_kept_corners(place: Path) -> None:
    (place / "calibration.json").unlink()
    session = place / "session.toml"
    session.write_text(session.read_text().replace("board.toml", "floor.toml"))
    programs = [rigkit("calibrate", "session.toml", "-o", f"new{k}.json") for k in range(2)]
    for program in programs:
        assert ended(program)[0] == 3
    assert json.loads((place / "corners.json").read_text())["images"]


def test_a_worker_that_is_killed(place: Path) -> None:
    (place / "many").mkdir()
    for k in range(400):
        shutil.copy(place / "image.png", place / "many" / f"{k:03d}.png")
    program = rigkit("detect", "many", "-j", "2", "-o", "new.csv")
    victim, end = 0, time.monotonic() + PATIENCE_S
    while not victim:
        assert time.monotonic() < end and program.poll() is None
        victim = next((pid for pid in _children(program.pid) if _is_worker(pid)), 0)
        time.sleep(0.01)
    os.kill(victim, signal.SIGKILL)
    code, printed = ended(program)
    assert code == 2 and len(printed) == 1 and "-j 1" in printed[0]
    assert not (place / "new.csv").exists()


def _children(pid: int) -> list[int]:
    text = Path(f"/proc/{pid}/task/{pid}/children").read_text()
    return [int(word) for word in text.split()]


def _is_worker(pid: int) -> bool:
    try:
        return b"spawn_main" in Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:
        return False


def test_the_check_notices_truncated_files(place: Path) -> None:
    for words in QUICK:
        assert main(words.split()) == 0
    results = sorted((place / "out").iterdir())
    assert len(results) == RESULTS
    for path in results:
        assert whole(path)
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
        # Half of a line of numbers may be a line of numbers.
        assert path.suffix == ".csv" or not whole(path), path
