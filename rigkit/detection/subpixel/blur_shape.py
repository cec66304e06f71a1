"""The covariance of a board's blur, due to motion or defocus.

Around each corner the squares are a sum of waves with known wave vectors k, which a blur of covariance C multiplies by
exp(-k' C k / 2). C is estimated by least squares from the brightness around the board's corners, assuming that it is
the same everywhere. The edges of a single corner determine two of its three elements, the brightness of its centre the
third.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rigkit.core.arrays import FloatArray
from rigkit.detection.lattice.lattice import Lattice
from rigkit.detection.lattice.local_fit import LocalFit, fit_cells
from rigkit.detection.saddles.response import GreyImage, sample

ORDERS = np.array([1.0, 3.0, 5.0, 7.0])
"""Orders of the waves, in half waves per square: blur of an eighth of a square reduces the next order to 1 %."""

LARGE_SQUARES = 7.0
"""The sampled region of squares larger than this many s is limited to this size."""

READ_AT = np.linspace(-0.6, 0.6, 9)
"""Sample positions around a corner, in squares along both sides, within the outer squares of the board."""

MAX_LOOKED_AT = 64
"""Largest number of corners that are sampled."""

STEPS, SETTLED, HALVINGS = 12, 0.01, 6
"""Largest number of Gauss-Newton steps, the relative change of s at which they end, and the largest number of halvings
of a step that does not decrease the cost."""

CHANGE = 1e-3
"""Step of the finite differences in the logarithm of the covariance."""

MAX_CHANGE = 0.7
"""Largest change of the logarithm of the covariance per step: a factor 1.4 of s."""


def blur_covariance(image: GreyImage, lattice: Lattice, blur_px: float) -> FloatArray:
    """Return the covariance (2, 2), px^2, of the blur of the board `lattice`; `blur_px` is an initial value of s."""
    known = lattice.known
    shape = fit_cells(lattice.pixels, known)
    chosen = np.zeros(len(shape.pixels), np.bool_)
    chosen[:: max(len(chosen) // MAX_LOOKED_AT, 1)] = True
    shape, centres = shape.of(chosen), lattice.pixels[known][chosen]
    along, down = (part.ravel() for part in np.meshgrid(READ_AT, READ_AT))
    part = np.minimum(1.0, LARGE_SQUARES * blur_px / shape.cell_px())[:, None, None]
    shape = replace(shape, sides=part * shape.sides, curvatures=part**2 * shape.curvatures)
    # Sample positions follow the curvature of the rows and columns.
    terms = np.stack([along, down, 0.5 * along**2, 0.5 * down**2])
    offsets = np.einsum("ks,nkx->nsx", terms, np.concatenate([shape.sides, shape.curvatures], axis=1))
    seen = sample(image, centres[:, None] + offsets).astype(np.float64)
    seen -= seen.mean(axis=1, keepdims=True)
    return _covariance(seen, _waves(along, down), _wave_vectors(shape), blur_px)


def _waves(along: FloatArray, down: FloatArray) -> FloatArray:
    """Return the waves (S, 2, K, K) of the squares at the positions (S,), for sums and differences of the phases."""
    first, second = np.meshgrid(ORDERS, ORDERS, indexing="ij")
    phases = [np.pi * (first * along[:, None, None] + sign * second * down[:, None, None]) for sign in (1.0, -1.0)]
    waves = np.stack([-np.cos(phases[0]), np.cos(phases[1])], axis=1) / (first * second)
    return np.asarray(waves)


def _wave_vectors(shape: LocalFit) -> FloatArray:
    """Return the wave vectors (N, 2, K, K, 2) of `_waves` in the image, rad/px."""
    per_px = np.linalg.inv(shape.sides).transpose(0, 2, 1)
    first, second = np.meshgrid(ORDERS, ORDERS, indexing="ij")
    cells = np.stack([np.stack([first, sign * second], axis=-1) for sign in (1.0, -1.0)])
    return np.asarray(np.pi * np.einsum("tjkc,ncx->ntjkx", cells, per_px))


def _covariance(seen: FloatArray, waves: FloatArray, vectors: FloatArray, blur_px: float) -> FloatArray:
    """Return the covariance of the least squares fit to the brightness `seen` (N, S), starting at `blur_px`."""
    flat = waves.reshape(len(waves), -1)
    vectors = vectors.reshape(len(vectors), -1, 2)
    products = np.stack([vectors[..., 0] ** 2, 2.0 * vectors[..., 0] * vectors[..., 1], vectors[..., 1] ** 2], axis=-1)

    def residuals(log: FloatArray) -> FloatArray:
        c = _exponential(log)
        pattern = np.exp(-0.5 * (products @ np.array([c[0, 0], c[0, 1], c[1, 1]]))) @ flat.T
        pattern -= pattern.mean(axis=1, keepdims=True)
        share = (pattern * seen).sum(axis=1) / np.maximum((pattern**2).sum(axis=1), 1e-12)
        return np.asarray((seen - share[:, None] * pattern).ravel())

    log = np.array([2.0 * np.log(blur_px), 0.0, 2.0 * np.log(blur_px)])
    rest = residuals(log)
    for _ in range(STEPS):
        jacobian = np.stack([(residuals(log + CHANGE * unit) - rest) / CHANGE for unit in np.eye(3)], axis=1)
        step = np.linalg.lstsq(jacobian, -rest, rcond=None)[0]
        step *= min(1.0, MAX_CHANGE / max(float(np.abs(step).max()), 1e-12))
        for _ in range(HALVINGS):
            after = residuals(log + step)
            if after @ after <= rest @ rest:
                break
            step *= 0.5
        else:
            break
        log, rest = log + step, after
        if float(np.abs(step).max()) < SETTLED:
            break
    return _exponential(log)


def _exponential(log: FloatArray) -> FloatArray:
    """Return the matrix exponential of the symmetric matrix (uu, uv, vv) `log`, which is positive definite."""
    values, axes = np.linalg.eigh(np.array([[log[0], log[1]], [log[1], log[2]]]))
    return np.asarray((axes * np.exp(values)) @ axes.T)
