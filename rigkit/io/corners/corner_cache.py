"""Cache of detected corners beside a session, so that calibrating again needs no images.

It never changes a result. An entry is valid while the image (by hash), rigkit's code (by hash) and the boards are the
same. Corners detected with a known lens are stored beside those detected without, with a key of everything that the
lens was calibrated from. If the images are gone, corners of an older version of rigkit are used.
"""

from __future__ import annotations

import functools
import hashlib
import json
import re
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import rigkit
from rigkit.core.boards import Board
from rigkit.core.detections import BoardDetection
from rigkit.core.errors import InputError
from rigkit.io.disk.json_reader import parse_json
from rigkit.io.disk.reading import read_bytes, read_text
from rigkit.io.disk.writing import write_atomic

CORNERS_SCHEMA = "rigkit.corners/2"
FILE_START = re.compile(rb'^\s*\{\s*"schema":\s*"rigkit\.corners/')
"""Start of such a file of any version, even if the rest is damaged."""
SOURCE_SUFFIXES = {".py", ".c", ".h"}


@functools.cache
def source_hash() -> str:
    """Return a hash of rigkit's sources, read once a process: results cached by other code are computed again."""
    root = Path(rigkit.__path__[0])
    digest = hashlib.sha256()
    for path in sorted(p for p in root.rglob("*") if p.suffix in SOURCE_SUFFIXES):
        # Temporary files, such as an editor's lock, may vanish.
        with suppress(FileNotFoundError):
            digest.update(path.relative_to(root).as_posix().encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:16]


@dataclass(frozen=True, eq=False, slots=True)
class FoundCorners:
    """The boards detected in one image of `size_px` (width, height)."""

    size_px: tuple[int, int]
    detections: tuple[BoardDetection, ...]


class CornerCache:
    """The corners of a session's images: `get`, `put`, and `save` at the end. Without a path it is only in memory."""

    def __init__(self, path: Path | None, boards: Sequence[Board]) -> None:
        self.path = path
        targets = " ".join(_target(b) for b in boards)
        self.detector = f"{source_hash()} {targets}"
        self.current = True
        """Whether the entries were detected by the present code."""
        self._entries: dict[str, dict[str, Any]] = {}
        self._changed = False
        if path is None:
            return
        try:
            data = parse_json(read_text(path))
            if isinstance(data, dict) and data.get("schema") == CORNERS_SCHEMA:
                if data["detector"].partition(" ")[2] != targets:
                    return
                for entry in data["images"].values():
                    str(entry["sha256"]), _found_in(entry), _found_through(entry)
                self._entries, self.current = data["images"], data["detector"] == self.detector
        except (OSError, ValueError, TypeError, KeyError, AttributeError, OverflowError, InputError):
            # A damaged cache is ignored and written anew.
            return

    @property
    def images(self) -> list[str]:
        """Names of the images in the cache."""
        return sorted(self._entries)

    def digest(self, name: str) -> str:
        """Return the hash of image `name` at detection."""
        return str(self._entries[name]["sha256"])

    def get(self, name: str, digest: str | None, lens: str | None = None) -> FoundCorners | None:
        """Return the corners of image `name` if its hash is `digest`, else None; a `digest` of None accepts any hash.

        With the key of a `lens`, return the corners detected with that lens, else those detected without one.
        """
        entry = self._entries.get(name)
        if entry is None or (digest is not None and (entry["sha256"] != digest or not self.current)):
            return None
        if lens is not None:
            return _found_through(entry) if entry["lens"] and entry["lens"]["key"] == lens else None
        return _found_in(entry)

    def put(self, name: str, digest: str, found: FoundCorners, lens: str | None = None) -> None:
        """Store the corners of an image; those detected with a `lens` beside those detected without one."""
        boards = [detection_to_json(d) for d in found.detections]
        if not self.current:
            self._entries, self.current = {}, True
        if lens is None:
            self._entries[name] = {"sha256": digest, "size_px": list(found.size_px), "boards": boards, "lens": None}
        else:
            self._entries[name]["lens"] = {"key": lens, "boards": boards}
        self._changed = True

    def keep(self, names: Collection[str]) -> None:
        """Remove all other images, so that images removed from a session do not come back with the cache."""
        kept = {name: entry for name, entry in self._entries.items() if name in names}
        self._changed |= len(kept) < len(self._entries)
        self._entries = kept

    def save(self) -> None:
        """Write the file if anything changed; raises InputError if it cannot be written, or is no corner cache."""
        if self._changed and self.path is not None:
            if self.path.is_file() and not FILE_START.match(read_bytes(self.path)):
                raise InputError(f"'{self.path}' is no file of corners kept by rigkit and is left as it is; rename it")
            data = {"schema": CORNERS_SCHEMA, "detector": self.detector, "images": self._entries}
            write_atomic(self.path, json.dumps(data, allow_nan=False) + "\n", force=True)


def kept_corners(data: Any) -> dict[str, FoundCorners]:
    """Return the corners by image of a cache file's content; damage raises any error."""
    if data["schema"] != CORNERS_SCHEMA:
        raise InputError(f"its schema is not '{CORNERS_SCHEMA}'")
    return {str(image): _found_in(entry) for image, entry in data["images"].items()}


def _target(board: Board) -> str:
    """Return a key of everything about a board that its detection depends on."""
    size = f"{board.columns}x{board.rows}:{board.pattern!r}"
    return f"{board.board_id}:{size}:{board.square_x_mm:g}:{board.square_y_mm:g}" if board.identified else size


def lens_key(images: Mapping[str, str], boards: Sequence[Board], *options: object) -> str:
    """Return a key of the first calibration, from its images (name -> hash), boards and options."""
    known = [*images.items(), *map(repr, boards), *map(str, options), source_hash()]
    return hashlib.sha256(json.dumps(known).encode()).hexdigest()


def image_hash(path: Path) -> str:
    """Return the SHA-256 of the file."""
    return hashlib.sha256(read_bytes(path, "image")).hexdigest()


def detection_to_json(d: BoardDetection) -> dict[str, Any]:
    """Return the JSON of a detection; the board's key is "board_id"."""
    return {
        "board_id": d.board_id,
        "columns": d.columns,
        "rows": d.rows,
        "grid": d.grid.tolist(),
        "pixels": d.pixels.tolist(),
        "sigma_px": d.sigma_px.tolist(),
    }


def _found_in(entry: dict[str, Any]) -> FoundCorners:
    width, height = entry["size_px"]
    return FoundCorners((int(width), int(height)), tuple(_detection_in(v) for v in entry["boards"]))


def _found_through(entry: dict[str, Any]) -> FoundCorners | None:
    return None if entry["lens"] is None else _found_in(entry | {"boards": entry["lens"]["boards"]})


def _detection_in(data: dict[str, Any]) -> BoardDetection:
    grid = np.array(data["grid"], dtype=np.int64).reshape(-1, 2)
    pixels, sigma = np.array(data["pixels"], dtype=float).reshape(-1, 2), np.array(data["sigma_px"], dtype=float)
    return BoardDetection(data["board_id"], int(data["columns"]), int(data["rows"]), grid, pixels, sigma)
