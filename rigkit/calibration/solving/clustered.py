"""Covariances from what repeats: the image is the unit that is independent, not the corner.

Residuals of one view share causes (a lens or a board that is not quite its model, blur, light, a board that bends), so
50 to 300 corners count like a few. With H_v and s_v what image v contributes to information and score of the shared
unknowns after its own poses are eliminated, and K = (sum H_v + prior)^-1, the sandwich

    K (sum_v s_v s_v^T) K

holds whatever happens inside an image. Whitened by K, M_v = K^1/2 H_v K^1/2 is the leverage of an image: it has pulled
the solution to itself, and z_v = K^1/2 s_v is too small. (I - M_v)^-1/2 z_v is not: its second moments sum to those of
independent corners where corners are independent ("CR2").

So few images know the size of the second moments, and hardly their shape in ten or twenty directions. They are shrunk
towards a multiple of what independent corners would have, by as much as their own noise asks ("oracle approximating
shrinkage"): with few images one number scales the covariance of independent corners, with many each direction has its
own. What corners of an image have in common adds to their scatter, a component of variance that is not negative: where
that number is below one, it is so by chance, and one is taken, as Birge's ratio for measurements that agree too well.

What images say has as many degrees of freedom as there are images but one, or fewer where some images weigh more than
others: quantiles are Student's. What counts these (bounds, chances) takes the covariance as it is; standard deviations
that are quoted are widened (`widening`), so that two hold 95 % of errors after four images as after forty.

References: R. M. Bell, D. F. McCaffrey, "Bias reduction in standard errors for linear regression with multi-stage
samples", Survey Methodology 28, 2002. J. G. MacKinnon, M. D. Webb, "Cluster-robust inference: a guide to empirical
practice", Journal of Econometrics 232, 2023. Y. Chen, A. Wiesel, Y. C. Eldar, A. O. Hero, "Shrinkage algorithms for
MMSE covariance estimation", IEEE Trans. Signal Processing 58, 2010, eq. 23. R. T. Birge, "The calculation of errors by
the method of least squares", Physical Review 40, 1932.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rigkit.calibration.solving.normal_equations import pose_inverses
from rigkit.core.arrays import FloatArray, IntArray, scaled_pinv
from rigkit.kernels.linearise import chebyshev_series

MIN_CLUSTERS = 2
"""One image (or frame) says nothing about how they differ."""
MIN_LEFT = 0.05
"""What is left of an image's pull in a direction that it alone determines: less is rounding."""
MAX_FOR_SERIES, SERIES_LEFT_OUT = 0.8, 1e-13
"""Up to such a leverage x a series of Chebyshev polynomials approximates (1 - x)^-1/2; its coefficients fall by
(1 - sqrt(1 - x)) / (1 + sqrt(1 - x)) each, down to about the second."""
NULL_DRAWS = 4000
"""Draws of a null distribution: a chance is then known to 0.002 near 0.01."""
QUOTED = 2.0
"""So many quoted standard deviations hold what as many of a normal distribution do: 95.4 %."""
SERIAL_LAGS, SERIAL_POWER = 4.0, 2.0 / 9.0
"""Among N clusters in order up to 4 (N / 100)^(2/9) neighbours are looked at (Newey and West)."""
SERIAL_SIGMAS = 3.0
"""Neighbours agree where their products exceed those of an order by chance by so many standard deviations."""
LARGE_FREEDOM = 1e6
"""As good as infinite, which the F distribution does not take."""
RANK = 1e-12
"""Combinations with less than this part of the largest information are not determined."""


@dataclass(frozen=True, eq=False, slots=True)
class Clustered:
    """Covariance (n, n) of shared unknowns; `overdispersion`, by how much more (as a ratio of standard deviations) the
    clusters disagree than independent corners would, at least 1; `freedom`, the degrees of freedom of the covariance
    (infinite where it rests on the scatter of corners, with too few clusters to know better)."""

    covariance: FloatArray
    overdispersion: float
    freedom: float


def effective_freedom(
    freedom: float, overdispersion: float, directions: int, common_freedom: float = float("inf")
) -> float:
    """Return the degrees of freedom of the variance in one of so many directions (Satterthwaite).

    What corners scatter is known from all directions of all images. What images disagree beyond that is known as well
    as `freedom` of them tell; where it is one number for all directions, as well as directions agree on it
    (`common_freedom`).
    """
    beyond = max(0.0, 1.0 - 1.0 / overdispersion**2) if overdispersion > 0.0 else 0.0
    variance_of_ratio = beyond**2 * (1.0 / freedom + 1.0 / common_freedom)
    variance_of_ratio += (1.0 - beyond) ** 2 / (freedom * directions)
    return min(1.0 / max(variance_of_ratio, 1.0 / LARGE_FREEDOM), LARGE_FREEDOM)


def widening(freedom: float) -> float:
    """Return by how much standard deviations with so many `effective_freedom` are widened when they are quoted: two
    then hold what two of a normal distribution do, and one more than 68 %: 80 with three of them, 72 with ten."""
    # Imported here: a camera is read, and used, without it.
    from scipy.special import ndtr, stdtrit

    return float(stdtrit(freedom, ndtr(QUOTED))) / QUOTED if freedom < LARGE_FREEDOM else 1.0


def reduced_by_cluster(
    products: FloatArray, count: int, cluster: IntArray, inverses: FloatArray | None = None
) -> tuple[FloatArray, FloatArray]:
    """Return information (N, P, P) and score (N, P) of every cluster of views after their poses are eliminated.

    `products` (V, P + 7, P + 7) are those of `view_products`, `count` is P, `cluster` (V,) numbers the clusters,
    `inverses` (V, 6, 6) are those of the poses' blocks, where they are known.
    """
    coupling, pose = products[:, :count, count : count + 6], products[:, count : count + 6, count : count + 6]
    back = coupling @ (pose_inverses(pose) if inverses is None else inverses)
    total = int(cluster.max()) + 1
    information, score = np.zeros((total, count, count)), np.zeros((total, count))
    np.add.at(information, cluster, products[:, :count, :count] - back @ np.swapaxes(coupling, -1, -2))
    own = products[:, :count, -1] - (back @ products[:, count : count + 6, -1:])[..., 0]
    np.add.at(score, cluster, own)
    return information, score


def clustered_covariance(
    unit: FloatArray,
    information: FloatArray,
    score: FloatArray,
    prior: FloatArray,
    sigma_px: float,
    *,
    in_order: bool = False,
) -> Clustered:
    """Return the covariance of n shared unknowns from N clusters.

    Parameters
    ----------
    unit : (n, n) their covariance for independent corners of unit variance, all other unknowns free.
    information, score : (N, n, n) and (N, n), of each cluster, its poses eliminated, released corners held: they are
        many, mostly their priors hold them, and what they add to `unit` is scaled as a whole.
    prior : (n, n) information of the priors.
    sigma_px : standard deviation of a corner, from all residuals.
    in_order : whether the clusters follow each other in time, so that neighbours may err alike.
    """
    if len(score) < MIN_CLUSTERS or not sigma_px > 0.0:
        return Clustered(unit * sigma_px**2, 1.0, float("inf"))
    data = information.sum(axis=0)
    # Scaled to a unit diagonal: parameters differ by many powers of ten.
    scale = 1.0 / np.sqrt(np.maximum(np.diag(data + prior), np.finfo(float).tiny))
    values, vectors = np.linalg.eigh((data + prior) * scale[:, None] * scale)
    known = values > RANK * values[-1]
    root = scale[:, None] * vectors[:, known] / np.sqrt(values[known])
    leverage = root.T @ information @ root
    pull = _without_leverage(leverage, score @ root / sigma_px)
    expected = root.T @ data @ root
    # Images of much leverage count for several.
    share = np.einsum("vii->v", leverage)
    freedom = max(float(share.sum() ** 2 / (share**2).sum()) - 1.0, 1.0)
    moments, alike = _serial_moments(pull) if in_order else (pull.T @ pull, 1.0)
    freedom = max((freedom + 1.0) / alike - 1.0, 1.0)
    found = _shrunk(moments, expected, freedom)
    factor = float(np.trace(found) / np.trace(expected))
    found, factor = found + max(0.0, 1.0 - factor) * expected, max(1.0, factor)
    covariance = root @ (found + np.eye(len(found)) - expected) @ root.T
    covariance += factor * (unit - root @ root.T)
    covariance *= sigma_px**2
    return Clustered(0.5 * (covariance + covariance.T), float(np.sqrt(factor)), freedom)


def _without_leverage(leverage: FloatArray, pull: FloatArray) -> FloatArray:
    """Return (I - M)^-1/2 z (N, n) of clusters with leverages M (N, n, n) and z (N, n)."""
    out, size = np.empty_like(pull), np.sqrt((leverage * leverage).sum(axis=(1, 2)))
    # Frobenius' norm bounds the eigenvalues of M. Where it is well below one, powers of M take less than all of those.
    small = size < MAX_FOR_SERIES
    if small.any():
        bound = max(float(size[small].max()), RANK)
        fall = (1.0 - np.sqrt(1.0 - bound)) / (1.0 + np.sqrt(1.0 - bound))
        count = max(1, int(np.log(SERIES_LEFT_OUT) / np.log(fall)))
        # Interpolated at the zeros of the first polynomial left out.
        angle = np.pi * (np.arange(count + 1) + 0.5) / (count + 1)
        values = 1.0 / np.sqrt(1.0 - 0.5 * bound * (1.0 + np.cos(angle)))
        series = 2.0 / len(angle) * np.cos(np.outer(np.arange(count + 1), angle)) @ values
        series[0] *= 0.5
        out[small] = chebyshev_series(leverage[small], pull[small], bound, series)
    if not small.all():
        left, axes = np.linalg.eigh(np.eye(pull.shape[1]) - leverage[~small])
        along = np.swapaxes(axes, -1, -2) @ pull[~small, :, None]
        out[~small] = (axes @ (along / np.sqrt(np.maximum(left, MIN_LEFT))[..., None]))[..., 0]
    return out


def _serial_moments(pull: FloatArray) -> tuple[FloatArray, float]:
    """Return the second moments of the sum of pulls z (N, n) in order, and by how much more that is than the sum of
    theirs: 1 unless neighbours agree by more than chance.

    A board that moves before cameras without a common trigger moves the same way for a while, and the frames then err
    alike. Newey and West's weights, which fall with the distance, leave no negative variance.
    """
    count, own = len(pull), pull.T @ pull
    lags = min(int(SERIAL_LAGS * (count / 100.0) ** SERIAL_POWER), count - 2)
    if lags < 1:
        return own, 1.0
    weights = 1.0 - np.arange(1, lags + 1) / (lags + 1.0)
    products = sum(w * (pull[:-k].T @ pull[k:]) for k, w in enumerate(weights, 1))
    # Of an order by chance: the pairs z_i . z_j are any of all.
    squares = (pull**2).sum(axis=1)
    pairs = count * (count - 1.0)
    mean = (float((pull.sum(axis=0) ** 2).sum()) - float(squares.sum())) / pairs
    variance = (float((own**2).sum()) - float((squares**2).sum())) / pairs - mean**2
    number = count - np.arange(1, lags + 1)
    sigma = np.sqrt(max(variance, 0.0) * float((weights**2 * number).sum()))
    if float(np.trace(products)) - mean * float((weights * number).sum()) <= SERIAL_SIGMAS * sigma:
        return own, 1.0
    moments = own + products + products.T
    return moments, float(np.trace(moments) / np.trace(own))


def _shrunk(moments: FloatArray, expected: FloatArray, freedom: float) -> FloatArray:
    """Return the second moments shrunk towards a multiple of those expected."""
    count = len(moments)
    size = float(np.trace(moments))
    squared = float((moments**2).sum())
    # Chen et al., eq. 23.
    above = (1.0 - 2.0 / count) * squared + size**2
    below = (freedom + 1.0 - 2.0 / count) * (squared - size**2 / count)
    shrinkage = min(1.0, above / below) if below > 0.0 else 1.0
    return (1.0 - shrinkage) * moments + shrinkage * size / float(np.trace(expected)) * expected


def with_block(covariance: FloatArray, block: FloatArray, factor: float) -> FloatArray:
    """Return a covariance (N, N) in which the first n unknowns have the covariance `block` (n, n): the others follow
    them as before, and what is their own is multiplied by `factor`."""
    n = len(block)
    before = covariance[:n, :n]
    follow = covariance[n:, :n] @ scaled_pinv(before, RANK)
    out = np.empty_like(covariance)
    out[:n, :n] = block
    out[n:, :n] = follow @ block
    out[:n, n:] = out[n:, :n].T
    own = covariance[n:, n:] - follow @ before @ follow.T
    out[n:, n:] = factor * own + follow @ block @ follow.T
    return np.asarray(0.5 * (out + out.T))


def drawn_errors(covariance: FloatArray, freedom: float, rng: np.random.Generator) -> FloatArray:
    """Return errors (n, NULL_DRAWS) of `covariance` (n, n): Student's t with the degrees of freedom that it has."""
    # Scaled to correlations first: parameters differ by twenty orders of magnitude.
    sigma = np.sqrt(np.diag(covariance))
    safe = np.where(sigma > 0.0, sigma, 1.0)
    values, vectors = np.linalg.eigh(covariance / np.outer(safe, safe))
    root = safe[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))
    drawn = root @ rng.normal(size=(len(sigma), NULL_DRAWS))
    if np.isfinite(freedom):
        drawn /= np.sqrt(rng.chisquare(freedom, NULL_DRAWS) / freedom)
    return np.asarray(drawn)
