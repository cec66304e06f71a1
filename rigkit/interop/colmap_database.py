"""Matches of two images from COLMAP's database (SQLite), verified ones if there are any, with frames of features."""

from __future__ import annotations

import sqlite3
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rigkit.core.arrays import Affines, FloatArray, IntArray, Pixels
from rigkit.core.errors import InputError
from rigkit.interop.colmap import HALF_PIXEL

SQLITE = b"SQLite format 3\x00"
MAX_IMAGES = 2147483647
"""COLMAP's pair_id is this times the smaller image_id, plus the larger one."""
POSITION, SIMILARITY, AFFINITY = 2, 4, 6
"""Number of columns of COLMAP's keypoints: x, y; also scale, orientation; or also the four entries of the frame."""


class DatabaseMatches(NamedTuple):
    """N matches: pixels (N, 2) of both images and, if features have frames, affinities (N, 2, 2)."""

    pixels1: Pixels
    pixels2: Pixels
    A21: Affines | None


def is_colmap_database(payload: bytes) -> bool:
    """Return whether the content of a file is an SQLite database."""
    return payload.startswith(SQLITE)


def read_colmap_matches(path: Path, images: Sequence[str]) -> DatabaseMatches:
    """Return the matches of two images, given by their file names.

    Raises InputError for other files, an image that is not in the database, or two images without matches.
    """
    try:
        with sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro", uri=True) as database:
            ids = _image_ids(database, path, images)
            pairs = _index_pairs(database, ids)
            if not len(pairs):
                raise InputError(f"'{path}': no matches of '{images[0]}' and '{images[1]}'; match them in COLMAP first")
            frames = [_keypoints(database, path, i) for i in ids]
    except (sqlite3.Error, ValueError, TypeError, OverflowError) as error:
        raise InputError(f"'{path}': no database of COLMAP's, or damaged ({error}); write it again") from error
    if any(pairs[:, k].max() >= len(frames[k]) for k in (0, 1)):
        raise InputError(f"'{path}': matches of keypoints that are not there; extract and match again")
    first, second = frames[0][pairs[:, 0]], frames[1][pairs[:, 1]]
    A21 = None
    if first.shape[1] > POSITION and second.shape[1] > POSITION:
        with np.errstate(all="ignore"):
            A21 = affinities_of_frames(_frame(first), _frame(second))
    return DatabaseMatches(first[:, :2] - HALF_PIXEL, second[:, :2] - HALF_PIXEL, A21)


def affinities_of_frames(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return the affinities (N, 2, 2) between frames (N, 2, 2) of matched features; NaN for singular first frames."""
    regular = np.abs(np.linalg.det(first)) > 0.0
    A21 = np.full(first.shape, np.nan)
    A21[regular] = second[regular] @ np.linalg.inv(first[regular])
    return A21


def _image_ids(database: sqlite3.Connection, path: Path, images: Sequence[str]) -> tuple[int, int]:
    rows = database.execute("SELECT image_id, name FROM images").fetchall()
    found = []
    for name in images:
        ids = [int(i) for i, other in rows if Path(str(other)).name == Path(name).name]
        if len(ids) != 1:
            there = ", ".join(str(other) for _, other in rows[:10])
            raise InputError(
                f"'{path}': {len(ids)} images called '{Path(name).name}', one is needed; it has {there or 'none'}"
            )
        found.append(ids[0])
    return found[0], found[1]


def _index_pairs(database: sqlite3.Connection, ids: tuple[int, int]) -> IntArray:
    """Return the indices (N, 2) of matched keypoints."""
    key = MAX_IMAGES * min(ids) + max(ids)
    for table in ("two_view_geometries", "matches"):
        row = database.execute(f"SELECT rows, data FROM {table} WHERE pair_id = ?", (key,)).fetchone()
        if row and row[0] and row[1]:
            pairs = np.frombuffer(row[1], np.uint32).reshape(int(row[0]), 2).astype(np.int64)
            return pairs if ids[0] < ids[1] else pairs[:, ::-1]
    return np.zeros((0, 2), dtype=np.int64)


def _keypoints(database: sqlite3.Connection, path: Path, image_id: int) -> FloatArray:
    row = database.execute("SELECT rows, cols, data FROM keypoints WHERE image_id = ?", (image_id,)).fetchone()
    if not row or int(row[1]) not in (POSITION, SIMILARITY, AFFINITY):
        raise InputError(f"'{path}': no keypoints of image {image_id}, or of an unknown kind; extract them in COLMAP")
    return np.frombuffer(row[2], np.float32).reshape(int(row[0]), int(row[1])).astype(np.float64)


def _frame(keypoints: FloatArray) -> FloatArray:
    """Return the frames (N, 2, 2) of keypoints with scale and orientation, or with all four entries."""
    if keypoints.shape[1] == AFFINITY:
        return keypoints[:, 2:].reshape(-1, 2, 2)
    scale, angle = keypoints[:, 2], keypoints[:, 3]
    c, s = scale * np.cos(angle), scale * np.sin(angle)
    return np.stack([np.stack([c, -s], axis=-1), np.stack([s, c], axis=-1)], axis=-2)
