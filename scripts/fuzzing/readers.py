"""Readers that need more than a path, for `fuzz.py`."""

from __future__ import annotations

import contextlib
import os
import shutil
from pathlib import Path

from rigkit.cli.main import main
from rigkit.coach.coach import Coach
from rigkit.coach.guide import GuideOptions
from rigkit.coach.sources import frames_of_folders
from rigkit.core.boards import Board
from rigkit.core.errors import RigkitError
from rigkit.interop.ocamcalib import read_py_ocamcalib
from rigkit.io.corners.corner_cache import CornerCache
from rigkit.io.corners.corners_file import read_corners
from rigkit.io.corners.correspondences import read_correspondences
from rigkit.io.disk.reading import read_text
from rigkit.io.manifests.session import load_session
from rigkit.io.manifests.truth_csv import load_truth_csv
from rigkit.io.media.video import read_timestamps
from rigkit.workflows.calibration.calibrate import calibrate_session
from rigkit.workflows.capture.coach import coach_frames, coach_recording, open_coach
from rigkit.workflows.inputs.frames import frames_of_videos
from rigkit.workflows.options.coach import CoachOptions

SMALL = Board("small", 5, 4, 30.0, 30.0)
GUIDE = GuideOptions(boards=(SMALL,))


def _replace(path: Path, name: str) -> None:
    """Put the case in the place of a good file, which other cases share by a link: it may not be written into."""
    Path(name).unlink(missing_ok=True)
    shutil.copy(path, name)


def read_vnl(path: Path) -> None:
    """Read corners of mrgingham, which are about one board."""
    read_corners(path, [SMALL])


def read_truth(path: Path) -> None:
    """Read a truth table about boards that are there."""
    load_truth_csv(path, {"first": (Board("wall", 5, 4, 30.0, 30.0), Board("floor", 5, 4, 30.0, 30.0))})


def read_py_ocam(path: Path) -> None:
    """Read a camera of py-OCamCalib."""
    read_py_ocamcalib(read_text(path), (640, 480), str(path))


def read_cache(path: Path) -> None:
    """Read the corners kept beside a session: what is damaged is as good as none."""
    cache = CornerCache(path, [SMALL])
    for name in cache.images:
        cache.get(name, cache.digest(name))


def calibrate_kept(path: Path) -> None:
    """Calibrate from corners that were kept beside a session whose images are gone."""
    _replace(path, "corners.json")
    session = load_session(Path("gone.toml"))
    with contextlib.suppress(RigkitError):
        # The message is about the session: what was kept is no input of a person's.
        calibrate_session(session)


def fetch_listed(path: Path) -> None:
    """List a catalogue with a damaged entry, and fetch it."""
    _replace(path, "catalogue/small.toml")
    for words in (["fetch"], ["fetch", "small", "-o", "out/set"]):
        assert main([*words, "--catalogue", "catalogue"]) in (0, 1, 2, 3), words


def read_frames(path: Path) -> None:
    """Keep the frames of a video that show the board."""
    frames_of_videos({"": path}, Path("out/frames"), [SMALL], max_frames=4)


def read_record(path: Path) -> None:
    """Keep the frames of a video where a record of former ones is damaged: they are chosen anew."""
    Path("out/frames").mkdir()
    shutil.copy(path, "out/frames/frames.json")
    frames_of_videos({"": Path("film.avi")}, Path("out/frames"), [SMALL], max_frames=4)


def read_database(path: Path) -> None:
    """Read the matches of two images from a database of COLMAP's."""
    read_correspondences(path, ("scene1.png", "scene2.png"))


def read_times(path: Path) -> None:
    """Read which frames of two videos are of one moment."""
    read_timestamps(path, {"cam1": 0, "cam2": 0})


def coach_video(path: Path) -> None:
    """Let the coach choose from the frames of a video."""
    coach_recording(_coach(), [path])


def coach_folder(path: Path) -> None:
    """Let the coach watch a folder with a damaged picture: it names it, and goes on to the next."""
    Path("watched").mkdir()
    for name in (path.name, "image.png"):
        shutil.copy(name, Path("watched") / name)
        # Of long ago: nobody waits for it to be whole.
        os.utime(Path("watched") / name, (0.0, 0.0))
    coach = _coach()
    coach_frames(coach, frames_of_folders([Path("watched")], until_idle_s=0.1), photos=True)
    assert coach.guide.frames, "the picture after the damaged one was not looked at"


def coach_again(path: Path) -> None:
    """Let the coach go on with a session of which a frame is damaged."""
    _coach()
    shutil.copy(path, "out/coach/images/frame-0001.png")
    shutil.copy("image.png", "out/coach/images/frame-0002.png")
    assert _coach().guide.frames, "the frame after the damaged one was not read"


def _coach() -> Coach:
    return open_coach(CoachOptions(folder=Path("out/coach"), boards=("5x4x30",), guide=GUIDE))
