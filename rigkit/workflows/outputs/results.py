"""Folders of results; files are written into them all together or not at all."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping
from pathlib import Path

from rigkit.core.errors import InputError
from rigkit.io.disk.writing import FORCE, ensure_folder_writable, ensure_writable, write_together

CALIBRATIONS = "calibrations"
"""Subfolder of results for cameras that were calibrated for them."""


def new_results_folder(name: str, *, force: bool) -> Path:
    """Return the first of out/NAME, out/NAME-2, ... that does not exist; with `force` out/NAME."""
    base = Path("out") / name
    if force:
        return base
    names = itertools.chain([base], (base.with_name(f"{base.name}-{number}") for number in itertools.count(2)))
    return next(folder for folder in names if not folder.exists())


def require_folder(folder: Path, *, force: bool) -> None:
    """Raise InputError if `folder` is not empty and `force` is not given, or if it cannot be written."""
    if folder.is_dir() and any(folder.iterdir()) and not force:
        raise InputError(f"folder '{folder}' is not empty; {FORCE} to replace results in it, or another folder")
    if folder.exists() and not folder.is_dir():
        raise InputError(f"'{folder}' is a file, not a folder; give another name with -o")
    ensure_folder_writable(folder)


def write_results(
    folder: Path, files: Mapping[str, str | bytes], *, force: bool, inputs: Iterable[str | Path] = ()
) -> tuple[Path, ...]:
    """Write all files (relative path -> content) into `folder`, or none; return their paths.

    Raises InputError if a file would replace one of `inputs`, or would be outside of `folder` because of a link in it.
    """
    placed = {folder / name: data for name, data in files.items()}
    whole = folder.resolve()
    for path in placed:
        if not path.parent.resolve().is_relative_to(whole):
            raise InputError(
                f"cannot write '{path}': a link in '{folder}' leads out of it, to '{path.parent.resolve()}'; remove "
                "the link, or give another folder"
            )
    # A new calibration was computed without reading the old one, so with `force` it may replace that.
    new = {path.resolve() for path in placed if path.relative_to(folder).parts[0] == CALIBRATIONS}
    ensure_writable(placed, force=force, inputs=[path for path in inputs if Path(path).resolve() not in new])
    write_together(placed, force=force)
    return tuple(placed)
