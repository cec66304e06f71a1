"""Manifests of data sets: pairs of images with their cameras and boards, and measured truth."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

from rigkit.core.boards import Board
from rigkit.core.choices import PLANE_CHOICES, Planes
from rigkit.core.errors import InputError
from rigkit.core.posetype import PoseType
from rigkit.core.printing import brief
from rigkit.core.truth import PairTruth
from rigkit.identification.board_ids import BOARD_SIDES
from rigkit.io.boards.board_file import BOARD_KEYS, load_board, measured_board
from rigkit.io.disk.reading import usable_path
from rigkit.io.disk.schema_builders import (
    NAME,
    NUMBER,
    TEXT,
    Schema,
    choice,
    described,
    file,
    obj,
    optional,
    row,
    rows,
    table,
    texts,
)
from rigkit.io.disk.toml_reader import TomlTable, read_toml
from rigkit.io.manifests.session import SESSION_NAME, files_of_session
from rigkit.io.manifests.truth_csv import load_truth_csv
from rigkit.io.manifests.truth_file import TRUTH_KEYS, measured, truth_from_table

DATASET_SCHEMA = "rigkit.dataset/1"
MANIFEST = "dataset.toml"
_DOWN = [0.0, 0.98, 0.17]
_LEVEL: Schema = {
    **obj(
        {
            "sigma_deg?": described({**NUMBER, "minimum": 0}, "standard deviation of the level; 0: exactly level", 0.2),
            "down1?": described(row(3), "which way is down in camera 1, for planar motion", _DOWN),
            "down2?": described(row(3), "the same in camera 2", _DOWN),
        },
        "the spirit level; by default a carefully set one",
    ),
    "examples": [{"sigma_deg": 0.2}],
    "dependentRequired": {"down1": ["down2"], "down2": ["down1"]},
}
_PAIR_KEYS: Mapping[str, Schema] = {
    "id": described(NAME, "its name", "left-right"),
    "camera1": described(TEXT, "that took image1", "left"),
    "camera2": described(TEXT, "that took image2", "right"),
    "image1": described(TEXT, "file", "images/view1.jpg"),
    "image2": described(TEXT, "file", "images/view2.jpg"),
    "boards": described(texts(1), "those that stand there", ["plane1", "plane2"]),
    "pose_type": described(
        choice(*map(str, PoseType)),
        "general; planar: turned about the vertical, moved in the horizontal plane; standard: moved along x; forward: "
        "along z; auto: the images say",
    ),
    "level?": _LEVEL,
    "layout?": described(
        table(choice(*BOARD_SIDES)),
        "positions of boards that look alike, seen from camera 1",
        {"plane1": "left", "plane2": "floor", "plane3": "right"},
    ),
    "planes?": described(choice(*PLANE_CHOICES), "of this pair, where it differs"),
    "truth?": obj(
        {"baseline?": obj(measured("mm"), "distance between the two entrance pupils"), **TRUTH_KEYS},
        "measured ground truth",
    ),
}
DATASET_FILE = file(
    DATASET_SCHEMA,
    "Pairs of images with measured ground truth",
    {
        "name": described(NAME, "of the data set", "my-lab"),
        "boards": rows(
            {
                "id": described(NAME, "its name", "plane1"),
                "file?": described(TEXT, "of the board, or its keys here", "board.toml"),
                **optional(BOARD_KEYS),
            },
            "boards in the images",
            min_items=1,
        ),
        "cameras": rows(
            {
                "id": described(NAME, "its name", "left"),
                "calibration": described(TEXT, "its file", "calibration.json"),
                "session?": described(
                    TEXT, "to calibrate it from; by default session.toml beside the calibration", SESSION_NAME
                ),
            },
            "the cameras; one that was moved is one",
            min_items=1,
        ),
        "pairs": rows(_PAIR_KEYS, "two images of the same boards each", min_items=1),
        "images?": described(
            choice("real", "rendered"), "real or rendered images: printed beside ratios to the paper's results"
        ),
        "planes?": described(
            choice(*PLANE_CHOICES),
            "planes for angles and clouds: free (every point by itself, the default), coplanar (points of a board in "
            "one plane), or lattice (on its known grid)",
        ),
        "truth_table?": described(TEXT, "a CSV file with what was measured, kept in a spreadsheet", "truth.csv"),
    },
)

Entry = TypeVar("Entry")


@dataclass(frozen=True, slots=True)
class CameraEntry:
    """A camera of a data set.

    Attributes
    ----------
    camera_id : name in the manifest.
    calibration : calibration file; need not exist if there is a session.
    session : session file to calibrate from, or None.
    """

    camera_id: str
    calibration: Path
    session: Path | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Pair:
    """Two images of the same boards.

    Attributes
    ----------
    pair_id : name of the pair.
    camera1, camera2 : cameras; the same one if one camera was moved.
    image1, image2 : image files.
    pose_type : as declared; AUTO lets the data decide.
    level_sigma_deg : standard deviation of the levelling, a prior; 0: exactly level; None: that of careful levelling.
    boards : boards in the images.
    truth : measured truth.
    layout : board id -> "left", "right", "floor", "ceiling" or "back", as seen from camera 1; may be empty.
    planes : constraint on a board's points, see `Planes`.
    down : direction of gravity in the frames of cameras 1 and 2, for planar motion of tilted cameras, or None.
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
        """Raise InputError if an image file does not exist."""
        for number, path in ((1, self.image1), (2, self.image2)):
            if not path.is_file():
                what = "is a folder" if path.is_dir() else "does not exist"
                raise InputError(f"pair '{self.pair_id}': image{number} '{path}' {what}; correct the manifest")


@dataclass(frozen=True, slots=True, kw_only=True)
class Dataset:
    """The content of a manifest, with absolute paths.

    Attributes
    ----------
    sources : files of boards and truth that the manifest names.
    images : "real" or "rendered"; None if not stated.
    """

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
        """All files that work on this data set may read; results must not replace them."""
        images = (image for pair in self.pairs for image in (pair.image1, pair.image2))
        calibrations = (camera.calibration for camera in self.cameras if camera.calibration.is_file())
        sessions = (camera.session for camera in self.cameras if camera.session is not None)
        read = (path for session in sessions for path in _files_of(session))
        return (self.manifest, *self.sources, *images, *calibrations, *read)

    @property
    def used_cameras(self) -> frozenset[str]:
        """Ids of the cameras that pairs use."""
        return frozenset(e.camera_id for pair in self.pairs for e in (pair.camera1, pair.camera2))

    def pair(self, pair_id: str) -> Pair:
        """Return the pair of that name; raises InputError that lists the known ones."""
        return _declared(pair_id, {p.pair_id: p for p in self.pairs}, f"{self.manifest}: pair")

    def camera(self, camera_id: str) -> CameraEntry:
        """Return the camera of that name; raises InputError that lists the known ones."""
        return _declared(camera_id, {c.camera_id: c for c in self.cameras}, f"{self.manifest}: camera")

    def select(self, pair_ids: Iterable[str]) -> Dataset:
        """Return the data set with these pairs only, in the order of the manifest; with all if none is named."""
        wanted = {self.pair(name).pair_id for name in pair_ids}
        return replace(self, pairs=tuple(p for p in self.pairs if p.pair_id in wanted)) if wanted else self


def load_dataset(path: str | Path) -> Dataset:
    """Return the data set of a manifest, given its folder or file.

    Raises InputError: no manifest, an unknown or missing key, a reference to something undeclared, a duplicate id, or a
    camera with neither calibration nor session.
    """
    given = usable_path(path)
    source = given / MANIFEST if given.is_dir() else given
    if not source.is_file():
        what = f"folder '{given}' has no {MANIFEST}" if given.is_dir() else f"data set '{given}' does not exist"
        raise InputError(f"{what}; write one, or let `rigkit init` start it")
    source = source.resolve()
    top = read_toml(source, DATASET_FILE)
    for what in ("boards", "cameras", "pairs"):
        names = [entry["id"] for entry in top[what]]
        if twice := [name for name in names if names.count(name) > 1]:
            raise top.error(f"[[{what}]]: '{twice[0]}' is declared twice; give every one its own id")
    boards = tuple(map(_board, top["boards"]))
    cameras = tuple(map(_camera, top["cameras"]))
    pairs = tuple(_pair(entry, boards, cameras, top.get("planes", "free")) for entry in top["pairs"])
    if "truth_table" in top:
        pairs = _with_table(top, pairs)
    return Dataset(
        name=top["name"],
        root=source.parent,
        manifest=source,
        boards=boards,
        cameras=cameras,
        pairs=pairs,
        sources=tuple(
            t.path_of(t[key]) for t, key in (*((b, "file") for b in top["boards"]), (top, "truth_table")) if key in t
        ),
        images=top.get("images"),
    )


def _files_of(session: Path) -> tuple[Path, ...]:
    """Return the files that a calibration from the session reads; only the session itself if it is damaged."""
    try:
        return files_of_session(session)
    except InputError:
        return (session,)


def _board(entry: TomlTable) -> Board:
    if "file" not in entry:
        return measured_board(entry, entry["id"])
    entry.allow_only(("id", "file"))
    with entry.located():
        return replace(load_board(entry.path_of(entry["file"])), board_id=entry["id"])


def _camera(entry: TomlTable) -> CameraEntry:
    calibration = entry.path_of(entry["calibration"])
    session: Path | None = calibration.with_name(SESSION_NAME)
    if "session" in entry:
        session = entry.path_of(entry["session"])
        if not session.is_file():
            raise entry.error(f"session '{session}' does not exist; correct the path")
    elif session is not None and not session.is_file():
        session = None
    if session is None and not calibration.is_file():
        raise entry.error(
            f"calibration '{calibration}' does not exist, nor a {SESSION_NAME} beside it to calibrate from; correct "
            "the path"
        )
    return CameraEntry(entry["id"], calibration, session)


def _pair(entry: TomlTable, boards: Sequence[Board], cameras: Sequence[CameraEntry], default_planes: Planes) -> Pair:
    by_camera, by_board = {c.camera_id: c for c in cameras}, {b.board_id: b for b in boards}
    place = f"{entry.path}: {entry.where}"
    camera1, camera2 = (_declared(entry[key], by_camera, f"{place}: {key}") for key in ("camera1", "camera2"))
    pose_type = PoseType(entry["pose_type"])
    chosen = tuple(_declared(name, by_board, f"{place}: board") for name in entry["boards"])
    layout = dict(entry.get("layout", {}))
    for board_id in layout:
        _declared(board_id, dict.fromkeys(entry["boards"], 0), f"{place}, 'layout': board")
    level, down = _level(entry["level"], pose_type) if "level" in entry else (None, None)
    return Pair(
        pair_id=entry["id"],
        camera1=camera1,
        camera2=camera2,
        image1=entry.path_of(entry["image1"]),
        image2=entry.path_of(entry["image2"]),
        pose_type=pose_type,
        level_sigma_deg=level,
        boards=chosen,
        truth=truth_from_table(entry.get("truth", {}), chosen),
        layout=layout,
        planes=entry.get("planes", default_planes),
        down=down,
    )


def _level(
    level: TomlTable, pose_type: PoseType
) -> tuple[float | None, tuple[tuple[float, ...], tuple[float, ...]] | None]:
    """Return the standard deviation of the level, and the direction of gravity in both cameras if stated."""
    if "down1" not in level:
        return level["sigma_deg"], None
    if pose_type is not PoseType.PLANAR:
        raise level.error(f"'down1' and 'down2' are for planar motion, not for '{pose_type}'; leave them out")
    for key in ("down1", "down2"):
        if not any(level[key]):
            raise level.error(f"'{key}' must be three numbers, not all zero, got {list(level[key])}")
    return level.get("sigma_deg"), (level["down1"], level["down2"])


def _with_table(top: TomlTable, pairs: tuple[Pair, ...]) -> tuple[Pair, ...]:
    """Return the pairs with the truth of the spreadsheet; a pair's truth must not be in both."""
    source = top.path_of(top["truth_table"])
    stated = load_truth_csv(source, {pair.pair_id: pair.boards for pair in pairs})
    for pair in pairs:
        if pair.truth.count and pair.pair_id in stated:
            raise top.error(f"pair '{pair.pair_id}' has its truth both here and in '{source}'; keep one of them")
    return tuple(replace(pair, truth=stated.get(pair.pair_id, pair.truth)) for pair in pairs)


def _declared(name: str, known: Mapping[str, Entry], where: str) -> Entry:
    if name not in known:
        raise InputError(f"{where} '{name}' is not declared; known: {', '.join(known)}")
    return known[name]
