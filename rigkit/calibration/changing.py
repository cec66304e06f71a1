"""What changes from image to image: focus, a stabilised sensor, a picture read row by row, a board that bends.

One lens and one board explain all images but for the poses. What else an image shows of its own is told by residuals:
after its pose, how much of them is a longer focal length, a shifted picture, a motion while the rows were read, a board
bent otherwise. A lens or a board that is not what the model says, the same in all images, has a little of each; what
changes from image to image is one of them far above the others.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from rigkit.calibration.result import Calibration, ViewResult
from rigkit.core.arrays import FloatArray, IntArray, Points
from rigkit.core.findings import Finding, Severity

MIN_TELLING_CORNERS = 20
"""A view with fewer corners says too little of its own after its pose."""
MIN_TELLING_VIEWS = 6
MIN_OWN_PART = 1e-6
"""A way to change that the pose, or the ways before, follow but for this part of it is none of its own."""
MIN_VARIANCE_RATIO = 6.0
"""Variance along a way to change over that of the rest."""
MIN_SHARE_EXPLAINED = 0.5
"""The main part: a way to change that explains less of all squares may be a little of something else. A board held in
hand before two cameras is bent by the residuals of one, sheared by those of the other, with a third of each."""
MIN_NEIGHBOUR_CORRELATION = 0.1
"""All ways to change are smooth over a board: where one is the main part, the residuals of neighbouring corners agree,
by half of 0.5 and more. Those of mere noise have a correlation of 0, a little less after a pose."""
MIN_LEAD_OF_CRITERION = 10.0
"""By so much its Bayesian information criterion must be below that of nothing and of every other way: very strong
evidence (Kass and Raftery, "Bayes factors", J. Am. Stat. Assoc. 90, 1995)."""
MIN_LEAD_OF_GAIN = 0.1
"""And by this part of its own lead over nothing: ways to change that follow the same images nearly as well leave open
which of them it was, however many corners there are."""


@dataclass(frozen=True, slots=True)
class _Way:
    """A way in which an image may differ from the others: what is said of it, and what to do."""

    message: str
    remedy: str


WAYS = {
    "focus": _Way(
        "the focal length differs from image to image",
        "switch autofocus, zoom and focus breathing off (fix the focus with a screw or tape), and retake all",
    ),
    "shift": _Way(
        "the picture is shifted on the sensor from image to image",
        "switch image stabilisation off, and retake all",
    ),
    "rows": _Way(
        "boards are sheared as if they moved while the image was read row by row (rolling shutter)",
        "hold camera and board still while an image is taken, on a stand, or expose for a shorter time",
    ),
    "bend": _Way(
        "the board is bent otherwise in every image",
        "glue it to something stiff, and retake all",
    ),
}


NO_CHANGE = "columns"
"""No camera reads its image column by column: what fits that as well as rows may be a lens or board unlike its
model."""
MOTION = ("rows", NO_CHANGE)
MOVED = _Way(
    "boards or the camera moved while the image was read (rolling shutter)",
    WAYS["rows"].remedy,
)
"""A pose that follows a sheared board leaves nearly the same of a motion over rows as of one over columns. Where rows
are best, and both explain the images far better than all else, it was a motion, unless a bend of each board is the main
part, too: a lens or board unlike its model shows as that."""


def changing(calibration: Calibration, correlation: float) -> list[Finding]:
    """Return a finding where one thing differs from image to image that the calibration takes for constant;
    `correlation` is that of the residuals of neighbouring corners."""
    changes = view_changes(calibration) if correlation > MIN_NEIGHBOUR_CORRELATION else {}
    if not changes:
        return []
    best = min(changes, key=lambda way: changes[way].criterion)
    if best in WAYS and _leads(changes, best):
        way, share = WAYS[best], changes[best].share
    elif (
        best == "rows"
        and all(_leads(changes, way, but=MOTION) for way in MOTION)
        and changes["bend"].share < MIN_SHARE_EXPLAINED
    ):
        way, share = MOVED, changes[best].share
    else:
        return []
    message = f"{way.message}: that explains {100.0 * share:.0f} % of the squares of all residuals"
    return [Finding(severity=Severity.LOOK, message=message, remedy=way.remedy)]


def _leads(changes: Mapping[str, ViewChange], way: str, but: Collection[str] = ()) -> bool:
    """Say whether a way to change is the main part of the residuals, far above all others but those of `but`."""
    found = changes[way]
    others = [0.0, *(change.criterion for name, change in changes.items() if name != way and name not in but)]
    lead = max(MIN_LEAD_OF_CRITERION, -MIN_LEAD_OF_GAIN * found.criterion)
    return (
        found.ratio >= MIN_VARIANCE_RATIO
        and found.share >= MIN_SHARE_EXPLAINED
        and min(others) - found.criterion >= lead
    )


@dataclass(frozen=True, slots=True)
class ViewChange:
    """How much of the residuals a way to change from image to image explains.

    Attributes
    ----------
    ratio : variance along it over that of the rest; 1 by chance.
    share : of all squares, beyond chance.
    criterion : its Bayesian information criterion less that of no change.
    """

    ratio: float
    share: float
    criterion: float


def view_changes(calibration: Calibration) -> dict[str, ViewChange]:
    """Return what each way to change explains; nothing where too few views have enough corners, or where the boards
    are bent alike in all of them while the calibration has them flat."""
    views = [view for view in calibration.views if np.count_nonzero(view.kept) >= MIN_TELLING_CORNERS]
    if len(views) < MIN_TELLING_VIEWS:
        return {}
    rows, count = _rows(calibration, views)
    # A lens so far off has no pixels, or no slopes, for some views: they tell nothing.
    told = np.logical_and.reduceat(np.isfinite(rows).all(axis=(0, 1)), np.cumsum(count) - count)
    if np.count_nonzero(told) < MIN_TELLING_VIEWS:
        return {}
    stops = np.cumsum(count)
    each = [rows[..., stop - n : stop] for n, stop in zip(count[told], stops[told], strict=True)]
    products = np.array([part[0] @ part[0].T + part[1] @ part[1].T for part in each])
    length = np.sqrt(np.maximum(np.diagonal(products, axis1=1, axis2=2), np.finfo(float).tiny))
    own = _without_pose(products, length)
    common, residual = slice(6, -OWN_COLUMNS), -1
    gram, score = own[:, common, common].sum(axis=0), own[:, common, residual].sum(axis=0)
    scale = np.sqrt(np.maximum(np.diag(gram), np.finfo(float).tiny))
    step = np.linalg.lstsq(gram / np.outer(scale, scale), score / scale, rcond=MIN_OWN_PART)[0] / scale
    before = float(own[:, residual, residual].sum())
    total = before - float(step @ (2.0 * score - gram @ step))
    freedom = sum(2 * n - 6 for n in count[told].tolist()) - len(step)
    if total < (1.0 - MIN_SHARE_EXPLAINED) * before:
        # A bow that all images share was left out of the model: what is left after it is of no fit, and says nothing.
        return {}
    out = {}
    along = own[:, :, residual] - own[:, :, common] @ step
    for name, way in _columns(rows.shape[1]).items():
        # Directions of the unit vectors' own part, and how much of the residual lies along each.
        size = length[:, way]
        sizes, axes = np.linalg.eigh(own[:, way, way] / (size[:, :, None] * size[:, None]))
        known = sizes > MIN_OWN_PART**2
        amount = ((along[:, way] / size)[:, None] @ axes)[:, 0]
        squares = float((amount[known] ** 2 / sizes[known]).sum())
        directions = int(known.sum())
        if freedom <= 2 * directions or not total > squares:
            return {}
        rest = (total - squares) / (freedom - directions)
        criterion = freedom * np.log1p(-squares / total) + directions * np.log(freedom)
        out[name] = ViewChange(squares / directions / rest, (squares - directions * rest) / total, float(criterion))
    return out


WAY_COLUMNS = {"bend": 3, "focus": 1, "shift": 2, "rows": 6, NO_CHANGE: 6}
"""How many rows of `_rows` each way to change has, in their order before the residual; bends are common, too."""
OWN_COLUMNS = sum(WAY_COLUMNS.values()) - WAY_COLUMNS["bend"] + 1
"""Rows of `_rows` that are neither of the pose nor common to all images."""


def _columns(count: int) -> dict[str, slice]:
    """Return where the ways to change are among `count` rows of `_rows`."""
    stops = count - 1 - sum(WAY_COLUMNS.values()) + np.cumsum(list(WAY_COLUMNS.values()))
    return {
        name: slice(stop - size, stop) for (name, size), stop in zip(WAY_COLUMNS.items(), stops.tolist(), strict=True)
    }


def _rows(calibration: Calibration, views: Sequence[ViewResult]) -> tuple[FloatArray, IntArray]:
    """Return how the kept corners of the views move, (2, K, N) px, and how many there are of each view (V,).

    With what is, in this order: the pose (6), what all images share (the camera's parameters and the 3 bows of the
    boards), the other ways to change, and the residual last.
    """
    count = np.array([np.count_nonzero(view.kept) for view in views])
    start, view = np.cumsum(count) - count, np.repeat(np.arange(len(views)), count)

    def centred(values: FloatArray) -> FloatArray:
        return np.asarray(values - (np.add.reduceat(values, start, axis=-1) / count)[..., view])

    points = _points(calibration, views).T
    rotation = np.array([one.cam_from_board.rotation for one in views])[view].transpose(1, 2, 0)
    turned = (rotation * points).sum(axis=1)
    in_cam = turned + np.array([one.cam_from_board.translation_mm for one in views])[view].T
    p = calibration.camera.parameters.size
    rows = np.zeros((2, p + 6 + sum(WAY_COLUMNS.values()) + 1, points.shape[1]))
    by_point = rows[:, 3:6]
    u, v, valid = calibration.camera.derivatives(in_cam[0], in_cam[1], in_cam[2], by_point, rows[:, 6 : 6 + p])
    pixels = np.where(valid, [u, v], np.nan)
    lever, flat = centred(turned), centred(points[:2])
    x, y = flat / np.maximum.reduceat(np.abs(flat).max(axis=0), start)[view]
    centre, _ = calibration.camera.project(np.array([0.0, 0.0, 1.0]))
    along_u, along_v = centred(pixels) / np.array(calibration.camera.size_px)[:, None]
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        np.multiply(lever[i], by_point[:, j], out=rows[:, k])
        rows[:, k] -= lever[j] * by_point[:, i]
    ways = {name: rows[:, way] for name, way in _columns(rows.shape[1]).items()}
    out_of_plane = (by_point * rotation[:, 2]).sum(axis=1)
    for k, bow in enumerate((x * x, x * y, y * y)):
        np.multiply(out_of_plane, bow, out=ways["bend"][:, k])
    np.subtract(pixels, centre[:, None], out=ways["focus"][:, 0])
    ways["shift"][0, 0] = ways["shift"][1, 1] = 1.0
    np.multiply(rows[:, :6], along_v, out=ways["rows"])
    np.multiply(rows[:, :6], along_u, out=ways[NO_CHANGE])
    rows[:, -1] = np.concatenate([one.residuals_px[one.kept] for one in views]).T
    return rows, count


def _points(calibration: Calibration, views: Sequence[ViewResult]) -> Points:
    """Return the points (N, 3) of the boards that the kept corners of the views are."""
    shapes = {board.board_id: board for board in calibration.boards}
    return np.concatenate([shapes[view.board_id].at(view.grid[view.kept]) for view in views])


def _without_pose(products: FloatArray, length: FloatArray) -> FloatArray:
    """Return the products (V, K, K) of rows with the part taken out that the first six follow, the pose; `length`
    (V, K) is that of the rows. Directions that the corners leave open are none of the pose."""
    pose = length[:, :6]
    sizes, axes = np.linalg.eigh(products[:, :6, :6] / (pose[:, :, None] * pose[:, None]))
    whitened = np.where(sizes > MIN_OWN_PART**2, sizes, np.inf) ** -0.5
    back = np.swapaxes(axes * whitened[:, None], -1, -2) @ (products[:, :6] / pose[:, :, None])
    return np.asarray(products - np.swapaxes(back, -1, -2) @ back)
