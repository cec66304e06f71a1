"""Writing files whole or not at all, and never over something that is already there unless told to."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from rigkit.errors import InputError

__all__ = ["ensure_writable", "write_atomic"]


def ensure_writable(paths: str | Path | Iterable[str | Path], *, force: bool = False) -> None:
    """Raise InputError if one of `paths` could not be written: call it before work that takes long.

    A path that exists is refused without `force`; so is a folder in its place, and a parent that is a file.
    """
    for path in [paths] if isinstance(paths, str | Path) else paths:
        target = Path(path)
        if target.is_dir():
            raise InputError(f"cannot write '{target}': a folder of that name exists; give another name")
        if target.exists() and not force:
            raise InputError(f"'{target}' exists and is left as it is; use --force to replace it, or another name")
        parent = next(p for p in target.absolute().parents if p.exists())
        if not parent.is_dir():
            raise InputError(f"cannot write '{target}': '{parent}' is a file, not a folder; give another name")
        if not os.access(parent, os.W_OK | os.X_OK):
            raise InputError(f"cannot write '{target}': no permission in '{parent}'; choose another folder")


def write_atomic(path: str | Path, data: str | bytes, *, force: bool = False) -> None:
    """Write `data` (text as UTF-8) to `path` so that a reader sees the old file or the whole new one.

    A temporary file in the same folder is flushed to the disk and renamed. Missing folders are made.

    Raises
    ------
    InputError
        The file exists and `force` is not set, or it cannot be written (permission, full disk); what was there before
        is still there.
    """
    target = Path(path)
    ensure_writable(target, force=force)
    payload = data.encode("utf-8") if isinstance(data, str) else data
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(prefix=f".{target.name}.", suffix=".part", dir=target.parent)
    except OSError as error:
        raise InputError(f"cannot write '{target}': {error.strerror}; choose another folder") from error
    temporary = Path(name)
    try:
        with os.fdopen(handle, "wb") as stream:
            stream.write(payload)
            stream.flush()
            os.fsync(stream.fileno())
        # mkstemp makes files that only the owner may read; a result should have the permissions of any new file.
        temporary.chmod(0o666 & ~_umask())
        if force:
            temporary.replace(target)
        else:
            # A hard link fails if somebody made the file meanwhile, where a rename would silently replace it.
            _link_new(temporary, target)
    except OSError as error:
        raise InputError(f"cannot write '{target}': {error.strerror}; nothing was changed") from error
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


def _link_new(temporary: Path, target: Path) -> None:
    try:
        os.link(temporary, target)
    except FileExistsError as error:
        raise InputError(f"'{target}' appeared while we worked and is left as it is; use --force") from error
    except OSError:
        # Some file systems have no hard links.
        temporary.replace(target)


def _umask() -> int:
    mask = os.umask(0o022)
    os.umask(mask)
    return mask
