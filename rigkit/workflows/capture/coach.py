"""A guided capture: a session's folder, the coach that fills it, and its page."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rigkit.cameras.base import Camera
from rigkit.coach.coach import Coach, Image, Take, ignored
from rigkit.coach.full_rig_calibration import remaining_errors_of_rig
from rigkit.coach.guide import GuideOptions, errors_in_words
from rigkit.coach.keeper import Keeper, folder_of
from rigkit.coach.look import FrameObservation
from rigkit.coach.server import LOCAL, address_in_network, coach_app, new_token, serve
from rigkit.coach.sources import Frame, device_frames, frames_of_folders
from rigkit.core.errors import DegenerateError, InputError, RigkitError
from rigkit.core.findings import Severity, worst
from rigkit.core.processes import worker_pool
from rigkit.core.progress import Progress, silent
from rigkit.geometry.rigid3 import Rigid3
from rigkit.io.disk.writing import ensure_folder_writable
from rigkit.io.manifests.rig_session import ONE
from rigkit.io.manifests.session import SESSION_NAME
from rigkit.io.media.video import Video
from rigkit.planning.goal import Goal
from rigkit.planning.information import check_field
from rigkit.workflows.calibration.calibrate import SessionCalibration
from rigkit.workflows.calibration.calibrate_any import calibrate_session_file
from rigkit.workflows.calibration.next_pictures import length_goals
from rigkit.workflows.inputs.folder_session import session_of_future_images
from rigkit.workflows.inputs.frames import moments_of_videos, numbers_of_moments, timestamps_next_to
from rigkit.workflows.moments import warn_of_several_cameras
from rigkit.workflows.options.cameras import Cache, CalibrateOptions
from rigkit.workflows.options.coach import CoachOptions

LOCALHOST, EVERYWHERE = "127.0.0.1", "0.0.0.0"
LAN_WARNING = (
    "--lan: anyone in this network who has the address sees the images, unencrypted; keep the address secret, and do "
    "not use it in a public network"
)
_log = logging.getLogger(__name__)


def open_coach(
    options: CoachOptions, report: Callable[[str], None] = ignored, executor: Executor | None = None
) -> Coach:
    """Return the coach of a session's folder, which is made, or gone on with; `report` and `executor` as in `Coach`.

    Raises InputError where the folder holds another session, or cannot be one.
    """
    check_field(options.guide.hfov_deg)
    ensure_folder_writable(options.folder)
    options.folder.mkdir(parents=True, exist_ok=True)
    names = _names(options)
    patterns = {name: f"{folder_of(name, len(names))}/*.png" for name in names}
    wanted = session_of_future_images(patterns, options.boards, options.folder)
    keeper = Keeper(options.folder, wanted, names)
    guide, length = options.guide, options.length
    if length is not None:

        def measured(cameras: Sequence[Camera], cam_from_rig: Sequence[Rigid3]) -> Sequence[Goal]:
            return length_goals(cameras, cam_from_rig, length)

        guide = replace(guide, measured=measured)
    return Coach(guide, keeper, lambda: finished_words(options.folder, guide), report, executor)


def _names(options: CoachOptions) -> tuple[str, ...]:
    """Return what the cameras are called."""
    names = [path.resolve().name for path in options.watch] + [path.stem for path in options.video]
    names = names or [f"camera{n}" for n in options.device or range(options.cameras)]
    if len(names) == 1:
        return (ONE,)
    if len(set(names)) < len(names):
        raise InputError(f"coach: folders and videos name the cameras, and two are called alike: {', '.join(names)}")
    return tuple(names)


def finished_words(folder: Path, guide: GuideOptions) -> str:
    """Calibrate the session of a folder, write the result beside it, and say what came of it, and of the goal.

    Raises as `calibrate_session_file`.
    """
    done = calibrate_session_file(
        folder / SESSION_NAME, CalibrateOptions(report=Path(), force=True, cache=Cache.UPDATE)
    )
    if isinstance(done, SessionCalibration):
        c = done.calibration
        what = f"{c.camera.model}, {guide.stated(c)}"
        return _finished(what, c.rms_px, c.heldout_rms_px, worst(c.verdicts), done.written)
    rig = done.rig
    try:
        what = errors_in_words(remaining_errors_of_rig(rig, guide))
    except DegenerateError as error:
        what = str(error)
    return _finished(what, rig.rms_px, rig.heldout_rms_px, worst(rig.verdicts), done.written)


def _finished(what: str, rms_px: float, heldout_px: float | None, verdict: Severity, written: Sequence[Path]) -> str:
    fit = f"rms {rms_px:.3f} px" if heldout_px is None else f"held-out {heldout_px:.3f} px"
    page = written[-1].name
    more = {Severity.LOOK: f"; with warnings: see {page}", Severity.BAD: f"; verdict bad: see {page}"}
    return f"Done: {what}, {fit}, {written[0].name} written{more.get(verdict, '')}"


def coach_frames(
    coach: Coach, frames: Iterator[Frame], *, photos: bool, show: Callable[[Sequence[Image]], None] = ignored
) -> None:
    """Offer frames to the coach until there are enough, or no more, or somebody finished it."""
    for images, source in frames:
        try:
            state = coach.look(images, take=Take.IF_USEFUL, photo=photos, source=source, show=show)
        except RigkitError as error:
            _log.warning("%s: %s", source or "frame", error)
            coach.say(str(error))
            continue
        if state["enough"] or coach.finished is not None:
            break


def coach_recording(
    coach: Coach,
    videos: Sequence[Path],
    *,
    show: Callable[[Sequence[Image]], None] = ignored,
    progress: Progress = silent,
) -> str:
    """Let the coach choose frames of a video, or of several that run together; return what the recording lacks, in
    words, "" where nothing.

    Raises InputError where a video cannot be read, or shows no board.
    """
    sources, boards = dict(zip(coach.keeper.names, videos, strict=True)), coach.guide.options.boards
    times = timestamps_next_to(videos)

    def report(what: str, done: int, total: int) -> None:
        coach.say(f"{what.capitalize()}: {done} of {total}")
        progress(what, done, total)

    numbers = numbers_of_moments(sources, boards, times, report)
    moments = [frames for _, frames in moments_of_videos(sources, numbers, times)]
    coach.choose([[frames[name] for name in sources] for frames in moments if len(frames) == len(sources)], show)
    guide = coach.guide
    if not guide.frames:
        return ""
    advice = guide.advise([FrameObservation(size_px=glance.size_px, view=None) for glance in guide.frames[-1]])
    more = advice.more_percent
    bring = "" if more is None else f"; two more pictures would bring {more:.0f} %"
    return "" if advice.enough else f". What it lacks: {advice.words[0].lower()}{advice.words[1:]}{bring}"


def _preview(frame: NDArray[Any]) -> bytes:
    """Return an image, of one or three channels of 8 or 16 bits, as JPEG."""
    shown = frame if frame.dtype == np.uint8 else (frame >> 8).astype(np.uint8)
    bgr = shown if shown.ndim == 2 else cv2.cvtColor(shown, cv2.COLOR_RGB2BGR)
    return bytes(cv2.imencode(".jpg", bgr)[1])


def run_coach(options: CoachOptions, announce: Callable[[str], None], progress: Progress = silent) -> None:
    """Serve the coach's page on this machine until it is stopped; `announce` is given its address, `progress` how much
    of a recording has been looked at.

    Raises InputError for a folder or source that cannot be used, InstallationError without the extra `coach`.
    """
    for path in options.video:
        with Video(path):
            pass
    frames = _frames(options)
    # Files wait while those before them are calibrated; a person does not.
    with nullcontext() if options.watch or options.video else worker_pool(1) as pool:
        _run(options, open_coach(options, announce, pool), frames, announce, progress)


def _run(
    options: CoachOptions,
    coach: Coach,
    frames: Iterator[Frame] | None,
    announce: Callable[[str], None],
    progress: Progress,
) -> None:
    token = new_token()
    host = address_in_network() if options.lan else LOCALHOST
    of_server = bool(options.video) or frames is not None
    app = coach_app(coach, token, (host, *LOCAL), camera=_where(options))
    preview: dict[int, bytes] = app.state.preview

    def show(images: Sequence[Image]) -> None:
        preview.update(enumerate(map(_preview, images)))

    def work() -> None:
        missing = ""
        try:
            if frames is None:
                missing = coach_recording(coach, options.video, show=show, progress=progress)
            else:
                coach_frames(coach, frames, photos=bool(options.watch), show=show)
            if coach.finished is None:
                coach.finish(missing)
        except RigkitError as error:
            coach.say(str(error))
            announce(str(error))

    if options.watch:
        coach.say(f"Waiting for pictures in {' and '.join(map(str, options.watch))}")
    if of_server:
        threading.Thread(target=work, daemon=True).start()
    if options.lan:
        _log.warning("%s", LAN_WARNING)

    def ready(port: int) -> None:
        _log.info("open this page in a browser; Ctrl-C ends, and the same command goes on from there")
        announce(f"http://{host}:{port}/{token}/")

    serve(app, EVERYWHERE if options.lan else LOCALHOST, options.port, ready)


def _where(options: CoachOptions) -> str:
    """Return where frames come from, as the page knows it."""
    found = {"folder": options.watch, "recording": options.video, "server": options.device}
    return next((where for where, given in found.items() if given), "page")


def _frames(options: CoachOptions) -> Iterator[Frame] | None:
    if sum(bool(source) for source in (options.watch, options.video, options.device)) > 1:
        raise InputError("coach: frames come from one place: --watch, --video or --device")
    if options.watch:
        warn_of_several_cameras(options.watch)
        return frames_of_folders(options.watch)
    return device_frames(options.device) if options.device else None
