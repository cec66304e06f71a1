"""Reading files: regular ones, of a size that they may have, and the range of numbers in them.

Whatever lies outside of these limits is a slip or damage, and the error says what is wrong with it.
"""

from __future__ import annotations

import csv
import io
import math
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from rigkit.core.errors import InputError, InstallationError, RigkitError

MAX_TEXT_BYTES = 64_000_000
"""The corners of ten thousand images."""
MAX_BINARY_BYTES = 1_000_000_000
"""An image of 160 megapixels in 16 bits, a cloud of ten million points."""
MAX_NAME_BYTES, MAX_PATH_BYTES = 255, 4095
"""What file systems take of one name, and the system of a whole path."""
MAX_NUMBER = 1e9
"""A thousand kilometres in mm."""
MIN_POSITIVE = 1e-9
"""A picometre in mm; a measurement with a smaller sigma would outweigh all else."""


def is_file_or_lost_link(path: Path) -> bool:
    """Say whether a folder's entry is a file, or a link to one that is not there: what reads it says so."""
    return path.is_file() or (path.is_symlink() and not path.exists())


def usable_path(path: str | Path) -> Path:
    """Return the path; raises InputError where no system could open it: a NUL character, names too long, links that
    lead to each other."""
    text = str(path)
    shown = ascii(text if len(text) < 80 else text[:80] + "...")
    if "\0" in text:
        raise InputError(f"{shown} has a NUL character, which no path has; correct the path")
    names = [len(os.fsencode(part)) for part in Path(text).parts]
    if max(names, default=0) > MAX_NAME_BYTES or len(os.fsencode(text)) > MAX_PATH_BYTES:
        raise InputError(f"{shown}: a name is longer than {MAX_NAME_BYTES} bytes; give a shorter path")
    try:
        Path(text).resolve(strict=True)  # from Python 3.13 on, only this meets links in a circle
    except (FileNotFoundError, NotADirectoryError, PermissionError):
        pass  # for those who read or write it to say
    except (RuntimeError, OSError) as error:
        raise InputError(f"{shown} cannot be followed: its links lead to each other; correct the path") from error
    return Path(text)


ARCHIVES = {b"PK\x03\x04": "a ZIP archive", b"\x1f\x8b": "a gzip archive", b"7z\xbc\xaf\x27\x1c": "a 7-Zip archive"}
"""What files of others come packed in, by their first bytes."""


def refuse_archive(data: bytes, name: str) -> None:
    """Raise InputError where a file that begins with `data` is packed; `name` is said of it."""
    packed = next((words for start, words in ARCHIVES.items() if data.startswith(start)), None)
    if packed is not None:
        raise InputError(f"{name} is {packed}; unpack it, and give what is in it")


def read_bytes(path: str | Path, what: str = "", *, max_bytes: int = MAX_BINARY_BYTES) -> bytes:
    """Return the content of a regular file.

    `what` the file is comes before its name in the InputError for one that is not there, cannot be read, is a folder, a
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
    """Return the text of a UTF-8 file, without the byte order mark that spreadsheets and editors may put in front.

    Raises InputError as `read_bytes` does, and for what is no text, an archive by that name.
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
    """Yield line number and cells of the rows of a CSV file that are not empty.

    Raises InputError as `read_text` does, and for a line that is none of a table.
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
    """Return the head of a CSV file and its rows, each with its line number, cells by column and without blanks around;
    empty rows and those that begin with # are left out.

    Raises InputError as `csv_rows` does, and for a row that has not as many cells as the head.
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
    """Let errors of the block, which is about these files, name them."""
    try:
        yield
    except RigkitError as error:
        if isinstance(error, InstallationError) or any(str(path) in str(error) for path in paths):
            raise
        raise type(error)(" and ".join(f"'{path}'" for path in paths) + f": {error}") from error


def damage(error: Exception) -> str:
    """Return what is wrong with a file in one line, of a reader's error that may quote much of it."""
    return " ".join(str(error).split())[:200]


def _named(path: str | Path, what: str) -> str:
    """Return what the file is and its name."""
    return f"{what} '{path}'" if what else f"'{path}'"


def fault_of_number(value: object, *, positive: bool = True) -> str | None:
    """Return what is wrong with a number of a file, in words that follow its name and "must be"; None if nothing is."""
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
    """Say whether words are a number."""
    try:
        float(text)
    except ValueError:
        return False
    return True
