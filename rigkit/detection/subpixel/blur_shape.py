"""How wide a board's blur is in which direction: the covariance that a moving or unfocused camera gives its edges.

Around each corner squares alternate, so that their picture, blurred by covariance C, is a sum of waves of known
directions, each weakened by exp(-k' C k / 2) for its wave vector k. Blur of one shape everywhere on the board is sought
that explains the brightness around its corners best; of one corner alone the edges tell two of its three numbers, and
how bright its middle is the third.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rigkit.core.arrays import FloatArray
from rigkit.detection.lattice.lattice import Lattice
from rigkit.detection.lattice.local_fit import LocalFit, fit_cells
from rigkit.detection.saddles.response import GreyImage, sample

ORDERS = np.array([1.0, 3.0, 5.0, 7.0])
"""Waves of the squares, in halves of one a square: what blur of an eighth of a square leaves of the next is 1 %."""

LARGE_SQUARES = 7.0
"""Squares of more s are taken to be of so many: what is looked at around a corner is the same."""

READ_AT = np.linspace(-0.6, 0.6, 9)
"""Where brightness is read around a corner, in squares along both sides: at the board's end other things lie beyond."""

MAX_LOOKED_AT = 64
"""Corners that are looked at: more tell no more."""

STEPS, SETTLED, HALVINGS = 12, 0.01, 6
"""Gauss-Newton steps at most, the relative change of s that ends them, and how often a step that does not help is
halved."""

CHANGE = 1e-3
"""Derivatives are differences over so much of the logarithm of the covariance."""

MAX_CHANGE = 0.7
"""The most that a step changes the logarithm of the covariance by: s by the factor 1.4."""


def blur_covariance(image: GreyImage, lattice: Lattice, blur_px: float) -> FloatArray:
    """Return the covariance (2, 2), px^2, of the blur of the board `lattice`; it is about `blur_px` wide."""
    known = lattice.known
    shape = fit_cells(lattice.pixels, known)
    chosen = np.zeros(len(shape.pixels), np.bool_)
    chosen[:: max(len(chosen) // MAX_LOOKED_AT, 1)] = True
    shape, centres = shape.of(chosen), lattice.pixels[known][chosen]
    along, down = (part.ravel() for part in np.meshgrid(READ_AT, READ_AT))
    part = np.minimum(1.0, LARGE_SQUARES * blur_px / shape.cell_px())[:, None, None]
    shape = replace(shape, sides=part * shape.sides, curvatures=part**2 * shape.curvatures)
    # Along bent lines, as the squares lie.
    terms = np.stack([along, down, 0.5 * along**2, 0.5 * down**2])
    offsets = np.einsum("ks,nkx->nsx", terms, np.concatenate([shape.sides, shape.curvatures], axis=1))
    seen = sample(image, centres[:, None] + offsets).astype(np.float64)
    seen -= seen.mean(axis=1, keepdims=True)
    return _covariance(seen, _waves(along, down), _wave_vectors(shape), blur_px)


def _waves(along: FloatArray, down: FloatArray) -> FloatArray:
    """Return the waves (S, 2, K, K) that make up squares at the places (S,): of sum and difference of the phases."""
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
    """Return the covariance that explains the brightness `seen` (N, S) best, from `blur_px` on."""
    flat = waves.reshape(len(waves), -1)
    vectors = vectors.reshape(len(vectors), -1, 2)
    products = np.stack([vectors[..., 0] ** 2, 2.0 * vectors[..., 0] * vectors[..., 1], vectors[..., 1] ** 2], axis=-1)

    def left(log: FloatArray) -> FloatArray:
        c = _exponential(log)
        pattern = np.exp(-0.5 * (products @ np.array([c[0, 0], c[0, 1], c[1, 1]]))) @ flat.T
        pattern -= pattern.mean(axis=1, keepdims=True)
        share = (pattern * seen).sum(axis=1) / np.maximum((pattern**2).sum(axis=1), 1e-12)
        return np.asarray((seen - share[:, None] * pattern).ravel())

    log = np.array([2.0 * np.log(blur_px), 0.0, 2.0 * np.log(blur_px)])
    rest = left(log)
    for _ in range(STEPS):
        jacobian = np.stack([(left(log + CHANGE * unit) - rest) / CHANGE for unit in np.eye(3)], axis=1)
        step = np.linalg.lstsq(jacobian, -rest, rcond=None)[0]
        step *= min(1.0, MAX_CHANGE / max(float(np.abs(step).max()), 1e-12))
        for _ in range(HALVINGS):
            after = left(log + step)
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
    """Return the exponential of the symmetric matrix of elements `log` (uu, uv, vv): positive definite whatever they
    are."""
    values, axes = np.linalg.eigh(np.array([[log[0], log[1]], [log[1], log[2]]]))
    return np.asarray((axes * np.exp(values)) @ axes.T)
