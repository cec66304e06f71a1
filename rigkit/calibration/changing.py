"""What changes from image to image: focus, a stabilised sensor, a picture read row by row, a board that bends.

One lens and one board explain all images but for the poses. What else an image shows of its own is told by residuals:
after its pose, how much of them is a longer focal length, a shifted picture, a motion while the rows were read, a board
bent otherwise. A lens or a board that is not what the model says, the same in all images, has a little of each; what
changes from image to image is one of them far above the others.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rigkit.calibration.result import Calibration, ViewResult
from rigkit.core.arrays import FloatArray, Points
from rigkit.core.findings import Finding, Severity
from rigkit.geometry.rotation import skew

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
"""No camera reads its image column by column: what fits that as well as rows is neither, but a lens or board unlike its
model."""


def changing(calibration: Calibration) -> list[Finding]:
    """Return a finding where one thing differs from image to image that the calibration takes for constant."""
    changes = view_changes(calibration)
    if not changes:
        return []
    best = min(changes, key=lambda way: changes[way].criterion)
    found = changes[best]
    others = [0.0, *(change.criterion for way, change in changes.items() if way != best)]
    if (
        best not in WAYS
        or found.ratio < MIN_VARIANCE_RATIO
        or found.share < MIN_SHARE_EXPLAINED
        or min(others) - found.criterion < max(MIN_LEAD_OF_CRITERION, -MIN_LEAD_OF_GAIN * found.criterion)
    ):
        return []
    message = f"{WAYS[best].message}: that explains {100.0 * found.share:.0f} % of the squares of all residuals"
    return [Finding(severity=Severity.LOOK, message=message, remedy=WAYS[best].remedy)]


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
    shapes = {board.board_id: board.points_mm for board in calibration.boards}
    columns = {
        name: 1 + max(int(v.grid[:, 0].max()) for v in calibration.views if v.board_id == name) for name in shapes
    }
    views = []
    for view in calibration.views:
        if np.count_nonzero(view.kept) >= MIN_TELLING_CORNERS:
            points = shapes[view.board_id][view.grid[view.kept] @ [1, columns[view.board_id]]]
            own = _OwnPart.of(calibration, view, points)
            views += [] if own is None else [own]
    if len(views) < MIN_TELLING_VIEWS:
        return {}
    gram = np.sum([view.common.T @ view.common for view in views], axis=0)
    score = np.sum([view.common.T @ view.residual for view in views], axis=0)
    scale = np.sqrt(np.maximum(np.diag(gram), np.finfo(float).tiny))
    step = np.linalg.lstsq(gram / np.outer(scale, scale), score / scale, rcond=MIN_OWN_PART)[0] / scale
    residuals = [view.residual - view.common @ step for view in views]
    total = float(sum(r @ r for r in residuals))
    freedom = sum(len(r) - 6 for r in residuals) - len(step)
    if total < (1.0 - MIN_SHARE_EXPLAINED) * sum(float(view.residual @ view.residual) for view in views):
        # A bow that all images share was left out of the model: what is left after it is of no fit, and says nothing.
        return {}
    out = {}
    for name in (*WAYS, NO_CHANGE):
        squares = float(sum(np.sum((v.ways[name].T @ r) ** 2) for v, r in zip(views, residuals, strict=True)))
        count = sum(view.ways[name].shape[1] for view in views)
        if freedom <= 2 * count or not total > squares:
            return {}
        rest = (total - squares) / (freedom - count)
        criterion = freedom * np.log1p(-squares / total) + count * np.log(freedom)
        out[name] = ViewChange(squares / count / rest, (squares - count * rest) / total, float(criterion))
    return out


@dataclass(frozen=True, eq=False, slots=True)
class _OwnPart:
    """What of a view's residuals its pose does not follow.

    Attributes
    ----------
    residual : (2 N,) px.
    common : (2 N, C) how it moves with what all images share: the camera's parameters, a bow of the boards.
    ways : (2 N, D) orthonormal, the ways to change by name.
    """

    residual: FloatArray
    common: FloatArray
    ways: dict[str, FloatArray]

    @classmethod
    def of(cls, calibration: Calibration, view: ViewResult, points: Points) -> _OwnPart | None:
        """Return it for the `points` kept; None where a lens so far off has no pixels, or no slopes, for them."""
        rotation = view.cam_from_board.rotation
        turned = points @ rotation.T
        in_cam = turned + view.cam_from_board.translation_mm
        pixels, valid, by_point, by_camera = calibration.camera.project_with_jacobians(in_cam)
        if not (valid.all() and np.isfinite(by_point).all() and np.isfinite(by_camera).all()):
            return None
        pose = np.concatenate([-by_point @ skew(turned - turned.mean(axis=0)), by_point], axis=2)
        centre, _ = calibration.camera.project(np.array([[0.0, 0.0, 1.0]]))
        along_v, along_u = ((pixels - pixels.mean(axis=0)) / calibration.camera.size_px).T[::-1, :, None, None]
        flat = points[:, :2] - points[:, :2].mean(axis=0)
        x, y = (flat / np.abs(flat).max()).T
        bow = (by_point @ rotation[:, 2])[:, :, None] * np.stack([x * x, x * y, y * y], axis=1)[:, None, :]
        ways = {
            "focus": (pixels - centre)[:, :, None],
            "shift": np.broadcast_to(np.eye(2), (len(points), 2, 2)),
            "rows": pose * along_v,
            "bend": bow,
            NO_CHANGE: pose * along_u,
        }
        own, _ = np.linalg.qr(pose.reshape(-1, 6))

        def free(moves: FloatArray) -> FloatArray:
            rows = moves.reshape(2 * len(points), -1)
            return np.asarray(rows - own @ (own.T @ rows))

        bases = {}
        for name, moves in ways.items():
            length = np.linalg.norm(moves.reshape(2 * len(points), -1), axis=0)
            basis, sizes, _ = np.linalg.svd(free(moves) / np.maximum(length, np.finfo(float).tiny), full_matrices=False)
            bases[name] = basis[:, sizes > MIN_OWN_PART]
        residual = free(view.residuals_px[view.kept])[:, 0]
        return cls(residual, free(np.concatenate([by_camera, bow], axis=2)), bases)
