"""Arrays of an NPZ as matchers save them, under the names of ours.

Known: keypoints0, keypoints1 with matches (K, 2) or matches0 (N,), -1 for none (LightGlue, SuperGlue); mkpts0, mkpts1
or kpts0, kpts1 (LoFTR, RoMa); lafs0, lafs1 (N, 2, 3), frames with the point in the last column (kornia). A leading
batch of one is taken off. Pixel (0, 0) is the centre of the top-left pixel.
"""

from __future__ import annotations

import numpy as np

from rigkit.core.arrays import FloatArray, IntArray
from rigkit.core.errors import InputError

POINTS = (("mkpts0", "mkpts1"), ("kpts0", "kpts1"), ("keypoints0", "keypoints1"), ("lafs0", "lafs1"))


def from_matcher(table: dict[str, FloatArray]) -> dict[str, FloatArray] | None:
    """Return pixels1, pixels2 and perhaps A21 of a matcher's arrays; None where they are no matcher's.

    Raises InputError where they do not fit each other.
    """
    names = next((pair for pair in POINTS if pair[0] in table and pair[1] in table), None)
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
    flat = np.abs(np.linalg.det(first[..., :2])) > 0.0
    A21 = np.full((len(first), 2, 2), np.nan)
    A21[flat] = second[flat][..., :2] @ np.linalg.inv(first[flat][..., :2])
    return {"pixels1": first[..., 2], "pixels2": second[..., 2], "A21": A21}


def _unbatched(values: FloatArray, rank: int) -> FloatArray:
    out = values[0] if values.ndim == rank + 1 and len(values) == 1 else values
    if out.ndim != rank:
        raise InputError(f"expected an array of {rank} dimensions, got {values.shape}")
    return out


def _index_pairs(table: dict[str, FloatArray], names: tuple[str, str], count0: int, count1: int) -> IntArray:
    """Return the indices (K, 2) of what matches, all in order where nothing says."""
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
