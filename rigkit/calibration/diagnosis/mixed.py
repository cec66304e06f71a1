"""Images of two cameras mixed up as those of one.

Two cameras on one mount see each board in two poses with always the same motion in between. In images of one camera no
motion between poses occurs twice, unless the board was moved by equal steps: then an image is the end of one step and
the start of the next.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from rigkit.calibration.diagnosis.two_kinds import listed
from rigkit.calibration.result import Calibration
from rigkit.calibration.views.repeats import close_pairs
from rigkit.core.arrays import FloatArray, IntArray
from rigkit.core.findings import Finding

SAME_MOTION = 0.005
"""Two motions are equal where they move the board to the same place within this part of its distance."""
MIN_MOTION = 2.0
"""A smaller multiple of that is no motion."""
MIN_PARTNERS = 4
"""Number of pairs of images with the same motion that is not chance: a motion has six parameters."""
MIN_SHARE_PAIRED = 0.5
"""Part of all images that must be in such pairs."""
MAX_SHARE_CHAINED = 0.2
"""Part of these images that may be both start and end; more is a board moved by equal steps."""
MAX_STARTS = 24
"""Number of views from which motions are tried, spread over the places of the boards, whatever their order."""


def two_cameras(calibration: Calibration, number: IntArray) -> Iterator[Finding]:
    """Yield a finding if the images are of two synchronous cameras; `number` (V,) are the `cluster_numbers` of the
    views' images."""
    views = calibration.views
    images = [view.image for view in views]
    _, first = np.unique(number, return_index=True)
    if len(first) < 2 * MIN_PARTNERS:
        return
    rotation, centre = calibration.corners.rotation, calibration.corners.translation_mm
    boards = np.unique([view.board_id for view in views], return_inverse=True)[1]
    start, end = _partners(rotation, centre, boards, number)
    if len(start) < MIN_PARTNERS:
        return
    alike = len(np.unique(number[start]))
    together = np.unique(np.concatenate([number[start], number[end]]))
    chained = np.intersect1d(number[start], number[end])
    enough = len(together) >= MIN_SHARE_PAIRED * len(first)
    of_one = list(dict.fromkeys(images[k] for k in sorted(start.tolist())))
    if alike >= MIN_PARTNERS and enough and len(chained) <= MAX_SHARE_CHAINED * len(together):
        yield Finding.bad(
            f"images of two cameras are mixed: the board moves in the same way between '{images[start[0]]}' and "
            f"'{images[end[0]]}' and in {alike - 1} other pairs of images, as in stereo pairs, of which one camera "
            f"took {listed(of_one)}",
            "calibrate each camera from its own images, or both as a rig with [[cameras]]; leave out images "
            "that a program made from others",
        )


def _partners(
    rotation: FloatArray, centre: FloatArray, boards: IntArray, number: IntArray
) -> tuple[IntArray, IntArray]:
    """Return start and end of the pairs of views with the most common motion of the board, from poses (V, 3, 3) and
    (V, 3) mm."""
    distance = float(np.linalg.norm(centre, axis=1).mean())
    # A pose as four points: the board's origin, and the ends of axes of half the distance.
    frame = 0.5 * distance * np.concatenate([np.zeros((1, 3)), np.eye(3)])
    reach = SAME_MOTION * distance * 2.0
    along = np.lexsort(centre.T)
    starts = along[np.unique(np.linspace(0, len(centre) - 1, min(MAX_STARTS, len(centre))).astype(np.int64))]
    # Displacement of a frame at the boards' mean place by each motion, as products of all ends and starts: coordinates
    # first, then start, end and point.
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
        # No motion occurs twice.
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    near = np.linalg.norm(moved - moved[int(np.argmax(alike))], axis=1) <= reach
    best = np.flatnonzero(near)
    points = frame @ np.swapaxes(rotation, -1, -2) + centre[:, None]
    # The motion closest to the median of those.
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
    """Return for each of the points (N, 12) the number within `reach` of it, (N,), itself included."""
    i, j = close_pairs(points, reach)
    near = np.linalg.norm(points[i] - points[j], axis=1) <= reach
    return np.asarray(1 + np.bincount(np.concatenate([i[near], j[near]]), minlength=len(points)))
