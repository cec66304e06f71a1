"""`rigkit fetch`: public captures with measured truth, found on this machine or downloaded, and checked by hash."""

from __future__ import annotations

import hashlib
import os
import tarfile
import tempfile
import zipfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from rigkit.core.errors import InputError
from rigkit.core.printing import brief
from rigkit.core.progress import Progress, silent
from rigkit.io.disk.writing import ensure_folder_writable, write_atomic
from rigkit.io.manifests.public_set import PublicSet, load_public_set

CATALOGUE = "datasets/public"
"""Folder of the descriptions, in the current folder or one above it."""
PLACE = "RIGKIT_DATA"
"""Environment variable: folder of captures; each set is in its `folder` there."""


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class FetchedSet:
    """A public capture on this machine.

    Attributes
    ----------
    described : description of the set.
    folder : folder of its files.
    present : existing files, with the right hash, by path in the set.
    fetched : those of them that were downloaded now.
    missing : files that do not exist and have no address to download from.
    """

    described: PublicSet
    folder: Path
    present: tuple[str, ...]
    fetched: tuple[str, ...]
    missing: tuple[str, ...]

    __repr__ = brief

    def files(self, pattern: str) -> tuple[Path, ...]:
        """Return the files of the set that match, sorted by name."""
        found = (path for path in self.folder.glob(pattern) if path.relative_to(self.folder).as_posix() in self.present)
        return tuple(sorted(found))


def public_sets(catalogue: Path | None = None) -> dict[str, PublicSet]:
    """Return the descriptions of public captures in a folder, by name; None: datasets/public of the project.

    Raises InputError if there is no such folder or it has no descriptions.
    """
    folder = catalogue or _catalogue()
    found = [load_public_set(path) for path in sorted(folder.glob("*.toml"))] if folder.is_dir() else []
    if not found:
        raise InputError(f"'{folder}' has no descriptions of public captures (*.toml); give the folder that has them")
    return {one.name: one for one in found}


def set_folder(described: PublicSet, root: Path | None = None) -> Path:
    """Return the folder of a set: in `root`, else in that of RIGKIT_DATA, else in the user's cache."""
    if root is None and PLACE in os.environ:
        root = Path(os.environ[PLACE])
    if root is None:
        import pooch

        root = Path(pooch.os_cache("rigkit"))
    return root / described.folder


def fetch_public_set(described: PublicSet, root: Path | None = None, *, progress: Progress = silent) -> FetchedSet:
    """Return a public capture after downloading its missing files; every file has the described hash.

    Raises InputError: an existing file has another hash, or a file cannot be downloaded.
    """
    folder = set_folder(described, root)
    if root is not None and root.exists() and not root.is_dir():
        raise InputError(f"'{root}' is a file, not a folder; give the folder of captures")
    present, fetched, missing = [], [], []
    packed: dict[str, dict[str, list[str]]] = {}
    for k, (name, expected) in enumerate(described.sha256.items()):
        progress(f"fetch {described.name}", k, len(described.sha256))
        url, _, member = described.urls.get(name, "").partition("#")
        if (folder / name).is_file():
            _require_hash(
                (folder / name).read_bytes(), str(folder / name), expected, "remove the file and fetch it anew"
            )
        elif member:
            packed.setdefault(url, {}).setdefault(member, []).append(name)
            fetched.append(name)
        elif url:
            _download(url, folder / name, expected)
            fetched.append(name)
        else:
            missing.append(name)
            continue
        present.append(name)
    for url, members in packed.items():
        for member, data in _members(url, list(members)):
            for name in members[member]:
                _write(data, f"{url}: {member}", folder / name, described.sha256[name])
    progress(f"fetch {described.name}", len(described.sha256), len(described.sha256))
    return FetchedSet(
        described=described, folder=folder, present=tuple(present), fetched=tuple(fetched), missing=tuple(missing)
    )


def _require_hash(data: bytes, source: str, expected: str, remedy: str) -> None:
    """Raise InputError if the content of a file has another hash."""
    found = hashlib.sha256(data).hexdigest()
    if found != expected:
        raise InputError(f"{source}: its SHA-256 is {found[:12]}..., the description says {expected[:12]}...; {remedy}")


def _download(url: str, path: Path, expected: str | None) -> None:
    """Download one file completely, and with the expected hash if one is given, or raise InputError."""
    ensure_folder_writable(path.parent)
    if url.startswith("file://"):
        source = Path(url.removeprefix("file://"))
        if not source.is_file():
            raise InputError(f"'{source}' cannot be fetched: there is no such file; correct the address")
        _write(source.read_bytes(), str(source), path, expected)
        return
    import pooch
    import requests

    # pooch warns of files without a hash; the members of an archive are checked later.
    pooch.get_logger().setLevel("ERROR")
    try:
        pooch.retrieve(url, expected and f"sha256:{expected}", fname=path.name, path=path.parent)
    except (requests.RequestException, OSError, ValueError) as error:
        reason = str(error).splitlines()[0]
        raise InputError(f"{url} cannot be fetched: {reason}; check whether the address is still right") from error


def _write(data: bytes, source: str, path: Path, expected: str | None) -> None:
    if expected is not None:
        _require_hash(data, source, expected, "correct the address, or the hash")
    ensure_folder_writable(path.parent)
    write_atomic(path, data)


def _members(url: str, names: Sequence[str]) -> Iterator[tuple[str, bytes]]:
    """Download a .tar or .zip and yield (name, content) of its members `names`; the archive is not kept."""
    with tempfile.TemporaryDirectory(prefix="rigkit-") as place:
        path = Path(place) / "archive"
        _download(url, path, None)
        left = set(names)
        for name, data in _read_zip(path, left) if zipfile.is_zipfile(path) else _read_tar(path, left, url):
            left.discard(name)
            yield name, data
    if left:
        raise InputError(f"{url}: there is no '{min(left)}' in it; correct the address")


def _read_zip(path: Path, names: set[str]) -> Iterator[tuple[str, bytes]]:
    with zipfile.ZipFile(path) as archive:
        for name in names & set(archive.namelist()):
            yield name, archive.read(name)


def _read_tar(path: Path, names: set[str], url: str) -> Iterator[tuple[str, bytes]]:
    try:
        # As a stream: seeking back would decompress it again for every member.
        with tarfile.open(path, "r|*") as archive:
            for entry in archive:
                found = archive.extractfile(entry) if entry.name in names else None
                if found is not None:
                    yield entry.name, found.read()
    except tarfile.TarError as error:
        raise InputError(f"{url} is no .tar or .zip; an address with # names a file in such an archive") from error


def _catalogue() -> Path:
    """Return datasets/public of the project that contains the current folder or this module."""
    for start in (Path.cwd(), Path(__file__).resolve()):
        for folder in (start, *start.parents):
            if (folder / CATALOGUE).is_dir():
                return folder / CATALOGUE
    return Path(CATALOGUE)
