"""Session files: what a person writes to have a camera calibrated (schema "rigkit.session/1").

::

    schema = "rigkit.session/1"
    images = "images/*.jpg"              # or a list of files and patterns, relative to this file
    board = "../../boards/a9x6_30.toml"  # or boards = ["a.toml", "b.toml"]
    model = "scaramuzza"                 # optional: a camera model, or "auto" (the default: chosen by held-out error)
    degree = 6                           # optional: of the polynomial; by default chosen by held-out error
    board_shape = "auto"                 # optional: flat, warp, released, or auto (chosen by held-out error)

Sessions of several cameras on one mount have [[cameras]] instead of `images`: see `rigkit.io.rig_session`.
"""

from __future__ import annotations

import glob
from dataclasses import dataclass
from pathlib import Path

from rigkit.calibration.shape import SHAPES
from rigkit.cameras.registry import MODELS, check_order
from rigkit.core.boards import Board
from rigkit.core.errors import InputError
from rigkit.core.printing import brief
from rigkit.io.board_file import load_board
from rigkit.io.toml_reader import TomlTable, named_path, read_toml

SESSION_SCHEMA = "rigkit.session/1"
SESSION_NAME = "session.toml"
HINT_BOARD = 'board = "board.toml" (or boards = ["a.toml", "b.toml"])'


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Session:
    """What to calibrate and how.

    Attributes
    ----------
    path : the session file.
    images : the image files that are there, sorted by name.
    boards : the boards that may be in them.
    model : name of a camera model, or "auto".
    degree : size of the model, or None to choose.
    board_shape : "flat", "warp", "released" or "auto".
    camera : name of the camera where the session is one of a rig's, else None.
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
    def calibration_path(self) -> Path:
        """Where the calibration goes: beside the session, see `beside_session`."""
        return beside_session(self.path, "calibration.json")

    @property
    def corners_path(self) -> Path:
        """Where the corners found are kept, so that calibrating again needs no images."""
        name = "corners.json" if self.camera is None else f"corners-{self.camera}.json"
        return beside_session(self.path, name)


def beside_session(session: Path, name: str) -> Path:
    """Return where a result of that name goes: of a session that is not called session.toml after the session's name,
    so that those of two sessions in one folder do not meet."""
    return session.parent / (name if session.stem == "session" else f"{session.stem}-{name}")


def load_session(path: str | Path) -> Session:
    """Return the session; raises InputError for a missing file or board, or an unknown key."""
    source = Path(path)
    table = read_toml(source, SESSION_SCHEMA)
    if table.has("cameras"):
        raise table.error("has several [[cameras]]; where one camera is asked for, give the session of that one")
    images = images_of(table)
    boards = boards_of(table)
    model, degree, shape = options_of(table)
    table.done()
    return Session(path=source, images=images, boards=boards, model=model, degree=degree, board_shape=shape)


def options_of(table: TomlTable) -> tuple[str, int | None, str]:
    """Return model, degree and board shape that a table asks for."""
    model = "auto"
    if table.has("model"):
        model = table.text("model", hint='model = "scaramuzza"', choices=("auto", *MODELS))
    degree = table.integer("degree", hint="degree = 6", at_least=1) if table.has("degree") else None
    if degree is not None:
        try:
            check_order(model, degree)
        except InputError as error:
            raise table.error(f"'degree': {error}") from error
    shape = "auto"
    if table.has("board_shape"):
        shape = table.text("board_shape", hint='board_shape = "auto"', choices=("auto", *SHAPES))
    return model, degree, shape


def images_of(table: TomlTable) -> tuple[Path, ...]:
    """Return the image files that are there, of the patterns that a table lists."""
    hint = 'images = "images/*.jpg" (or a list of files and patterns)'
    try:
        patterns: tuple[str, ...] = (table.text("images", hint=hint),)
    except InputError:
        patterns = table.texts("images", hint=hint)
    found: dict[Path, Path] = {}
    absent = []
    for pattern in patterns:
        table.beside(pattern)
        # Only what the person wrote is a pattern, and no file's own name: both may have brackets in them.
        root = table.path.parent
        matches = [root / m for m in sorted(glob.glob(pattern, root_dir=root))]
        if not matches and (root / pattern).is_file():
            matches = [root / pattern]
        for match in filter(Path.is_file, matches):
            # The same file twice is one image, under the name by which it was found first.
            found.setdefault(match.resolve(), named_path(match))
        absent += [pattern] if not matches else []
    # No image at all is well where corners are kept; one of several is a mistake.
    if found and absent:
        raise table.error(f"'images': nothing matches '{absent[0]}'; correct or remove it")
    return tuple(found.values())


def files_of_session(path: str | Path) -> tuple[Path, ...]:
    """Return every file that a calibration of this session, or rig's session, reads: itself, boards, images, and the
    corners kept beside it, whether they are there or not.

    Raises InputError like `load_session`.
    """
    source = Path(path)
    table = read_toml(source, SESSION_SCHEMA)
    boards = table.texts("boards", hint=HINT_BOARD) if table.has("boards") else (table.text("board", hint=HINT_BOARD),)
    out = [source, *map(table.beside, boards)]
    entries = table.tables("cameras", hint="[[cameras]]") if table.has("cameras") else (table,)
    out += [table.path_to("rig", hint='rig = "rig.json"')] if table.has("rig") else []
    for entry in entries:
        out += images_of(entry)
        out += [entry.path_to("calibration", hint="calibration")] if entry.has("calibration") else []
        name = f"-{entry.text('id', hint='id')}" if entry is not table else ""
        out.append(beside_session(source, f"corners{name}.json"))
    return tuple(out)


def boards_of(table: TomlTable) -> tuple[Board, ...]:
    """Return the boards that a table lists by file."""
    if table.has("boards"):
        if table.has("board"):
            raise table.error("'board' and 'boards'; keep one of the two")
        paths = [table.beside(name) for name in table.texts("boards", hint=HINT_BOARD)]
    else:
        paths = [table.path_to("board", hint=HINT_BOARD)]
    with table.located():
        boards = tuple(load_board(path) for path in paths)
    ids = [board.board_id for board in boards]
    if len(set(ids)) < len(ids):
        raise table.error("two boards have the same id; give one of the files another 'id'")
    return boards
