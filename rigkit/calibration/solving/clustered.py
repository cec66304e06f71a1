"""Cluster-robust covariances: images are the independent units, not corners.

Residuals of one view are correlated (lens or board deviate from their model, blur, light, a board that bends), so 50 to
300 corners count like a few. Let H_v and s_v be the information and score of the shared unknowns from image v, with its
poses eliminated, and K = (sum H_v + prior)^-1. The sandwich estimate

    K (sum_v s_v s_v^T) K

is valid for any correlation within an image. M_v = K^1/2 H_v K^1/2 is the leverage of an image: as the solution was
fitted to it, its score z_v = K^1/2 s_v is too small. The corrected (I - M_v)^-1/2 z_v has the expected second moments
if corners are independent ("CR2").

A few dozen images determine the trace of the second moments, but hardly their shape in ten or twenty dimensions. They
are shrunk towards a multiple of the expectation for independent corners, as far as their own noise requires ("oracle
approximating shrinkage"): with few images a single factor scales the covariance of independent corners, with many each
direction has its own. A common error within an image can only add variance: a factor below one is chance, and replaced
by one, as Birge's ratio for measurements that agree too well.

The estimate has as many degrees of freedom as images less one, or fewer where the leverages differ; quantiles are
Student's. Tests and bounds use the covariance with these degrees of freedom; quoted standard deviations are widened
(`widening`), so that two of them contain 95 % of the errors for four images as well as for forty.

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
from rigkit.core.arrays import FloatArray, IntArray, root_diagonal, scaled_pinv
from rigkit.kernels.linearise import chebyshev_series

MIN_CLUSTERS = 2
"""One image (or frame) gives no scatter between images."""
MIN_LEFT = 0.05
"""Smallest 1 - leverage, of a direction that one image alone determines: less is rounding."""
MAX_FOR_SERIES, SERIES_LEFT_OUT = 0.8, 1e-13
"""Up to this leverage x, (1 - x)^-1/2 is approximated by a series of Chebyshev polynomials. Its coefficients decrease
by a factor of (1 - sqrt(1 - x)) / (1 + sqrt(1 - x)) each, to about the second number."""
NULL_DRAWS = 4000
"""Draws of a null distribution: the standard error of a p-value near 0.01 is then 0.002."""
QUOTED = 2.0
"""Number of quoted standard deviations that contain the same probability as for a normal distribution: 95.4 %."""
SERIAL_LAGS, SERIAL_POWER = 4.0, 2.0 / 9.0
"""Autocorrelations of N clusters in order are used up to the lag 4 (N / 100)^(2/9) (Newey and West)."""
SERIAL_SIGMAS = 3.0
"""Standard deviations of a random order by which the autocorrelation must exceed its mean to be used."""
LARGE_FREEDOM = 1e6
"""Stands for infinity, which the F distribution does not accept."""
RANK = 1e-12
"""Relative eigenvalue of the information up to which a combination is undetermined."""


@dataclass(frozen=True, eq=False, slots=True)
class Clustered:
    """A cluster-robust covariance.

    Attributes
    ----------
    covariance : (n, n) of the shared unknowns.
    overdispersion : scatter between clusters over that expected from independent corners, as a ratio of standard
        deviations, at least 1.
    freedom : degrees of freedom of the covariance; infinite with too few clusters, where it is that of independent
        corners.
    """

    covariance: FloatArray
    overdispersion: float
    freedom: float


def effective_freedom(
    freedom: float, overdispersion: float, directions: int, common_freedom: float = float("inf")
) -> float:
    """Return the degrees of freedom of the variance in one of so many directions (Satterthwaite).

    The variance expected from independent corners is known from all directions of all images. The excess between images
    has `freedom` degrees of freedom; a further factor common to all directions has `common_freedom`.
    """
    beyond = max(0.0, 1.0 - 1.0 / overdispersion**2) if overdispersion > 0.0 else 0.0
    variance_of_ratio = beyond**2 * (1.0 / freedom + 1.0 / common_freedom)
    variance_of_ratio += (1.0 - beyond) ** 2 / (freedom * directions)
    return min(1.0 / max(variance_of_ratio, 1.0 / LARGE_FREEDOM), LARGE_FREEDOM)


def widening(freedom: float, sigmas: float = QUOTED) -> float:
    """Return the factor on quoted standard deviations with `effective_freedom` degrees of freedom.

    Two of them, or so many `sigmas`, then contain the probability of as many of a normal distribution; one of them
    contains more than 68 %: 80 % with three degrees of freedom, 72 % with ten.
    """
    # Imported here: reading and using a camera does not need scipy.
    from scipy.special import ndtr, stdtrit

    return -float(stdtrit(freedom, ndtr(-sigmas))) / sigmas if freedom < LARGE_FREEDOM else 1.0


def reduced_by_cluster(
    products: FloatArray, count: int, cluster: IntArray, inverses: FloatArray | None = None
) -> tuple[FloatArray, FloatArray]:
    """Return information (N, P, P) and score (N, P) of every cluster of views, with the poses eliminated.

    `products` (V, K, K) are those of `view_products`, of which the first `count` P unknowns are chosen and all others
    but the poses held; `cluster` (V,) is the cluster of each view, `inverses` (V, 6, 6) those of the poses' blocks, if
    known.
    """
    coupling, pose = products[:, :count, -7:-1], products[:, -7:-1, -7:-1]
    back = coupling @ (pose_inverses(pose) if inverses is None else inverses)
    information = products[:, :count, :count] - back @ np.swapaxes(coupling, -1, -2)
    score = products[:, :count, -1] - (back @ products[:, -7:-1, -1:])[..., 0]
    return summed_by(cluster, information), summed_by(cluster, score)


def summed_by(group: IntArray, values: FloatArray) -> FloatArray:
    """Return the sums (N, ...) of the values (V, ...) of each `group` (V,). np.add.at takes several times as long."""
    count = int(group.max(initial=-1)) + 1
    if count == len(group) and (group[1:] > group[:-1]).all():
        return values
    order = np.argsort(group, kind="stable")
    shown, first, size = np.unique(group[order], return_index=True, return_counts=True)
    out = values[order[first]]
    if len(shown) < count:
        out, some = np.zeros((count, *values.shape[1:])), out
        out[shown] = some
    # The second value of every group, the third one ...: none of these sets has a group twice.
    for k in range(1, int(size.max(initial=0))):
        one = order[first[size > k] + k]
        out[group[one]] += values[one]
    return out


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
    information, score : (N, n, n) and (N, n), of each cluster, with its poses eliminated and released corners held.
        Released corners are many and mostly determined by their priors; what they add to `unit` is scaled as a whole.
    prior : (n, n) information of the priors.
    sigma_px : standard deviation of a corner, from all residuals.
    in_order : whether the clusters are in order of time, so that errors of neighbours may be correlated.
    """
    if len(score) < MIN_CLUSTERS or not sigma_px > 0.0:
        return Clustered(unit * sigma_px**2, 1.0, float("inf"))
    data = information.sum(axis=0)
    root = root_of_inverse(data + prior)
    leverage = root.T @ information @ root
    pull = without_leverage(leverage, score @ root / sigma_px)
    expected = root.T @ data @ root
    # Images of high leverage count for several.
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


def root_of_inverse(information: FloatArray, rank: float = RANK) -> FloatArray:
    """Return R (n, r) with R R^T the inverse of an information (n, n) of rank r, in the directions that it has: those
    with eigenvalues above `rank` times the largest."""
    # Scaled to a unit diagonal: parameters differ by many powers of ten.
    scale = 1.0 / root_diagonal(information)
    values, vectors = np.linalg.eigh(information * scale[:, None] * scale)
    known = values > rank * values[-1]
    return np.asarray(scale[:, None] * vectors[:, known] / np.sqrt(values[known]))


def products_between(root: FloatArray, information: FloatArray, score: FloatArray) -> FloatArray:
    """Return the sums (K, K) over N clusters of products of K scores with unit information, z = R^T s, corrected for
    the clusters' leverages.

    `root` R (n, r) is that of the inverse of all information, `information` (N, n, n) that of each cluster, and `score`
    (N, n, K) its scores: of residuals, and of displacements that they may contain.
    """
    leverage, pull = root.T @ information @ root, np.swapaxes(score, 1, 2) @ root
    turned, small = np.swapaxes(pull, 1, 2).copy(), _frobenius(leverage) < MAX_FOR_SERIES
    turned[small] = np.linalg.solve(np.eye(root.shape[1]) - leverage[small], turned[small])
    if not small.all():
        left, axes = _left(leverage[~small])
        turned[~small] = axes @ (np.swapaxes(axes, -1, -2) @ turned[~small] / left[..., None])
    return np.tensordot(pull, turned, axes=((0, 2), (0, 1)))


def square_of_rest(products: FloatArray, second: FloatArray, mean: FloatArray) -> float:
    """Return the expected square of residuals less displacements, from the `products` (J + 1, J + 1) of J displacements
    and residuals, and the moments of the displacements' amounts: of second order (J, J), and means (J,)."""
    return float(products[-1, -1] - 2.0 * mean @ products[:-1, -1] + np.sum(products[:-1, :-1] * second))


def _frobenius(leverage: FloatArray) -> FloatArray:
    """Return the Frobenius norms (N,) of leverages M (N, n, n), which bound their eigenvalues."""
    return np.asarray(np.sqrt((leverage * leverage).sum(axis=(1, 2))))


def _left(leverage: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the eigenvalues (N, n) of I - M, at least MIN_LEFT, and its eigenvectors (N, n, n)."""
    left, axes = np.linalg.eigh(np.eye(leverage.shape[-1]) - leverage)
    return np.maximum(left, MIN_LEFT), axes


def without_leverage(leverage: FloatArray, pull: FloatArray) -> FloatArray:
    """Return (I - M)^-1/2 z (N, n) of clusters with leverages M (N, n, n) and scores z (N, n)."""
    out, size = np.empty_like(pull), _frobenius(leverage)
    # Where it is well below one, a series is faster than all eigenvalues.
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
        out[small] = chebyshev_series(leverage[small], pull[small, None], bound, series)[:, 0]
    if not small.all():
        left, axes = _left(leverage[~small])
        along = pull[~small, None] @ axes / np.sqrt(left)[:, None]
        out[~small] = (along @ np.swapaxes(axes, -1, -2))[:, 0]
    return out


def _serial_moments(pull: FloatArray) -> tuple[FloatArray, float]:
    """Return the second moments of the sum of scores z (N, n) in order, and their trace over that without
    autocorrelation: 1 unless the autocorrelation is significant.

    A board that moves in front of cameras without a common trigger keeps its direction for a while, so that errors of
    successive frames are alike. The weights of Newey and West, which decrease with the lag, keep variances positive.
    """
    count, own = len(pull), pull.T @ pull
    lags = min(int(SERIAL_LAGS * (count / 100.0) ** SERIAL_POWER), count - 2)
    if lags < 1:
        return own, 1.0
    weights = 1.0 - np.arange(1, lags + 1) / (lags + 1.0)
    products = sum(w * (pull[:-k].T @ pull[k:]) for k, w in enumerate(weights, 1))
    # In a random order the pairs z_i . z_j are drawn from all pairs.
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
    """Return the second moments shrunk towards a multiple of the expected ones."""
    count = len(moments)
    size = float(np.trace(moments))
    squared = float((moments**2).sum())
    # Chen et al., eq. 23.
    above = (1.0 - 2.0 / count) * squared + size**2
    below = (freedom + 1.0 - 2.0 / count) * (squared - size**2 / count)
    shrinkage = min(1.0, above / below) if below > 0.0 else 1.0
    return (1.0 - shrinkage) * moments + shrinkage * size / float(np.trace(expected)) * expected


def with_block(covariance: FloatArray, block: FloatArray, factor: float) -> FloatArray:
    """Return a covariance (N, N) in which the first n unknowns have the covariance `block` (n, n). The regression of
    the others on them is kept, and their conditional covariance multiplied by `factor`."""
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
    """Return errors (n, NULL_DRAWS) drawn from Student's t with `covariance` (n, n) and `freedom`."""
    # Scaled to correlations first: parameters differ by twenty orders of magnitude.
    sigma = np.sqrt(np.diag(covariance))
    safe = np.where(sigma > 0.0, sigma, 1.0)
    values, vectors = np.linalg.eigh(covariance / np.outer(safe, safe))
    root = safe[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))
    drawn = root @ rng.normal(size=(len(sigma), NULL_DRAWS))
    if np.isfinite(freedom):
        drawn /= np.sqrt(rng.chisquare(freedom, NULL_DRAWS) / freedom)
    return np.asarray(drawn)
