"""Public captures with measured truth: found on this machine or fetched, and held against their hashes."""

from __future__ import annotations

import hashlib
import os
from dataclasses import dataclass
from pathlib import Path

from rigkit.core.errors import InputError
from rigkit.core.progress import Progress, silent
from rigkit.io.files import ensure_folder_writable
from rigkit.io.public_set import PublicSet, load_public_set

CATALOGUE = "datasets/public"
"""Where the descriptions are, from the folder of the project or any folder below it."""
PLACE = "RIGKIT_DATA"
"""Environment variable: a folder of captures, with each set where its `folder` says."""


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class FetchedSet:
    """A public capture on this machine.

    Attributes
    ----------
    described : what it is.
    folder : where its files are.
    present : files that are there and have their hash, by path in the set.
    fetched : those of them that were downloaded now.
    missing : files that are not there and that nobody can fetch yet.
    """

    described: PublicSet
    folder: Path
    present: tuple[str, ...]
    fetched: tuple[str, ...]
    missing: tuple[str, ...]

    def files(self, pattern: str) -> tuple[Path, ...]:
        """Return the files of the set that match, sorted by name."""
        return tuple(sorted(path for path in self.folder.glob(pattern) if self._is_own(path)))

    def _is_own(self, path: Path) -> bool:
        return path.relative_to(self.folder).as_posix() in self.present


def public_sets(catalogue: Path | None = None) -> dict[str, PublicSet]:
    """Return the public captures that are described in a folder, by name; None: datasets/public of the project.

    Raises InputError where there is no such folder or none is described in it.
    """
    folder = catalogue or _catalogue()
    found = [load_public_set(path) for path in sorted(folder.glob("*.toml"))] if folder.is_dir() else []
    if not found:
        raise InputError(f"'{folder}' has no descriptions of public captures (*.toml); give the folder that has them")
    return {one.name: one for one in found}


def set_folder(described: PublicSet, root: Path | None = None) -> Path:
    """Return where the files of a set are or go: in `root`, in the folder that RIGKIT_DATA names, or in the cache of
    this user."""
    if root is None and PLACE in os.environ:
        root = Path(os.environ[PLACE])
    if root is None:
        import pooch

        root = Path(pooch.os_cache("rigkit"))
    return root / described.folder


def fetch_public_set(described: PublicSet, root: Path | None = None, *, progress: Progress = silent) -> FetchedSet:
    """Return a public capture with all its files that are here or can be fetched; each has the hash described.

    Raises
    ------
    InputError
        A file that is here has another hash, or cannot be downloaded.
    """
    folder = set_folder(described, root)
    if root is not None and root.exists() and not root.is_dir():
        raise InputError(f"'{root}' is a file, not a folder; give the folder of captures")
    present, fetched, missing = [], [], []
    for k, (name, expected) in enumerate(described.sha256.items()):
        progress(f"fetch {described.name}", k, len(described.sha256))
        path = folder / name
        if path.is_file():
            _require(path, expected)
        elif name in described.urls:
            _download(described.urls[name], path, expected)
            fetched.append(name)
        else:
            missing.append(name)
            continue
        present.append(name)
    progress(f"fetch {described.name}", len(described.sha256), len(described.sha256))
    return FetchedSet(
        described=described,
        folder=folder,
        present=tuple(present),
        fetched=tuple(fetched),
        missing=tuple(missing),
    )


def _require(path: Path, expected: str) -> None:
    """Raise InputError where the file has another hash."""
    found = hashlib.sha256(path.read_bytes()).hexdigest()
    if found != expected:
        raise InputError(
            f"{path}: its SHA-256 is {found[:12]}..., the description says {expected[:12]}...; remove the file and "
            "fetch it anew"
        )


def _download(url: str, path: Path, expected: str) -> None:
    """Fetch one file; it appears whole and with its hash, or not at all."""
    ensure_folder_writable(path.parent)
    if url.startswith("file://"):
        _copy(Path(url.removeprefix("file://")), path, expected)
        return
    import pooch
    import requests

    try:
        pooch.retrieve(url, f"sha256:{expected}", fname=path.name, path=path.parent)
    except (requests.RequestException, OSError, ValueError) as error:
        reason = str(error).splitlines()[0]
        raise InputError(f"{url} cannot be fetched: {reason}; look whether the address still holds") from error


def _copy(source: Path, path: Path, expected: str) -> None:
    from rigkit.io.files import write_atomic

    if not source.is_file():
        raise InputError(f"'{source}' cannot be fetched: there is no such file; correct the address")
    _require(source, expected)
    write_atomic(path, source.read_bytes())


def _catalogue() -> Path:
    """Return datasets/public of the project that this folder, or the package's sources, are in."""
    for start in (Path.cwd(), Path(__file__).resolve()):
        for folder in (start, *start.parents):
            if (folder / CATALOGUE).is_dir():
                return folder / CATALOGUE
    return Path(CATALOGUE)
