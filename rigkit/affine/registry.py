"""The affine estimators by name. Adding one is one line in the table and one module."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rigkit.affine.affinities import Affinities, DirectionNoise, EpipolarNormals, propagated
from rigkit.affine.components import MIN_CONDITIONING, PlanarDirections, blocks, finite, first_of
from rigkit.affine.epipolar import epipolar_block, soft_epipolar, usable_directions
from rigkit.affine.scaled import scaled_block
from rigkit.affine.unscaled import SCALES, determinant_block
from rigkit.core.arrays import Affines, BoolArray, FloatArray, Mat3, as_array
from rigkit.core.errors import InputError
from rigkit.core.matches import DirectionPairs

AFFINE_METHODS = ("F2UDIR", "F3UDIR", "DET3UDIR", "2SDIR", "3SDIR")

_COUNT: dict[str, int | None] = {"F2UDIR": 2, "F3UDIR": None, "DET3UDIR": None, "2SDIR": 2, "3SDIR": None}
_MIN_COUNT = {"F2UDIR": 2, "F3UDIR": 2, "DET3UDIR": 3, "2SDIR": 2, "3SDIR": 2}


@dataclass(frozen=True, eq=False, slots=True)
class _How:
    """How affinities are found: see `affines_from_directions`."""

    method: str
    epipolar: EpipolarNormals | None
    scale: str
    determinant: FloatArray | None


def needs_epipolar(method: str) -> bool:
    """Say whether `method` needs the epipolar geometry (then re-estimating that from its affinities is circular)."""
    return _known(method).startswith("F")


def affines_from_directions(
    directions: DirectionPairs,
    method: str,
    F21: Mat3 | None = None,
    *,
    epipolar: EpipolarNormals | None = None,
    scale: str = "area",
    noise: DirectionNoise | None = None,
    determinant: FloatArray | None = None,
    epipolar_rows: str = "hard",
    min_conditioning: float = MIN_CONDITIONING,
) -> Affinities:
    """Return the affinities of N corners from corresponding directions.

    Raises InputError: unknown method or option, no epipolar geometry or no lengths where the method needs them, lengths
    that differ.

    Parameters
    ----------
    directions : N corners, K directions each.
    method : "F2UDIR" or "2SDIR" use the first two usable directions of a corner, "F3UDIR", "DET3UDIR" and "3SDIR" all.
        Usable: valid, and for F2UDIR not along the epipolar line (|unit(d2) . unit(n2)| >= min_conditioning), so that
        the diagonal of a board steps in for an edge that is parallel to the baseline.
    F21 : for F2UDIR and F3UDIR in perspective images: the fundamental matrix; `directions` must have pixels then.
    epipolar : the same for any central camera: epipolar normals in the same pixels as the directions.
    scale : for DET3UDIR: "area" (exact, default), "ls" (exact), "sqmean" (the paper's) or "diagonal" (both biased).
    noise : of the directions; then each affinity has a covariance.
    determinant : (N,) for DET3UDIR: det A where it is known otherwise; then lengths are not used.
    epipolar_rows : "hard", or "soft": the epipolar equations stacked with the directions in least squares, as in the
        paper.
    min_conditioning : affinities below are invalid. 0 accepts everything that can be computed.

    Returns
    -------
    Affinities
        `valid` is False, and A21 NaN, where too few directions are usable or they do not determine the affinity.
    """
    if F21 is not None and epipolar is None and needs_epipolar(method):
        epipolar = _epipolar_of(directions, F21)
    how = _How(method, epipolar, scale, determinant)
    _check(directions, how, epipolar_rows, noise)
    A21, conditioning, use = _solved(directions, how, min_conditioning)
    if epipolar is not None and needs_epipolar(method) and epipolar_rows == "soft":
        A21 = soft_epipolar(directions, use, epipolar)
    with np.errstate(invalid="ignore"):
        valid = (use.sum(axis=1) >= _MIN_COUNT[method]) & (conditioning >= min_conditioning)
    valid &= finite(A21)
    A21[~valid] = np.nan
    covariance = None if noise is None else _covariance(directions, how, use, valid, noise)
    return Affinities(A21, valid, conditioning, covariance)


def _solved(directions: DirectionPairs, how: _How, min_conditioning: float) -> tuple[Affines, FloatArray, BoolArray]:
    """Return affinities (N, 2, 2), conditioning (N,) and which directions were used (N, K), a block at a time."""
    n, method, epipolar = len(directions.valid), how.method, how.epipolar
    A21 = np.full((n, 2, 2), np.nan)
    conditioning = np.full(n, np.nan)
    use = np.zeros(directions.valid.shape, dtype=bool)
    for block in blocks(n):
        planar = PlanarDirections.of(directions, block)
        if epipolar is not None and needs_epipolar(method):
            n1, n2 = (np.ascontiguousarray(v[block].T) for v in (epipolar.n1, epipolar.n2))
            chosen = usable_directions(planar, n2, _COUNT[method], min_conditioning)
            planar = planar if chosen is planar.use else planar.only(chosen)
            a, conditioning[block] = epipolar_block(planar, n1, n2)
        elif method == "DET3UDIR":
            known = None if how.determinant is None else np.asarray(how.determinant, dtype=np.float64)[block]
            a, conditioning[block] = determinant_block(planar, how.scale, known)
        else:
            count = _COUNT[method]
            planar = planar if count is None else planar.only(first_of(planar.use, count))
            a, conditioning[block] = scaled_block(planar)
        use[block] = planar.use.T
        A21[block] = a.T.reshape(-1, 2, 2)
    return A21, conditioning, use


def _covariance(
    directions: DirectionPairs, how: _How, use: BoolArray, valid: BoolArray, noise: DirectionNoise
) -> FloatArray:
    """Propagate the noise of the directions in use to vec(A), (N, 4, 4), to first order; NaN where invalid."""
    lines = None if how.epipolar is None else EpipolarNormals(how.epipolar.n1[valid], how.epipolar.n2[valid])
    known = None if how.determinant is None else np.asarray(how.determinant, dtype=np.float64)[valid]
    some, how = replace(directions, valid=use).select(valid), replace(how, epipolar=lines, determinant=known)

    def solve(moved: DirectionPairs) -> Affines:
        return _solved(moved, how, 0.0)[0]

    out = np.full((len(valid), 4, 4), np.nan)
    out[valid] = propagated(solve, some, DirectionNoise(noise.covariance1[valid], noise.covariance2[valid]))
    return out


def _epipolar_of(directions: DirectionPairs, F21: Mat3) -> EpipolarNormals:
    if directions.pixels1 is None or directions.pixels2 is None:
        raise InputError("affinities from F21: the directions have no pixels; give pixels1 and pixels2, or epipolar=")
    return EpipolarNormals.from_F(F21, directions.pixels1, directions.pixels2)


def _known(method: str) -> str:
    if method not in AFFINE_METHODS:
        raise InputError(f"affine method '{method}' is unknown; known: {', '.join(AFFINE_METHODS)}")
    return method


def _check(directions: DirectionPairs, how: _How, epipolar_rows: str, noise: DirectionNoise | None) -> None:
    method, epipolar, determinant = how.method, how.epipolar, how.determinant
    n, k = directions.valid.shape
    if how.scale not in SCALES:
        raise InputError(f"affine scale '{how.scale}' is unknown; known: {', '.join(SCALES)}")
    if epipolar_rows not in ("hard", "soft"):
        raise InputError(f"epipolar rows '{epipolar_rows}' are unknown; known: hard, soft")
    if needs_epipolar(method):
        if epipolar is None:
            raise InputError(f"{method} needs the epipolar geometry: pass epipolar=, or use 3SDIR")
        if len(epipolar) != n:
            raise InputError(f"{method}: {n} corners but epipolar normals of {len(epipolar)}")
    elif not directions.scaled and determinant is None:
        raise InputError(f"{method} needs the lengths of the directions, which these do not have: use F3UDIR")
    if determinant is not None:
        as_array(determinant, (n,), "determinant", finite=False)
    if k < _MIN_COUNT[method]:
        raise InputError(f"{method} needs {_MIN_COUNT[method]} directions a corner, got {k}")
    if noise is not None and noise.covariance1.shape != (n, 2 * k, 2 * k):
        raise InputError(f"direction noise: expected {n}x{2 * k}x{2 * k}, got {noise.covariance1.shape}")
