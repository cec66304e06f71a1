"""Files of correspondences: CSV with a header, NPZ, and the headerless text of AffineExtractor.

CSV: u1_px, v1_px, u2_px, v2_px; optionally a11, a12, a21, a22; optionally du1_1, dv1_1, du2_1, dv2_1, du1_2, ... for
the directions; optionally sigma_px and sigma_A. An empty field is unknown. Columns come in any order, other columns are
an error. NPZ: arrays pixels1, pixels2 and optionally A21, directions1, directions2 (N, K, 2), sigma_px, sigma_A.

COLMAP's database (`interop.colmap_database`) and NPZ of matchers are read, too: points, and rough affinities if
features have frames. Arrays of matchers: keypoints0, keypoints1 with matches (K, 2) or matches0 (N,), -1 for none
(LightGlue, SuperGlue); mkpts0, mkpts1 or kpts0, kpts1 (LoFTR, RoMa); lafs0, lafs1 (N, 2, 3), frames with the point in
the last column (kornia). A leading batch dimension of one is removed. Pixel (0, 0) is the centre of the top-left pixel.

AffineExtractor (https://github.com/LeventeHajder/AffineExtractor): ten numbers a line, a11 a21 a12 a22 tx ty x1 y1 x2
y2, with q2 = A q1 + t. Its refinement changes t but not x2, y2, so the refined point in image 2 is A q1 + t.
"""

from __future__ import annotations

import csv
import io
import math
import re
import struct
import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from rigkit.affine.correspondences import Correspondences
from rigkit.core.arrays import FloatArray, IntArray
from rigkit.core.errors import InputError
from rigkit.core.matches import DirectionPairs
from rigkit.interop.colmap_database import affinities_of_frames, is_colmap_database, read_colmap_matches
from rigkit.io.disk.reading import MAX_NUMBER, csv_table, is_number, on_one_line, read_bytes

POINT_COLUMNS = ("u1_px", "v1_px", "u2_px", "v2_px")
AFFINE = ("a11", "a12", "a21", "a22")
SIGMA_COLUMNS = ("sigma_px", "sigma_A")
DIRECTION = re.compile(r"^(du1|dv1|du2|dv2)_([1-9]\d*)$")
MATCHED = (("mkpts0", "mkpts1"), ("kpts0", "kpts1"), ("keypoints0", "keypoints1"), ("lafs0", "lafs1"))
"""Arrays of matchers."""
ARRAYS = ("pixels1", "pixels2", "A21", "directions1", "directions2", *SIGMA_COLUMNS)

SIGMA_OF_FRAMES = 0.2
"""Standard deviation of affinities from the frames (scale and orientation, or shape) of matched features."""
MAX_ARRAY_BYTES = 500_000_000
"""Maximum size of an uncompressed array of an NPZ."""
EXTRACTOR_COLUMNS = "a11 a21 a12 a22 tx ty x1 y1 x2 y2"
MAX_REFINEMENT_PX = 30.0
"""Half width of AffineExtractor's patches: points further from their matches mean a wrong order of columns."""


def read_correspondences(path: str | Path, images: Sequence[str] = ()) -> Correspondences:
    """Return the correspondences of a CSV, NPZ, AffineExtractor text or COLMAP database, recognised by its content.

    `images` are the file names of the two images, which a database with many images needs.

    Raises InputError, with the line, if the file cannot be read.
    """
    source = Path(path)
    payload = read_bytes(source, "correspondences")
    if payload[:2] == b"PK":
        return _from_npz(source, payload)
    if is_colmap_database(payload):
        if len(images) != 2:
            raise InputError(f"correspondences '{source}': COLMAP's database has many images; give the two of the pair")
        found = read_colmap_matches(source, images)
        return _correspondences(source, found.pixels1, found.pixels2, found.A21, None, _frame_sigmas(found.A21))
    try:
        text = payload.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"correspondences '{source}': neither text nor NPZ; expected .csv or .npz") from error
    lines = [line for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    if not lines:
        raise InputError(f"correspondences '{source}': the file is empty; give another")
    if is_number(re.split(r"[\s,;]+", lines[0].strip())[0]):
        return _from_extractor(source, lines)
    return _from_csv(source)


def correspondences_text(found: Correspondences) -> str:
    """Return the CSV text, with numbers at full precision."""
    columns: dict[str, FloatArray] = dict(zip(POINT_COLUMNS, np.hstack([found.pixels1, found.pixels2]).T, strict=True))
    if found.A21 is not None:
        columns |= dict(zip(AFFINE, found.A21.reshape(-1, 4).T, strict=True))
    if found.directions is not None:
        for k in range(found.directions.valid.shape[1]):
            for image, d in ((1, found.directions.image1), (2, found.directions.image2)):
                valid = found.directions.valid[:, k]
                columns[f"du{image}_{k + 1}"] = np.where(valid, d[:, k, 0], np.nan)
                columns[f"dv{image}_{k + 1}"] = np.where(valid, d[:, k, 1], np.nan)
    for name in SIGMA_COLUMNS:
        if getattr(found, name) is not None:
            columns[name] = getattr(found, name)
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(columns)
    for row in zip(*columns.values(), strict=True):
        writer.writerow(["" if np.isnan(value) else repr(float(value)) for value in row])
    return stream.getvalue()


def _from_csv(source: Path) -> Correspondences:
    header, lines = csv_table(source, "correspondences")
    fixed = (*POINT_COLUMNS, *AFFINE, *SIGMA_COLUMNS)
    unknown = [name for name in header if name not in fixed and not DIRECTION.match(name)]
    if unknown or len(set(header)) != len(header):
        what = f"unknown column '{unknown[0]}'" if unknown else "a column appears twice"
        known = ", ".join((*POINT_COLUMNS, *AFFINE, "du1_1", "...", *SIGMA_COLUMNS))
        raise InputError(f"correspondences '{source}': {what}; known: {known}")
    rows = []
    for number, cells in lines:
        try:
            rows.append([float(field) if field else np.nan for field in cells.values()])
        except ValueError as error:
            raise InputError(
                f"correspondences '{source}', line {number}: {error}; write a number, or nothing"
            ) from error
    table = dict(zip(header, np.array(rows, dtype=np.float64).reshape(-1, len(header)).T, strict=True))
    for group in (POINT_COLUMNS, AFFINE):
        lacking = [name for name in group if name not in table]
        if lacking and (group == POINT_COLUMNS or len(lacking) < len(group)):
            raise InputError(f"correspondences '{source}': column '{lacking[0]}' is missing; add it")
    points = np.stack([table[name] for name in POINT_COLUMNS], axis=1)
    A21 = np.stack([table[name] for name in AFFINE], axis=1).reshape(-1, 2, 2) if AFFINE[0] in table else None
    return _correspondences(source, points[:, :2], points[:, 2:], A21, _directions(source, table), table)


def _directions(source: Path, table: dict[str, FloatArray]) -> tuple[FloatArray, FloatArray] | None:
    numbers = sorted({int(found.group(2)) for name in table if (found := DIRECTION.match(name))})
    if not numbers:
        return None
    images = []
    for image in (1, 2):
        each = []
        for k in range(1, numbers[-1] + 1):
            names = (f"du{image}_{k}", f"dv{image}_{k}")
            for name in names:
                if name not in table:
                    raise InputError(f"correspondences '{source}': column '{name}' is missing; add it")
            each.append(np.stack([table[name] for name in names], axis=1))
        images.append(np.stack(each, axis=1))
    return images[0], images[1]


def _from_extractor(source: Path, lines: list[str]) -> Correspondences:
    rows = []
    for number, line in enumerate(lines, 1):
        try:
            rows.append([float(field) for field in re.split(r"[\s,;]+", line.strip()) if field])
        except ValueError as error:
            raise InputError(
                f"correspondences '{source}', line {number}: {error}; expected on each line: {EXTRACTOR_COLUMNS}"
            ) from error
        if len(rows[-1]) != 10:
            raise InputError(
                f"correspondences '{source}', line {number}: {len(rows[-1])} numbers; without a header line ten are "
                f"expected: {EXTRACTOR_COLUMNS}"
            )
    table = np.array(rows)
    A21 = table[:, [0, 2, 1, 3]].reshape(-1, 2, 2)
    pixels1 = table[:, 6:8]
    pixels2 = np.einsum("nij,nj->ni", A21, pixels1) + table[:, 4:6]
    off = np.linalg.norm(pixels2 - table[:, 8:10], axis=1)
    if np.median(off) > MAX_REFINEMENT_PX:
        raise InputError(
            f"correspondences '{source}': A q1 + t misses x2, y2 by {np.median(off):.0f} px; the columns must be "
            f"{EXTRACTOR_COLUMNS}"
        )
    good = off <= MAX_REFINEMENT_PX
    return _correspondences(source, pixels1[good], pixels2[good], A21[good], None, {})


def _from_npz(source: Path, payload: bytes) -> Correspondences:
    try:
        table = _arrays(payload)
    except (ValueError, TypeError, OSError, KeyError, EOFError, zipfile.BadZipFile, zlib.error, NotImplementedError,
            RuntimeError, SyntaxError, struct.error) as error:  # fmt: skip
        raise InputError(
            f"correspondences '{source}': damaged NPZ, or not of numbers ({on_one_line(error)}); write it again"
        ) from error
    try:
        matched = _from_matcher(table)
    except InputError as error:
        raise InputError(f"correspondences '{source}': {error}") from error
    if matched is not None:
        A21 = matched.get("A21")
        return _correspondences(source, matched["pixels1"], matched["pixels2"], A21, None, _frame_sigmas(A21))
    unknown = [name for name in table if name not in ARRAYS]
    if unknown:
        raise InputError(f"correspondences '{source}': unknown array {unknown[0]!r}; known: {', '.join(ARRAYS)}")
    needed = ["pixels1", "pixels2"]
    if "directions1" in table or "directions2" in table:
        needed += ["directions1", "directions2"]
    for name in needed:
        if name not in table:
            raise InputError(f"correspondences '{source}': array '{name}' is missing; add it")
    directions = (table["directions1"], table["directions2"]) if "directions1" in table else None
    return _correspondences(source, table["pixels1"], table["pixels2"], table.get("A21"), directions, table)


def _from_matcher(table: dict[str, FloatArray]) -> dict[str, FloatArray] | None:
    """Return pixels1, pixels2 and, if known, A21 from a matcher's arrays; None for other arrays.

    Raises InputError for inconsistent arrays.
    """
    names = next((pair for pair in MATCHED if pair[0] in table and pair[1] in table), None)
    if names is None:
        return None
    rank = 3 if names[0] == "lafs0" else 2
    first, second = (_unbatched(table[name], rank) for name in names)
    which = _index_pairs(table, names, len(first), len(second))
    first, second = first[which[:, 0]], second[which[:, 1]]
    if rank == 2:
        return {"pixels1": first, "pixels2": second}
    if first.shape[1:] != (2, 3) or second.shape[1:] != (2, 3):
        raise InputError(f"{names[0]}: local affine frames must be Nx2x3, got {first.shape}")
    A21 = affinities_of_frames(first[..., :2], second[..., :2])
    return {"pixels1": first[..., 2], "pixels2": second[..., 2], "A21": A21}


def _unbatched(values: FloatArray, rank: int) -> FloatArray:
    out = values[0] if values.ndim == rank + 1 and len(values) == 1 else values
    if out.ndim != rank:
        raise InputError(f"expected an array of {rank} dimensions, got {values.shape}")
    return out


def _index_pairs(table: dict[str, FloatArray], names: tuple[str, str], count0: int, count1: int) -> IntArray:
    """Return the index pairs (K, 2) of the matches; without match arrays, points of equal index."""
    if "matches" in table:
        pairs: IntArray = _unbatched(table["matches"], 2).astype(np.int64)
    elif "matches0" in table:
        partner = _unbatched(table["matches0"], 1).astype(np.int64)
        pairs = np.stack([np.arange(len(partner)), partner], axis=1)[partner >= 0]
    elif count0 == count1:
        pairs = np.repeat(np.arange(count0)[:, None], 2, axis=1)
    else:
        raise InputError(
            f"{names[0]} has {count0} and {names[1]} {count1} points; array 'matches' must say which match"
        )
    if pairs.ndim != 2 or pairs.shape[1] != 2 or (pairs < 0).any() or (pairs >= [count0, count1]).any():
        raise InputError(f"matches: indices of {count0} and {count1} points are needed, K x 2")
    return pairs


def _frame_sigmas(A21: FloatArray | None) -> dict[str, FloatArray]:
    """Return the column sigma_A for affinities from features' frames."""
    return {} if A21 is None else {"sigma_A": np.full(len(A21), SIGMA_OF_FRAMES)}


def _arrays(payload: bytes) -> dict[str, FloatArray]:
    """Return the arrays of an NPZ by name; stated sizes are checked before memory is allocated."""
    table: dict[str, FloatArray] = {}
    with zipfile.ZipFile(io.BytesIO(payload)) as archive:
        for info in archive.infolist():
            name = info.filename.removesuffix(".npy")
            if name in table:
                raise ValueError(f"array {name[:40]!r} is there twice")
            if info.file_size > MAX_ARRAY_BYTES:
                raise ValueError(f"array {name[:40]!r} has {info.file_size} bytes, more than {MAX_ARRAY_BYTES}")
            with archive.open(info) as member:
                version = np.lib.format.read_magic(member)
                read = np.lib.format.read_array_header_1_0 if version[0] == 1 else np.lib.format.read_array_header_2_0
                shape, _, kind = read(member)
            if kind.kind not in "iuf":
                raise ValueError(f"array {name[:40]!r} is of {kind}")
            if math.prod(shape) * kind.itemsize > info.file_size:
                raise ValueError(f"array {name[:40]!r} states more values than it has")
            with archive.open(info) as member:
                table[name] = np.asarray(np.lib.format.read_array(member, allow_pickle=False), dtype=np.float64)
    return table


def _correspondences(
    source: Path,
    pixels1: FloatArray,
    pixels2: FloatArray,
    A21: FloatArray | None,
    directions: tuple[FloatArray, FloatArray] | None,
    table: dict[str, FloatArray],
) -> Correspondences:
    for values in (pixels1, pixels2, A21, *(directions or ()), *table.values()):
        if values is not None and (np.abs(values) > MAX_NUMBER).any():
            raise InputError(f"correspondences '{source}': a number is beyond {MAX_NUMBER:g}; check the columns")
    try:
        pairs = None
        if directions is not None:
            first, second = directions
            if first.ndim != 3:
                raise InputError(f"directions: expected shape NxKx2, got {first.shape}")
            kinds = tuple(f"direction {k + 1}" for k in range(first.shape[1]))
            pairs = DirectionPairs(
                image1=first, image2=second, valid=np.ones(first.shape[:2], dtype=bool), scaled=False, kinds=kinds
            )
        return Correspondences(pixels1, pixels2, A21, pairs, table.get("sigma_px"), table.get("sigma_A"))
    except InputError as error:
        raise InputError(f"correspondences '{source}': {error}; correct the columns") from error
