"""Provenance of results: versions, time, and hashes of the input files."""

from __future__ import annotations

import hashlib
import platform
from collections.abc import Mapping, Sequence
from contextlib import suppress
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

from rigkit.core.errors import InputError
from rigkit.io.corners.corner_cache import image_hash
from rigkit.io.manifests.rig_session import RigSession
from rigkit.io.manifests.session import Session

SHORT_HASH = 16
"""Hexadecimal digits of an image's SHA-256 that a calibration keeps: two different images never share them."""
PACKAGES = ("numpy", "opencv-contrib-python-headless")
"""Packages whose versions all results depend on."""


def software_facts(*packages: str) -> dict[str, str]:
    """Return the time and the versions of rigkit, Python, PACKAGES and further `packages`."""
    facts = {"rigkit": version("rigkit"), "Python": platform.python_version()}
    facts |= {name: version(name) for name in (*PACKAGES, *packages)}
    return facts | {"written": datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")}


def provenance_of(session: Session | RigSession) -> dict[str, Any]:
    """Return the provenance that a calibration file states: rigkit's version, the time, the SHA-256 of the session, for
    each camera the SHA-256 of what `sha256sum` prints for its readable images, and the first digits of each image's."""
    inputs = {session.path.name: digest_of(session.path)} if session.path.is_file() else {}
    every: list[str] = []
    for name, own in session.cameras.items():
        pairs = _hashes(own.images)
        every += [digest[:SHORT_HASH] for _, digest in pairs]
        if pairs:
            inputs[f"{len(pairs)} images{f' of {name}' if name else ''}"] = _digest_of(pairs)
    written = datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
    return {"rigkit": version("rigkit"), "written": written, "inputs": inputs, "images": every}


def digest_line(source: Path | str | bytes) -> str:
    """Return "SHA-256 ..." of a file, of a text as UTF-8, or of bytes."""
    return f"SHA-256 {digest_of(source)}"


def digest_of(source: Path | str | bytes) -> str:
    """Return the SHA-256 of a file, of a text as UTF-8, or of bytes."""
    if isinstance(source, Path):
        source = source.read_bytes()
    return hashlib.sha256(source.encode() if isinstance(source, str) else source).hexdigest()


def digest_of_images(paths: Sequence[Path]) -> str | None:
    """Return one SHA-256 of all readable images, with how to compute it in words; None if none is readable."""
    pairs = _hashes(paths)
    return f"{len(pairs)} files; SHA-256 of what `sha256sum` prints of them: {_digest_of(pairs)}" if pairs else None


def is_one_of(image: Path, made: Mapping[str, Any]) -> bool:
    """Return whether a calibration with the provenance `made` states that it was made from this image, by content."""
    listed, known = made.get("images"), _hashes([image])
    return isinstance(listed, list) and bool(known) and known[0][1][:SHORT_HASH] in listed


def _hashes(paths: Sequence[Path]) -> list[tuple[str, str]]:
    """Return (name, SHA-256) of the readable images."""
    pairs = []
    for path in paths:
        with suppress(InputError):
            pairs.append((path.name, image_hash(path)))
    return pairs


def _digest_of(pairs: Sequence[tuple[str, str]]) -> str:
    return hashlib.sha256("".join(f"{own}  {name}\n" for name, own in pairs).encode()).hexdigest()
