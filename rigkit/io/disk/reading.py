"""Reading regular files up to a maximum size, and limits of the numbers in them.

Values outside of these limits are mistakes or damage; errors say which.
"""

from __future__ import annotations

import csv
import io
import math
import os
import stat
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from rigkit.core.errors import InputError, InstallationError, RigkitError

MAX_TEXT_BYTES = 64_000_000
"""The corners of ten thousand images."""
MAX_BINARY_BYTES = 1_000_000_000
"""An image of 160 megapixels in 16 bits, a cloud of ten million points."""
MAX_NAME_BYTES, MAX_PATH_BYTES = 255, 4095
"""Limits of file systems for a name, and of the system for a path."""
MAX_NUMBER = 1e9
"""A thousand kilometres in mm."""
MIN_POSITIVE = 1e-9
"""A picometre in mm; a measurement with a smaller sigma would outweigh all else."""


def is_file_or_broken_link(path: Path) -> bool:
    """Return whether a folder's entry is a file or a broken link, which its reader reports."""
    return path.is_file() or (path.is_symlink() and not path.exists())


def paths_of(given: str | Path | Sequence[str | Path]) -> list[Path]:
    """Return paths; a single one need not be in a list."""
    return [Path(given)] if isinstance(given, str | Path) else [Path(one) for one in given]


def usable_path(path: str | Path) -> Path:
    """Return the path; raises InputError for a NUL character, names that are too long, and circular links."""
    text = str(path)
    shown = ascii(text if len(text) < 80 else text[:80] + "...")
    if "\0" in text:
        raise InputError(f"{shown} has a NUL character, which no path has; correct the path")
    names = [len(os.fsencode(part)) for part in Path(text).parts]
    if max(names, default=0) > MAX_NAME_BYTES or len(os.fsencode(text)) > MAX_PATH_BYTES:
        raise InputError(f"{shown}: a name is longer than {MAX_NAME_BYTES} bytes; give a shorter path")
    try:
        Path(text).resolve(strict=True)  # from Python 3.13 on, only this detects circular links
    except (FileNotFoundError, NotADirectoryError, PermissionError):
        pass  # reading or writing reports these
    except (RuntimeError, OSError) as error:
        raise InputError(f"{shown} cannot be followed: its links lead to each other; correct the path") from error
    return Path(text)


ARCHIVES = {b"PK\x03\x04": "a ZIP archive", b"\x1f\x8b": "a gzip archive", b"7z\xbc\xaf\x27\x1c": "a 7-Zip archive"}
"""Archives by their first bytes."""


def refuse_archive(data: bytes, name: str) -> None:
    """Raise InputError, which begins with `name`, if `data` is an archive."""
    packed = next((words for start, words in ARCHIVES.items() if data.startswith(start)), None)
    if packed is not None:
        raise InputError(f"{name} is {packed}; unpack it, and give what is in it")


def read_bytes(path: str | Path, what: str = "", *, max_bytes: int = MAX_BINARY_BYTES) -> bytes:
    """Return the content of a regular file.

    Raises InputError, which begins with `what` and the name, if the file does not exist, cannot be read, is a folder, a
    pipe or a device, or has more than `max_bytes`.
    """
    source = usable_path(path)
    name = _named(source, what)
    try:
        status = source.stat()
        if stat.S_ISDIR(status.st_mode):
            raise InputError(f"{name} is a folder; give a file")
        if not stat.S_ISREG(status.st_mode):
            raise InputError(f"{name} is a pipe or a device; save its content as a file and give that")
        if status.st_size > max_bytes:
            raise InputError(f"{name} has {status.st_size} bytes, more than {max_bytes}; is it the right one?")
        return source.read_bytes()
    except FileNotFoundError as error:
        if source.is_symlink():
            raise InputError(f"{name} is a link to '{source.readlink()}', which is not there; fetch that") from error
        raise InputError(f"{name} does not exist; check the path") from error
    except OSError as error:
        raise InputError(f"{name} cannot be read: {error.strerror}; check the path and permissions") from error


def read_text(path: str | Path, what: str = "", *, max_bytes: int = MAX_TEXT_BYTES) -> str:
    """Return the text of a UTF-8 file, without a byte order mark and with \\n as the line ending.

    Raises InputError as `read_bytes`, and for files that are not UTF-8; archives are named as such.
    """
    data = read_bytes(path, what, max_bytes=max_bytes)
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        refuse_archive(data, _named(path, what))
        raise InputError(
            f"{_named(path, what)} cannot be read: not UTF-8 text; save it as UTF-8, or give another"
        ) from error
    return text.replace("\r\n", "\n").replace("\r", "\n")


def csv_rows(path: str | Path, what: str = "", *, delimiter: str = ",") -> Iterator[tuple[int, list[str]]]:
    """Yield (line number, cells) of the non-empty rows of a CSV file.

    Raises InputError as `read_text`, and for a malformed line.
    """
    reader = csv.reader(io.StringIO(read_text(path, what)), delimiter=delimiter)
    try:
        for row in reader:
            if row:
                yield reader.line_num, row
    except csv.Error as error:
        raise InputError(f"{_named(path, what)}, line {reader.line_num}: {error}; correct the line") from error


def csv_table(
    path: str | Path, what: str = "", *, delimiter: str = ","
) -> tuple[list[str], list[tuple[int, dict[str, str]]]]:
    """Return the column names of a CSV file, and its rows as (line number, cells by column); cells are stripped.

    Empty rows and rows that begin with # are skipped. Raises InputError as `csv_rows`, and for a row whose length
    differs from the head's.
    """
    head: list[str] = []
    rows = []
    for line, row in csv_rows(path, what, delimiter=delimiter):
        cells = [cell.strip() for cell in row]
        if not any(cells) or cells[0].startswith("#"):
            continue
        if not head:
            head = cells
            continue
        if len(cells) != len(head):
            raise InputError(
                f"{_named(path, what)}, line {line}: {len(cells)} cells, but the head has {len(head)}; correct "
                "the row, with quotes around text that has a comma"
            )
        rows.append((line, dict(zip(head, cells, strict=True))))
    return head, rows


@contextmanager
def about(*paths: str | Path) -> Iterator[None]:
    """Prefix the errors of the block with the names of these files, unless they name one already."""
    try:
        yield
    except RigkitError as error:
        if isinstance(error, InstallationError) or any(str(path) in str(error) for path in paths):
            raise
        raise type(error)(" and ".join(f"'{path}'" for path in paths) + f": {error}") from error


def on_one_line(error: Exception) -> str:
    """Return a parser's error on one line of at most 200 characters."""
    return " ".join(str(error).split())[:200]


def _named(path: str | Path, what: str) -> str:
    return f"{what} '{path}'" if what else f"'{path}'"


def fault_of_number(value: object, *, positive: bool = True) -> str | None:
    """Return what a number of a file must be, in words that follow "must be"; None if it is valid."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return "a number"
    if isinstance(value, float) and not math.isfinite(value):
        return "a finite number"
    if positive and value <= 0:
        return "positive"
    if abs(value) > MAX_NUMBER:
        return f"at most {MAX_NUMBER:g}"
    if positive and value < MIN_POSITIVE:
        return f"at least {MIN_POSITIVE:g}"
    return None


def is_number(text: str) -> bool:
    """Return whether a text is a number."""
    try:
        float(text)
    except ValueError:
        return False
    return True
