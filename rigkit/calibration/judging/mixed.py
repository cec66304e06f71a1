"""Two cameras whose images were mixed: the board before the one, then before the other.

Cameras that stand beside each other see every board from two places, and always the same motion lies between them. Of
one camera before which a board is held here and there, no motion comes twice. A board that is moved by equal steps
comes from each place on to the next one: the same image is the end of one step and the start of another.
"""

from __future__ import annotations

import numpy as np

from rigkit.calibration.result import Calibration
from rigkit.calibration.views.repeats import close_pairs
from rigkit.core.arrays import FloatArray, IntArray
from rigkit.core.findings import Finding

SAME_MOTION = 0.005
"""Boards that land within this part of their distance were moved alike."""
MIN_MOTION = 2.0
"""A motion of less than so many times that is none."""
MIN_PARTNERS = 4
"""So many images with a partner at the same motion are no chance: a motion has six numbers."""
MIN_SHARE_PAIRED = 0.5
"""Of all images, with their partners, at least this part must hang together so."""
MAX_SHARE_CHAINED = 0.2
"""More images than this part that are both start and end: a board moved by equal steps."""
MAX_STARTS = 24
"""So many views from which motions are tried, spread over the places of the boards, in whatever order they come."""


def two_cameras(calibration: Calibration, number: IntArray) -> list[Finding]:
    """Return a finding if the images are of two cameras that see the board at once; `number` (V,) is that of each
    view's image, as `cluster_numbers` has it."""
    views = calibration.views
    images = [view.image for view in views]
    _, first = np.unique(number, return_index=True)
    if len(first) < 2 * MIN_PARTNERS:
        return []
    rotation, centre = calibration.corners.rotation, calibration.corners.translation_mm
    boards = np.unique([view.board_id for view in views], return_inverse=True)[1]
    start, end = _partners(rotation, centre, boards, number)
    if len(start) < MIN_PARTNERS:
        return []
    alike = len(np.unique(number[start]))
    together = np.unique(np.concatenate([number[start], number[end]]))
    chained = np.intersect1d(number[start], number[end])
    enough = len(together) >= MIN_SHARE_PAIRED * len(first)
    if alike < MIN_PARTNERS or not enough or len(chained) > MAX_SHARE_CHAINED * len(together):
        return []
    return [
        Finding.bad(
            f"two cameras are mixed in these images: between '{images[start[0]]}' and '{images[end[0]]}', and "
            f"{alike - 1} other pairs of images, the board has moved in one and the same way",
            "calibrate each camera from its own images, or both as a rig with [[cameras]]",
        )
    ]


def _partners(
    rotation: FloatArray, centre: FloatArray, boards: IntArray, number: IntArray
) -> tuple[IntArray, IntArray]:
    """Return start and end of the views (V,) between which the boards have moved in the one way that is the most
    common, from poses (V, 3, 3) and (V, 3) mm."""
    distance = float(np.linalg.norm(centre, axis=1).mean())
    # A pose as four points: the board's origin, and the ends of axes half as long as it is far away.
    frame = 0.5 * distance * np.concatenate([np.zeros((1, 3)), np.eye(3)])
    reach = SAME_MOTION * distance * 2.0
    along = np.lexsort(centre.T)
    starts = along[np.unique(np.linspace(0, len(centre) - 1, min(MAX_STARTS, len(centre))).astype(np.int64))]
    # By how much each motion moves a frame that stands where boards usually were, as products of all ends and starts:
    # coordinates first, then start, end and point.
    typical = frame + centre.mean(axis=0)
    seen_from = (typical - centre[starts, None]) @ rotation[starts]
    moved = np.swapaxes(rotation, 0, 1).reshape(-1, 3) @ seen_from.reshape(-1, 3).T
    moved = moved.reshape(3, len(centre), len(starts), len(frame))
    moved += centre.T[:, :, None, None] - typical.T[:, None, None]
    chosen = (number[:, None] != number[starts]) & (boards[:, None] == boards[starts])
    chosen &= (moved * moved).sum(axis=0).max(axis=-1) > (0.5 * MIN_MOTION * reach) ** 2
    i, j = np.nonzero(chosen.T)
    moved = np.moveaxis(moved[:, j, i], 0, 1).reshape(-1, 12)
    alike = _neighbours(moved, reach) if len(moved) else np.zeros(0, np.int64)
    if alike.max(initial=0) < 2:
        # No motion comes twice.
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    near = np.linalg.norm(moved - moved[int(np.argmax(alike))], axis=1) <= reach
    best = np.flatnonzero(near)
    points = frame @ np.swapaxes(rotation, -1, -2) + centre[:, None]
    # The motion of the one that lies in the middle of those.
    middle = best[int(np.argmin(np.linalg.norm(moved[best] - np.median(moved[best], axis=0), axis=1)))]
    start, end = starts[i[middle]], j[middle]
    landed = (points - centre[start]) @ (rotation[end] @ rotation[start].T).T + centre[end]
    one, other = landed.reshape(-1, 12), points.reshape(-1, 12)
    # |a - b|^2 - |a|^2, all of them as one product.
    end = ((other**2).sum(axis=1) - 2.0 * one @ other.T).argmin(axis=1)
    found = np.flatnonzero(((one - other[end]) ** 2).sum(axis=1) < reach**2)
    found = found[(boards[found] == boards[end[found]]) & (number[found] != number[end[found]])]
    return found, end[found]


def _neighbours(points: FloatArray, reach: float) -> IntArray:
    """Return how many of the points (N, 12) lie within `reach` of each (N,), itself too."""
    i, j = close_pairs(points, reach)
    near = np.linalg.norm(points[i] - points[j], axis=1) <= reach
    return np.asarray(1 + np.bincount(np.concatenate([i[near], j[near]]), minlength=len(points)))
