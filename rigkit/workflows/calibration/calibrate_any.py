"""Calibration from any source: a session file of one camera or several, folders of images, or videos."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import replace
from pathlib import Path

from rigkit.cameras.registry import camera_model
from rigkit.core.errors import InputError, RigkitError
from rigkit.core.progress import Progress, silent
from rigkit.io.boards.board_words import board_of_words
from rigkit.io.corners.corner_cache import FoundCorners
from rigkit.io.disk.reading import about, paths_of, read_bytes, read_text, usable_path
from rigkit.io.disk.writing import ensure_writable, write_together
from rigkit.io.manifests.rig_session import RigSession, load_any_session
from rigkit.io.manifests.session import SESSION_NAME, Session, beside_session
from rigkit.io.media.images import IMAGE_ENDINGS
from rigkit.io.media.video import is_video, videos_inside
from rigkit.workflows.calibration.calibrate import (
    RigSessionCalibration,
    SessionCalibration,
    calibrate_rig_session,
    calibrate_session,
    session_inputs,
)
from rigkit.workflows.inputs.corners import keep_corners
from rigkit.workflows.inputs.folder_session import (
    ImagesByCamera,
    boards_seen,
    cameras_in,
    session_of_folders,
)
from rigkit.workflows.inputs.frames import (
    frames_folder,
    frames_of_videos,
    timestamps_next_to,
    with_frames,
)
from rigkit.workflows.inputs.layout_evidence import cameras_by_name, cameras_seen, moments_by_order
from rigkit.workflows.options.cameras import Cache, CalibrateOptions, FolderOptions
from rigkit.workflows.outputs.calibration_paths import calibration_paths

_log = logging.getLogger(__name__)


def calibrate_sources(
    sources: Sequence[Path], folder_options: FolderOptions, options: CalibrateOptions, *, progress: Progress = silent
) -> SessionCalibration | RigSessionCalibration:
    """Calibrate from a session file, folders of images, or videos.

    A folder with a session file is calibrated by it, unless `folder_options` give boards or a model. Raises as
    `calibrate_folders` and `calibrate_session_file`.
    """
    first = sources[0]
    has_options = folder_options != FolderOptions(timestamps=folder_options.timestamps)
    if len(sources) == 1 and not has_options and (first / SESSION_NAME).is_file():
        first = first / SESSION_NAME
    # For a single image, that function says what to give instead.
    if len(sources) > 1 or first.is_dir() or is_video(first) or first.suffix.lower() in IMAGE_ENDINGS:
        return calibrate_folders(sources, folder_options, options, progress=progress)
    if not first.exists():
        raise InputError(f"calibrate: '{first}' does not exist; give a folder of images, a video or a session's file")
    # Reading refuses an archive, and whatever else is no text; JSON is a result.
    if first.suffix.lower() != ".toml" and (read_text(first).lstrip().startswith("{") or has_options):
        raise InputError(
            f"calibrate: '{first}' is none of these: a folder of images, a video, a session's file (.toml)"
        )
    if has_options:
        raise InputError(
            f"calibrate: '{first}' states board, model and cameras already; leave out --board, --square-mm, --model "
            "and --cameras"
        )
    return calibrate_session_file(first, options, progress=progress)


def calibrate_session_file(
    path: str | Path, options: CalibrateOptions, *, progress: Progress = silent
) -> SessionCalibration | RigSessionCalibration:
    """Calibrate the camera or the rig of a session file.

    Without `options.output` the result is written beside the session; the report Path("") beside the result.

    Raises as `calibrate_session` and `calibrate_rig_session`.
    """
    listed = load_any_session(path)
    if isinstance(listed, Session) and options.known.files:
        raise InputError("one camera has no extrinsics to solve for; `rigkit pose` gives its pose relative to a board")
    output = options.output or listed.result_path
    options = replace(options, output=output, report=_report_path(options, output))
    # Before the frames of videos are chosen, which takes minutes; the videos are inputs as well as these frames.
    ensure_writable((output, options.report), force=options.force, inputs=session_inputs(listed, options))
    if options.report is None and (page := output.with_suffix(".html")).is_file():
        _log.warning(f"'{page}' is of an earlier calibration and stays as it is; -r --force replaces it")
    session = with_frames(listed, progress)
    with about(options.corners) if options.corners else nullcontext():
        if isinstance(session, RigSession):
            return calibrate_rig_session(session, options, progress=progress)
        return calibrate_session(session, options, progress=progress)


def calibrate_folders(
    folders: str | Path | Sequence[str | Path],
    folder_options: FolderOptions,
    options: CalibrateOptions,
    *,
    progress: Progress = silent,
) -> SessionCalibration | RigSessionCalibration:
    """Calibrate the camera or the rig whose images are in folders or videos.

    Also writes a session file, beside `options.output` or in the common folder of all images. An existing session file
    is kept if it states the same; else it is refused, or replaced with `options.force`. If the calibration fails, no
    file changes except the corner cache (`options.cache`) of a session that existed.

    Raises InputError: no board given, no images, a file that cannot be written, and as `calibrate_session_file`;
    DegenerateError: the views do not determine a camera.
    """
    for words in folder_options.boards:
        board_of_words(words)  # refused before anything else is asked for
    folders = paths_of(folders)
    given = [inside for folder in folders for inside in videos_inside(folder)]
    videos = _videos_of(given, options.output)
    if videos and folder_options.cameras not in (None, len(videos)):
        raise InputError(f"calibrate: --cameras {folder_options.cameras}, but the videos are of {len(videos)}")
    places = list(videos) or given
    session = _session_path(places, options.output)
    declared = [*folders, *([folder_options.timestamps] if folder_options.timestamps else [])]
    # Before boards are identified and frames chosen, which takes minutes.
    names = [folder.name for folder in videos] or list(cameras_by_name(places, folder_options.cameras) or ())
    if names:
        ensure_writable(_results(names, session, options), force=options.force, inputs=declared)
    boards = _boards(given, folder_options, progress)
    if videos:
        _choose_frames(videos, boards, folder_options.timestamps, progress)
    wanted, cameras, corners = _session(places, boards, session, folder_options, options, progress)
    new = {path: text for path, text in wanted.items() if not _has_content(path, text)}
    results = _results(cameras, session, options)
    ensure_writable([*new, *results], force=options.force, inputs=[*(set(wanted) - set(new)), *declared])
    before = {path: read_bytes(path, "session") for path in new if path.exists()}
    write_together(new, force=options.force)
    made, missing = list(set(new) - set(before)), [path for path in results if not path.exists()]
    caches: list[Path] = []
    try:
        with _errors_about(folders, session):
            if session in made:
                corner_paths = (own.corners_path for own in load_any_session(session).cameras.values())
                caches = [path for path in corner_paths if not path.exists()]
                made += caches
            if corners and options.cache is Cache.UPDATE and options.corners is None:
                _keep_corners(session, corners)
            done = calibrate_session_file(session, options, progress=progress)
        return replace(done, written=(*done.written, *new, *filter(Path.exists, caches)))
    except BaseException:
        if before:
            write_together(before, force=True)
        # A result that appeared meanwhile is another run's, whose session this is.
        for path in made if not any(path.exists() for path in missing) else ():
            with suppress(OSError):
                path.unlink()
        raise


def new_session(
    folder: Path, folder_options: FolderOptions, path: Path, *, progress: Progress = silent
) -> dict[Path, str]:
    """Return the files of the session, in `path`, with which `calibrate_folders` calibrates a folder of images.

    Raises as `calibrate_folders` for boards and cameras.
    """
    if folder_options.model not in (None, "auto"):
        camera_model(folder_options.model)  # Refused before boards are searched for, which takes long.
    boards = _boards([folder], folder_options, progress)
    return _session([folder], boards, path, folder_options, CalibrateOptions(), progress)[0]


def _session(
    places: Sequence[Path],
    boards: Sequence[str],
    path: Path,
    folder_options: FolderOptions,
    options: CalibrateOptions,
    progress: Progress,
) -> tuple[dict[Path, str], list[str], Mapping[Path, FoundCorners]]:
    """Return the files of the session of folders, the names of its cameras, and the corners found to tell these."""
    cameras: ImagesByCamera | None = None
    corners: dict[Path, FoundCorners] = {}
    by_order = False
    if boards and folder_options.cameras is not None:
        cameras = cameras_in(places, folder_options.cameras)
    elif boards:
        known = [board_of_words(words) for words in boards]
        cameras, corners = cameras_seen(places, known, path, progress)
        by_order = moments_by_order(cameras, known, path, corners, progress)
    wanted = session_of_folders(
        places,
        boards,
        path,
        model=folder_options.model or "auto",
        options=options,
        cameras=cameras,
        by_order=by_order,
        progress=progress,
    )
    return wanted, list(cameras or ()), corners


def _keep_corners(path: Path, found: Mapping[Path, FoundCorners]) -> None:
    """Write the corners of images to the caches of a session's cameras."""
    for own in load_any_session(path).cameras.values():
        keep_corners(own, found)


def _boards(places: Sequence[Path], declared: FolderOptions, progress: Progress) -> tuple[str, ...]:
    """Return the declared boards, or those that the images show, with squares of `declared.square_mm`."""
    if declared.boards and declared.square_mm is not None:
        raise InputError("--board states the square size already; leave --square-mm out")
    if declared.square_mm is None:
        return declared.boards
    boards = boards_seen(places, declared.square_mm, progress)
    _log.info(f"the images show --board {' --board '.join(boards)}")
    return boards


@contextmanager
def _errors_about(given: Sequence[str | Path], session: Path) -> Iterator[None]:
    """Let errors of the block name the given folders and videos instead of the session made from them, which is removed
    after a failure."""
    with about(*given):
        try:
            yield
        except RigkitError as error:
            names = " and ".join(f"'{path}'" for path in given)
            words = str(error).replace(f"'{session}'", names).replace(str(session), names)
            raise type(error)(words) from error


def _session_path(places: Sequence[Path], output: Path | None) -> Path:
    """Return the path of the session file, named after `output`: two results in one folder have a session each."""
    if output is not None:
        return usable_path(usable_path(output).with_name(f"{output.stem}-session.toml"))
    if len(places) == 1:
        return places[0] / SESSION_NAME
    # Named as they were given: results are called "rig.json" where the folders are called "left" and "right".
    absolute = any(place.is_absolute() for place in places)
    return Path(os.path.commonpath([place.absolute() if absolute else place for place in places])) / SESSION_NAME


def _results(cameras: Sequence[str], session: Path, options: CalibrateOptions) -> list[Path]:
    """Return the files that the calibration of a session's cameras writes."""
    output = options.output or beside_session(session, "rig.json" if len(cameras) > 1 else "calibration.json")
    return calibration_paths(cameras, replace(options, output=output, report=_report_path(options, output)))


def _report_path(options: CalibrateOptions, output: Path) -> Path | None:
    """Return the path of the page; Path("") stands for one named after the output."""
    return output.with_suffix(".html") if options.report == Path() else options.report


def _videos_of(places: Sequence[Path], output: Path | None) -> dict[Path, Path]:
    """Return the given videos by the folder of their frames, beside the session named after `output`, or beside the
    videos; {} for folders.

    A result has frames of its own: those of another board would replace the ones that its session names.
    """
    videos = [place for place in places if is_video(place)]
    if not videos:
        return {}
    if len(videos) < len(places):
        raise InputError(
            "calibrate: videos mixed with folders of images; give all cameras as videos, or all as folders"
        )
    folder = frames_folder(videos) if output is None else beside_session(_session_path(videos, output), "frames")
    out = {folder: videos[0]} if len(videos) == 1 else {folder / video.stem: video for video in videos}
    if len(out) < len(videos):
        raise InputError("calibrate: two videos have the same name, which names a camera; rename one")
    return out


def _choose_frames(
    videos: Mapping[Path, Path], boards: Sequence[str], timestamps: Path | None, progress: Progress
) -> None:
    """Write selected frames of the videos into their folders."""
    if not boards:
        raise InputError(
            "calibrate: the square size is missing; give --square-mm, the side of one, or the board, such "
            "as --board 9x6x25; rigkit board identify shows which"
        )
    seen = [board_of_words(words) for words in boards]
    if len(videos) == 1:
        ((folder, video),) = videos.items()
        frames_of_videos({"": video}, folder, seen, progress=progress)
        return
    times = timestamps or timestamps_next_to(list(videos.values()))
    cameras = {folder.name: video for folder, video in videos.items()}
    frames_of_videos(cameras, next(iter(videos)).parent, seen, timestamps=times, progress=progress)


def _has_content(path: Path, text: str) -> bool:
    """Return whether the file exists and has this text, apart from comments."""
    if not path.is_file():
        return False
    try:
        return _stripped(read_bytes(path, "session").decode()) == _stripped(text)
    except (InputError, UnicodeDecodeError):
        return False


def _stripped(text: str) -> list[str]:
    return [line.strip() for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
