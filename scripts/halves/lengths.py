"""Lengths on the boards of frames that a rig was not calibrated with: how many errors are within a certificate's bound?

A length is the distance of two corners that both cameras see, triangulated; its truth is that distance on the board in
the shape that all frames of the set tell. Its scale is that of the stated squares, as the rig's is. Half of the data
behind that shape are the rig's own, so what a rig's error has in common with the shape's cancels in part. A bound is
that of the certificate at the length's own place. Frames of which `rigkit check` says that the rig no longer holds are
counted apart: there board and cameras moved between exposures, or an image is faulty.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from rigkit.calibration.board_shape import BoardShape
from rigkit.calibration.rig.result import RigCalibration
from rigkit.core.arrays import FloatArray, IntArray, Points
from rigkit.core.detections import BoardView
from rigkit.core.measurement_task import Quantity, Task
from rigkit.geometry.triangulation import triangulate_rays
from rigkit.validation.certificate.certify import bound_of
from rigkit.validation.certificate.propagation import OF_SCALE, gradients, systematic, variances
from rigkit.validation.certificate.result import instrument_of
from rigkit.validation.monitoring.evidence import FreshView, Monitored
from rigkit.validation.monitoring.verdict import check_views
from rigkit.validation.monitoring.watch import monitored_rig

STEP = 2
"""Squares that a short length spans."""
Seen = Mapping[str, tuple[BoardView, BoardView]]
"""What the two cameras see in each frame, with the same corners."""


@dataclass(frozen=True, eq=False, slots=True)
class Measured:
    """The errors of a frame's lengths over their bounds of 95 % (N,), and whether `rigkit check` accepts the frame."""

    frame: str
    over_bound: FloatArray
    holds: bool


def both_see(whole: RigCalibration, views: Mapping[str, Sequence[tuple[str, BoardView]]], names: Sequence[str]) -> Seen:
    """Return the corners that two cameras see in each frame, as the calibration of all frames reads their boards."""
    each: list[dict[str, BoardView]] = []
    for name in names:
        frames, boards = (
            {view.image: frame for frame, view in views[name]},
            {v.board.board_id: v.board for _, v in views[name]},
        )
        own: dict[str, BoardView] = {}
        for view in whole.cameras[whole.index(name)].calibration.views:
            kept, board = view.kept, boards.get(view.board_id)
            if board is not None:
                sigma = np.full(int(kept.sum()), whole.sigma_px)
                own[frames[view.image]] = BoardView(view.image, board, view.grid[kept], view.pixels[kept], sigma)
        each.append(own)
    return {frame: pair for frame in each[0] if frame in each[1] and (pair := _common(each[0][frame], each[1][frame]))}


def _common(first: BoardView, second: BoardView) -> tuple[BoardView, BoardView] | None:
    rows = [{(int(u), int(v)): row for row, (u, v) in enumerate(view.grid)} for view in (first, second)]
    shared = sorted(set(rows[0]) & set(rows[1]))
    if first.board.board_id != second.board.board_id or not shared:
        return None
    a, b = (
        BoardView(
            v.image, v.board, np.array(shared), *(part[[at[key] for key in shared]] for part in (v.pixels, v.sigma_px))
        )
        for v, at in zip((first, second), rows, strict=True)
    )
    return a, b


def measured(
    rig: RigCalibration, names: tuple[str, str], seen: Seen, shapes: Mapping[str, BoardShape]
) -> list[Measured]:
    """Return the lengths that a rig measures in the frames `seen`; `shapes` are the true ones of their boards."""
    instrument = instrument_of(monitored_rig(rig.mounted), names)
    solved = {shape.board_id: shape.points_mm for shape in rig.cameras[rig.index(names[0])].calibration.boards}
    out = []
    for frame, pair in seen.items():
        ends = _ends(pair[0].grid)
        if not len(ends) or pair[0].board.board_id not in shapes:
            continue
        true = shapes[pair[0].board.board_id].at(pair[0].grid)
        off = over_bound(instrument, _triangulated(instrument, pair)[ends], true[ends])
        fresh = [FreshView(frame, k, view) for k, view in enumerate(pair)]
        out.append(Measured(frame, off, check_views(replace(instrument, boards_mm=solved), fresh).holds))
    return out


def _ends(grid: IntArray) -> IntArray:
    """Return the corners (N, 2) between which lengths are measured: those of each whole row and column that is seen,
    and those two squares apart."""
    at = {(int(u), int(v)): row for row, (u, v) in enumerate(grid)}
    out = []
    for axis in (0, 1):
        for line in np.unique(grid[:, 1 - axis]):
            own = np.flatnonzero(grid[:, 1 - axis] == line)
            own = own[np.argsort(grid[own, axis])]
            if len(own) > STEP + 1:
                out.append((own[0], own[-1]))
    for (u, v), row in at.items():
        if u % STEP == v % STEP == 0:
            out += [(row, at[key]) for key in ((u + STEP, v), (u, v + STEP)) if key in at]
    return np.array(out, dtype=np.int64).reshape(-1, 2)


def _triangulated(instrument: Monitored, pair: tuple[BoardView, BoardView]) -> Points:
    """Return the corners (N, 3) in the frame of the first camera."""
    sights = [c.unproject(v.pixels)[0] for c, v in zip(instrument.cameras, pair, strict=True)]
    slopes = [c.ray_jacobian(v.pixels) for c, v in zip(instrument.cameras, pair, strict=True)]
    pose = instrument.cam_from_rig[1] @ instrument.cam_from_rig[0].inverse()
    return triangulate_rays(sights[0], sights[1], pose, jacobians1=slopes[0], jacobians2=slopes[1])[0]


def over_bound(instrument: Monitored, ends: Points, true: Points) -> FloatArray:
    """Return the errors of lengths over their bounds (N,), from their measured and true ends (N, 2, 3). The scale of
    the squares is common to both and no part of the bound."""
    along, truth = ends[:, 1] - ends[:, 0], np.linalg.norm(true[:, 1] - true[:, 0], axis=1)
    length = np.linalg.norm(along, axis=1)
    direction = along / length[:, None]
    found = gradients(
        instrument.cameras, instrument.cam_from_rig, ends, np.stack([-direction, direction], axis=1)[:, None]
    )
    # Size and distance tell only the share of the scale, which is left out.
    distance = float(np.linalg.norm(ends.mean(axis=(0, 1))))
    task = Task(quantity=Quantity.LENGTH, size_mm=float(np.median(truth)), distance_mm=distance)
    variance = variances(instrument, task, ends, found)
    sigma = {cause: np.sqrt(value[:, 0]) for cause, value in variance.items() if cause != OF_SCALE}
    expected = np.sqrt(systematic(instrument, found.by_calibration)[:, 0])
    bound, _ = bound_of(sigma, expected, instrument.freedom, task.confidence)
    return np.asarray((length - truth) / bound)


def share(frames: Sequence[Measured]) -> str:
    """Return how many lengths are within their bounds, in words."""
    if not frames:
        return "no frame"
    off = np.abs(np.concatenate([own.over_bound for own in frames]))
    return f"{100.0 * np.mean(off <= 1.0):.1f} % of {len(off)} in {len(frames)} frames"
