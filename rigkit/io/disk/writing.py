"""Atomic writing of files; existing files are only replaced with `force`."""

from __future__ import annotations

import io
import os
import tempfile
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rigkit.core.errors import IN_PYTHON, InputError
from rigkit.io.disk.reading import usable_path

FORCE = f"use --force{IN_PYTHON}"
"""Part of messages about existing files."""


def ensure_writable(
    paths: str | Path | Iterable[str | Path | None] | None, *, force: bool = False, inputs: Iterable[str | Path] = ()
) -> None:
    """Raise InputError if one of `paths` (None is ignored) cannot be written; to be called before long work.

    Refused are existing files without `force`, folders, parents that are files or without permission, and even with
    `force` the files `inputs`, two results of the same path, pipes and devices.
    """
    asked = [p for p in ([paths] if paths is None or isinstance(paths, str | Path) else paths) if p is not None]
    read = {usable_path(path).resolve() for path in inputs} if asked else set()
    written: set[Path] = set()
    for path in asked:
        target = usable_path(path)
        whole = target.resolve()
        if whole in read:
            raise InputError(f"cannot write '{target}': this command reads it, and it would be lost; give another name")
        if whole in written:
            raise InputError(f"cannot write '{target}' twice, for two results; give them different names")
        written.add(whole)
        if target.is_dir():
            raise InputError(f"cannot write '{target}': a folder of that name exists; give another name")
        if target.exists() and not target.is_file():
            raise InputError(f"cannot write '{target}': it is a pipe or a device; give the name of a file")
        # A broken link counts as an existing file.
        if (target.exists() or target.is_symlink()) and not force:
            raise InputError(f"'{target}' exists and is left as it is; {FORCE} to replace it, or another name")
        _ensure_place(target, target.absolute().parent)


def ensure_folder_writable(folder: str | Path) -> None:
    """Raise InputError if files cannot be written into `folder`, which need not exist yet."""
    _ensure_place(Path(folder), usable_path(folder).absolute())


def _ensure_place(target: Path, folder: Path) -> None:
    """Raise InputError if `folder` or its first existing parent does not permit writing `target`."""
    place = next(p for p in (folder, *folder.parents) if p.exists())
    if not place.is_dir():
        raise InputError(f"cannot write '{target}': '{place}' is a file, not a folder; give another name")
    if not os.access(place, os.W_OK | os.X_OK):
        raise InputError(f"cannot write '{target}': no permission in '{place}'; choose another folder")


def write_atomic(path: str | Path, data: str | bytes, *, force: bool = False) -> None:
    """Write `data` (text as UTF-8) to `path` atomically: a reader sees the old file or the complete new one.

    A temporary file in the same folder is flushed to the disk and renamed. Missing folders are made.

    Raises InputError: the file exists and `force` is not set, or it cannot be written (permission, full disk); an old
    file is unchanged then.
    """
    write_together({Path(path): data}, force=force)


def write_together(files: Mapping[Path, str | bytes], *, force: bool = False) -> None:
    """Write all `files` (path -> content) or none: they are renamed after all are on the disk.

    Raises InputError as `write_atomic`; old files are unchanged then, and no new folder is left. Only if a rename fails
    after others have replaced files do those stay replaced; the message says so.
    """
    ensure_writable(files, force=force)
    made: list[Path] = []
    staged: dict[Path, Path] = {}
    renamed: list[Path] = []
    target = Path()
    try:
        for target, data in files.items():
            for folder in [p for p in (target.parent, *target.parent.parents) if not p.exists()][::-1]:
                folder.mkdir(exist_ok=True)
                made.append(folder)
            handle, name = tempfile.mkstemp(prefix=f".{target.name}.", suffix=".part", dir=target.parent)
            staged[target] = Path(name)
            # The text may name files whose names are not UTF-8.
            _fill(handle, data.encode("utf-8", "backslashreplace") if isinstance(data, str) else data)
            # mkstemp makes files that only the owner may read; a result should have the permissions of any new file.
            staged[target].chmod(0o666 & ~_umask())
        for target, temporary in staged.items():
            if force:
                temporary.replace(target)
            else:
                # If the file was created meanwhile, a hard link fails; a rename would replace it.
                _link_new(temporary, target)
            renamed.append(target)
    except BaseException as error:
        if not force:
            for path in renamed:
                with suppress(OSError):
                    path.unlink()
        if not isinstance(error, OSError):
            raise
        same = "it stays as it was" if len(files) == 1 else f"all {len(files)} files of this step stay as they were"
        changed = f"{len(renamed)} of {len(files)} files were replaced" if force and renamed else same
        raise InputError(f"cannot write '{target}': {error.strerror}; {changed}") from error
    finally:
        for temporary in staged.values():
            with suppress(OSError):
                temporary.unlink(missing_ok=True)
        # Folders with files are not removed.
        for folder in reversed(made):
            with suppress(OSError):
                folder.rmdir()


def _fill(handle: int, data: bytes) -> None:
    with os.fdopen(handle, "wb") as stream:
        stream.write(data)
        stream.flush()
        os.fsync(stream.fileno())


def _link_new(temporary: Path, target: Path) -> None:
    try:
        os.link(temporary, target)
    except FileExistsError as error:
        raise InputError(f"'{target}' appeared while we worked and is left as it is; {FORCE}") from error
    except OSError:
        # Some file systems have no hard links.
        temporary.replace(target)


def _umask() -> int:
    mask = os.umask(0o022)
    os.umask(mask)
    return mask


def npz_bytes(arrays: Mapping[str, NDArray[Any]]) -> bytes:
    """Return an npz file of these arrays."""
    stream = io.BytesIO()
    np.savez_compressed(stream, **arrays)  # type: ignore[arg-type]
    return stream.getvalue()
