"""The shape of the boards, with priors as wide as the views say.

A prior that is too wide lets the noise of the views bend a flat board, and the lens with it; one that is too narrow
holds back the corners of a wavy one. The evidence of the views knows: for bows, stretches and the stray of single
corners in the plane and out of it, each board has a size of its own by MacKay's update sigma^2 = sum u^2 / gamma, where
gamma = sum (1 - variance / prior^2) is how many of the unknowns u the views determine.

Reference: D. MacKay, "Bayesian interpolation", Neural Computation 4 (1992), section 4.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from rigkit.arrays import FloatArray, IntArray
from rigkit.calibration.assemble import solution_normal
from rigkit.calibration.fit import Fit, fit_kept
from rigkit.calibration.observations import Observations
from rigkit.calibration.shape import BOWS, STRETCHES, WARP_UNKNOWNS, often_seen, shape_model

__all__ = ["fit_shape"]

ROUNDS = 2
"""More rounds change the sizes by a few per cent and the lens not at all."""
LEAST = 1e-4
"""A size falls to no less than this part of the first one in a round: on exact data it would fall to nothing."""


def fit_shape(observations: Observations, fit: Fit, kind: str) -> Fit:
    """Return the fit with boards of the shape `kind`, from that with flat ones."""
    if kind == "flat":
        return fit
    shape = shape_model("warp", observations)
    start = replace(fit.state, shape=shape, unknowns=np.zeros(shape.count))
    fit = _evident(observations, fit_kept(observations, start, fit.kept, settle=True))
    if kind == "warp":
        return fit
    first = fit.state.shape.count
    shape = shape_model(kind, observations)
    shape = replace(shape, sigma=np.concatenate([fit.state.shape.sigma, shape.sigma[first:]]))
    unknowns = np.concatenate([fit.state.unknowns, np.zeros(shape.count - first)])
    start = replace(fit.state, shape=shape, unknowns=unknowns)
    return _evident(observations, fit_kept(observations, start, fit.kept, settle=True))


def _evident(observations: Observations, fit: Fit) -> Fit:
    for _ in range(ROUNDS):
        shape = replace(fit.state.shape, sigma=_sizes(observations, fit))
        fit = fit_kept(observations, replace(fit.state, shape=shape), fit.kept, settle=True)
    return fit


def _sizes(observations: Observations, fit: Fit) -> FloatArray:
    """Return the prior standard deviation of each unknown of the shape."""
    sizes = fit.state.shape.sigma.copy()
    known = 1.0 - (_variance(fit) / sizes**2)
    for group in _groups(observations, fit):
        if (gamma := float(known[group].sum())) > 0.0:
            found = np.sqrt((fit.state.unknowns[group] ** 2).sum() / gamma)
            sizes[group] = max(float(found), LEAST * float(sizes[group].max()))
    return sizes


def _groups(observations: Observations, fit: Fit) -> Iterator[IntArray]:
    """Yield the unknowns that have one size together: of the warp, or of the released corners that move against it.
    Those at the board's border are apart: paper ends or curls there, and a detector sees one neighbour less."""
    first = fit.state.shape.basis.shape[-1]
    for i, board in enumerate(np.flatnonzero(often_seen(observations)).tolist()):
        if fit.state.shape.kind == "warp":
            yield from (WARP_UNKNOWNS * i + part for part in (BOWS, STRETCHES))
        else:
            grid = observations.boards[board].grid()
            border = ((grid == 0) | (grid == np.array(observations.boards[board].size) - 1)).any(axis=1)
            for chosen in (border, ~border):
                rows = observations.first_row[board] + np.flatnonzero(chosen)
                yield from (first + (3 * rows[:, None] + np.array(axes)).ravel() for axes in ((0, 1), (2,)))


def _variance(fit: Fit) -> FloatArray:
    """Return the variance of each unknown of the shape. That of a released corner is taken with the others held:
    against the exact one its sizes come out the same within a tenth, without the inverse of a matrix of thousands."""
    normal, sigma = solution_normal(fit), fit.sigma_px if np.isfinite(fit.sigma_px) else 1.0
    count = fit.state.shape.count
    if fit.state.shape.kind == "warp":
        return np.diag(normal.covariance()[0])[len(normal.g) - count :] * sigma**2
    first = fit.state.shape.basis.shape[-1]
    points, start = (count - first) // 3, len(normal.g) - (count - first)
    each = np.arange(points)
    blocks = normal.gg[start:, start:].reshape(points, 3, points, 3)[each, :, each, :]
    own = np.diagonal(np.linalg.inv(blocks), axis1=-2, axis2=-1) * sigma**2
    return np.concatenate([np.zeros(first), own.ravel()])
