"""Reading the text files that people and other tools write."""

from __future__ import annotations

from pathlib import Path

from rigkit.core.errors import InputError

__all__ = ["read_text"]


def read_text(path: str | Path, what: str = "") -> str:
    """Return the text of a UTF-8 file, without the byte order mark that spreadsheets and editors may put in front.

    `what` the file is comes before its name in the InputError for one that is not there, cannot be read or is no text.
    """
    source = Path(path)
    name = f"{what} '{source}'" if what else f"'{source}'"
    try:
        return source.read_text(encoding="utf-8-sig")
    except FileNotFoundError as error:
        raise InputError(f"{name} does not exist; check the path") from error
    except OSError as error:
        raise InputError(f"{name} cannot be read: {error.strerror}; check the path and permissions") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{name} cannot be read: not UTF-8 text; save it as UTF-8") from error
