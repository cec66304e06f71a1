"""Detection of fresh images that some program rotated or mirrored: the calibration holds once the flip is undone.

Otherwise such images would mean that the principal point moved to the other side of the image centre, which no lens
does, or, for a rig, would have no explanation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rigkit.calibration.views.flips import FLIP_SIGNS, Flip
from rigkit.cameras.base import Camera, image_center
from rigkit.cameras.board_pose import cam_from_seen_board
from rigkit.core.arrays import Pixels, Points
from rigkit.core.detections import BoardView, grid_turned
from rigkit.core.errors import DegenerateError, InputError
from rigkit.geometry.rigid3 import Rigid3
from rigkit.validation.monitoring.evidence import FreshView, Monitored, evidence_of
from rigkit.validation.monitoring.verdict import check_views, exceeds_expected, unchanged_px

MIN_SHARE_FLIPPED = 0.01
"""Smallest displacement of the principal point by a flip, of the longer side: a knock could cause a smaller one. REAL
lenses are 0.1 to 3.5 % off centre (camodocal-fisheye, bouguet-stereo), and a flip doubles that."""


def flipped_pictures(monitored: Monitored, views: Sequence[FreshView]) -> str:
    """Return in words how the images must have been flipped, for a rig also of which camera, if they fit after undoing
    it; joined by "or" where several flips fit alike. "" where none fits, or the flip is too small to detect."""
    count = len(monitored.cameras)
    if count > 1:
        # For a symmetric rig, mirroring the images of one camera is equivalent to mirroring those of the other.
        one = [
            f"those of '{name}' {flip}"
            for c, name in enumerate(monitored.names)
            for flip in _fitting_flips(monitored, views, (c,))
        ]
        if one:
            return " or ".join(one)
    return " or ".join(_fitting_flips(monitored, views, tuple(range(count))))


def _fitting_flips(monitored: Monitored, views: Sequence[FreshView], which: tuple[int, ...]) -> list[str]:
    """Return the flips after undoing which the images of some cameras fit, in words."""
    cameras = [monitored.cameras[c] for c in which]
    # With another camera that sees the same board, a flip cannot be confused with a knock: the board's poses differ.
    whose = {frame: {v.camera for v in views if v.frame == frame} for frame in {v.frame for v in views}}
    together = any(len(seen) > 1 and not seen.isdisjoint(which) for seen in whose.values())
    fit = []
    for words, signs in FLIP_SIGNS.items():
        if not together and max(_moved(camera, signs) for camera in cameras) < MIN_SHARE_FLIPPED:
            continue
        # The colours of a mirrored board's ends make its columns or its rows count backwards.
        ways = [Flip(signs, backwards) for backwards in ((0, 1) if np.prod(signs) < 0.0 else (None,))]
        if any(_fits(monitored, _all_unflipped(monitored, views, which, flip)) for flip in ways):
            fit.append(words)
    return fit


def _moved(camera: Camera, signs: tuple[float, float]) -> float:
    """Return the displacement of the principal point by a flip, as a part of the longer side."""
    off = np.array(camera.size_px) - 1.0 - 2.0 * camera.axis_px
    return float(np.linalg.norm(np.where(np.array(signs) < 0.0, off, 0.0))) / max(camera.size_px)


def _all_unflipped(
    monitored: Monitored, views: Sequence[FreshView], which: tuple[int, ...], flip: Flip
) -> list[FreshView]:
    """Return all views with the flip of some cameras undone; their boards are numbered as other cameras number them."""
    out = [view for view in views if view.camera not in which]
    for view in views:
        if view.camera in which:
            middle = image_center(monitored.cameras[view.camera].size_px)
            put = replace(view, view=flip.view(view.view, middle))
            out.append(consistently_numbered(monitored, put, out))
    return out


def consistently_numbered(monitored: Monitored, fresh: FreshView, before: Sequence[FreshView]) -> FreshView:
    """Return a view of a rotationally symmetric board, numbered from the same end as by another camera, or else from
    that which fits the board's calibrated shape."""
    view, c = fresh.view, fresh.camera
    name = view.board.board_id
    same = [v for v in before if v.frame == fresh.frame and v.view.board.board_id == name and v.camera != c]
    if not view.board.looks_same_turned:
        return fresh
    if not same:
        return _numbered_as_calibrated(monitored, fresh)
    first = same[0]
    try:
        pose = cam_from_seen_board(monitored.cameras[first.camera], first.view.pixels, first.view.points())
    except (InputError, DegenerateError):
        return fresh
    here = monitored.cam_from_rig[c] @ monitored.cam_from_rig[first.camera].inverse() @ pose

    def distance_px(one: BoardView) -> float:
        return _distance_px(monitored.cameras[c], here, one.pixels, one.points())

    return min(fresh, _from_the_other_end(fresh), key=lambda one: distance_px(one.view))


def _numbered_as_calibrated(monitored: Monitored, fresh: FreshView) -> FreshView:
    """Return a view of a rotationally symmetric board from the end from which its calibrated shape fits better."""
    board, camera = fresh.view.board, monitored.cameras[fresh.camera]
    shape = monitored.boards_mm.get(board.board_id)
    if shape is None or len(shape) != board.corner_count:
        return fresh

    def distance_px(one: FreshView) -> float:
        points = shape[one.view.grid @ np.array([1, board.size[0]])]
        pose = cam_from_seen_board(camera, one.view.pixels, points)
        return _distance_px(camera, pose, one.view.pixels, points)

    try:
        return min(fresh, _from_the_other_end(fresh), key=distance_px)
    except (InputError, DegenerateError):
        return fresh


def _from_the_other_end(fresh: FreshView) -> FreshView:
    return replace(fresh, view=replace(fresh.view, grid=grid_turned(fresh.view.grid, fresh.view.board.size, 2)))


def _distance_px(camera: Camera, pose: Rigid3, seen: Pixels, points_mm: Points) -> float:
    """Return the median distance of pixels (N, 2) from the projections of their points (N, 3)."""
    pixels, valid = camera.project(pose.apply(points_mm))
    return float(np.median(np.linalg.norm(pixels - seen, axis=1)[valid])) if valid.any() else np.inf


def _fits(monitored: Monitored, views: Sequence[FreshView]) -> bool:
    try:
        evidence = evidence_of(monitored, views)
        # No change is looked for in views that do not fit as they are: that takes most of the time.
        fit = not exceeds_expected(evidence.rms_px, unchanged_px(monitored, evidence))
        return fit and check_views(monitored, views).holds
    except (DegenerateError, InputError):
        return False
