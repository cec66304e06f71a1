"""What residuals say of each image: how much of them is a longer focal length, a shifted picture, a bent board ...

At first order, after each image's own pose, and with all that the images have in common free to follow.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from rigkit.calibration.result import Calibration, ViewResult
from rigkit.core.arrays import FloatArray, IntArray, Points

MIN_INFORMATIVE_CORNERS = 20
"""A view with fewer corners says too little of its own after its pose."""
MIN_INFORMATIVE_VIEWS = 6
CORNERS_AT_ONCE = 20_000
"""Of which rows are held: 1.6 kB each, in `judging.pupil` as many again."""
MIN_OWN_PART = 1e-6
"""A kind of change that the pose, or the kinds before, follow but for this part of it is none of its own."""
MIN_COMMON_PART = 1e-6
"""Of what is common to all images, a direction that a kind of change follows but for this part of its square is
open."""
MIN_SHARE_LEFT = 0.5
"""A bow that all images share takes no more than the rest of the squares."""
NO_CHANGE = "columns"
"""No camera reads its image column by column: what fits that as well as rows may be a lens or board unlike its
model."""
CHANGE_COLUMNS = {"bend": 3, "focus": 1, "shift": 2, "rows": 6, NO_CHANGE: 6}
"""How many rows of `rows_of` each kind of change has, in their order before the residual; bends are common, too."""
COMMON = slice(6, -(sum(CHANGE_COLUMNS.values()) - CHANGE_COLUMNS["bend"] + 1))
"""Rows of `rows_of` that are common to all images: not of the pose, nor of one image's own."""


@dataclass(frozen=True, slots=True)
class ViewChange:
    """How much of the residuals a kind of change from image to image explains.

    Attributes
    ----------
    ratio : variance along it over that of the rest; 1 by chance.
    share : of all squares, beyond chance.
    left : part of all squares that it leaves.
    criterion : its Bayesian information criterion less that of no change.
    """

    ratio: float
    share: float
    left: float
    criterion: float

    @classmethod
    def of(cls, left: float, freedom: int, directions: int) -> ViewChange:
        """Return that of a kind with so many directions, of residuals with so many degrees of freedom."""
        rest = left / (freedom - directions)
        squares = 1.0 - left
        criterion = freedom * np.log(left) + directions * np.log(freedom)
        return cls(squares / directions / rest, squares - directions * rest, left, float(criterion))


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class ViewEvidence:
    """What the residuals of V views say, as products of rows of `rows_of` without the pose.

    Attributes
    ----------
    views : which of the calibration's.
    own, length : products (V, K, K), and the lengths (V, K) of the rows with it.
    along : (V, K) products with the residuals, what is common to all images followed.
    gram, scale : products (C, C) of what is common, to a unit diagonal by the scales (C,).
    total, freedom : sum of squares of the residuals, and its degrees of freedom.
    """

    views: list[int]
    own: FloatArray
    length: FloatArray
    along: FloatArray
    gram: FloatArray
    scale: FloatArray
    total: float
    freedom: int

    def common_covariance(self) -> FloatArray:
        """Return the inverse (C, C) of the products of what is common, as far as the images tell it."""
        values, vectors = np.linalg.eigh(self.gram)
        root = vectors * np.where(values > MIN_COMMON_PART, values, np.inf) ** -0.5 / self.scale[:, None]
        return np.asarray(root @ root.T)

    def explained(self, rows: slice) -> tuple[float, int, FloatArray]:
        """Return the squares that a kind of change explains when all that is common to the images follows, how many
        directions it has, and its amounts (V, n)."""
        # Directions of the unit vectors' own part, and how much of the residual, and of what is common, lies along
        # each.
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

    def changes(self) -> dict[str, ViewChange]:
        """Return what each kind of change explains; nothing where the residuals leave too little freedom."""
        out = {}
        for kind, rows in columns_of(self.own.shape[1]).items():
            squares, directions, _ = self.explained(rows)
            if self.freedom <= 2 * directions or not self.total > squares:
                return {}
            out[kind] = ViewChange.of(1.0 - squares / self.total, self.freedom, directions)
        return out


def view_evidence(calibration: Calibration, clusters: IntArray | None = None) -> ViewEvidence | None:
    """Return what the residuals say; None where that is nothing.

    `clusters` (V,) number the views' images, as `cluster_numbers` has it: those that repeat another one say nothing
    that it does not say, and are not asked.
    """
    informative = [
        k for k, view in enumerate(calibration.views) if np.count_nonzero(view.kept) >= MIN_INFORMATIVE_CORNERS
    ]
    if clusters is not None:
        images = [view.image for view in calibration.views]
        first = dict(zip(clusters[::-1].tolist(), images[::-1], strict=True))
        informative = [k for k in informative if images[k] == first[int(clusters[k])]]
    if len(informative) < MIN_INFORMATIVE_VIEWS:
        return None
    products = products_of([calibration.views[k] for k in informative], lambda views: rows_of(calibration, views))
    # A lens so far off has no pixels, or no slopes, for some views: they tell nothing.
    finite = np.asarray(np.isfinite(products).all(axis=(1, 2)))
    if np.count_nonzero(finite) < MIN_INFORMATIVE_VIEWS:
        return None
    products = products[finite]
    count = np.array([np.count_nonzero(calibration.views[k].kept) for k in informative])
    length = np.sqrt(np.maximum(np.diagonal(products, axis1=1, axis2=2), np.finfo(float).tiny))
    own = without_pose(products, length)
    residual = -1
    gram, score = own[:, COMMON, COMMON].sum(axis=0), own[:, COMMON, residual].sum(axis=0)
    scale = np.sqrt(np.maximum(np.diag(gram), np.finfo(float).tiny))
    scaled = gram / np.outer(scale, scale)
    step = np.linalg.lstsq(scaled, score / scale, rcond=MIN_OWN_PART)[0] / scale
    before = float(own[:, residual, residual].sum())
    total = before - float(step @ (2.0 * score - gram @ step))
    if total < (1.0 - MIN_SHARE_LEFT) * before:
        # A bow that all images share was left out of the model: what is left after it is of no fit, and says nothing.
        return None
    return ViewEvidence(
        views=[k for k, tells in zip(informative, finite, strict=True) if tells],
        own=own,
        length=length,
        along=own[:, :, residual] - own[:, :, COMMON] @ step,
        gram=scaled,
        scale=scale,
        total=total,
        freedom=sum(2 * n - 6 for n in count[finite].tolist()) - len(step),
    )


def products_of(
    views: Sequence[ViewResult], rows_of_some: Callable[[Sequence[ViewResult]], tuple[FloatArray, IntArray]]
) -> FloatArray:
    """Return of every view the products (V, K, K) of its rows, those of u and of v summed; `rows_of_some` returns the
    rows (2, K, N) of some of the views and how many corners each has. Rows of all views at once are never held."""
    corners = np.cumsum([np.count_nonzero(view.kept) for view in views])
    batch = (corners - 1) // CORNERS_AT_ONCE
    out = []
    for own in np.split(np.arange(len(views)), np.flatnonzero(np.diff(batch)) + 1):
        rows, count = rows_of_some([views[k] for k in own])
        with np.errstate(invalid="ignore"):
            out += [u @ u.T + v @ v.T for u, v in np.split(rows, np.cumsum(count)[:-1], axis=-1)]
    return np.array(out)


def columns_of(count: int) -> dict[str, slice]:
    """Return where the kinds of change are among `count` rows of `rows_of`."""
    stops = count - 1 - sum(CHANGE_COLUMNS.values()) + np.cumsum(list(CHANGE_COLUMNS.values()))
    out = {
        name: slice(stop - size, stop)
        for (name, size), stop in zip(CHANGE_COLUMNS.items(), stops.tolist(), strict=True)
    }
    return out | {"lens": slice(out["focus"].start, out["shift"].stop)}


def rows_of(calibration: Calibration, views: Sequence[ViewResult]) -> tuple[FloatArray, IntArray]:
    """Return how the kept corners of the views move, (2, K, N) px, and how many there are of each view (V,).

    With what is, in this order: the pose (6), what all images share (the parameters of camera and pupil and the 3 bows
    of the boards), the other kinds of change, and the residual last.
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
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        np.multiply(lever[i], d_pixels_d_point[:, j], out=rows[:, k])
        rows[:, k] -= lever[j] * d_pixels_d_point[:, i]
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
    """Return the points (N, 3) of the boards that the kept corners of the views are."""
    shapes = {board.board_id: board for board in calibration.boards}
    return np.concatenate([shapes[view.board_id].at(view.grid[view.kept]) for view in views])


def without_pose(products: FloatArray, length: FloatArray) -> FloatArray:
    """Return the products (V, K, K) of rows with the part taken out that the first six follow, the pose; `length`
    (V, K) is that of the rows. Directions that the corners leave open are none of the pose."""
    pose = length[:, :6]
    sizes, axes = np.linalg.eigh(products[:, :6, :6] / (pose[:, :, None] * pose[:, None]))
    whitened = np.where(sizes > MIN_OWN_PART**2, sizes, np.inf) ** -0.5
    back = np.swapaxes(axes * whitened[:, None], -1, -2) @ (products[:, :6] / pose[:, :, None])
    return np.asarray(products - np.swapaxes(back, -1, -2) @ back)
