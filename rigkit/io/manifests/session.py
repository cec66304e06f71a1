"""Session files: images, boards and options of a calibration, written by a person (schema "rigkit.session/1").

::

    schema = "rigkit.session/1"
    images = "images/*.jpg"              # or a list of files and patterns, relative to this file
    board = "../../boards/a9x6_30.toml"  # or boards = ["a.toml", "b.toml"]
    model = "scaramuzza"                 # optional: a camera model, or "auto" (the default: chosen by held-out error)
    degree = 6                           # optional: of the polynomial; by default chosen by held-out error
    board_shape = "auto"                 # optional: flat, warp, released, or auto (chosen by held-out error)

Sessions of several cameras on one mount have [[cameras]] instead of `images`: see `rigkit.io.manifests.rig_session`.
"""

from __future__ import annotations

import glob
import logging
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rigkit.calibration.solving.shape import SHAPES
from rigkit.cameras.registry import MODELS, check_order
from rigkit.core.boards import Board
from rigkit.core.printing import brief
from rigkit.identification.board_ids import BOARD_SIDES
from rigkit.io.boards.board_file import load_board
from rigkit.io.disk.reading import is_file_or_broken_link
from rigkit.io.disk.schema_builders import (
    ANY_OF,
    COUNT,
    NAME,
    TEXT,
    Schema,
    array,
    choice,
    described,
    file,
    rows,
    table,
    texts,
)
from rigkit.io.disk.toml_reader import TomlTable, named_path, read_toml
from rigkit.io.manifests.truth_file import TRUTH_KEYS, between

_log = logging.getLogger(__name__)

SESSION_SCHEMA = "rigkit.session/1"
SESSION_NAME = "session.toml"

_IMAGES = described({ANY_OF: [TEXT, texts()]}, "a pattern, or a list of files and patterns", "images/*.jpg")
_MODEL_KEYS: Mapping[str, Schema] = {
    "model?": described(choice("auto", *MODELS), "camera model; auto (default): the lowest held-out error"),
    "degree?": described(
        COUNT, "terms of brown (4, 5, 8), degree of scaramuzza; by default chosen by held-out error", 6
    ),
}
ONE_CAMERA_KEYS = ("schema", "images", "board", "boards", "model", "degree", "board_shape")
"""Keys of sessions of one camera; all others are of rigs."""
_CAMERA_KEYS: Mapping[str, Schema] = {
    "id": described(NAME, "its name", "left"),
    "images": _IMAGES,
    "calibration?": described(
        TEXT, "calibration file whose intrinsics are kept: only the extrinsics are solved", "left.json"
    ),
    **_MODEL_KEYS,
}
_RIGID_KEYS: Mapping[str, Schema] = {
    "boards": described(texts(2), "boards mounted to each other", ["left", "floor", "right"]),
    "layout?": described(
        table(choice(*BOARD_SIDES)),
        "relative positions, which identify boards that look alike",
        {"left": "left", "floor": "floor"},
    ),
    **TRUTH_KEYS,
}
SESSION_FILE = file(
    SESSION_SCHEMA,
    "What to calibrate, and how",
    {
        "images?": _IMAGES,
        "board?": described(TEXT, 'file of the board in the images; or boards = ["a.toml", "b.toml"]', "board.toml"),
        "boards?": described(texts(1), "files of the boards, where there are several", ["a.toml", "b.toml"]),
        **_MODEL_KEYS,
        "board_shape?": described(
            choice("auto", *SHAPES), "flat, warp (print scale and bow), released (every corner), or auto"
        ),
        "frames?": described(
            choice("name", "number", "time", "order"),
            "of several cameras, how simultaneous images are matched: by name, by the number at its end, by nearly "
            "equal times as names, or by the position in the sorted list",
        ),
        "rig?": described(
            TEXT, "rig file whose intrinsics and extrinsics are kept: other cameras are added to it", "rig.json"
        ),
        "cameras?": rows(_CAMERA_KEYS, "several cameras, instead of images; the first is the rig's frame", min_items=2),
        "baselines?": described(
            array(between("mm", "a camera", "left", "right")),
            "measured distances between cameras: compared with the result, not used",
        ),
        "rigid_boards?": rows(_RIGID_KEYS, "rigidly mounted boards"),
    },
)


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Session:
    """The session of one camera.

    Attributes
    ----------
    path : session file.
    images : existing image files, sorted by name.
    boards : boards that the images may show.
    model : name of a camera model, or "auto".
    degree : order of the model; None: chosen automatically.
    board_shape : "flat", "warp", "released" or "auto".
    camera : name of the camera in a rig's session, else None.
    """

    path: Path
    images: tuple[Path, ...]
    boards: tuple[Board, ...]
    model: str
    degree: int | None
    board_shape: str
    camera: str | None = None

    __repr__ = brief

    @property
    def cameras(self) -> Mapping[str, Session]:
        """Itself, where the session of a rig has those of its cameras."""
        return {"": self}

    @property
    def whose(self) -> str:
        """The words "of camera NAME" after a blank, for messages; "" outside of a rig."""
        return "" if self.camera is None else f" of camera '{self.camera}'"

    @property
    def result_path(self) -> Path:
        """Default path of the calibration, beside the session (see `beside_session`)."""
        return beside_session(self.path, "calibration.json")

    @property
    def corners_path(self) -> Path:
        """Path of the corner cache, beside the session."""
        name = "corners.json" if self.camera is None else f"corners-{self.camera}.json"
        return beside_session(self.path, name)


def beside_session(session: Path, name: str) -> Path:
    """Return the path of a result in the session's folder; its name begins with the session's unless that is
    session.toml."""
    return session.parent / (name if session.stem == "session" else f"{session.stem}-{name}")


def load_session(path: str | Path) -> Session:
    """Return the session; raises InputError for a missing file or board, or an unknown key."""
    source = Path(path)
    table = read_toml(source, SESSION_FILE)
    if "cameras" in table:
        raise table.error("has several [[cameras]]; where one camera is asked for, give the session of that one")
    table.allow_only(ONE_CAMERA_KEYS)
    return Session(path=source, images=images_of(table), boards=boards_of(table), **options_of(table))


def options_of(table: TomlTable, of_all: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Return model, degree and board shape of a table, as fields of `Session`; by default those `of_all` cameras."""
    typical = {"model": "auto", "degree": None, "board_shape": "auto"} if of_all is None else dict(of_all)
    typical |= {"degree": None} if "model" in table else {}
    out = typical | {key: table[key] for key in typical if key in table}
    if out["degree"] is not None:
        with table.located():
            check_order(out["model"], out["degree"])
    return out


def images_of(table: TomlTable) -> tuple[Path, ...]:
    """Return the existing image files that match the patterns of a table."""
    patterns = (table["images"],) if isinstance(table["images"], str) else table["images"]
    found: dict[Path, Path] = {}
    absent, again = list[str](), list[tuple[Path, Path]]()
    for pattern in patterns:
        table.path_of(pattern)
        # The root is no pattern: its name may have brackets.
        root = table.path.parent
        matches = [root / m for m in sorted(glob.glob(pattern, root_dir=root))]
        if not matches and (root / pattern).is_file():
            matches = [root / pattern]
        for match in filter(is_file_or_broken_link, matches):
            # A file found twice is one image, under its first name.
            first = found.setdefault(match.resolve(), named_path(match))
            again += [(first, named_path(match))] if first != named_path(match) else []
        absent += [pattern] if not matches else []
    # No image at all is valid if the corners are cached; a single pattern without a match is a mistake.
    if found and absent:
        raise table.error(f"'images': nothing matches '{absent[0]}'; correct or remove it")
    if again:
        first, other = again[0]
        more = f", and {len(again) - 1} more like it" if len(again) > 1 else ""
        _log.warning("'%s' and '%s' are one file, which counts once%s", first, other, more)
    return tuple(found.values())


def files_of_session(path: str | Path) -> tuple[Path, ...]:
    """Return all files that a calibration of a session (of one camera or a rig) reads: itself, boards, images, and
    corner caches, existing or not.

    Raises InputError as `load_session`.
    """
    source = Path(path)
    table = read_toml(source, SESSION_FILE)
    out = [source, *_board_files(table), *([table.path_of(table["rig"])] if "rig" in table else [])]
    for entry in table.get("cameras", (table,)):
        out += images_of(entry)
        out += [entry.path_of(entry["calibration"])] if "calibration" in entry else []
        name = f"-{entry['id']}" if entry is not table else ""
        out.append(beside_session(source, f"corners{name}.json"))
    return tuple(out)


def _board_files(table: TomlTable) -> list[Path]:
    return [table.path_of(name) for name in (table["boards"] if "boards" in table else (table["board"],))]


def boards_of(table: TomlTable) -> tuple[Board, ...]:
    """Return the boards whose files a table lists."""
    if "boards" in table and "board" in table:
        raise table.error("'board' and 'boards'; keep one of the two")
    with table.located():
        boards = tuple(load_board(path) for path in _board_files(table))
    ids = [board.board_id for board in boards]
    if len(set(ids)) < len(ids):
        raise table.error("two boards have the same id; give one of the files another 'id'")
    return boards
