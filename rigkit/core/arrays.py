"""Array aliases for signatures, validation of arrays, and small fast array functions.

All arrays are float64 with points in rows; a leading `...` broadcasts. Jacobians put the dependent variable first.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rigkit.core.errors import InputError

BRIGHT_SHARE = 0.999
"""Quantile of the pixels that determines the number of bits; brighter pixels are hot, or a glint."""

NOT_NUMBERS = "bSUmMV"
"""Kinds of arrays that numpy would convert to numbers: booleans, strings, dates."""
MAX_ASYMMETRY = 1e-6
"""Of a covariance, in units of the two sigmas: the solution of a well-posed problem leaves 1e-12."""
MAX_VARIANCE = 1e36
"""Variance of a completely unknown number of at most 1e15; products of much larger ones overflow."""
MIN_EIGENVALUE = -1e-6
"""Of a correlation matrix, times the number of its rows: rounding of an inverse makes zeros slightly negative."""

TINY = 1e-300
"""Least divisor (variance, sum of squares) where a quotient must exist; below all that is not rounding."""
NEGLIGIBLE_AXIS = 1e-12
"""Relative variance (of parameters scaled to one sigma) up to which a principal axis is left out."""
SORTED_SOONER = 1000
"""Below so many numbers sorting is faster than partitioning."""

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.int64]
GreyImage = NDArray[np.uint8] | NDArray[np.float32]
"""Grey levels 0..255. Images of an 8-bit camera stay bytes: four times the memory costs as much time as detection."""
Pixels = Annotated[FloatArray, "(..., 2) px, (u, v), (0, 0) the centre of the top-left pixel"]
Points = Annotated[FloatArray, "(..., 3) mm"]
Rays = Annotated[FloatArray, "(..., 3) unit"]
Normals = Annotated[FloatArray, "(..., 3) unit"]
Affines = Annotated[FloatArray, "(..., 2, 2) image 2 from image 1"]
RayJacobians = Annotated[FloatArray, "(..., 3, 2) d ray / d pixel"]
Mat3 = Annotated[FloatArray, "(..., 3, 3)"]
Coordinates = Annotated[tuple[FloatArray, FloatArray, FloatArray], "x, y, z of points in the camera frame, (N,) each"]
Projected = Annotated[tuple[FloatArray, FloatArray, BoolArray], "u, v of pixels and where they are valid, (N,) each"]


def as_array(value: ArrayLike, shape: tuple[int | None, ...], name: str, *, finite: bool = True) -> FloatArray:
    """Return a read-only float64 copy of `value`, checked against `shape`, in which None stands for any length.

    Raises InputError, with `name` in the message, for another shape, values that are no numbers or, if `finite`, values
    that are not finite.
    """
    try:
        raw = np.asarray(value)
        if raw.dtype.kind in NOT_NUMBERS and raw.size:
            raise TypeError(f"of {raw.dtype.name}")
        array = np.array(raw, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{name}: not an array of numbers ({error})") from error
    _check_shape(array, shape, name)
    if finite and not np.isfinite(array).all():
        bad = int((~np.isfinite(array)).sum())
        raise InputError(f"{name}: {bad} of {array.size} values are NaN or infinite; remove them first")
    array.flags.writeable = False
    return array


def keep_arrays(
    result: object, *, finite: bool = True, optional: bool = False, what: str = "", **shapes: tuple[int | None, ...]
) -> None:
    """Replace the fields named in `shapes` of a frozen `result` by read-only copies, checked as by `as_array`.

    `optional`: these fields may also be None. `what` precedes their names in messages.
    """
    for name, shape in shapes.items():
        value = getattr(result, name)
        if not (optional and value is None):
            object.__setattr__(result, name, as_array(value, shape, what + name, finite=finite))


def keep_indices(result: object, **shapes: tuple[int | None, ...]) -> None:
    """Replace integer fields of a frozen `result` by read-only copies, checked as by `as_indices`."""
    for name, shape in shapes.items():
        object.__setattr__(result, name, as_indices(getattr(result, name), shape, name))


def as_floats(value: ArrayLike, tail: tuple[int, ...], name: str) -> FloatArray:
    """Return `value` as a float64 array, not copied, of shape (..., *tail); raises InputError for any other shape."""
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{name}: not an array of numbers ({error})") from error
    if array.shape[array.ndim - len(tail) :] != tail or array.ndim < len(tail):
        raise InputError(f"{name}: expected shape (..., {', '.join(map(str, tail))}), got {array.shape}")
    return array


def as_mask(value: ArrayLike, shape: tuple[int, ...], name: str) -> BoolArray:
    """Return `value`, a boolean array of this shape; raises InputError for anything else."""
    array = np.asarray(value)
    if array.dtype != np.bool_ or array.shape != shape:
        words = "x".join(map(str, shape))
        raise InputError(f"{name}: truth values of shape {words} are needed, got {array.dtype} of {array.shape}")
    return array


def as_covariance(value: ArrayLike, name: str, size: int) -> FloatArray:
    """Return a read-only copy of a covariance (`size`, `size`).

    Raises InputError for another shape, or a matrix that is not finite, not symmetric, zero, or not positive
    semidefinite, with the tolerances `MAX_ASYMMETRY` and `MIN_EIGENVALUE` for rounding.
    """
    covariance = as_array(value if size else np.zeros((0, 0)), (size, size), name)
    variance = np.diag(covariance)
    if (variance < 0.0).any():
        raise InputError(
            f"{name}: a variance is negative ({variance.min():.3g}); the numbers were changed or damaged; "
            "calibrate again"
        )
    if size and not variance.any():
        raise InputError(f"{name}: every variance is zero, and nothing that is measured is exact; calibrate again")
    if (variance > MAX_VARIANCE).any():
        raise InputError(f"{name}: a variance is {variance.max():.3g}, which says nothing; calibrate again")
    sigma = np.sqrt(variance)
    # What has no variance has no covariance either.
    scale = np.outer(sigma, sigma)
    if (np.abs(covariance - covariance.T) > MAX_ASYMMETRY * scale).any():
        raise InputError(
            f"{name}: it is not symmetric, as covariances are; the numbers were changed or damaged; calibrate again"
        )
    if (np.abs(covariance) > (1.0 - MIN_EIGENVALUE) * scale).any():
        raise InputError(f"{name}: a correlation is beyond 1; the numbers were changed or damaged; calibrate again")
    correlation = np.divide(covariance, scale, out=np.zeros_like(covariance), where=scale > 0.0)
    if size and float(np.linalg.eigvalsh(correlation + correlation.T)[0]) < 2.0 * MIN_EIGENVALUE * size:
        raise InputError(
            f"{name}: it has a negative variance in some direction; the numbers were changed or damaged; "
            "calibrate again"
        )
    return covariance


def as_indices(value: ArrayLike, shape: tuple[int | None, ...], name: str) -> IntArray:
    """Return a read-only int64 copy of `value`, checked against `shape`; raises InputError like `as_array`."""
    raw = np.asarray(value)
    if raw.size and not np.issubdtype(raw.dtype, np.integer):
        raise InputError(f"{name}: whole numbers expected, got {raw.dtype}")
    array = np.array(raw, dtype=np.int64)
    _check_shape(array, shape, name)
    array.flags.writeable = False
    return array


def in_8_bits(image: NDArray[Any]) -> NDArray[np.uint8]:
    """Return an 8-bit image unchanged, and a 16-bit image reduced to the upper eight of the bits that its bright pixels
    use: cameras of 10 and 12 bits fill the lower bits of 16."""
    if image.dtype == np.uint8:
        return image
    bright = int(np.quantile(image[::8, ::8], BRIGHT_SHARE)) if image.size else 0
    bits = min(max(bright.bit_length(), 8), 16)
    return np.asarray(np.minimum(image, (1 << bits) - 1) >> (bits - 8), dtype=np.uint8)


def _check_shape(array: NDArray[Any], shape: tuple[int | None, ...], name: str) -> None:
    # A loop, for speed: this runs for every array of every view.
    fits = array.ndim == len(shape)
    if fits:
        for want, have in zip(shape, array.shape, strict=True):
            if want is not None and want != have:
                fits = False
    if not fits:
        wanted = "x".join("N" if want is None else str(want) for want in shape) or "a scalar"
        raise InputError(f"{name}: expected shape {wanted}, got {'x'.join(map(str, array.shape)) or 'a scalar'}")


def without_nan(value: Any) -> Any:
    """Return nested dicts and lists with None for every number that is not finite: JSON has no NaN."""
    if isinstance(value, dict):
        return {key: without_nan(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [without_nan(inner) for inner in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def known_median(values: FloatArray) -> float:
    """Return the median of the numbers that are not NaN; NaN if there are none. np.nanmedian takes five times as
    long."""
    known = values[~np.isnan(values)]
    return median_of(known) if known.size else math.nan


def sampling_step(count: int, max_samples: int) -> int:
    """Return the step of a slice that takes at most `max_samples` of `count` items, evenly spread."""
    return max(1, math.ceil(count / max_samples))


def spread_indices(count: int, max_samples: int) -> IntArray:
    """Return the indices of at most `max_samples` of `count` items, evenly spread from the first to the last."""
    return np.linspace(0, count - 1, min(max_samples, count)).astype(np.int64)


def rows_where(values: FloatArray, which: BoolArray) -> FloatArray:
    """Return the rows (M, K) of `values` (..., K) where `which` (...) is true. values[which] takes five times as
    long."""
    return values.reshape(-1, values.shape[-1])[which.reshape(-1).nonzero()[0]]


def upper_median(values: FloatArray) -> float:
    """Return the upper median of N > 0 numbers. For fifty numbers np.median takes ten times as long."""
    half, ordered = len(values) // 2, values.copy()
    ordered.partition(half)
    return float(ordered[half])


def quantiles_of(values: FloatArray, shares: Sequence[float]) -> list[float]:
    """Return the linearly interpolated quantiles of N > 0 numbers. np.quantile takes several times as long."""
    ordered, out = np.sort(values), []
    for share in shares:
        below, part = divmod(share * (len(ordered) - 1), 1.0)
        low, high = ordered[int(below)], ordered[min(int(below) + 1, len(ordered) - 1)]
        out.append(float(low + part * (high - low)))
    return out


def root_diagonal(matrices: FloatArray) -> FloatArray:
    """Return the roots (..., n) of the diagonals of information matrices (..., n, n), at least that of the smallest
    number: divided by them on both sides, matrices of unknowns with different units have a unit diagonal."""
    return np.asarray(np.sqrt(np.maximum(np.diagonal(matrices, axis1=-2, axis2=-1), np.finfo(float).tiny)))


def symmetric_pinv(matrix: FloatArray, rcond: float = 1e-15) -> FloatArray:
    """Return the pseudo-inverse of a symmetric matrix (n, n); eigenvalues up to `rcond` times the largest count as
    zero. For a small matrix np.linalg.pinv takes six times as long."""
    values, vectors = np.linalg.eigh(matrix)
    size = np.abs(values)
    known = size > rcond * size.max(initial=0.0)
    return np.asarray((vectors[:, known] / values[known]) @ vectors[:, known].T)


def scaled_pinv(matrix: FloatArray, rcond: float = 1e-15) -> FloatArray:
    """Return the pseudo-inverse of a covariance or information (n, n) of unknowns with different units: as
    `symmetric_pinv` after scaling to a unit diagonal. Rows with a zero diagonal stay zero."""
    diagonal = np.diag(matrix)
    scale = np.where(diagonal > 0.0, 1.0 / np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0)), 0.0)
    return np.asarray(symmetric_pinv(matrix * scale[:, None] * scale, rcond) * scale[:, None] * scale)


def principal_axes(covariance: FloatArray) -> FloatArray:
    """Return rows (K, P) whose outer products sum up to `covariance`: independent steps of one sigma each."""
    sigma = np.sqrt(np.diag(covariance))
    safe = np.where(sigma > 0.0, sigma, 1.0)
    values, vectors = np.linalg.eigh(covariance / np.outer(safe, safe))
    kept = values > NEGLIGIBLE_AXIS * values[-1]
    return np.asarray((vectors[:, kept] * np.sqrt(values[kept])).T * sigma)


def median_of(values: FloatArray) -> float:
    """Return the median of N > 0 numbers, which are reordered in place. np.median takes four times as long."""
    low, high = (values.size - 1) // 2, values.size // 2
    if values.size < SORTED_SOONER:
        values.sort()
    else:
        values.partition((low, high))
    return 0.5 * float(values[low] + values[high])
