"""Session files of rigs: several cameras on one mount ([[cameras]] instead of `images`), boards on one mount, or both.

::

    schema = "rigkit.session/1"
    board = "board.toml"             # or boards = [...]
    model = "brown"                  # of all cameras; a camera may have its own `model` and `degree`
    frames = "number"                # optional: which images were taken at the same moment (below)
    rig = "rig.json"                 # optional: cameras in this rig stay as they are, lens and mount; others are added

    [[cameras]]
    id = "left"
    images = "left*.jpg"
    calibration = "left.json"        # optional: this lens stays as it is; only its mount is found

    [[cameras]]
    id = "right"
    images = "right*.jpg"

    [[baselines]]                    # optional: what a person measured between two lenses
    a = "left"
    b = "right"
    value_mm = 100.0
    sigma_mm = 1.0
    how = "steel rule"

    [[rigid_boards]]                 # optional: boards that are mounted to each other
    boards = ["left", "floor", "right"]
    layout = { left = "left", floor = "floor", right = "right" }  # optional: which is which, of boards that look alike
    angles = [ { a = "left", b = "floor", value_deg = 90.0, sigma_deg = 0.3, how = "set square" } ]      # optional
    distances = [ { a = "left.centre", b = "floor", value_mm = 150.0, sigma_mm = 1.0, how = "rule" } ]   # optional

A session of one camera with [[rigid_boards]] has `images` as ever.

Images of one moment have the same file name without its ending in every camera's folder (frames = "name"), the same
number at the end of that name ("number": left07 and right07), or the same place in the sorted list ("order"). Where
`frames` is not given, it is the first of name and number that any two cameras share.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path, PurePath

from rigkit.core.boards import Board
from rigkit.core.errors import InputError
from rigkit.core.printing import brief
from rigkit.core.truth import MeasuredLength, PairTruth
from rigkit.identification.board_ids import BOARD_SIDES
from rigkit.io.session import SESSION_SCHEMA, Session, beside_session, boards_of, images_of, options_of
from rigkit.io.toml_reader import TomlTable, read_toml
from rigkit.io.truth_file import measured_value, truth_from_table

FRAMES = ("name", "number", "order")
HINT_ID = 'id = "left"'
HINT_RIGID = 'boards = ["left", "floor", "right"]'
ONE = "camera"
"""What the only camera of a session without [[cameras]] is called."""


@dataclass(frozen=True, slots=True)
class MeasuredBaseline:
    """The distance between the centres of cameras `a` and `b` as a person measured it."""

    a: str
    b: str
    length: MeasuredLength


@dataclass(frozen=True, eq=False, slots=True)
class RigidBoards:
    """Boards mounted to each other: their ids, on which side those are that look alike, and what was measured."""

    boards: tuple[str, ...]
    layout: Mapping[str, str]
    truth: PairTruth


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class RigSession:
    """What to calibrate together.

    Attributes
    ----------
    path : the session file.
    cameras : one session a camera, by its name, in the order of the file; the first is the rig's frame.
    frames : "name", "number" or "order"; None to choose.
    baselines : what was measured between cameras.
    rigid_boards : what is mounted to each other.
    lenses : by camera, the file of a lens that stays as it is.
    known_rig : the file of a rig of which the cameras stay as they are, lens and mount; None: of none.
    """

    path: Path
    cameras: Mapping[str, Session]
    frames: str | None
    baselines: tuple[MeasuredBaseline, ...]
    rigid_boards: tuple[RigidBoards, ...] = ()
    lenses: Mapping[str, Path] = field(default_factory=dict)
    known_rig: Path | None = None

    __repr__ = brief

    @property
    def rig_path(self) -> Path:
        """Where the result goes, beside the session: that of one camera is a calibration like any other."""
        return beside_session(self.path, "rig.json" if len(self.cameras) > 1 else "calibration.json")


def is_rig_session(path: str | Path) -> bool:
    """Say whether the session has several cameras or boards on one mount; raises InputError like `load_session`."""
    table = read_toml(path, SESSION_SCHEMA)
    return table.has("cameras") or table.has("rigid_boards")


def load_rig_session(path: str | Path) -> RigSession:
    """Return the session of a rig.

    Raises InputError for a missing file or board, an unknown key, one camera only or two of one name, a baseline
    between cameras that are not there, and boards on a mount that are not listed or are on two.
    """
    source = Path(path)
    table = read_toml(source, SESSION_SCHEMA)
    boards = boards_of(table)
    model, degree, shape = options_of(table)
    rigid = _rigid_boards(table, boards)
    if rigid and not table.has("cameras"):
        one = Session(
            path=source, images=images_of(table), boards=boards, model=model, degree=degree, board_shape=shape
        )
        table.done()
        return RigSession(path=source, cameras={ONE: one}, frames=None, baselines=(), rigid_boards=rigid)
    if table.has("images"):
        raise table.error("'images' together with [[cameras]]; give every camera its own images")
    frames = None
    if table.has("frames"):
        frames = table.text("frames", hint='frames = "number"', choices=FRAMES)
    known_rig = table.path_to("rig", hint='rig = "rig.json"') if table.has("rig") else None
    cameras: dict[str, Session] = {}
    lenses: dict[str, Path] = {}
    for entry in table.tables("cameras", hint='[[cameras]] with id = "left" and images = "left*.jpg"'):
        name = entry.identifier("id", hint=HINT_ID)
        if name in cameras:
            raise entry.error("its id must be its own; give it another")
        own, own_degree = model, degree
        if entry.has("model"):
            own, own_degree, _ = options_of(entry)
        images = images_of(entry)
        if entry.has("calibration"):
            lenses[name] = entry.path_to("calibration", hint='calibration = "left.json"')
        entry.done()
        cameras[name] = Session(
            path=source, images=images, boards=boards, model=own, degree=own_degree, board_shape=shape, camera=name
        )
    if len(cameras) < 2:
        raise table.error("a rig has at least two [[cameras]]; for one, write its `images` without [[cameras]]")
    baselines = _baselines(table, tuple(cameras))
    table.done()
    return RigSession(
        path=source,
        cameras=cameras,
        frames=frames,
        baselines=baselines,
        rigid_boards=rigid,
        lenses=lenses,
        known_rig=known_rig,
    )


def _rigid_boards(table: TomlTable, boards: Sequence[Board]) -> tuple[RigidBoards, ...]:
    if not table.has("rigid_boards"):
        return ()
    known = {b.board_id: b for b in boards}
    out: list[RigidBoards] = []
    for entry in table.tables("rigid_boards", hint=f"[[rigid_boards]] with {HINT_RIGID}"):
        names = entry.texts("boards", hint=HINT_RIGID)
        for name in names:
            if name not in known:
                raise entry.error(f"no board is called '{name}'; known: {', '.join(known)}")
            if any(name in other.boards for other in out):
                raise entry.error(f"board '{name}' is on two mounts; remove it from one")
        if len(names) < 2:
            raise entry.error(f"one board has no mount to share; write {HINT_RIGID}")
        layout: dict[str, str] = {}
        if entry.has("layout"):
            sides = entry.table("layout", hint='layout = { left = "left", floor = "floor" }')
            layout = {
                name: sides.text(name, hint=f'{name} = "left"', choices=tuple(BOARD_SIDES)) for name in sides.names()
            }
            for name in layout:
                if name not in names:
                    raise entry.error(f"layout: '{name}' is none of its boards; use {' or '.join(names)}")
        if entry.has("baseline"):
            raise entry.error("'baseline' is between cameras: write [[baselines]]")
        out.append(RigidBoards(names, layout, truth_from_table(entry, [known[name] for name in names])))
    return tuple(out)


def _baselines(table: TomlTable, names: Sequence[str]) -> tuple[MeasuredBaseline, ...]:
    if not table.has("baselines"):
        return ()
    out = []
    for entry in table.tables("baselines", hint="[[baselines]] with a, b, value_mm, sigma_mm and how"):
        a, b = (entry.text(key, hint=f'{key} = "{names[0]}"', choices=names) for key in "ab")
        if a == b:
            raise entry.error(f"'a' and 'b' are both '{a}'; name two cameras")
        measured = measured_value(entry, "mm")
        entry.done()
        out.append(MeasuredBaseline(a, b, MeasuredLength(*measured)))
    return tuple(out)


def frames_of_images(images: Mapping[str, Sequence[str]], how: str | None = None) -> dict[str, dict[str, str]]:
    """Return camera -> image -> frame: images of one moment have the same frame.

    Parameters
    ----------
    images : camera -> names of its images, in their order.
    how : "name", "number" or "order" (see above); by default the first of name and number that two cameras share.

    Raises
    ------
    InputError
        Two images of a camera would be of one frame, the numbers of images differ ("order"), or no two cameras share a
        frame.
    """
    if how == "order":
        counts = {name: len(own) for name, own in images.items()}
        if len(set(counts.values())) > 1:
            words = ", ".join(f"{n} of '{name}'" for name, n in counts.items())
            raise InputError(f'frames = "order" needs as many images of every camera, there are {words}')
        return {name: {image: f"{k:04d}" for k, image in enumerate(own)} for name, own in images.items()}
    for key in (how,) if how else ("name", "number"):
        frames = {name: {image: FRAME_KEYS[key](image) for image in own} for name, own in images.items()}
        twice = _twice(frames)
        known = sorted(frame for own in frames.values() for frame in set(own.values()))
        if twice is None and any(a == b for a, b in pairwise(known)):
            return frames
        if how and twice is not None:
            raise InputError(f'frames = "{how}": {twice} are of one frame; rename them, or use frames = "order"')
    raise InputError(
        "no two cameras have an image of the same name or number, so nothing says what was taken at the same moment; "
        'rename the images, or write frames = "order" if the sorted lists belong together one by one'
    )


def _number(image: str) -> str:
    """Return the last number in the name, without leading zeros; the name itself where it has none."""
    numbers = re.findall(r"\d+", PurePath(image).stem)
    return str(int(numbers[-1])) if numbers else image


FRAME_KEYS: dict[str, Callable[[str], str]] = {"name": lambda image: PurePath(image).stem, "number": _number}


def _twice(frames: Mapping[str, Mapping[str, str]]) -> str | None:
    """Return two images of one camera that have the same frame, in words."""
    for name, own in frames.items():
        seen: dict[str, str] = {}
        for image, frame in own.items():
            if frame in seen:
                return f"images '{seen[frame]}' and '{image}' of camera '{name}'"
            seen[frame] = image
    return None
