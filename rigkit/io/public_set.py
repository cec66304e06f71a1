"""Public captures with measured truth: what was measured and by what, licence, source, and each file's hash.

::

    schema = "rigkit.public/1"
    name = "bumblebee2"
    about = "11 stereo pairs of a chessboard"
    rendered = false
    source = "https://github.com/..."
    licence = "CC-BY-4.0"
    folder = "public/bumblebee2"     # where its files are in a folder of captures

    [[boards]]                       # as in a board's file, with an `id`
    id = "board"
    columns = 4
    rows = 6
    square_mm = 30.0

    [[measured]]
    id = "baseline"
    value = 120.0
    sigma = 0.1                      # optional: where nobody stated it, it is not there
    unit = "mm"
    how = "the maker's data sheet"

    [files]                          # SHA-256 of each file
    "left01.jpg" = "..."

    [urls]                           # whence to fetch them; a file without is not fetchable yet
    "left01.jpg" = "https://..."
    "left02.jpg" = "https://.../archive.tar.gz#folder/left02.jpg"      # in a .tar or .zip
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from rigkit.core.boards import Board
from rigkit.core.errors import InputError
from rigkit.io.board_file import board_from_table
from rigkit.io.toml_reader import TomlTable, read_toml

PUBLIC_SCHEMA = "rigkit.public/1"
MEASURED_UNITS = ("mm", "deg", "px")
URL = re.compile(r"^(https?|file)://\S+$")
SHA256 = re.compile(r"^[0-9a-f]{64}$")


@dataclass(frozen=True, slots=True)
class PublicMeasurement:
    """A quantity that somebody measured: `sigma` is None where nobody stated one; `how` says by what."""

    what: str
    value: float
    sigma: float | None
    unit: str
    how: str


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class PublicSet:
    """A public capture.

    Attributes
    ----------
    path : the file that describes it.
    name, about, source, licence : in words.
    rendered : images of a computer, not of a camera.
    folder : where its files are in a folder of captures.
    boards : in its images.
    measured : what is known of it.
    sha256 : of each file, by its path in the set.
    urls : of the files that can be fetched.
    """

    path: Path
    name: str
    about: str
    source: str
    licence: str
    rendered: bool
    folder: str
    boards: tuple[Board, ...]
    measured: tuple[PublicMeasurement, ...]
    sha256: Mapping[str, str]
    urls: Mapping[str, str]

    def measurement(self, what: str) -> PublicMeasurement:
        """Return what was measured under this name; raises InputError that lists the names."""
        for measurement in self.measured:
            if measurement.what == what:
                return measurement
        names = ", ".join(m.what for m in self.measured)
        raise InputError(f"{self.path}: nothing called '{what}' was measured; there are {names}")


def load_public_set(path: str | Path) -> PublicSet:
    """Return the description of a public capture; raises InputError for a missing or unknown key, a path that leaves
    the set, something that is no hash or address, or an address of a file that is not listed."""
    table = read_toml(path, PUBLIC_SCHEMA)
    boards: tuple[Board, ...] = ()
    if table.has("boards"):
        boards = tuple(_board(entry) for entry in table.tables("boards", hint="[[boards]] with id, columns, rows"))
    measured: tuple[PublicMeasurement, ...] = ()
    if table.has("measured"):
        entries = table.tables("measured", hint="[[measured]] with id, value, unit and how")
        measured = tuple(_measurement(entry) for entry in entries)
    sha256 = _texts(table, "files", SHA256, "a SHA-256; write the 64 characters of 0-9 and a-f that `sha256sum` prints")
    urls = _texts(table, "urls", URL, "an address (https://...)") if table.has("urls") else {}
    for name in urls:
        if name not in sha256:
            raise table.error(f"[urls]: '{name}' is not in [files]; add its hash")
    found = PublicSet(
        path=Path(path),
        name=table.identifier("name", hint='name = "bumblebee2"'),
        about=table.text("about", hint='about = "11 stereo pairs of a chessboard"'),
        source=table.text("source", hint='source = "https://github.com/..."'),
        licence=table.text("licence", hint='licence = "CC-BY-4.0"'),
        rendered=table.boolean("rendered", hint="rendered = false"),
        folder=_inside(table, table.text("folder", hint='folder = "public/bumblebee2"')),
        boards=boards,
        measured=measured,
        sha256=sha256,
        urls=urls,
    )
    table.done()
    return found


def _board(entry: TomlTable) -> Board:
    board = board_from_table(entry, "board")
    entry.done()
    return board


def _measurement(entry: TomlTable) -> PublicMeasurement:
    sigma = entry.number("sigma", hint="sigma = 0.1") if entry.has("sigma") else None
    found = PublicMeasurement(
        entry.text("id", hint='id = "baseline"'),
        entry.number("value", hint="value = 120.0", positive=False),
        sigma,
        entry.text("unit", hint='unit = "mm"', choices=MEASURED_UNITS),
        entry.text("how", hint='how = "calipers"'),
    )
    entry.done()
    return found


def _texts(table: TomlTable, key: str, pattern: re.Pattern[str], kind: str) -> dict[str, str]:
    """Return a table of texts by path in the set, each of the pattern."""
    own = table.table(key, hint=f"[{key}]")
    out = {}
    for name in own.names():
        out[_inside(own, name)] = value = own.text(name, hint=kind)
        if not pattern.match(value):
            raise own.error(f"'{name}' is '{value[:80]}', which is not {kind}")
    if not out:
        raise table.error(f"[{key}] is empty; list the files of the set")
    return out


def _inside(table: TomlTable, name: str) -> str:
    """Return a path that stays in its folder."""
    path = PurePosixPath(name)
    if path.is_absolute() or ".." in path.parts or "\\" in name or ":" in name:
        raise table.error(f"'{name}' leaves the folder of the set; give a path in it, with /")
    return path.as_posix()
