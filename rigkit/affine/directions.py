"""Directions along a board's rows, columns and diagonals at every corner, with exact lengths, in pixels.

A direction is the derivative of the pixel by the grid index (px per square). It is estimated in the plane tangent to
the unit sphere at the corner's ray, where images of straight lines are straight and whose coordinates agree with the
pixels to first order. This works for raw pixels of any central camera, at any angle to the axis.

Reference: Hajder, Affine Correspondences in Stereo Vision, directions of a chessboard. Chord lengths to the neighbours
have first-order errors under perspective; harmonic means, or a projective fit, are exact.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rigkit.cameras.base import Camera
from rigkit.core.arrays import TINY, BoolArray, FloatArray, IntArray
from rigkit.core.choices import SUPPORTS, Support
from rigkit.core.detections import BoardDetection
from rigkit.core.errors import InputError
from rigkit.core.patterns.base import Pattern

MIN_COSINE = 0.2
"""Corners whose rays are more than 78 degrees from that of a corner are not used for its directions."""
MIN_PIVOT = 1e-7
"""Smallest pivot of a local fit over the largest that is not singular."""
PROJECTIVE_STEPS = 4


@dataclass(frozen=True, eq=False, slots=True)
class DirectionField:
    """Directions at the N corners of one detection, in its order.

    Attributes
    ----------
    vectors : (N, 3, 2) px per square: horizontal (along a row, towards higher columns), vertical (towards higher rows)
        and diagonal (their sum); NaN where unknown.
    valid : (N, 3) bool
    covariance : (N, 3, 2, 2) px^2, from the corners' `sigma_px`.
    shared : (N, 2, 2) px^2, covariance of the horizontal (rows) with the vertical (columns).
    """

    vectors: FloatArray
    valid: BoolArray
    covariance: FloatArray
    shared: FloatArray


def direction_field(
    detection: BoardDetection,
    view: Camera,
    *,
    support: Support = "patch",
    window: int | None = 2,
    pattern: Pattern | None = None,
) -> DirectionField:
    """Return the directions at every corner of one detection.

    Raises InputError: unknown support, a window below 1, or any other support than "patch" for a pattern whose points
    are not one square apart.

    Parameters
    ----------
    pattern : of the board; None: corners are one square apart, as on chessboards.
    support : what a direction is estimated from.
        "chord": the chord to the next corner, at the far border from the previous one (the paper's directions): the
        angle is exact, the length is not.
        "neighbours": the chord through the two neighbours, its length their harmonic mean; at a border the next two
        corners. Lengths are exact.
        "line": a projective fit x(s) = (p + s v) / (1 + g s) to the nearest 2 `window` + 1 corners of the line.
        "patch": a homography through the nearest (2 `window` + 1)^2 corners. More corners reduce noise, but the
        result depends more on the flatness of the board and on the calibration.
    window : half width in squares; None: the whole line or board. Ignored by "chord" and "neighbours".

    Notes
    -----
    Corners are weighted by their `sigma_px`, propagated to the tangent plane.

    The default, a patch of 5 x 5, follows from rms angle errors on 8x6 boards (degrees, SIMULATED) for "neighbours" and
    "patch" with window 1, 2, 3 and None. Corner noise 0.05 px: regular lens .054 .028 .010 .006 .005, fisheye .101 .053
    .020 .012 .012. A board of 350 mm bent by 0.5 mm, no noise: .021 .022 .049 .082 .099.
    """
    if window is not None and window < 1:
        raise InputError(f"directions: the window must be at least 1 square, got {window}")
    uneven = pattern is not None and not pattern.even_steps
    if uneven and support in ("chord", "neighbours", "line"):
        raise InputError(
            f"directions: the points of this board are not one square apart along straight rows and columns, as "
            f"support '{support}' takes them to be; use 'patch'"
        )
    tangent = _Tangent.build(detection, view)
    if support == "chord":
        return _next_chords(tangent, detection)
    if support == "neighbours":
        return _along_both(*(_chords(tangent, detection, axis) for axis in (0, 1)))
    if support == "line":
        fits = [_line_fit(tangent, detection, axis, window) for axis in (0, 1)]
        return _along_both(*fits)
    if support == "patch":
        places = detection.grid.astype(np.float64)
        return _patch_fit(tangent, detection, places if pattern is None else pattern.positions(places), window)
    raise InputError(f"directions: support '{support}' is unknown; known: {', '.join(SUPPORTS)}")


@dataclass(frozen=True, eq=False, slots=True)
class _Tangent:
    """Rays, their derivatives and the pixel-scaled tangent bases (pseudo-inverse of d ray / d pixel) of N corners."""

    rays: FloatArray
    jacobians: FloatArray
    bases: FloatArray
    sigma_px: FloatArray
    seen: BoolArray

    @classmethod
    def build(cls, detection: BoardDetection, view: Camera) -> _Tangent:
        rays, seen = view.unproject(detection.pixels)
        jacobians = np.where(seen[:, None, None], view.ray_jacobian(detection.pixels), np.nan)
        metric = np.swapaxes(jacobians, 1, 2) @ jacobians
        determinant = metric[:, 0, 0] * metric[:, 1, 1] - metric[:, 0, 1] ** 2
        swapped = np.stack([metric[:, 1, 1], -metric[:, 0, 1], -metric[:, 1, 0], metric[:, 0, 0]], axis=-1)
        inverse = swapped.reshape(-1, 2, 2) / determinant[:, None, None]
        return cls(rays, jacobians, inverse @ np.swapaxes(jacobians, 1, 2), detection.sigma_px, seen)

    def positions(self, index: IntArray) -> tuple[FloatArray, BoolArray, FloatArray]:
        """Return the coordinates (N, M, 2), px, of corners `index` (N, M) in the tangent planes of the N corners.

        Also returns which are usable (N, M), and the cosines between the rays (N, M; NaN where not). Index -1 is none.
        """
        rays = self.rays[index]
        cosine = np.einsum("ni,nmi->nm", self.rays, rays)
        usable = (index >= 0) & (cosine > MIN_COSINE)
        cosine = np.where(usable, cosine, np.nan)
        return np.einsum("nij,nmj->nmi", self.bases, rays) / cosine[..., None], usable, cosine

    def whitening(self, index: IntArray, positions: FloatArray, cosine: FloatArray) -> FloatArray:
        """Return matrices (N, M, 2, 2) that whiten errors in the tangent plane."""
        by_ray = (self.bases[:, None] - positions[..., None] * self.rays[:, None, None, :]) / cosine[..., None, None]
        by_pixel = by_ray @ self.jacobians[index]
        usable = _finite(by_pixel.reshape(*index.shape, 4))
        inverse = np.linalg.inv(np.where(usable[..., None, None], by_pixel, np.eye(2)))
        return np.asarray(np.where(usable[..., None, None], inverse / self.sigma_px[index][..., None, None], 0.0))


def _finite(array: FloatArray) -> BoolArray:
    """Return whether all of the last axis is finite."""
    return np.asarray(np.isfinite(array).all(axis=-1), dtype=bool)


def _index_map(detection: BoardDetection) -> IntArray:
    """Return (rows, columns) indices into the detection, -1 where no corner was found."""
    out = np.full((detection.rows, detection.columns), -1)
    out[detection.grid[:, 1], detection.grid[:, 0]] = np.arange(len(detection.grid))
    return out


def _span(position: IntArray, count: int, window: int | None) -> IntArray:
    """Return the indices (N, M) of the window nearest to each position that stays within 0..count-1."""
    half = count if window is None else window
    width = min(2 * half + 1, count)
    start = np.clip(position - half, 0, count - width)
    return np.asarray(start[:, None] + np.arange(width))


def _along_both(horizontal: tuple[FloatArray, FloatArray], vertical: tuple[FloatArray, FloatArray]) -> DirectionField:
    """Return two directions and their sum, whose covariance neglects the correlation due to the common corner."""
    vectors = np.stack([horizontal[0], vertical[0], horizontal[0] + vertical[0]], axis=1)
    covariance = np.stack([horizontal[1], vertical[1], horizontal[1] + vertical[1]], axis=1)
    return DirectionField(vectors, _finite(vectors), covariance, np.zeros((len(vectors), 2, 2)))


def _next_chords(tangent: _Tangent, detection: BoardDetection) -> DirectionField:
    """Return the chords to the next corner along row, column and diagonal, at the far border from the previous one.

    Corners without a diagonal neighbour get the sum of their exact horizontal and vertical derivatives.
    """
    padded = np.pad(_index_map(detection), 1, constant_values=-1)
    column, row = detection.grid[:, 0] + 1, detection.grid[:, 1] + 1
    own = tangent.sigma_px**2
    chords, variances, signs = [], [], []
    for right, down in ((1, 0), (0, 1), (1, 1)):
        index = np.stack([padded[row + step_sign * down, column + step_sign * right] for step_sign in (1, -1)], axis=1)
        position, usable, _ = tangent.positions(index)
        ahead = usable[:, 0]
        chords.append(np.where(ahead[:, None], position[:, 0], -position[:, 1]))
        other = np.where(ahead, index[:, 0], index[:, 1])
        variances.append(np.where(usable.any(axis=1), tangent.sigma_px[other] ** 2 + own, np.nan))
        signs.append(np.where(ahead, 1.0, -1.0))
    lone = ~_finite(chords[2])
    exact = [_chords(tangent, detection, axis) for axis in (0, 1)]
    chords[2] = np.where(lone[:, None], exact[0][0] + exact[1][0], chords[2])
    variances[2] = np.where(lone, sum(0.5 * np.trace(c, axis1=1, axis2=2) for _, c in exact), variances[2])
    vectors, eye = np.stack(chords, axis=1), np.eye(2)
    shared = (signs[0] * signs[1] * own)[:, None, None] * eye
    return DirectionField(vectors, _finite(vectors), np.stack(variances, axis=1)[..., None, None] * eye, shared)


def _chords(tangent: _Tangent, detection: BoardDetection, axis: int) -> tuple[FloatArray, FloatArray]:
    """Return vectors (N, 2) and covariances along one grid axis by harmonic means of chords.

    Notes
    -----
    On a line x(s) = a s / (1 + c s): a = 2 l+ l- / (l+ + l-) from the neighbours at either side, and
    a = l1 l2 / (2 (l2 - l1)) from the next two corners at one side.
    """
    padded = np.pad(_index_map(detection), 2, constant_values=-1)
    column, row = detection.grid[:, 0] + 2, detection.grid[:, 1] + 2
    steps = (-2, -1, 1, 2)
    index = np.stack([padded[row + s * axis, column + s * (1 - axis)] for s in steps], axis=1)
    position, usable, _ = tangent.positions(index)
    length = np.linalg.norm(position, axis=-1)
    variance = np.where(usable, tangent.sigma_px[index] ** 2, np.nan)
    own = tangent.sigma_px**2

    chord = position[:, 2] - position[:, 1]
    before, after = length[:, 1], length[:, 2]
    size = 2.0 * before * after / (before + after)
    d_after, d_before = 2.0 * (before / (before + after)) ** 2, 2.0 * (after / (before + after)) ** 2
    along = d_after**2 * variance[:, 2] + d_before**2 * variance[:, 1] + (d_after - d_before) ** 2 * own
    across = (variance[:, 1] + variance[:, 2]) * (size / np.linalg.norm(chord, axis=-1)) ** 2
    vector, covariance = _oriented(chord, size, along, across)
    for first, second, sign in ((2, 3, 1.0), (1, 0, -1.0)):
        l1, l2 = length[:, first], length[:, second]
        size = l1 * l2 / (2.0 * (l2 - l1))
        d1, d2 = 0.5 * (l2 / (l2 - l1)) ** 2, -0.5 * (l1 / (l2 - l1)) ** 2
        along = d1**2 * variance[:, first] + d2**2 * variance[:, second] + (d1 + d2) ** 2 * own
        across = (variance[:, second] + own) * (size / l2) ** 2
        border = _oriented(sign * position[:, second], size, along, across)
        lacking = ~_finite(vector) & (l2 > l1)
        vector = np.where(lacking[:, None], border[0], vector)
        covariance = np.where(lacking[:, None, None], border[1], covariance)
    return vector, covariance


def _oriented(
    direction: FloatArray, size: FloatArray, along: FloatArray, across: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return vectors of length `size` along `direction`, with covariances from the variances along and across."""
    e = direction / np.linalg.norm(direction, axis=-1, keepdims=True)
    outer = e[:, :, None] * e[:, None, :]
    covariance = along[:, None, None] * outer + across[:, None, None] * (np.eye(2) - outer)
    return e * size[:, None], covariance


def _line_fit(
    tangent: _Tangent, detection: BoardDetection, axis: int, window: int | None
) -> tuple[FloatArray, FloatArray]:
    """Return vectors (N, 2) and covariances along one grid axis by a projective fit to the corners of its line."""
    lattice = _index_map(detection)
    own, across = detection.grid[:, axis], detection.grid[:, 1 - axis]
    span = _span(own, lattice.shape[1 - axis], window)
    index = lattice[across[:, None], span] if axis == 0 else lattice[span, across[:, None]]
    steps = (span - own[:, None]).astype(np.float64)[..., None]
    vectors, covariance = _projective_fit(tangent, index, steps)
    return vectors[:, 0], covariance[:, 0, :, 0, :]


def _patch_fit(tangent: _Tangent, detection: BoardDetection, places: FloatArray, window: int | None) -> DirectionField:
    """Return all three directions by homographies through the corners around each corner; `places` (N, 2) are the
    corners' positions on the board in squares."""
    lattice = _index_map(detection)
    columns = _span(detection.grid[:, 0], detection.columns, window)
    rows = _span(detection.grid[:, 1], detection.rows, window)
    n = len(columns)
    index = lattice[rows[:, :, None], columns[:, None, :]].reshape(n, -1)
    # Index -1 (not found) takes an arbitrary place; `positions` marks it as not usable.
    vectors, covariance = _projective_fit(tangent, index, places[index] - places[:, None])
    joint = np.array([[1.0, 0.0], [0.0, 1.0], [1.0, 1.0]])
    all_vectors = joint @ vectors
    all_covariance = np.einsum("ka,naibj,kb->nkij", joint, covariance, joint)
    return DirectionField(all_vectors, _finite(all_vectors), all_covariance, covariance[:, 0, :, 1])


def _projective_fit(tangent: _Tangent, index: IntArray, steps: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Fit y(s) = (c + V s) / (1 + g.s) to corners `index` (N, M) at grid offsets `steps` (N, M, D), D = 1 or 2.

    Returns dy/ds at s = 0, (N, D, 2), and its covariance (N, D, 2, D, 2); NaN where the corners do not determine it.

    Notes
    -----
    Gauss-Newton from the linear start: with w = 1 + g.s and the fitted y, the rows are
    [s/w, 1/w, -y s/w] (V, c, g) = y_measured - y + y/w, whitened by each corner's covariance in this tangent plane.
    No damping is needed: the start, a fit without perspective, is good to a few per cent, and the rows are nearly
    linear in (V, c, g). Fits that diverge have w <= 0 and are rejected.
    """
    n, m, d = steps.shape
    measured, usable, cosine = tangent.positions(index)
    whitening = tangent.whitening(index, measured, cosine)
    scale = np.sqrt(np.nanmean(np.where(usable, (measured**2).sum(axis=-1), np.nan), axis=1))[:, None, None]
    scale = np.where(scale > 0.0, scale, 1.0)
    measured = np.where(usable[..., None], measured, 0.0) / scale
    steps = np.where(usable[..., None], steps, 0.0)
    whitening = np.where(usable[..., None, None], whitening, 0.0) * scale[..., None]

    fitted, w = measured, np.ones((n, m, 1))
    theta = np.zeros((n, 3 * d + 2))
    for _ in range(PROJECTIVE_STEPS):
        rows = np.zeros((n, m, 2, 3 * d + 2))
        for k in range(2):
            rows[:, :, k, k * d : (k + 1) * d] = steps / w
            rows[:, :, k, 2 * d + k] = 1.0 / w[..., 0]
            rows[:, :, k, 2 * d + 2 :] = -fitted[..., k, None] * steps / w
        target = measured - fitted + fitted / w
        q, r = np.linalg.qr((whitening @ rows).reshape(n, 2 * m, -1))
        pivots = np.abs(np.einsum("nii->ni", r)) if r.shape[1] == r.shape[2] else np.zeros((n, 1))
        solvable = pivots.min(axis=1) > MIN_PIVOT * np.maximum(pivots.max(axis=1), TINY)
        if not solvable.any():
            break
        inverse = np.linalg.inv(np.where(solvable[:, None, None], r, np.eye(3 * d + 2)))
        right = np.swapaxes(q, 1, 2) @ (whitening @ target[..., None]).reshape(n, 2 * m, 1)
        theta = (inverse @ right)[..., 0]
        slopes, centre, g = np.split(theta, [2 * d, 2 * d + 2], axis=1)
        w = 1.0 + (steps @ g[..., None])
        solvable &= (w > 0.0).all(axis=(1, 2))
        w = np.maximum(w, 1e-3)
        fitted = (steps @ np.swapaxes(slopes.reshape(n, 2, d), 1, 2) + centre[:, None]) / w
    if not solvable.any():
        return np.full((n, d, 2), np.nan), np.full((n, d, 2, d, 2), np.nan)
    slopes, centre, g = np.split(theta, [2 * d, 2 * d + 2], axis=1)
    vectors = np.swapaxes(slopes.reshape(n, 2, d), 1, 2) - g[:, :, None] * centre[:, None, :]
    by_theta = np.zeros((n, d, 2, 3 * d + 2))
    for a in range(d):
        for k in range(2):
            by_theta[:, a, k, k * d + a] = 1.0
            by_theta[:, a, k, 2 * d + k] = -g[:, a]
            by_theta[:, a, k, 2 * d + 2 + a] = -centre[:, k]
    half = (by_theta.reshape(n, 2 * d, -1) @ inverse) * scale
    covariance = (half @ np.swapaxes(half, 1, 2)).reshape(n, d, 2, d, 2)
    lost = ~solvable
    vectors[lost], covariance[lost] = np.nan, np.nan
    return vectors * scale, covariance
