"""Which code computed a result that is kept: what other code left is computed again."""

from __future__ import annotations

import functools
import hashlib
from contextlib import suppress
from pathlib import Path

import rigkit

SOURCE_SUFFIXES = {".py", ".c", ".h"}


@functools.cache
def source_hash(*packages: str) -> str:
    """Return a hash of the sources of subpackages of rigkit, such as "detection"; of all of it where none is named.

    They are read once: what runs is what was there then.
    """
    root = Path(rigkit.__path__[0])
    digest = hashlib.sha256()
    for folder in [root / name for name in packages] or [root]:
        if not folder.is_dir():
            raise ValueError(f"rigkit has no part '{folder.name}'")
        for path in sorted(p for p in folder.rglob("*") if p.suffix in SOURCE_SUFFIXES):
            # Files of a moment, such as an editor's lock that links nowhere, come and go beside the code.
            with suppress(FileNotFoundError):
                digest.update(path.relative_to(root).as_posix().encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:16]
