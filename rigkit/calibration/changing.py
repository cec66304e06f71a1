"""What changes from image to image: focus, a stabilised sensor, a picture read row by row, a board that bends.

One lens and one board explain all images but for the poses. What else an image shows of its own is told by residuals:
after its pose, how much of them is a longer focal length, a shifted picture, a motion while the rows were read, a board
bent otherwise. A lens or a board that is not what the model says, the same in all images, has a little of each; what
changes from image to image is one of them far above the others.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from rigkit.calibration.assemble import board_shapes
from rigkit.calibration.fit import Fit
from rigkit.calibration.observations import Observations
from rigkit.calibration.result import Calibration, ViewResult
from rigkit.calibration.solver import solve
from rigkit.core.arrays import FloatArray, IntArray, Points
from rigkit.core.findings import Finding, Severity
from rigkit.geometry.rigid3 import Rigid3

MIN_TELLING_CORNERS = 20
"""A view with fewer corners says too little of its own after its pose."""
MIN_TELLING_VIEWS = 6
MIN_OWN_PART = 1e-6
"""A way to change that the pose, or the ways before, follow but for this part of it is none of its own."""
MIN_COMMON_PART = 1e-6
"""Of what is common to all images, a direction that a way to change follows but for this part of its square is open."""
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


MAX_LEFT_OF_CONTROL = 0.85
"""A motion over rows leaves no more than this part of the squares that one over columns leaves: both follow half of
what any lens or board unlike its model leaves, in captures held still, too."""
MIN_SHARE_TRIED = 0.2
"""Where a lens that changes explains this much at first order, it is solved for in every image."""
LENS_ROUNDS, LENS_TOLERANCE = 2, 1e-6
"""A focal length that is off by a hundredth moves poses by more than first order: the second round ends it."""


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
    "lens": _Way(
        "the picture is scaled and shifted on the sensor from image to image (focus, zoom or stabilisation)",
        "switch autofocus, zoom and image stabilisation off, and retake all",
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
OF_LENS = ("focus", "shift", "lens")
"""The last is both of the others, for a zoom whose centre is not the lens's."""
MOTION = ("rows", NO_CHANGE)
MOVED = _Way(
    "boards or the camera moved while the image was read (rolling shutter)",
    WAYS["rows"].remedy,
)
"""A pose that follows a sheared board leaves nearly the same of a motion over rows as of one over columns. Where rows
are best, and both explain nearly all, far better than all else, it was a motion, unless a bend of each board is the
main part, too: a lens or board unlike its model shows as that."""
MIN_SHARE_MOVED = 0.9
"""What a motion explains then: 0.97 and more where simulated boards in hand move by pixels."""


def changing(
    calibration: Calibration,
    correlation: float,
    solved: tuple[Observations, Fit] | None = None,
    but: Collection[str] = (),
) -> list[Finding]:
    """Return a finding where one thing differs from image to image that the calibration takes for constant.

    Parameters
    ----------
    correlation : that of the residuals of neighbouring corners.
    solved : what was calibrated, where it is known: a lens that changes is then solved for, not only looked for at
        first order.
    but : names of ways to change that are not to be told.
    """
    evidence = _evidence(calibration) if correlation > MIN_NEIGHBOUR_CORRELATION else None
    changes = evidence.changes() if evidence is not None else {}
    if evidence is None or not changes:
        return []
    if solved is not None and changes["lens"].ratio >= MIN_VARIANCE_RATIO and changes["lens"].share >= MIN_SHARE_TRIED:
        changes |= {way: _solved_for(way, evidence, calibration, *solved, changes[way]) for way in OF_LENS}
    best = min(changes, key=lambda way: changes[way].criterion)
    if best in OF_LENS and _leads(changes, best, but=OF_LENS):
        # A zoom about another centre is both; what is nearly as good with one of them is that one.
        alone = [way for way in OF_LENS[:2] if _leads(changes, way, but=("lens",))]
        way = WAYS[alone[0] if alone else best]
    elif best == "rows" and changes["rows"].left <= MAX_LEFT_OF_CONTROL * changes[NO_CHANGE].left:
        if _leads(changes, best):
            way = WAYS[best]
        elif (
            all(_leads(changes, way, but=MOTION) and changes[way].share >= MIN_SHARE_MOVED for way in MOTION)
            and changes["bend"].share < MIN_SHARE_EXPLAINED
        ):
            way = MOVED
        else:
            return []
    elif best == "bend" and _leads(changes, best):
        way = WAYS[best]
    else:
        return []
    if best in but:
        return []
    message = f"{way.message}: that explains {100.0 * changes[best].share:.0f} % of the squares of all residuals"
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
    left : part of all squares that it leaves.
    criterion : its Bayesian information criterion less that of no change.
    """

    ratio: float
    share: float
    left: float
    criterion: float

    @classmethod
    def of(cls, left: float, freedom: int, directions: int) -> ViewChange:
        """Return that of a way with so many directions, of residuals with so many degrees of freedom."""
        rest = left / (freedom - directions)
        squares = 1.0 - left
        criterion = freedom * np.log(left) + directions * np.log(freedom)
        return cls(squares / directions / rest, squares - directions * rest, left, float(criterion))


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class _Evidence:
    """What the residuals of V views say, as products of rows of `_rows` without the pose.

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

    def explained(self, way: slice) -> tuple[float, int, FloatArray]:
        """Return the squares that a way to change explains when all that is common to the images follows, how many
        directions it has, and its amounts (V, n)."""
        # Directions of the unit vectors' own part, and how much of the residual, and of what is common, lies along
        # each.
        size, common = self.length[:, way], COMMON
        sizes, axes = np.linalg.eigh(self.own[:, way, way] / (size[:, :, None] * size[:, None]))
        known = sizes > MIN_OWN_PART**2
        back = np.swapaxes(axes * np.where(known, sizes, np.inf)[:, None] ** -0.5, -1, -2) / size[:, None]
        amount = (back @ self.along[:, way, None])[..., 0]
        shared = back @ self.own[:, way, common] / self.scale
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
        """Return what each way to change explains; nothing where the residuals leave too little freedom."""
        out = {}
        for name, way in _columns(self.own.shape[1]).items():
            squares, directions, _ = self.explained(way)
            if self.freedom <= 2 * directions or not self.total > squares:
                return {}
            out[name] = ViewChange.of(1.0 - squares / self.total, self.freedom, directions)
        return out


def view_changes(calibration: Calibration) -> dict[str, ViewChange]:
    """Return what each way to change explains; nothing where too few views have enough corners, or where the boards
    are bent alike in all of them while the calibration has them flat."""
    evidence = _evidence(calibration)
    return {} if evidence is None else evidence.changes()


def _evidence(calibration: Calibration) -> _Evidence | None:
    """Return what the residuals say; None where that is nothing."""
    telling = [k for k, view in enumerate(calibration.views) if np.count_nonzero(view.kept) >= MIN_TELLING_CORNERS]
    if len(telling) < MIN_TELLING_VIEWS:
        return None
    rows, count = _rows(calibration, [calibration.views[k] for k in telling])
    # A lens so far off has no pixels, or no slopes, for some views: they tell nothing.
    told = np.logical_and.reduceat(np.isfinite(rows).all(axis=(0, 1)), np.cumsum(count) - count)
    if np.count_nonzero(told) < MIN_TELLING_VIEWS:
        return None
    stops = np.cumsum(count)
    each = [rows[..., stop - n : stop] for n, stop in zip(count[told], stops[told], strict=True)]
    products = np.array([part[0] @ part[0].T + part[1] @ part[1].T for part in each])
    length = np.sqrt(np.maximum(np.diagonal(products, axis1=1, axis2=2), np.finfo(float).tiny))
    own = _without_pose(products, length)
    residual = -1
    gram, score = own[:, COMMON, COMMON].sum(axis=0), own[:, COMMON, residual].sum(axis=0)
    scale = np.sqrt(np.maximum(np.diag(gram), np.finfo(float).tiny))
    scaled = gram / np.outer(scale, scale)
    step = np.linalg.lstsq(scaled, score / scale, rcond=MIN_OWN_PART)[0] / scale
    before = float(own[:, residual, residual].sum())
    total = before - float(step @ (2.0 * score - gram @ step))
    if total < (1.0 - MIN_SHARE_EXPLAINED) * before:
        # A bow that all images share was left out of the model: what is left after it is of no fit, and says nothing.
        return None
    return _Evidence(
        views=[k for k, tells in zip(telling, told.tolist(), strict=True) if tells],
        own=own,
        length=length,
        along=own[:, :, residual] - own[:, :, COMMON] @ step,
        gram=scaled,
        scale=scale,
        total=total,
        freedom=sum(2 * n - 6 for n in count[told].tolist()) - len(step),
    )


def _solved_for(
    way: str,
    evidence: _Evidence,
    calibration: Calibration,
    observations: Observations,
    fit: Fit,
    at_first: ViewChange,
) -> ViewChange:
    """Return what a lens that changes in this way explains when all is solved with it; `at_first` order where that is
    more."""
    weight, start, residuals, left = fit.weight(observations), fit.state, fit.residuals, at_first.left
    before = ((fit.residuals.px**2).sum(axis=-1) * weight**2).sum(axis=1)
    freedom, columns = evidence.freedom, _columns(evidence.own.shape[1])[way]
    _, directions, amounts = evidence.explained(columns)
    for rounds in range(LENS_ROUNDS):
        if rounds:
            poses = Rigid3.stack(start.rotation, start.translation_mm)
            px = np.where(residuals.valid[..., None], residuals.px, np.nan)
            solved = replace(
                calibration,
                camera=start.camera,
                views=ViewResult.of_views(observations.views, poses, px, fit.kept),
                boards=board_shapes(observations, start.shape, start.unknowns),
            )
            now = _evidence(solved)
            if now is None:
                return at_first
            evidence, (_, _, amounts) = now, now.explained(columns)
        views = evidence.views
        zoom = amounts[:, 0] if way != "shift" else np.zeros(len(views))
        shift = amounts[:, -2:] if way != "focus" else np.zeros((len(views), 2))
        centre, _ = start.camera.project(np.array([0.0, 0.0, 1.0]))
        pixels = observations.pixels.copy()
        pixels[views] -= zoom[:, None, None] * (pixels[views] - centre) + shift[:, None]
        observations = replace(observations, pixels=pixels)
        solution = solve(observations, start, weight=weight, prior_sigma_px=fit.sigma_px, cost_tolerance=LENS_TOLERANCE)
        start, residuals = solution.state, solution.data.residuals[0]
        squares = ((residuals.px**2).sum(axis=-1) * weight**2).sum(axis=1)
        left = min(left, float(squares.sum() / before.sum()))
    return ViewChange.of(left, freedom, directions) if left < at_first.left else at_first


WAY_COLUMNS = {"bend": 3, "focus": 1, "shift": 2, "rows": 6, NO_CHANGE: 6}
"""How many rows of `_rows` each way to change has, in their order before the residual; bends are common, too."""
COMMON = slice(6, -(sum(WAY_COLUMNS.values()) - WAY_COLUMNS["bend"] + 1))
"""Rows of `_rows` that are common to all images: not of the pose, nor of one image's own."""


def _columns(count: int) -> dict[str, slice]:
    """Return where the ways to change are among `count` rows of `_rows`."""
    stops = count - 1 - sum(WAY_COLUMNS.values()) + np.cumsum(list(WAY_COLUMNS.values()))
    out = {
        name: slice(stop - size, stop) for (name, size), stop in zip(WAY_COLUMNS.items(), stops.tolist(), strict=True)
    }
    return out | {"lens": slice(out["focus"].start, out["shift"].stop)}


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
