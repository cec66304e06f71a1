"""Whether images are of several cameras on one mount, by the boards in them: between two such cameras the board moves
in the same way at every moment."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from rigkit.calibration.result import Calibration
from rigkit.calibration.rig.joint import early_disagreement
from rigkit.calibration.rig.views.frames import mounts_of
from rigkit.calibration.rig.views.mispaired import typical_px
from rigkit.calibration.rig.views.observations import FrameObservations, RigViews, frame_observations
from rigkit.core.boards import Board
from rigkit.core.errors import InputError
from rigkit.core.processes import in_threads
from rigkit.core.progress import Progress
from rigkit.io.corners.corner_cache import FoundCorners
from rigkit.io.manifests.rig_session import RigSession, frames_of_images
from rigkit.io.manifests.session import Session
from rigkit.io.media.images import images_below
from rigkit.workflows.inputs.corners import (
    FirstCheck,
    SessionCorners,
    first_calibration,
    found_in,
    named_images,
    session_views,
)
from rigkit.workflows.inputs.folder_session import (
    ImagesByCamera,
    cameras_in,
    images_of_camera,
    images_of_layout,
)
from rigkit.workflows.inputs.layouts import MIN_MOMENTS, CameraLayout, layout_by_names, layouts_of

_log = logging.getLogger(__name__)

MAX_MOMENTS = 12
"""Number of moments whose images are looked at."""
TOGETHER = 0.05
"""Distance between the cameras' views of a board, where one mount fits best, over that with moments exchanged, up to
which they are of one moment. REAL: 0.001 for the pairs of bouguet-stereo and bumblebee2, 0.86 and more for images of
one camera, side by side or by halves. SIMULATED: 0.17 and more for a board that one camera sees twice at the same
tilts, repeated to 3 degrees and 10 mm. A robot that repeats them exactly looks like a rig."""
MIN_CAMERA_MOTION = 0.02
"""Distance of two cameras, as a part of that of the boards, or angle of their axes; less is one camera that took
everything twice, or whose images were rotated."""


def cameras_by_name(folders: Sequence[Path], count: int | None = None) -> dict[str, list[tuple[Path, str]]] | None:
    """Return the images of every camera as `cameras_in` does; None where boards have to decide (`cameras_seen`)."""
    try:
        found = cameras_in(folders, count)
    except InputError:
        if count is not None or len(folders) > 1:
            raise
        return None
    decided = count is not None or len(folders) > 1 or len(found) > 1
    return found if decided or not layouts_of(images_below(folders[0])) else None


def cameras_seen(
    folders: Sequence[Path], boards: Sequence[Board], path: Path, progress: Progress
) -> tuple[dict[str, list[tuple[Path, str]]], dict[Path, FoundCorners]]:
    """Return the images of every camera as `cameras_in` does, and the corners found to decide; where the structure of
    names allows several cameras, but no known words say so, boards decide. Raises InputError as `cameras_in`; `path` is
    that of the session to come."""
    corners: dict[Path, FoundCorners] = {}
    try:
        found, doubt = cameras_in(folders), None
    except InputError as error:
        found, doubt = {}, error
    if len(folders) > 1 or len(found) > 1:
        if len(folders) == 1:
            _log.info(
                f"by names the images are of the cameras {', '.join(found)}; --cameras 1 takes them as one camera's"
            )
        return (found if doubt is None else cameras_in(folders)), corners
    images = images_below(folders[0])
    layouts = layouts_of(images)
    for layout in layouts:
        if on_one_mount(layout, boards, path, corners, progress):
            _log.info(f"by names and boards the images are of {layout}; --cameras 1 takes them as one camera's")
            return images_of_layout(layout), corners
    named = " or ".join(f"{layout} (--cameras {len(layout.cameras)})" for layout in layouts)
    if doubt is not None and not images:
        raise doubt
    if doubt is not None:
        shown = f"; by their names the images may be of {named}, but boards do not move alike there" if named else ""
        raise InputError(f"{doubt}; if all are of one camera: --cameras 1{shown}") from doubt
    if layouts:
        _log.info(f"the images may be of {named} by their names; by the boards they are one camera's")
    return found, corners


def moments_by_order(
    cameras: ImagesByCamera,
    boards: Sequence[Board],
    path: Path,
    corners: dict[Path, FoundCorners],
    progress: Progress,
) -> bool:
    """Return whether images are of one moment by their order: as many of each camera, where boards move alike (see
    `on_one_mount`), but names say no moments (DSC_1001.jpg, photo 37.jpg), or only for some images and boards do not
    move alike by these (the counters of two cameras, DSC_1001 to DSC_1013 and DSC_1006 to DSC_1018)."""
    images = {name: images_of_camera(patterns) for name, patterns in cameras.items()}
    if len(images) < 2 or len({len(own) for own in images.values()}) > 1:
        return False
    count = len(next(iter(images.values())))
    named = layout_by_names(images)
    if named is not None and (len(named.shared) == count or on_one_mount(named, boards, path, corners, progress)):
        return False
    ordered = {name: {f"{k:04d}": image for k, image in enumerate(own)} for name, own in images.items()}
    layout = CameraLayout(ordered, tuple(next(iter(ordered.values()))))
    if count < MIN_MOMENTS:
        return False
    if not on_one_mount(layout, boards, path, corners, progress):
        if named is None:
            _log.info("nor does the order of the images say it: boards do not move alike by it")
        return False
    _log.info("names do not say which images are of one moment: their order does, as boards move alike by it")
    return True


def on_one_mount(
    layout: CameraLayout, boards: Sequence[Board], path: Path, corners: dict[Path, FoundCorners], progress: Progress
) -> bool | None:
    """Return whether the images of a layout are of cameras on one mount, by up to MAX_MOMENTS moments; None where
    boards do not tell. `path` is that of the session to come; the corners of the images are added to `corners`."""
    at = np.unique(np.linspace(0, len(layout.shared) - 1, MAX_MOMENTS).round().astype(np.int64))
    moments = [layout.shared[k] for k in at]
    seen, single = list[FrameObservations](), list[Calibration]()
    for name, own in layout.cameras.items():
        images = tuple(own[moment] for moment in moments)
        session = Session(
            path=path,
            images=images,
            boards=tuple(boards),
            model="auto",
            degree=None,
            board_shape="flat",
            camera=name,
        )
        _look(session, corners, progress)
        found = {name: corners[image] for name, image in named_images(session).items() if image in corners}
        calibration = first_calibration(session, found)
        if calibration is None:
            return None
        moment_of = dict(zip(named_images(session), moments, strict=True))
        seen.append(_observations(session, found, calibration, moment_of))
        single.append(calibration)
    return _move_alike(RigViews(list(layout.cameras), seen, tuple(single), {}))


def check_of_moments(session: RigSession) -> FirstCheck:
    """Return a function for the corners and the first calibration of one camera of a rig after the other. It warns as
    soon as cameras seem not to have been on one mount at the same moments: the calibration refuses these in the end
    only."""
    images = {name: list(named_images(own)) for name, own in session.cameras.items()}
    frames = frames_of_images(images, session.frames)
    names, seen, single, warned = list[str](), list[FrameObservations](), list[Calibration](), list[str]()

    def check(own: Session, found: Mapping[str, FoundCorners], calibration: Calibration) -> None:
        name = own.camera or ""
        names.append(name)
        seen.append(_observations(own, found, calibration, frames[name]))
        single.append(calibration)
        words = None if len(seen) < 2 else early_disagreement(RigViews(names, seen, tuple(single), {}))
        if words is not None and not warned:
            warned.append(words)
            _log.warning(f"as it seems so far, {words}; the calibration goes on and will tell")

    return check


def _observations(
    session: Session, found: Mapping[str, FoundCorners], calibration: Calibration, moment_of: Mapping[str, str]
) -> FrameObservations:
    """Return the observations of a camera by moment, from its corners and its calibration."""
    views, _, _ = session_views(session, SessionCorners(found=found, unreadable={}, source=""))
    return frame_observations([(moment_of[view.image], view) for view in views], calibration)


def _look(session: Session, corners: dict[Path, FoundCorners], progress: Progress) -> None:
    """Add the corners of those images of a session to `corners` that can be read and are not there."""

    def corners_of(image: Path) -> FoundCorners | None:
        try:
            return found_in(image, session)
        except InputError:
            return None

    images = [image for image in session.images if image not in corners]
    for k, (image, found) in enumerate(zip(images, in_threads(corners_of, images), strict=True), start=1):
        progress(f"first corners of {session.camera}", k, len(images))
        if found is not None:
            corners[image] = found


def _move_alike(views: RigViews) -> bool | None:
    """Return whether boards move in the same way between the cameras at all moments; None without enough of them."""
    try:
        mounts, _ = mounts_of(views)
    except InputError:
        return None
    together = typical_px(views)
    others = [typical_px(_later(views, step)) for step in range(1, len({frame for frame, _ in views.seen[0]}))]
    exchanged = float(np.median([px for px in others if np.isfinite(px)] or [np.inf]))
    if not np.isfinite(together) or not np.isfinite(exchanged):
        return None
    distance = np.median([np.linalg.norm(e.cam_from_board.translation_mm) for e in views.seen[0].values()])
    axes = [np.arccos(np.clip(m.rotation[2, 2], -1.0, 1.0)) for m in mounts[1:]]
    moved = [max(axis, np.linalg.norm(m.translation_mm) / distance) for axis, m in zip(axes, mounts[1:], strict=True)]
    return together <= TOGETHER * exchanged and min(moved) > MIN_CAMERA_MOTION


def _later(views: RigViews, step: int) -> RigViews:
    """Return the views with the moments of each camera `step` later than those of the camera before, in a circle."""
    order = sorted({frame for own in views.seen for frame, _ in own})
    for k, own in enumerate(views.seen):
        to = {frame: order[(n + k * step) % len(order)] for n, frame in enumerate(order)}
        views = views.with_camera(
            k, {(to[f], b): replace(e, frame=to[f], key=(to[f], e.key[1])) for (f, b), e in own.items()}
        )
    return views
