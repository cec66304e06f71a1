"""Mix-ups of a rig's image files: duplicates, exchanged cameras, frames off by one, rotated or mirrored images; and a
camera that slipped.

Cameras that disagree on the pose of a board are usually not synchronous. Mix-ups of files have the same effect, but can
be corrected without new images:

- the same images under the names of two cameras, or two cameras exchanged in a frame
- an image that is missing in one camera, so that all later ones are off by one frame
- images rotated by 180 degrees by a program
- mirrored images of one camera, which a chessboard does not show
- one image of a camera under the names of two frames

Each is tried, and reported if it resolves the disagreement.

Where a camera slipped between two frames, the mounts before and from then on differ: the frames of each part agree on
the boards' poses with mounts of their own, and those of the whole do not. Frames that are not simultaneous disagree in
each part as well.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from rigkit.calibration.rig.solving.state import Key
from rigkit.calibration.rig.views.disagree import shared_keys
from rigkit.calibration.rig.views.frames import mounts_of, view_distances_px, with_common_orientation
from rigkit.calibration.rig.views.observations import FrameObservations, RigViews
from rigkit.calibration.views.flips import FLIP_SIGNS, Flip
from rigkit.calibration.views.repeats import close_pairs, places_of
from rigkit.cameras.base import Camera
from rigkit.core.arrays import FloatArray, spread_indices
from rigkit.core.detections import BoardView
from rigkit.core.errors import InputError
from rigkit.core.findings import Finding
from rigkit.core.identifiers import natural_key
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import rotation_angle

SAME_IMAGE_PX = 0.1
"""RMS difference of corners up to which two images are copies, perhaps compressed again: two cameras have at least
different noise."""
MOVED_BOARD_PX = 1.0
"""RMS difference of corners from which a board was elsewhere."""
MAX_LEFT_OF_DISTANCE = 0.1
"""Distance between views after correcting a mix-up, over that before, up to which it explains the disagreement. Before,
it is the movement of the boards between frames, a hundred pixels and more; after, the error of lenses calibrated from
mixed images: 2 to 8 px for exchanged images of bouguet-stereo (REAL)."""
FRAME_STEPS = (1, -1, 2, -2)
"""Numbers of frames that a camera may be off by."""
MIN_FRAMES_CORRECTED = 3
"""Fewest frames that must agree after renumbering: the six parameters of a mount fit one frame exactly."""
MIN_SHARE_CORRECTED = 0.6
"""Part of the disagreeing frames that must agree then: some may be bad for another reason."""
NAMED = 3
"""Number of frames that a message lists."""
MIN_FRAMES_OF_PART = 4
"""Fewest frames before and after: a mount, of six parameters, fits one frame exactly and two nearly."""
MAX_LEFT_OF_SQUARES = 0.2
"""Sum of squared distances between views with two mounts, over that with one, up to which a camera slipped. The best of
all splits of 8 to 20 frames whose boards moved between the exposures leaves 0.73 and more (60 SIMULATED rigs), a camera
that is turned by half a degree half way 0.05 and 0.10 (REAL, bumblebee2 and bouguet)."""
MAX_SPLITS = 40
"""Number of splits tried, spread over the frames."""


def _all(frames: int) -> str:
    return "their only frame" if frames == 1 else f"all {frames} frames"


def duplicate_images(views: Mapping[str, Sequence[tuple[str, BoardView]]]) -> list[Finding]:
    """Return a finding for every two cameras with copies of one image in some frames, and for every two frames with
    copies of one camera's image whose other cameras saw the board elsewhere; `views` are (frame, view) by camera.

    Raises InputError where two cameras have copies in all frames.
    """
    out: list[Finding] = []
    shown = {name: {(frame, view.board.board_id): view for frame, view in own} for name, own in views.items()}
    centres = {name: _centres(own) for name, own in shown.items()}
    for (a, own), (b, other) in combinations(shown.items(), 2):
        shared = own.keys() & other.keys()
        near = (key for key in shared if math.dist(centres[a][key], centres[b][key]) <= SAME_IMAGE_PX)
        frames = _in_order({key[0] for key in near if _same_image(own[key], other[key])})
        if not frames:
            continue
        total = len({frame for frame, _ in shared})
        if len(frames) == total:
            raise InputError(
                f"rig: cameras '{a}' and '{b}' have identical images in {_all(total)}; give each camera its own images"
            )
        out.append(
            Finding.bad(
                f"cameras '{a}' and '{b}' have identical images in {_frames_in_words(frames)} of {total} frames",
                "give each camera its own images, and calibrate again",
            )
        )
    return [*out, *_repeated_images(shown, centres)]


def _repeated_images(
    shown: Mapping[str, Mapping[Key, BoardView]], centres: Mapping[str, Mapping[Key, FloatArray]]
) -> Iterator[Finding]:
    """Yield a finding for every two frames with copies of one camera's image; a board that nobody moved looks the same
    to all cameras. `centres` are those of the views."""
    for name, own in shown.items():
        others = [other for camera, other in shown.items() if camera != name]
        keys = list(own)
        if len(keys) < 2:
            continue
        for i, j in zip(*close_pairs(np.stack(list(centres[name].values())), SAME_IMAGE_PX), strict=True):
            one, again = keys[i], keys[j]
            if one[1] != again[1] or not _same_image(own[one], own[again]):
                continue
            both = [other for other in others if one in other and again in other]
            if any(not _same_image(other[one], other[again], MOVED_BOARD_PX) for other in both):
                yield Finding.bad(
                    f"the images of '{name}' in frames '{one[0]}' and '{again[0]}' are copies of one image, while the "
                    "board moved for another camera",
                    "replace the wrong one or leave its frame out, and calibrate again",
                )


def mixups_of_frames(views: RigViews, mounts: Sequence[Rigid3], left_out: Iterable[Key]) -> list[Finding]:
    """Return findings on the frames `left_out` that agree with the `mounts` of the others after exchanging the images
    of two cameras, rotating those of one, or renumbering them. `views` include the frames left out.
    """
    frames, names = {frame for frame, _ in left_out}, views.names
    those = views.with_seen([_of_frames(one, frames) for one in views.seen])
    own, now = those.seen, _by_frame(_distances_px(those, mounts))
    tried: list[tuple[RigViews, str, str, str]] = []
    for i, j in combinations(range(len(own)), 2):
        trial = those.with_camera(i, own[j]).with_camera(j, own[i])
        tried.append(
            (trial, f"'{names[i]}' and '{names[j]}' are exchanged", "exchanging them back", "correct their names")
        )
    for k, camera in enumerate(views.cameras):
        trial = those.with_camera(k, _flipped(own[k], camera, Flip(FLIP_SIGNS["rotated by 180 degrees"])))
        remedy = "use the image files as the camera wrote them"
        tried.append((trial, f"'{names[k]}' are rotated by 180 degrees", "rotating them back", remedy))
    out = []
    for trial, what, mended, remedy in tried:
        if right := _frames_corrected(now, _by_frame(_distances_px(trial, mounts))):
            agree = "makes the cameras agree on the boards' poses"
            message = f"the images of {what} in {_frames_in_words(right)}: {mended} {agree}"
            out.append(Finding.bad(message, f"{remedy}, and calibrate again"))
    return [*out, *_offset_of_frames(views, mounts, now)]


def _offset_of_frames(views: RigViews, mounts: Sequence[Rigid3], now: Mapping[str, float]) -> list[Finding]:
    """Return a finding where frames left out, with distances `now`, agree with frames before or after them."""
    if not now:
        return []
    seen = views.seen
    # The image of another camera may belong to a frame that only one camera has.
    agree = {frame for frame, _ in shared_keys(seen)} - now.keys()
    typical = dict.fromkeys(_frames_of(seen), float(np.median(list(now.values()))))
    for k in range(1, len(seen)):
        for step in FRAME_STEPS:
            trial = [_of_frames(own, typical.keys() - agree) for own in seen]
            trial[k] = _of_frames(_with_offset(seen, k, step), typical.keys() - agree)
            right = _frames_corrected(typical, _by_frame(_distances_px(views.with_seen(trial), mounts)))
            if len(right) >= max(MIN_FRAMES_CORRECTED, MIN_SHARE_CORRECTED * len(now)):
                moments = _in_order(typical)
                called = [moments[moments.index(frame) + step] for frame in right]
                where = f"'{views.names[k]}' in {_frames_in_words(called)}"
                message = (
                    f"the images of {where} belong to {_offset_in_words(step)}: with that shift the cameras agree on "
                    "the boards' poses; an image is missing, or was taken twice"
                )
                return [Finding.bad(message, "give simultaneous images the same number, and calibrate again")]
    return []


def mixup_of_all_frames(views: RigViews) -> Finding | None:
    """Return a finding on the mix-up whose correction makes the frames agree, if most disagree; None if there is
    none."""
    names, seen = views.names, views.seen
    limit = MAX_LEFT_OF_DISTANCE * typical_px(views)
    for k, camera in enumerate(views.cameras):
        for step in FRAME_STEPS if k else ():
            if typical_px(views.with_camera(k, _with_offset(seen, k, step))) <= limit:
                return Finding.bad(
                    f"the images of '{names[k]}' belong to {_offset_in_words(step)} in all frames: with that shift the "
                    "cameras agree; an image is missing, or the cameras did not start together",
                    "give simultaneous images the same number",
                )
        for backwards in (0, 1):
            mirrored = _flipped(seen[k], camera, Flip(FLIP_SIGNS["mirrored left to right"], backwards))
            if typical_px(views.with_camera(k, mirrored)) <= limit:
                # Of two cameras either may be the mirrored one.
                who = f"'{names[k]}'" if len(seen) > 2 else f"'{names[0]}' or those of '{names[1]}'"
                return Finding.bad(
                    f"the images of {who} are mirrored: undoing that makes the cameras agree",
                    "use the image files as the camera wrote them",
                )
        turned = views.with_camera(k, _flipped(seen[k], camera, Flip(FLIP_SIGNS["rotated by 180 degrees"])))
        if sides := _frames_to_change(views, turned, limit):
            return Finding.bad(
                f"the images of '{names[k]}' are rotated by 180 degrees in {_frames_in_words(sides)}, "
                "or in all others: undoing that makes the cameras agree",
                "use the image files as the camera wrote them",
            )
    for i, j in combinations(range(len(seen)), 2):
        exchanged = views.with_camera(i, seen[j]).with_camera(j, seen[i])
        if sides := _frames_to_change(views, exchanged, limit):
            return Finding.bad(
                f"the images of '{names[i]}' and '{names[j]}' are exchanged in {_frames_in_words(sides)}, or in all "
                "others: undoing that makes the cameras agree",
                "correct their names",
            )
    return None


def typical_px(views: RigViews) -> float:
    """Return the median distance between views, px, with the mounts from `mounts_of`; infinite if there are none."""
    try:
        mounts, _ = mounts_of(views)
    except InputError:
        return np.inf
    off = _distances_px(views, mounts)
    return float(np.median(list(off.values()))) if len(_by_frame(off)) >= MIN_FRAMES_CORRECTED else np.inf


def _frames_to_change(views: RigViews, changed: RigViews, limit_px: float) -> list[str]:
    """Return the frames, in order, with the views `changed` of which all frames agree within `limit_px`; none if there
    are none, or all."""
    every = _frames_of(views.seen)
    for sides in _frames_better_changed(views, changed):
        if sides and sides != every:
            some = [
                _of_frames(own, every - sides) | _of_frames(other, sides)
                for own, other in zip(views.seen, changed.seen, strict=True)
            ]
            if typical_px(views.with_seen(some)) <= limit_px:
                return _in_order(sides)
    return []


def _frames_better_changed(views: RigViews, trial: RigViews) -> Iterator[set[str]]:
    """Yield for each frame, with the mounts that it alone gives, the frames in which cameras agree better in the
    `trial`."""
    for frame in _in_order(_frames_of(views.seen)):
        try:
            mounts, _ = mounts_of(views.with_seen([_of_frames(own, {frame}) for own in views.seen]))
        except InputError:
            continue
        now, then = (_by_frame(_distances_px(one, mounts)) for one in (views, trial))
        yield {name for name, value in then.items() if value < now[name]}


def _distances_px(views: RigViews, mounts: Sequence[Rigid3]) -> dict[Key, float]:
    return view_distances_px(with_common_orientation(views, mounts), mounts)


def _by_frame(off_px: Mapping[Key, float]) -> dict[str, float]:
    """Return the distance between views in each frame, of the worst board."""
    out: dict[str, float] = {}
    for (frame, _), value in off_px.items():
        out[frame] = max(out.get(frame, 0.0), value)
    return out


def _frames_corrected(now: Mapping[str, float], then: Mapping[str, float]) -> list[str]:
    """Return the frames in which the distance `then` is at most MAX_LEFT_OF_DISTANCE times that `now`."""
    return _in_order(frame for frame, value in then.items() if value <= MAX_LEFT_OF_DISTANCE * now.get(frame, 0.0))


def _frames_of(seen: Sequence[FrameObservations]) -> set[str]:
    return {frame for own in seen for frame, _ in own}


def _of_frames(own: FrameObservations, frames: Iterable[str]) -> FrameObservations:
    return {key: entry for key, entry in own.items() if key[0] in frames}


def _with_offset(seen: Sequence[FrameObservations], k: int, step: int) -> FrameObservations:
    """Return the observations of camera k with every image assigned to the frame `step` frames before."""
    frames = _in_order(_frames_of(seen))
    before = {frames[n]: frames[n - step] for n in range(len(frames)) if 0 <= n - step < len(frames)}
    return {
        (before[frame], board): replace(entry, frame=before[frame], key=(before[frame], entry.key[1]))
        for (frame, board), entry in seen[k].items()
        if frame in before
    }


def _flipped(own: FrameObservations, camera: Camera, flip: Flip) -> FrameObservations:
    """Return a camera's observations in images flipped about the optical axis."""
    return {
        key: replace(
            entry,
            view=flip.view(entry.view, camera.axis_px),
            cam_from_board=flip.pose(entry.cam_from_board, entry.view.board),
        )
        for key, entry in own.items()
    }


def _centres(own: Mapping[Key, BoardView]) -> dict[Key, FloatArray]:
    """Return the mean (2,) of each view's corners: those of copies are no further apart than their corners."""
    return dict(zip(own, places_of([view.pixels for view in own.values()])[:, 1:3], strict=True)) if own else {}


def _same_image(one: BoardView, other: BoardView, within_px: float = SAME_IMAGE_PX) -> bool:
    """Return whether two views have the same corners at the same pixels."""
    if one.grid.shape != other.grid.shape or (one.grid != other.grid).any():
        return False
    return bool(np.sqrt(np.mean(np.sum((one.pixels - other.pixels) ** 2, axis=1))) <= within_px)


def _offset_in_words(step: int) -> str:
    count = "one frame" if abs(step) == 1 else f"{abs(step)} frames"
    return f"{count} {'earlier' if step > 0 else 'later'}"


def _in_order(frames: Iterable[str]) -> list[str]:
    return sorted(frames, key=natural_key)


def _frames_in_words(frames: Sequence[str]) -> str:
    if len(frames) == 1:
        return f"frame '{frames[0]}'"
    more = f" and {len(frames) - NAMED} more" if len(frames) > NAMED else ""
    return f"frames {', '.join(repr(frame) for frame in frames[:NAMED])}{more}"


def slipped_camera(views: RigViews) -> Finding | None:
    """Return a finding if the frames before and from one on, in the order of their names, have different mounts."""
    frames = _in_order(_frames_of(views.seen))
    splits = np.arange(MIN_FRAMES_OF_PART, len(frames) - MIN_FRAMES_OF_PART + 1)
    if not len(splits) or (whole := _solved(views, frames)) is None:
        return None
    found = []
    for at in splits[spread_indices(len(splits), MAX_SPLITS)].tolist():
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
    own = views.with_seen([_of_frames(seen, set(frames)) for seen in views.seen])
    try:
        mounts, _ = mounts_of(own)
    except InputError:
        return None
    return mounts, _distances_px(own, mounts)


def _left(both: dict[Key, float], whole: dict[Key, float]) -> float:
    """Return the sum of squared distances with two mounts over that with one, of the targets that have both."""
    known = [key for key in both.keys() & whole.keys() if np.isfinite([both[key], whole[key]]).all()]
    squares = sum(whole[key] ** 2 for key in known)
    return sum(both[key] ** 2 for key in known) / squares if squares > 0.0 else np.inf
