"""Copies of a board in fresh images of a rig, matched between its cameras by their arrangement."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np

from rigkit.calibration.rig.views.copies import with_copies_matched
from rigkit.calibration.rig.views.observations import FrameObservations, Observation, RigViews
from rigkit.cameras.board_pose import cam_from_seen_board
from rigkit.core.errors import DegenerateError
from rigkit.validation.monitoring.evidence import FreshView, Monitored


def with_copies_shared(monitored: Monitored, views: Sequence[FreshView]) -> list[FreshView]:
    """Return the views with copies that two cameras see in a frame under one name, as `with_copies_matched` does; the
    mounts are what is checked, so that they are not used."""
    unmarked = [view for view in views if not view.view.board.identified]
    several = Counter((view.frame, view.camera, view.view.board.size) for view in unmarked)
    if not monitored.is_rig or max(several.values(), default=0) < 2:
        return list(views)
    seen: list[FrameObservations] = [{} for _ in monitored.cameras]
    others: list[FreshView] = []
    for fresh in views:
        view = fresh.view
        key = (fresh.frame, view.board.board_id)
        try:
            pose = cam_from_seen_board(monitored.cameras[fresh.camera], view.pixels, view.points())
        except DegenerateError:
            others.append(fresh)
            continue
        count = len(view.grid)
        kept = np.ones(count, dtype=bool)
        seen[fresh.camera][key] = Observation(view, kept, pose, np.zeros(count), fresh.frame, key)
    matched = with_copies_matched(RigViews(monitored.names, seen, (), {}))
    return [*others, *(FreshView(e.frame, c, e.view) for c, own in enumerate(matched.seen) for e in own.values())]
