"""Session files of rigs: several cameras on one mount ([[cameras]] instead of `images`), boards on one mount, or both.

::

    schema = "rigkit.session/1"
    boards = ["left.toml", "floor.toml"]
    model = "brown"                  # of all cameras; a camera may have its own `model` and `degree`

    [[cameras]]                      # at least two
    id = "left"
    images = "left*.jpg"

    [[baselines]]                    # what a person measured between two lenses
    a = "left"
    b = "right"
    value_mm = 100.0
    sigma_mm = 1.0
    how = "steel rule"

    [[rigid_boards]]                 # boards that are mounted to each other
    boards = ["left", "floor"]
    angles = [ { a = "left", b = "floor", value_deg = 90.0, sigma_deg = 0.3, how = "set square" } ]

`rigkit.io.manifests.session.SESSION_FILE` has every key with its meaning. A session of one camera with [[rigid_boards]]
has `images`.

Images of one moment have the same file name without its ending in every camera's folder (frames = "name"), the same
number at the end of that name ("number": left07 and right07), or the same place in the sorted list ("order"), or names
that are times, and nearly the same ("time"). By default it is the time where all names are times (10 digits or more),
else the first of name, number, and the parts of path and name that differ within a camera, which two cameras share.
"""

from __future__ import annotations

import re
from bisect import bisect, insort
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from decimal import Decimal
from itertools import pairwise
from pathlib import Path, PurePath
from statistics import median

from rigkit.core.boards import Board
from rigkit.core.errors import InputError
from rigkit.core.identifiers import last_number
from rigkit.core.printing import brief
from rigkit.core.truth import MeasuredLength, PairTruth
from rigkit.io.disk.toml_reader import TomlTable, read_toml
from rigkit.io.manifests.session import (
    ONE_CAMERA_KEYS,
    SESSION_FILE,
    Session,
    beside_session,
    boards_of,
    images_of,
    load_session,
    options_of,
)
from rigkit.io.manifests.truth_file import measured_value, truth_from_table

ONE = "camera"
"""Name of the camera of a session without [[cameras]]."""


@dataclass(frozen=True, slots=True)
class MeasuredBaseline:
    """The measured distance between the centres of cameras `a` and `b`."""

    a: str
    b: str
    length: MeasuredLength


@dataclass(frozen=True, eq=False, slots=True)
class RigidBoards:
    """Boards on one mount: their ids, the sides of those that look alike, and measured truth."""

    boards: tuple[str, ...]
    layout: Mapping[str, str]
    truth: PairTruth


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class RigSession:
    """The session of a rig.

    Attributes
    ----------
    path : session file.
    cameras : session of each camera by name, in the order of the file; the first defines the rig's frame.
    frames : "name", "number", "time" or "order"; None: chosen automatically.
    baselines : measured distances between cameras.
    rigid_boards : groups of boards on one mount.
    lenses : files of fixed lenses by camera.
    known_rig : file of a rig whose lenses and poses are fixed, or None.
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
    def result_path(self) -> Path:
        """Default path of the result: a rig file, or the calibration of a single camera."""
        return beside_session(self.path, "rig.json" if len(self.cameras) > 1 else "calibration.json")


def is_rig_session(path: str | Path) -> bool:
    """Return whether a session has several cameras or boards on one mount; raises InputError as `load_session`."""
    table = read_toml(path, SESSION_FILE)
    return "cameras" in table or "rigid_boards" in table


def load_rig_session(path: str | Path) -> RigSession:
    """Return the session of a rig.

    Raises InputError for a missing file or board, an unknown key, a single camera or two of one name, a baseline
    between unknown cameras, and a board on a mount that is not listed or is on two mounts.
    """
    source = Path(path)
    table = read_toml(source, SESSION_FILE)
    boards = boards_of(table)
    options = options_of(table)
    rigid = _rigid_boards(table, boards)
    if rigid and "cameras" not in table:
        table.allow_only((*ONE_CAMERA_KEYS, "rigid_boards"))
        one = Session(path=source, images=images_of(table), boards=boards, **options)
        return RigSession(path=source, cameras={ONE: one}, frames=None, baselines=(), rigid_boards=rigid)
    if "images" in table:
        raise table.error("'images' together with [[cameras]]; give every camera its own images")
    cameras: dict[str, Session] = {}
    lenses: dict[str, Path] = {}
    for entry in table["cameras"]:
        name = entry["id"]
        if name in cameras:
            raise entry.error("its id must be its own; give it another")
        if "calibration" in entry:
            lenses[name] = entry.path_of(entry["calibration"])
        own = options_of(entry, options)
        cameras[name] = Session(path=source, images=images_of(entry), boards=boards, camera=name, **own)
    return RigSession(
        path=source,
        cameras=cameras,
        frames=table.get("frames"),
        baselines=tuple(_baseline(entry, list(cameras)) for entry in table.get("baselines", ())),
        rigid_boards=rigid,
        lenses=lenses,
        known_rig=table.path_of(table["rig"]) if "rig" in table else None,
    )


def load_any_session(path: str | Path) -> Session | RigSession:
    """Return the session of a camera or a rig; raises InputError as `load_session` and `load_rig_session`."""
    return load_rig_session(path) if is_rig_session(path) else load_session(path)


def _rigid_boards(table: TomlTable, boards: Sequence[Board]) -> tuple[RigidBoards, ...]:
    known = {b.board_id: b for b in boards}
    out: list[RigidBoards] = []
    for entry in table.get("rigid_boards", ()):
        names, layout = entry["boards"], dict(entry.get("layout", {}))
        for name in names:
            if name not in known:
                raise entry.error(f"no board is called '{name}'; known: {', '.join(known)}")
            if any(name in other.boards for other in out):
                raise entry.error(f"board '{name}' is on two mounts; remove it from one")
        for name in layout:
            if name not in names:
                raise entry.error(f"layout: '{name}' is none of its boards; use {' or '.join(names)}")
        out.append(RigidBoards(names, layout, truth_from_table(entry, [known[name] for name in names])))
    return tuple(out)


def _baseline(entry: TomlTable, names: Sequence[str]) -> MeasuredBaseline:
    for end in ("a", "b"):
        if entry[end] not in names:
            raise entry.error(f"'{end}' is '{entry[end]}', which is unknown; known: {', '.join(names)}")
    if entry["a"] == entry["b"]:
        raise entry.error(f"'a' and 'b' are both '{entry['a']}'; name two cameras")
    with entry.located():
        return MeasuredBaseline(entry["a"], entry["b"], MeasuredLength(*measured_value(entry, "mm")))


def frames_of_images(images: Mapping[str, Sequence[str]], how: str | None = None) -> dict[str, dict[str, str]]:
    """Return camera -> image -> frame; images of one moment have the same frame.

    Raises InputError: two images of a camera have the same frame, the numbers of images differ ("order"), or no two
    cameras share a frame.

    Parameters
    ----------
    images : camera -> names of its images, in their order.
    how : "name", "number", "time" or "order" (see above); None: chosen automatically.
    """
    stems = [PurePath(image).stem for own in images.values() for image in own]
    if how is None and stems and all(TIME.fullmatch(stem) for stem in stems):
        how = "time"
    counts = ", ".join(f"{len(own)} of '{name}'" for name, own in images.items())
    as_many = len(set(map(len, images.values()))) == 1
    if how == "order":
        if not as_many:
            raise InputError(f'frames = "order" needs as many images of every camera, there are {counts}')
        # In this order when sorted, and called as the first camera's images.
        called = [f"{k:04d}-{PurePath(image).stem}" for k, image in enumerate(next(iter(images.values()), ()))]
        return {name: dict(zip(own, called, strict=True)) for name, own in images.items()}
    if how == "time":
        return _frames_by_time(images)
    alike = None
    for key in (how,) if how else FRAME_KEYS:
        frames = {name: dict(zip(own, FRAME_KEYS[key](own), strict=True)) for name, own in images.items()}
        twice = _duplicate_frame(frames)
        known = sorted(frame for own in frames.values() for frame in set(own.values()))
        if twice is None and any(a == b for a, b in pairwise(known)):
            return frames
        if how and twice is not None:
            raise InputError(f'frames = "{how}": {twice} are of one frame; rename them, or use frames = "order"')
        alike = alike or twice
    if how is None and all(len(own) == 1 for own in images.values()):
        return frames_of_images(images, "order")
    remedy = "give the images of one moment one name or number"
    if as_many:
        remedy += ', or write frames = "order" in the session if the sorted lists correspond one by one'
    else:
        remedy += f", or as many of every camera in the same order; there are {counts}"
    if alike is not None:
        raise InputError(f"{alike} are simultaneous by their names, which is impossible; {remedy}")
    raise InputError(
        "no two cameras have an image of the same name or number, so simultaneous images are unknown; " + remedy
    )


def _frames_by_time(images: Mapping[str, Sequence[str]]) -> dict[str, dict[str, str]]:
    """Return the frames of images whose names are times: of each moment of the cameras before, the nearest image, if
    near. A frame has the name of its first image.

    Raises InputError for a name that is no time, or if no two cameras share a moment.
    """
    for name, own in images.items():
        for image in own:
            if not TIME.fullmatch(PurePath(image).stem):
                raise InputError(f"frames = \"time\": '{image}' of camera '{name}' is not named by a time; rename it")
    times = {name: {image: Decimal(PurePath(image).stem) for image in own} for name, own in images.items()}
    gaps = [b - a for own in times.values() for a, b in pairwise(sorted(own.values()))]
    near = MAX_PART_OF_GAP * median(gaps or [Decimal(0)])
    moments: list[Decimal] = []
    called: dict[Decimal, str] = {}
    frames: dict[str, dict[str, str]] = {}
    for name, time_of in times.items():
        moment_of = _nearest_moments(time_of, moments, near)
        for image, time in time_of.items():
            if image not in moment_of:
                moment_of[image] = time
                insort(moments, time)
        frames[name] = {image: called.setdefault(moment_of[image], PurePath(image).stem) for image in time_of}
    if twice := _duplicate_frame(frames):
        raise InputError(f"{twice} are of one time by their names; rename one")
    if sum(map(len, frames.values())) == len(moments):
        raise InputError(
            "no two cameras have images that were taken at the same moment, by the times in their names; "
            'write frames = "order" if the sorted lists correspond one by one'
        )
    return frames


def _nearest_moments(time_of: Mapping[str, Decimal], moments: Sequence[Decimal], near: Decimal) -> dict[str, Decimal]:
    """Return the moment of each image that is the nearest one of its nearest moment (sorted), and not farther than
    `near`. Of near-copies a moment has one."""
    found: dict[Decimal, tuple[Decimal, str]] = {}
    for image, time in time_of.items():
        place = bisect(moments, time)
        neighbours = [(abs(one - time), one) for one in moments[max(place - 1, 0) : place + 1]]
        gap, moment = min(neighbours, default=(near + 1, time))
        if gap <= near and (moment not in found or gap < found[moment][0]):
            found[moment] = gap, image
    return {image: moment for moment, (_, image) in found.items()}


TIME = re.compile(r"\d{10,}(\.\d+)?")
"""A name that is a time since 1970: seconds have 10 digits, nanoseconds 19."""
MAX_PART_OF_GAP = Decimal("0.25")
"""How far apart times of one moment may be, as part of the median gap between two images of a camera: cameras without a
trigger are up to half a frame apart, but images that are kept for a calibration are many frames apart."""

NAME_PART = re.compile(r"\d+|[^\W\d_]+|[\W_]+")
"""A name is a sequence of numbers, words, and what is between them."""


def _parts_that_differ(images: Sequence[str]) -> list[str]:
    """Return for each image of a camera the parts of its path and name that are not those of all its images: 07 of
    frame_07/left.png and of img_07_22113.png. Names of different structure, and of a single image, are kept whole."""
    paths = [PurePath(image) for image in images]
    parts = [[part for name in (*path.parent.parts, path.stem) for part in NAME_PART.findall(name)] for path in paths]
    if len(images) < 2 or len({len(own) for own in parts}) != 1:
        return [str(path.with_suffix("")) for path in paths]
    differ = [k for k, values in enumerate(zip(*parts, strict=True)) if len(set(values)) > 1]
    return ["_".join(own[k] for k in differ) for own in parts]


FRAME_KEYS: dict[str, Callable[[Sequence[str]], list[str]]] = {
    "name": lambda images: [PurePath(image).stem for image in images],
    "number": lambda images: [last_number(PurePath(image).stem) for image in images],
    "part": _parts_that_differ,
}


def _duplicate_frame(frames: Mapping[str, Mapping[str, str]]) -> str | None:
    """Return two images of one camera with the same frame, in words, or None."""
    for name, own in frames.items():
        seen: dict[str, str] = {}
        for image, frame in own.items():
            if frame in seen:
                return f"images '{seen[frame]}' and '{image}' of camera '{name}'"
            seen[frame] = image
    return None
