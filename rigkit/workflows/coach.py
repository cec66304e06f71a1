"""A guided capture: a session's folder, the coach that fills it, and its page."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2

from rigkit.coach.coach import Coach
from rigkit.coach.guide import GuideOptions
from rigkit.coach.keeper import FRAME_FOLDER, Keeper
from rigkit.coach.server import coach_app, new_token, serve
from rigkit.coach.sources import Frame, device_frames, video_frames, watched_frames
from rigkit.core.errors import InputError, RigkitError
from rigkit.core.findings import worst
from rigkit.io.session import load_session
from rigkit.workflows.calibrate import CalibrateOptions, calibrate_session
from rigkit.workflows.corners import Cache
from rigkit.workflows.folder_session import session_to_come

__all__ = ["CoachOptions", "coach_frames", "open_coach", "run_coach"]

SESSION = "session.toml"
LOCALHOST = "127.0.0.1"
_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True)
class CoachOptions:
    """Where the session goes, what is shown, and where frames come from."""

    folder: Path
    """Of the session: new, or one to go on with."""
    boards: tuple[str, ...]
    """COLUMNSxROWSxMM, or files of boards."""
    guide: GuideOptions
    watch: Path | None = None
    """Folder in which pictures appear."""
    video: Path | None = None
    device: int | None = None
    """Camera of this machine; with all three None the page's own camera is used."""
    port: int = 8137
    """0: any that is free."""


def open_coach(options: CoachOptions) -> Coach:
    """Return the coach of a session's folder, which is made, or gone on with.

    Raises InputError where the folder holds another session.
    """
    options.folder.mkdir(parents=True, exist_ok=True)
    wanted = session_to_come(f"{FRAME_FOLDER}/*.png", options.boards, options.folder)
    return Coach(options.guide, Keeper(options.folder, dict(wanted.files)), lambda: finished_words(options.folder))


def finished_words(folder: Path) -> str:
    """Calibrate the session of a folder, write the result beside it, and say what came of it.

    Raises as `calibrate_session`.
    """
    session = load_session(folder / SESSION)
    output = session.calibration_path
    done = calibrate_session(
        session,
        CalibrateOptions(output=output, report=output.with_suffix(".html"), force=True, cache=Cache.UPDATE),
    )
    c = done.calibration
    held = c.rms_px if c.heldout_rms_px is None else c.heldout_rms_px
    return f"Done: {c.camera.model}, held-out {held:.3f} px, {worst(c.verdicts)}; {output.name} written"


def coach_frames(
    coach: Coach, frames: Iterator[Frame], *, photos: bool, show: Callable[[bytes], None] | None = None
) -> None:
    """Offer frames to the coach until there are enough, or no more."""
    for frame in frames:
        try:
            state = coach.offer(frame, photo=photos)
        except RigkitError as error:
            _log.warning("%s", error)
            continue
        if show is not None:
            show(cv2.imencode(".jpg", cv2.cvtColor(frame, cv2.COLOR_RGB2BGR))[1].tobytes())
        if state.get("enough"):
            break


def run_coach(options: CoachOptions, told: Callable[[str], None]) -> None:
    """Serve the coach's page on this machine until it is stopped; `told` is given its address.

    Raises InputError for a folder or source that cannot be used, InstallationError without the extra `coach`.
    """
    coach = open_coach(options)
    frames = _frames(options)
    token = new_token()
    app = coach_app(coach, token, camera="page" if frames is None else "server")
    if frames is not None:
        preview: dict[str, bytes] = app.state.preview

        def work() -> None:
            coach_frames(coach, frames, photos=options.watch is not None, show=lambda jpeg: preview.update(jpeg=jpeg))
            try:
                told(coach.finish())
            except RigkitError as error:
                told(str(error))

        threading.Thread(target=work, daemon=True).start()
    serve(app, LOCALHOST, options.port, lambda port: told(f"http://{LOCALHOST}:{port}/{token}/"))


def _frames(options: CoachOptions) -> Iterator[Frame] | None:
    sources = [source for source in (options.watch, options.video, options.device) if source is not None]
    if len(sources) > 1:
        raise InputError("coach: frames come from one place: --watch, --video or --device")
    if options.watch is not None:
        return watched_frames(options.watch)
    if options.video is not None:
        return video_frames(options.video)
    return None if options.device is None else device_frames(options.device)
