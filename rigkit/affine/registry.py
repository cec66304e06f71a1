"""The affine estimators by name. A new one needs a module and an entry of the table."""

from __future__ import annotations

from collections.abc import Callable
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

Block = tuple[FloatArray, FloatArray]
"""vec(A), (4, n), and conditioning, (n,), of n corners."""


@dataclass(frozen=True, eq=False, slots=True)
class _Known:
    """Arguments of `affines_from_directions` other than the directions."""

    epipolar: EpipolarNormals | None
    scale: str
    determinant: FloatArray | None

    def select(self, which: slice | BoolArray) -> _Known:
        """Return those of some of the corners."""
        lines = None if self.epipolar is None else EpipolarNormals(self.epipolar.n1[which], self.epipolar.n2[which])
        determinant = None if self.determinant is None else np.asarray(self.determinant, dtype=np.float64)[which]
        return _Known(lines, self.scale, determinant)


@dataclass(frozen=True, slots=True)
class _Estimator:
    """Solver of a block of corners from at least `min_count` directions: the first `count` usable ones (None: all)."""

    solve: Callable[[PlanarDirections, _Known], Block]
    count: int | None = None
    min_count: int = 2
    needs_epipolar: bool = False


def _by_epipolar(directions: PlanarDirections, known: _Known) -> Block:
    assert known.epipolar is not None
    return epipolar_block(directions, known.epipolar.n1.T, known.epipolar.n2.T)


_ESTIMATORS = {
    "F2UDIR": _Estimator(_by_epipolar, count=2, needs_epipolar=True),
    "F3UDIR": _Estimator(_by_epipolar, needs_epipolar=True),
    "DET3UDIR": _Estimator(lambda some, known: determinant_block(some, known.scale, known.determinant), min_count=3),
    "2SDIR": _Estimator(lambda some, _: scaled_block(some), count=2),
    "3SDIR": _Estimator(lambda some, _: scaled_block(some)),
}
AFFINE_METHODS = tuple(_ESTIMATORS)


def needs_epipolar(method: str) -> bool:
    """Return whether `method` needs the epipolar geometry, which then must not be re-estimated from its affinities."""
    return _estimator(method).needs_epipolar


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

    Raises InputError: unknown method or option, no epipolar geometry or no lengths although the method needs them, or
    arrays of different lengths.

    Parameters
    ----------
    directions : N corners, K directions each.
    method : "F2UDIR" or "2SDIR" use the first two usable directions of a corner, "F3UDIR", "DET3UDIR" and "3SDIR" all.
        Usable: valid, and for F2UDIR not along the epipolar line (|unit(d2) . unit(n2)| >= min_conditioning), so that
        the diagonal of a board replaces an edge parallel to the baseline.
    F21 : fundamental matrix, for F2UDIR and F3UDIR in perspective images; `directions` must have pixels.
    epipolar : epipolar normals in the pixels of the directions, for F2UDIR and F3UDIR with any central camera.
    scale : for DET3UDIR: "area" (exact, default), "ls" (exact), "sqmean" (the paper's) or "diagonal" (both biased).
    noise : of the directions, for covariances of the affinities.
    determinant : (N,) for DET3UDIR: det A if it is known; lengths are then not used.
    epipolar_rows : "hard": exact constraint; "soft": least squares together with the directions, as in the paper.
    min_conditioning : smallest conditioning of a valid affinity; 0 accepts all that can be computed.

    Returns
    -------
    Affinities
        `valid` is False, and A21 NaN, if too few directions are usable or they do not determine the affinity.
    """
    if F21 is not None and epipolar is None and needs_epipolar(method):
        epipolar = _epipolar_of(directions, F21)
    known = _Known(epipolar, scale, determinant)
    _check(directions, method, known, epipolar_rows, noise)
    A21, conditioning, use = _solved(directions, method, known, min_conditioning)
    if epipolar is not None and needs_epipolar(method) and epipolar_rows == "soft":
        A21 = soft_epipolar(directions, use, epipolar)
    with np.errstate(invalid="ignore"):
        valid = (use.sum(axis=1) >= _estimator(method).min_count) & (conditioning >= min_conditioning)
    valid &= finite(A21)
    A21[~valid] = np.nan
    covariance = None if noise is None else _covariance(directions, method, known, use, valid, noise)
    return Affinities(A21, valid, conditioning, covariance)


def _solved(
    directions: DirectionPairs, method: str, known: _Known, min_conditioning: float
) -> tuple[Affines, FloatArray, BoolArray]:
    """Return affinities (N, 2, 2), conditioning (N,) and which directions were used (N, K)."""
    n, estimator = len(directions.valid), _estimator(method)
    A21 = np.full((n, 2, 2), np.nan)
    conditioning = np.full(n, np.nan)
    use = np.zeros(directions.valid.shape, dtype=bool)
    for block in blocks(n):
        planar, here = PlanarDirections.of(directions, block), known.select(block)
        if estimator.needs_epipolar and here.epipolar is not None:
            chosen = usable_directions(planar, here.epipolar.n2.T, estimator.count, min_conditioning)
            planar = planar if chosen is planar.use else planar.only(chosen)
        elif estimator.count is not None:
            planar = planar.only(first_of(planar.use, estimator.count))
        a, conditioning[block] = estimator.solve(planar, here)
        use[block] = planar.use.T
        A21[block] = a.T.reshape(-1, 2, 2)
    return A21, conditioning, use


def _covariance(
    directions: DirectionPairs, method: str, known: _Known, use: BoolArray, valid: BoolArray, noise: DirectionNoise
) -> FloatArray:
    """Return the first-order covariance of vec(A), (N, 4, 4), from the noise of the used directions; NaN if invalid."""
    some, of_some = replace(directions, valid=use).select(valid), known.select(valid)

    def solve(moved: DirectionPairs) -> Affines:
        return _solved(moved, method, of_some, 0.0)[0]

    out = np.full((len(valid), 4, 4), np.nan)
    out[valid] = propagated(solve, some, DirectionNoise(noise.covariance1[valid], noise.covariance2[valid]))
    return out


def _epipolar_of(directions: DirectionPairs, F21: Mat3) -> EpipolarNormals:
    if directions.pixels1 is None or directions.pixels2 is None:
        raise InputError("affinities from F21: the directions have no pixels; give pixels1 and pixels2, or epipolar=")
    return EpipolarNormals.from_F(F21, directions.pixels1, directions.pixels2)


def _estimator(method: str) -> _Estimator:
    if method not in _ESTIMATORS:
        raise InputError(f"affine method '{method}' is unknown; known: {', '.join(AFFINE_METHODS)}")
    return _ESTIMATORS[method]


def _check(
    directions: DirectionPairs, method: str, known: _Known, epipolar_rows: str, noise: DirectionNoise | None
) -> None:
    estimator, epipolar, determinant = _estimator(method), known.epipolar, known.determinant
    n, k = directions.valid.shape
    if known.scale not in SCALES:
        raise InputError(f"affine scale '{known.scale}' is unknown; known: {', '.join(SCALES)}")
    if epipolar_rows not in ("hard", "soft"):
        raise InputError(f"epipolar rows '{epipolar_rows}' are unknown; known: hard, soft")
    if estimator.needs_epipolar:
        if epipolar is None:
            raise InputError(f"{method} needs the epipolar geometry: pass epipolar=, or use 3SDIR")
        if len(epipolar) != n:
            raise InputError(f"{method}: {n} corners but epipolar normals of {len(epipolar)}")
    elif not directions.scaled and determinant is None:
        raise InputError(f"{method} needs the lengths of the directions, which these do not have: use F3UDIR")
    if determinant is not None:
        as_array(determinant, (n,), "determinant", finite=False)
    if k < estimator.min_count:
        raise InputError(f"{method} needs {estimator.min_count} directions a corner, got {k}")
    if noise is not None and noise.covariance1.shape != (n, 2 * k, 2 * k):
        raise InputError(f"direction noise: expected {n}x{2 * k}x{2 * k}, got {noise.covariance1.shape}")
