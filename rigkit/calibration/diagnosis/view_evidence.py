"""Regression of each image's residuals on possible changes between images: focal length, shift, bend of the board ...

At first order, with each image's pose and everything common to all images eliminated. What the other images predict of
an image's residuals (`predicted_by_others`) is no change.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from rigkit.calibration.certainty.departures import rotation_derivatives
from rigkit.calibration.result import Calibration, ViewResult
from rigkit.core.arrays import FloatArray, IntArray, Points, root_diagonal

MIN_INFORMATIVE_CORNERS = 20
"""A view with fewer corners has too few degrees of freedom after its pose."""
MIN_INFORMATIVE_VIEWS = 6
CORNERS_AT_ONCE = 20_000
"""Corners whose rows are in memory at a time: 1.6 kB each, in `diagnosis.pupil` twice as much."""
MIN_OWN_PART = 1e-6
"""Part of a kind of change (its length) that pose and earlier kinds must not absorb."""
MIN_COMMON_PART = 1e-6
"""Relative eigenvalue up to which a direction common to all images is undetermined given a kind of change."""
MIN_SHARE_LEFT = 0.5
"""Part of the squares that must remain after fitting a bow common to all images."""
NO_CHANGE = "columns"
"""The control: no camera reads its image column by column, so what columns explain as well as rows may be an error of
the lens or board model."""
FIELD_DEGREE = 4
"""Of the polynomials in u and v that displace the image alike in all images: distortions of lenses are of degree 3, and
what models leave of windows, tilted lenses or sheared glass is as smooth."""
CHANGE_COLUMNS = {"bend": 3, "focus": 1, "shift": 2, "rows": 6, NO_CHANGE: 6}
"""Number of rows of each kind of change in `rows_of`, in their order before the residual; bends are common, too."""
COMMON = slice(6, -(sum(CHANGE_COLUMNS.values()) - CHANGE_COLUMNS["bend"] + 1))
"""Rows of `rows_of` that are common to all images: parameters and bends."""


@dataclass(frozen=True, slots=True)
class ViewChange:
    """How much of the residuals a kind of change between images explains.

    Attributes
    ----------
    ratio : F ratio, the variance explained for each degree of freedom over that of the rest; 1 by chance.
    share : part of the sum of squares explained beyond chance.
    left : part of the sum of squares left.
    criterion : Bayesian information criterion less that of no change.
    """

    ratio: float
    share: float
    left: float
    criterion: float

    @classmethod
    def of(cls, left: float, freedom: int, directions: int) -> ViewChange:
        """Return that of a kind with so many degrees of freedom `directions`, of residuals with `freedom`."""
        rest = left / (freedom - directions)
        squares = 1.0 - left
        criterion = freedom * np.log(left) + directions * np.log(freedom)
        return cls(squares / directions / rest, squares - directions * rest, left, float(criterion))


@dataclass(frozen=True, eq=False, kw_only=True)
class ViewEvidence:
    """Products of the rows of `rows_of` for V views, with poses eliminated.

    Attributes
    ----------
    clusters : (W,) `Calibration.clusters`.
    views : indices of the V views among all W.
    own, length : (V, K, K) products of the rows, and (V, K) lengths of the rows before eliminating poses.
    along : (V, K) products of the rows with the residuals, after fitting the common rows.
    gram, scale : (C, C) products of the common rows, scaled to a unit diagonal, and (C,) their scales.
    total, freedom : sum of squares of the residuals, and its degrees of freedom.
    """

    clusters: IntArray
    views: list[int]
    own: FloatArray
    length: FloatArray
    along: FloatArray
    gram: FloatArray
    scale: FloatArray
    total: float
    freedom: int

    def explained(self, rows: slice) -> tuple[float, int, FloatArray]:
        """Return the sum of squares that a kind of change explains jointly with the common rows, its degrees of
        freedom, and its amounts (V, n)."""
        # Orthonormal directions of the scaled rows, and the components of residual and common rows along each.
        size, common = self.length[:, rows], COMMON
        sizes, axes = np.linalg.eigh(self.own[:, rows, rows] / (size[:, :, None] * size[:, None]))
        known = sizes > MIN_OWN_PART**2
        back = np.swapaxes(axes * np.where(known, sizes, np.inf)[:, None] ** -0.5, -1, -2) / size[:, None]
        amount = (back @ self.along[:, rows, None])[..., 0]
        shared = back @ self.own[:, rows, common] / self.scale
        every = shared.reshape(-1, len(self.scale))
        left = self.gram - every.T @ every
        pull = self.along[:, common].sum(axis=0) / self.scale - amount.ravel() @ every
        values, vectors = np.linalg.eigh(left)
        followed = values > MIN_COMMON_PART
        turned = vectors[:, followed].T @ pull
        step = vectors[:, followed] @ (turned / values[followed])
        squares = float((amount**2).sum()) + float((turned**2 / values[followed]).sum())
        return squares, int(known.sum()), (np.swapaxes(back, -1, -2) @ (amount - shared @ step)[..., None])[..., 0]

    def again(self, calibration: Calibration) -> ViewEvidence | None:
        """Return the evidence of another solution for the same images."""
        return _evidence(calibration, self.clusters)

    @cached_property
    def changes(self) -> Mapping[str, ViewChange]:
        """What each kind of change explains; empty with too few degrees of freedom."""
        out: dict[str, ViewChange] = {}
        for kind, rows in columns_of(self.own.shape[1]).items():
            squares, directions, _ = self.explained(rows)
            if self.freedom <= 2 * directions or not self.total > squares:
                return {}
            out[kind] = ViewChange.of(1.0 - squares / self.total, self.freedom, directions)
        return out


def view_evidence(calibration: Calibration) -> ViewEvidence | None:
    """Return the evidence of the residuals; None with too few views. Of near-duplicate images only the first is
    used."""
    return _evidence(calibration, calibration.clusters)


def _evidence(calibration: Calibration, clusters: IntArray) -> ViewEvidence | None:
    informative = [
        k for k, view in enumerate(calibration.views) if np.count_nonzero(view.kept) >= MIN_INFORMATIVE_CORNERS
    ]
    images = [view.image for view in calibration.views]
    first = dict(zip(clusters[::-1].tolist(), images[::-1], strict=True))
    informative = [k for k in informative if images[k] == first[int(clusters[k])]]
    if len(informative) < MIN_INFORMATIVE_VIEWS:
        return None
    products = products_of([calibration.views[k] for k in informative], lambda views: rows_of(calibration, views))
    # A very wrong lens may not project, or have no derivatives for, some views: they are left out.
    finite = np.asarray(np.isfinite(products).all(axis=(1, 2)))
    if np.count_nonzero(finite) < MIN_INFORMATIVE_VIEWS:
        return None
    products = products[finite]
    count = np.array([np.count_nonzero(calibration.views[k].kept) for k in informative])
    length = root_diagonal(products)
    own = without_pose(products, length)
    residual = -1
    gram, score = own[:, COMMON, COMMON].sum(axis=0), own[:, COMMON, residual].sum(axis=0)
    scale = root_diagonal(gram)
    scaled = gram / np.outer(scale, scale)
    step = np.linalg.lstsq(scaled, score / scale, rcond=MIN_OWN_PART)[0] / scale
    before = float(own[:, residual, residual].sum())
    total = before - float(step @ (2.0 * score - gram @ step))
    if total < (1.0 - MIN_SHARE_LEFT) * before:
        # The model lacks a bow common to all images: the residuals are not those of a minimum.
        return None
    return ViewEvidence(
        clusters=clusters,
        views=[k for k, is_finite in zip(informative, finite, strict=True) if is_finite],
        own=own,
        length=length,
        along=own[:, :, residual] - own[:, :, COMMON] @ step,
        gram=scaled,
        scale=scale,
        total=total,
        freedom=sum(2 * n - 6 for n in count[finite].tolist()) - len(step),
    )


def predicted_by_others(calibration: Calibration, evidence: ViewEvidence) -> float:
    """Return the part of the squares of each image that one smooth displacement predicts, which is fitted to all other
    images: zero or less for a change between images, much for a lens that is not as its model."""
    size = np.array(calibration.camera.size_px)

    def rows_with_field(views: Sequence[ViewResult]) -> tuple[FloatArray, IntArray]:
        rows, count = rows_of(calibration, views)
        pixels = np.concatenate([(one.pixels - one.residuals_px)[one.kept] for one in views])
        u, v = (2.0 * pixels / size - 1.0).T
        terms = np.array([u**i * v**j for i in range(FIELD_DEGREE + 1) for j in range(FIELD_DEGREE + 1 - i) if i + j])
        field = np.zeros((2, 2 * len(terms), len(u)))
        field[0, : len(terms)] = field[1, len(terms) :] = terms
        return np.concatenate([rows[:, :6], rows[:, COMMON], field, rows[:, -1:]], axis=1), count

    products = products_of([calibration.views[k] for k in evidence.views], rows_with_field)
    length = root_diagonal(products)
    own = without_pose(products, length)[:, 6:, 6:]
    scale = root_diagonal(own.sum(axis=0))[:-1]
    gram, score = own[:, :-1, :-1] / np.outer(scale, scale), own[:, :-1, -1] / scale

    others, by_others = gram.sum(axis=0) - gram, score.sum(axis=0) - score
    step = (np.linalg.pinv(others, rcond=MIN_COMMON_PART, hermitian=True) @ by_others[..., None])[..., 0]
    missed = own[:, -1, -1].sum() - 2.0 * (step * score).sum() + np.einsum("vi,vij,vj->", step, gram, step)
    return float(1.0 - missed / evidence.total)


def products_of(
    views: Sequence[ViewResult], rows_of_some: Callable[[Sequence[ViewResult]], tuple[FloatArray, IntArray]]
) -> FloatArray:
    """Return for every view the products (V, K, K) of its rows, summed over u and v. `rows_of_some` returns the rows
    (2, K, N) of some of the views and the number of corners of each; it is called with a few views at a time."""
    corners = np.cumsum([np.count_nonzero(view.kept) for view in views])
    batch = (corners - 1) // CORNERS_AT_ONCE
    out = []
    for own in np.split(np.arange(len(views)), np.flatnonzero(np.diff(batch)) + 1):
        rows, count = rows_of_some([views[k] for k in own])
        with np.errstate(invalid="ignore"):
            out += [u @ u.T + v @ v.T for u, v in np.split(rows, np.cumsum(count)[:-1], axis=-1)]
    return np.array(out)


def columns_of(count: int) -> dict[str, slice]:
    """Return the slices of the kinds of change among `count` rows of `rows_of`."""
    stops = count - 1 - sum(CHANGE_COLUMNS.values()) + np.cumsum(list(CHANGE_COLUMNS.values()))
    out = {
        name: slice(stop - size, stop)
        for (name, size), stop in zip(CHANGE_COLUMNS.items(), stops.tolist(), strict=True)
    }
    return out | {"lens": slice(out["focus"].start, out["shift"].stop)}


def rows_of(calibration: Calibration, views: Sequence[ViewResult]) -> tuple[FloatArray, IntArray]:
    """Return derivatives of the pixels of the views' inliers, (2, K, N), and the number of inliers of each view (V,).

    Rows are, in this order, the derivatives by the pose (6), by what is common to all images (parameters of camera and
    pupil, 3 bows of the boards) and by the other kinds of change, and last the residuals.
    """
    count = np.array([np.count_nonzero(view.kept) for view in views])
    start, view = np.cumsum(count) - count, np.repeat(np.arange(len(views)), count)

    def centred(values: FloatArray) -> FloatArray:
        return np.asarray(values - (np.add.reduceat(values, start, axis=-1) / count)[..., view])

    points = points_of(calibration, views).T
    rotation = np.array([one.cam_from_board.rotation for one in views])[view].transpose(1, 2, 0)
    turned = (rotation * points).sum(axis=1)
    in_cam = turned + np.array([one.cam_from_board.translation_mm for one in views])[view].T
    p = calibration.near.parameters.size
    rows = np.zeros((2, p + 6 + sum(CHANGE_COLUMNS.values()) + 1, points.shape[1]))
    d_pixels_d_point = rows[:, 3:6]
    u, v, valid = calibration.near.derivatives(in_cam[0], in_cam[1], in_cam[2], d_pixels_d_point, rows[:, 6 : 6 + p])
    pixels = np.where(valid, [u, v], np.nan)
    lever, flat = centred(turned), centred(points[:2])
    x, y = flat / np.maximum.reduceat(np.abs(flat).max(axis=0), start)[view]
    centre = calibration.camera.axis_px
    along_u, along_v = centred(pixels) / np.array(calibration.camera.size_px)[:, None]
    rows[:, :3] = rotation_derivatives(lever, d_pixels_d_point)
    of_kind = {kind: rows[:, own] for kind, own in columns_of(rows.shape[1]).items()}
    out_of_plane = (d_pixels_d_point * rotation[:, 2]).sum(axis=1)
    for k, bow in enumerate((x * x, x * y, y * y)):
        np.multiply(out_of_plane, bow, out=of_kind["bend"][:, k])
    np.subtract(pixels, centre[:, None], out=of_kind["focus"][:, 0])
    of_kind["shift"][0, 0] = of_kind["shift"][1, 1] = 1.0
    np.multiply(rows[:, :6], along_v, out=of_kind["rows"])
    np.multiply(rows[:, :6], along_u, out=of_kind[NO_CHANGE])
    rows[:, -1] = np.concatenate([one.residuals_px[one.kept] for one in views]).T
    return rows, count


def points_of(calibration: Calibration, views: Sequence[ViewResult]) -> Points:
    """Return the points (N, 3) mm of the views' inliers in their boards' frames."""
    shapes = {board.board_id: board for board in calibration.boards}
    return np.concatenate([shapes[view.board_id].at(view.grid[view.kept]) for view in views])


def without_pose(products: FloatArray, length: FloatArray) -> FloatArray:
    """Return the products (V, K, K) of rows with the first six, the pose, eliminated; `length` (V, K) are the rows'
    lengths. Undetermined directions of the pose are left out."""
    pose = length[:, :6]
    sizes, axes = np.linalg.eigh(products[:, :6, :6] / (pose[:, :, None] * pose[:, None]))
    whitened = np.where(sizes > MIN_OWN_PART**2, sizes, np.inf) ** -0.5
    back = np.swapaxes(axes * whitened[:, None], -1, -2) @ (products[:, :6] / pose[:, :, None])
    return np.asarray(products - np.swapaxes(back, -1, -2) @ back)
