"""A rig of which a camera slipped between two frames: the mounts before and from then on differ.

The frames of each part agree on the boards' poses with mounts of their own, and those of the whole do not. Frames that
are not simultaneous disagree in each part as well.
"""

from __future__ import annotations

import numpy as np

from rigkit.calibration.rig.solving.state import Key
from rigkit.calibration.rig.views.frames import mounts_of, view_distances_px, with_common_orientation
from rigkit.calibration.rig.views.observations import RigViews
from rigkit.core.errors import InputError
from rigkit.core.findings import Finding
from rigkit.core.identifiers import natural_key
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import rotation_angle

MIN_FRAMES_OF_PART = 4
"""Fewest frames before and after: a mount, of six parameters, fits one frame exactly and two nearly."""
MAX_LEFT_OF_SQUARES = 0.2
"""Sum of squared distances between views with two mounts, over that with one, up to which a camera slipped. The best of
all splits of 8 to 20 frames whose boards moved between the exposures leaves 0.73 and more (60 SIMULATED rigs), a camera
that is turned by half a degree half way 0.05 and 0.10 (REAL, bumblebee2 and bouguet)."""
MAX_SPLITS = 40
"""Number of splits tried, spread over the frames."""


def slipped_camera(views: RigViews) -> Finding | None:
    """Return a finding if the frames before and from one on, in the order of their names, have different mounts."""
    frames = sorted({frame for own in views.seen for frame, _ in own}, key=natural_key)
    splits = np.arange(MIN_FRAMES_OF_PART, len(frames) - MIN_FRAMES_OF_PART + 1)
    if not len(splits) or (whole := _solved(views, frames)) is None:
        return None
    found = []
    for at in splits[np.unique(np.linspace(0, len(splits) - 1, min(MAX_SPLITS, len(splits))).astype(int))].tolist():
        parts = [_solved(views, part) for part in (frames[:at], frames[at:])]
        if parts[0] is not None and parts[1] is not None:
            both = parts[0][1] | parts[1][1]
            found.append((_left(both, whole[1]), at, parts[0][0], parts[1][0]))
    left, at, before, after = min(found, key=lambda one: one[0], default=(np.inf, 0, [], []))
    if not left <= MAX_LEFT_OF_SQUARES:
        return None
    moved = [b @ a.inverse() for a, b in zip(before, after, strict=True)]
    angle = max(float(np.degrees(rotation_angle(one.rotation))) for one in moved)
    length = max(float(np.linalg.norm(b.translation_mm - a.translation_mm)) for a, b in zip(before, after, strict=True))
    who = f"camera '{views.names[1]}' or '{views.names[0]}'" if len(views.names) == 2 else "a camera"
    return Finding.bad(
        f"{who} moved on the rig before frame '{frames[at]}': the frames before it agree on the boards' poses with one "
        f"mount, those from it on with another ({angle:.2f} deg and {length:.1f} mm apart), which leaves "
        f"{100.0 * left:.0f} % of the squared disagreement",
        "fasten the cameras, and calibrate the frames before it and those from it on separately, or retake all",
    )


def _solved(views: RigViews, frames: list[str]) -> tuple[list[Rigid3], dict[Key, float]] | None:
    """Return the mounts that these frames give, and the distance between views of each target, px; None if there are
    no mounts."""
    some = set(frames)
    own = views.with_seen([{key: entry for key, entry in seen.items() if key[0] in some} for seen in views.seen])
    try:
        mounts, _ = mounts_of(own)
    except InputError:
        return None
    return mounts, view_distances_px(with_common_orientation(own, mounts), mounts)


def _left(both: dict[Key, float], whole: dict[Key, float]) -> float:
    """Return the sum of squared distances with two mounts over that with one, of the targets that have both."""
    known = [key for key in both.keys() & whole.keys() if np.isfinite([both[key], whole[key]]).all()]
    squares = sum(whole[key] ** 2 for key in known)
    return sum(both[key] ** 2 for key in known) / squares if squares > 0.0 else np.inf
