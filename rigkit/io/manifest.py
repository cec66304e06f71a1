"""Data sets: which images were taken with which cameras of which boards, and what a person measured."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

from rigkit.core.boards import Board
from rigkit.core.errors import InputError
from rigkit.core.planes import PLANE_CHOICES, Planes
from rigkit.core.posetype import PoseType
from rigkit.core.printing import brief
from rigkit.core.truth import PairTruth
from rigkit.identification.board_ids import BOARD_SIDES
from rigkit.io.board_file import board_from_table, load_board
from rigkit.io.reading import usable_path
from rigkit.io.session import SESSION_NAME, files_of_session
from rigkit.io.toml_reader import TomlTable, read_toml
from rigkit.io.truth_csv import load_truth_csv
from rigkit.io.truth_file import truth_from_table

DATASET_SCHEMA = "rigkit.dataset/1"
MANIFEST = "dataset.toml"

Entry = TypeVar("Entry")


@dataclass(frozen=True, slots=True)
class CameraEntry:
    """A camera of a data set.

    Attributes
    ----------
    camera_id : its name in the manifest.
    calibration : the calibration file; need not exist yet if there is a session.
    session : the session file to calibrate from, or None.
    """

    camera_id: str
    calibration: Path
    session: Path | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Pair:
    """Two images of the same boards.

    Attributes
    ----------
    pair_id : its name.
    camera1, camera2 : names of cameras; the same name where one camera was moved.
    image1, image2 : files.
    pose_type : as declared; AUTO lets the data decide.
    level_sigma_deg : how well the spirit level held: a soft prior; 0: exactly; None: as a carefully set one does.
    boards : the boards that stand there.
    truth : what a person measured.
    layout : board id -> "left", "right", "floor", "ceiling" or "back", as seen from camera 1; empty where not stated.
    planes : what is known of a board's points, see `Planes`.
    down : which way is down in the frames of camera 1 and 2, for planar motion of cameras that are not level; or None.
    """

    pair_id: str
    camera1: CameraEntry
    camera2: CameraEntry
    image1: Path
    image2: Path
    pose_type: PoseType
    level_sigma_deg: float | None
    boards: tuple[Board, ...]
    truth: PairTruth
    layout: dict[str, str]
    planes: Planes = "free"
    down: tuple[tuple[float, ...], tuple[float, ...]] | None = None

    @property
    def board_ids(self) -> tuple[str, ...]:
        return tuple(board.board_id for board in self.boards)

    def require_images(self) -> None:
        """Raise InputError if an image is not there: worth knowing before the work starts."""
        for number, path in ((1, self.image1), (2, self.image2)):
            if not path.is_file():
                what = "is a folder" if path.is_dir() else "does not exist"
                raise InputError(f"pair '{self.pair_id}': image{number} '{path}' {what}; correct the manifest")


@dataclass(frozen=True, slots=True, kw_only=True)
class Dataset:
    """A manifest as read; every path is absolute; `sources` are the files of boards and truth that it names; `images`
    says "real" or "rendered", None where the manifest does not."""

    name: str
    root: Path
    manifest: Path
    boards: tuple[Board, ...]
    cameras: tuple[CameraEntry, ...]
    pairs: tuple[Pair, ...]
    sources: tuple[Path, ...] = ()
    images: str | None = None

    __repr__ = brief

    @property
    def inputs(self) -> tuple[Path, ...]:
        """The files that work on this data set may read, which no result may be written over."""
        images = (image for pair in self.pairs for image in (pair.image1, pair.image2))
        calibrations = (camera.calibration for camera in self.cameras if camera.calibration.is_file())
        sessions = (camera.session for camera in self.cameras if camera.session is not None)
        read = (path for session in sessions for path in _files_of(session))
        return (self.manifest, *self.sources, *images, *calibrations, *read)

    @property
    def used_cameras(self) -> frozenset[str]:
        """The ids of the cameras that a pair was taken with."""
        return frozenset(e.camera_id for pair in self.pairs for e in (pair.camera1, pair.camera2))

    def pair(self, pair_id: str) -> Pair:
        """Return the pair of that name; raises InputError that lists the known ones."""
        return _named(pair_id, {p.pair_id: p for p in self.pairs}, f"{self.manifest}: pair")

    def camera(self, camera_id: str) -> CameraEntry:
        """Return the camera of that name; raises InputError that lists the known ones."""
        return _named(camera_id, {c.camera_id: c for c in self.cameras}, f"{self.manifest}: camera")

    def select(self, pair_ids: Iterable[str]) -> Dataset:
        """Return the data set with only these pairs, in the order of the manifest; all of them where none is named."""
        wanted = {self.pair(name).pair_id for name in pair_ids}
        return replace(self, pairs=tuple(p for p in self.pairs if p.pair_id in wanted)) if wanted else self


def load_dataset(path: str | Path) -> Dataset:
    """Read a manifest, given its folder or the file itself.

    Raises
    ------
    InputError
        No manifest, unknown keys, a missing fact (no square size, pose type or name has a default), a reference to
        something that is not declared, two things of one name, a camera with neither calibration nor session.
    """
    given = usable_path(path)
    source = given / MANIFEST if given.is_dir() else given
    if not source.is_file():
        what = f"folder '{given}' has no {MANIFEST}" if given.is_dir() else f"data set '{given}' does not exist"
        raise InputError(f"{what}; write one, or let `rigkit init` start it")
    source = source.resolve()
    top = read_toml(source, DATASET_SCHEMA)
    name = top.identifier("name", hint='name = "my-lab"')
    images = top.text("images", hint='images = "real"', choices=("real", "rendered")) if top.has("images") else None
    boards = tuple(_board(t) for t in top.tables("boards", hint='[[boards]] with id = "plane1" and file or sizes'))
    cameras = tuple(_camera(t) for t in top.tables("cameras", hint='[[cameras]] with id = "left" and calibration'))
    _refuse_twice(top, "boards", [b.board_id for b in boards])
    _refuse_twice(top, "cameras", [c.camera_id for c in cameras])
    planes = _planes(top) if top.has("planes") else "free"
    pairs = tuple(_pair(t, boards, cameras, planes) for t in top.tables("pairs", hint='[[pairs]] with id = "first"'))
    _refuse_twice(top, "pairs", [p.pair_id for p in pairs])
    if top.has("truth_table"):
        pairs = _with_table(top, pairs)
    top.done()
    named = [table.path_to("file", hint="") for table in top.tables("boards", hint="") if table.has("file")]
    if top.has("truth_table"):
        named.append(top.path_to("truth_table", hint=""))
    return Dataset(
        name=name,
        root=source.parent,
        manifest=source,
        boards=boards,
        cameras=cameras,
        pairs=pairs,
        sources=tuple(named),
        images=images,
    )


def _files_of(session: Path) -> tuple[Path, ...]:
    """Return what a calibration from the session reads; of a damaged one itself: that is said where it is needed."""
    try:
        return files_of_session(session)
    except InputError:
        return (session,)


def _board(table: TomlTable) -> Board:
    board_id = table.identifier("id", hint='id = "plane1"')
    if table.has("file"):
        path = table.path_to("file", hint='file = "board.toml"')
        with table.located():
            board = replace(load_board(path), board_id=board_id)
    else:
        board = board_from_table(table, board_id)
    table.done()
    return board


def _camera(table: TomlTable) -> CameraEntry:
    camera_id = table.identifier("id", hint='id = "left"')
    calibration = table.path_to("calibration", hint='calibration = "calibration.json"')
    session: Path | None = calibration.with_name(SESSION_NAME)
    if table.has("session"):
        session = table.path_to("session", hint='session = "session.toml"')
        if not session.is_file():
            raise table.error(f"session '{session}' does not exist; correct the path")
    elif session is not None and not session.is_file():
        session = None
    if session is None and not calibration.is_file():
        raise table.error(
            f"calibration '{calibration}' does not exist, nor a {SESSION_NAME} beside it to calibrate from; correct "
            "the path"
        )
    table.done()
    return CameraEntry(camera_id, calibration, session)


def _planes(table: TomlTable) -> Planes:
    given = table.text("planes", hint='planes = "coplanar"', choices=PLANE_CHOICES)
    return next(choice for choice in PLANE_CHOICES if choice == given)


def _pair(table: TomlTable, boards: Sequence[Board], cameras: Sequence[CameraEntry], default_planes: Planes) -> Pair:
    pair_id = table.identifier("id", hint='id = "left-right"')
    by_camera = {c.camera_id: c for c in cameras}
    by_board = {b.board_id: b for b in boards}
    place = f"{table.path}: {table.where}"
    camera1, camera2 = (
        _named(table.text(key, hint=f'{key} = "{cameras[0].camera_id}"'), by_camera, f"{place}: {key}")
        for key in ("camera1", "camera2")
    )
    image1 = table.path_to("image1", hint='image1 = "images/view1.jpg"')
    image2 = table.path_to("image2", hint='image2 = "images/view2.jpg"')
    kinds = [str(kind) for kind in PoseType]
    pose_type = PoseType(table.text("pose_type", hint=f'pose_type = "general" ({", ".join(kinds)})', choices=kinds))
    names = table.texts("boards", hint="boards = [" + ", ".join(f'"{b}"' for b in by_board) + "]")
    if not names:
        raise table.error("'boards' is empty; name the boards that stand in this pair")
    chosen = tuple(_named(n, by_board, f"{place}: board") for n in names)
    level, down = _level(table, pose_type) if table.has("level") else (None, None)
    truth = PairTruth()
    if table.has("truth"):
        truth = truth_from_table(table.table("truth", hint="[pairs.truth]"), chosen)
    layout = _layout(table, names) if table.has("layout") else {}
    planes = _planes(table) if table.has("planes") else default_planes
    table.done()
    return Pair(
        pair_id=pair_id,
        camera1=camera1,
        camera2=camera2,
        image1=image1,
        image2=image2,
        pose_type=pose_type,
        level_sigma_deg=level,
        boards=chosen,
        truth=truth,
        layout=layout,
        planes=planes,
        down=down,
    )


def _level(
    table: TomlTable, pose_type: PoseType
) -> tuple[float | None, tuple[tuple[float, ...], tuple[float, ...]] | None]:
    """Return how well the level held, and which way is down in either camera where that was said."""
    inner = table.table("level", hint="level = { sigma_deg = 0.2 }")
    has_down = [inner.has(key) for key in ("down1", "down2")]
    sigma, down = None, None
    if inner.has("sigma_deg") or not any(has_down):
        sigma = inner.number("sigma_deg", hint="sigma_deg = 0.2", positive=False)
        if sigma < 0.0:
            raise inner.error(f"'sigma_deg' must not be negative, got {sigma:g}; 0 means exactly level")
    if any(has_down):
        if pose_type is not PoseType.PLANAR:
            raise inner.error(f"'down1' and 'down2' are for planar motion, not for '{pose_type}'; leave them out")
        first, second = (inner.numbers(key, hint=f"{key} = [0.0, 0.98, 0.17]") for key in ("down1", "down2"))
        for key, values in (("down1", first), ("down2", second)):
            if len(values) != 3 or not any(values):
                raise inner.error(f"'{key}' must be three numbers, not all zero, got {list(values)}")
        down = (first, second)
    inner.done()
    return sigma, down


def _layout(table: TomlTable, names: Sequence[str]) -> dict[str, str]:
    inner = table.table("layout", hint='layout = { plane1 = "left", plane2 = "floor", plane3 = "right" }')
    out = {}
    for board_id in inner.names():
        _named(board_id, dict.fromkeys(names, 0), f"{inner.path}: {inner.where}: board")
        out[board_id] = inner.text(board_id, hint=f'{board_id} = "left"', choices=tuple(BOARD_SIDES))
    return out


def _with_table(top: TomlTable, pairs: tuple[Pair, ...]) -> tuple[Pair, ...]:
    """Add what a spreadsheet says to the pairs; a pair's truth is either there or in the manifest."""
    source = top.path_to("truth_table", hint='truth_table = "truth.csv"')
    stated = load_truth_csv(source, {pair.pair_id: pair.boards for pair in pairs})
    for pair in pairs:
        if pair.truth.count and pair.pair_id in stated:
            raise top.error(f"pair '{pair.pair_id}' has its truth both here and in '{source}'; keep one of them")
    return tuple(replace(pair, truth=stated.get(pair.pair_id, pair.truth)) for pair in pairs)


def _named(name: str, known: Mapping[str, Entry], where: str) -> Entry:
    if name not in known:
        raise InputError(f"{where} '{name}' is not declared; known: {', '.join(known)}")
    return known[name]


def _refuse_twice(table: TomlTable, what: str, names: Sequence[str]) -> None:
    for name in names:
        if names.count(name) > 1:
            raise table.error(f"[[{what}]]: '{name}' is declared twice; give every one its own id")
