"""Descriptions of public captures with measured truth: measurements, licence, source, and the files' hashes.

::

    schema = "rigkit.public/1"
    name = "bumblebee2"
    about = "11 stereo pairs of a chessboard"
    rendered = false
    source = "https://github.com/..."
    licence = "CC-BY-4.0"
    folder = "public/bumblebee2"     # where its files are in a folder of captures

    [[measured]]                     # and [[boards]], as in a board's file
    id = "baseline"
    value = 120.0
    sigma = 0.1                      # optional: where nobody stated it, it is not there
    unit = "mm"
    how = "the maker's data sheet"

    [files]                          # SHA-256 of each file
    "left01.jpg" = "..."

    [urls]                           # where to fetch them; a file without is not fetchable yet
    "left01.jpg" = "https://.../archive.tar.gz#folder/left01.jpg"      # # names a file in a .tar or .zip
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from rigkit.core.boards import Board
from rigkit.core.errors import InputError
from rigkit.io.boards.board_file import BOARD_KEYS, measured_board
from rigkit.io.disk.schema_builders import BOOLEAN, NAME, NUMBER, POSITIVE, TEXT, choice, described, file, rows, table
from rigkit.io.disk.toml_reader import TomlTable, read_toml

_HASH = "a SHA-256; write the 64 characters of 0-9 and a-f that `sha256sum` prints"
PUBLIC_FILE = file(
    "rigkit.public/1",
    "A public capture, and what somebody measured of it",
    {
        "name": described(NAME, "of the set", "bumblebee2"),
        "about": described(TEXT, "what it is", "11 stereo pairs of a chessboard"),
        "source": described(TEXT, "where it comes from", "https://github.com/..."),
        "licence": described(TEXT, "of its files", "CC-BY-4.0"),
        "rendered": described(BOOLEAN, "images of a computer, not of a camera", False),
        "folder": described(TEXT, "where its files are in a folder of captures", "public/bumblebee2"),
        "boards?": rows({"id?": described(NAME, "its name", "board"), **BOARD_KEYS}, "boards in its images"),
        "measured?": rows(
            {
                "id": described(TEXT, "what was measured", "baseline"),
                "value": described(NUMBER, "how much", 120.0),
                "sigma?": described(POSITIVE, "where somebody stated one", 0.1),
                "unit": choice("mm", "deg", "px"),
                "how": described(TEXT, "instrument: steel rule, set square, calipers", "calipers"),
            },
            "what is known of it",
        ),
        "files": described(table(described({**TEXT, "pattern": "^[0-9a-f]{64}$"}, _HASH)), "SHA-256 of each file"),
        "urls?": described(
            table(described({**TEXT, "pattern": r"^(https?|file)://\S+$"}, "an address (https://...)")),
            "where to fetch them; after # a file in a .tar or .zip",
        ),
    },
)


@dataclass(frozen=True, slots=True)
class PublicMeasurement:
    """A measured quantity; `sigma` is None if not stated, `how` names the instrument."""

    what: str
    value: float
    sigma: float | None
    unit: str
    how: str


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class PublicSet:
    """A public capture.

    Attributes
    ----------
    path : file of the description.
    name, about, source, licence : texts.
    rendered : whether the images are rendered, not real.
    folder : folder of its files in the folder of captures.
    boards : boards in its images.
    measured : measured quantities.
    sha256 : hash of each file by its path in the set.
    urls : addresses of files that can be downloaded.
    """

    path: Path
    name: str
    about: str
    source: str
    licence: str
    rendered: bool
    folder: str
    boards: tuple[Board, ...]
    measured: tuple[PublicMeasurement, ...]
    sha256: Mapping[str, str]
    urls: Mapping[str, str]

    def measurement(self, what: str) -> PublicMeasurement:
        """Return the measurement of this name; raises InputError that lists the known ones."""
        for measurement in self.measured:
            if measurement.what == what:
                return measurement
        names = ", ".join(m.what for m in self.measured)
        raise InputError(f"{self.path}: nothing called '{what}' was measured; there are {names}")


def load_public_set(path: str | Path) -> PublicSet:
    """Return the description of a public capture.

    Raises InputError for a missing or unknown key, a path outside of the set, an invalid hash or address, or an address
    of a file that is not listed.
    """
    top = read_toml(path, PUBLIC_FILE)
    sha256, urls = ({_inside(top, f): value for f, value in top.get(key, {}).items()} for key in ("files", "urls"))
    for key, listed in (("files", sha256), ("urls", urls)):
        if key in top and not listed:
            raise top.error(f"[{key}] is empty; list the files of the set")
    for name in urls:
        if name not in sha256:
            raise top.error(f"[urls]: '{name}' is not in [files]; add its hash")
    return PublicSet(
        path=Path(path),
        **{key: top[key] for key in ("name", "about", "source", "licence", "rendered")},
        folder=_inside(top, top["folder"]),
        boards=tuple(measured_board(entry, "board") for entry in top.get("boards", ())),
        measured=tuple(
            PublicMeasurement(entry["id"], entry["value"], entry.get("sigma"), entry["unit"], entry["how"])
            for entry in top.get("measured", ())
        ),
        sha256=sha256,
        urls=urls,
    )


def _inside(top: TomlTable, name: str) -> str:
    """Return the relative path `name`; raises InputError if it leaves its folder."""
    path = PurePosixPath(name)
    if path.is_absolute() or ".." in path.parts or "\\" in name or ":" in name:
        raise top.error(f"'{name}' leaves the folder of the set; give a path in it, with /")
    return path.as_posix()
