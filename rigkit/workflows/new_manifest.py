"""A new manifest from a folder of images: the pairs that the images show, and the file with what else was told."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from rigkit.core.boards import Board
from rigkit.core.errors import InputError
from rigkit.core.identifiers import MAX_IDENTIFIER
from rigkit.core.printing import counted
from rigkit.core.progress import Progress, silent
from rigkit.detection.detect import detect_boards
from rigkit.io.files import write_atomic
from rigkit.io.images import read_image, to_grey
from rigkit.io.manifest import load_dataset
from rigkit.io.manifest_writer import FoundPair, ImageBoards, ToldBoard, board_sizes, group_pairs, manifest_text
from rigkit.workflows.identify_board import suggested_words


@dataclass(frozen=True, eq=False, slots=True)
class FoundPairs:
    """The pairs of a folder, and why the images that are left out could not be read."""

    pairs: tuple[FoundPair, ...]
    unreadable: tuple[InputError, ...]


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class NewManifest:
    """What a manifest says.

    `root` is the folder of the images; `name` defaults to its name. `told` are the boards, or the side of a square of
    all chessboards found, mm. `calibrations` maps a camera to the path of its
    file, absolute or from the folder of the manifest. `cameras`, `pose_types`, `baselines` (mm, sigma mm) and `angles`
    between every two boards (deg, sigma deg) go by the names of the pairs.
    """

    root: Path
    pairs: Sequence[FoundPair]
    told: Sequence[ToldBoard] | float
    calibrations: Mapping[str, str]
    cameras: Mapping[str, tuple[str, str]]
    pose_types: Mapping[str, str]
    baselines: Mapping[str, tuple[float, float]]
    angles: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    name: str | None = None


def find_pairs(
    root: Path, images: Sequence[Path], boards: Sequence[Board] = (), *, on_progress: Progress = silent
) -> FoundPairs:
    """Return the pairs among `images`, which lie below `root`, that show `boards`, or any chessboards.

    Raises InputError where no image can be read, or none shows a board that was looked for.
    """
    shown: list[ImageBoards] = []
    unreadable: list[InputError] = []
    for done, path in enumerate(images, start=1):
        try:
            image = read_image(path)
            sizes = board_sizes(detect_boards(to_grey(image), boards or None))
            shown.append(ImageBoards(path, (image.shape[1], image.shape[0]), sizes))
        except InputError as error:
            unreadable.append(error)
        on_progress("looking for boards", done, len(images))
    if not shown and unreadable:
        raise unreadable[0]
    if not any(image.boards for image in shown):
        what = "of the boards told is" if boards else "chessboard is"
        seen = suggested_words(images)
        such = f"they show --board {seen}, with MM measured" if seen else "other boards must be told: --board"
        raise InputError(f"init: no {what} found in {counted(len(shown), 'image')}; {such}")
    return FoundPairs(tuple(group_pairs(shown, root)), tuple(unreadable))


def write_manifest(new: NewManifest, path: Path, *, force: bool = False) -> InputError | None:
    """Write the manifest and return what it still lacks to be loaded, or None.

    Raises InputError where the file exists, unless `force`, or cannot be written.
    """
    text = manifest_text(
        new.name or _name_of(new.root),
        path.parent.resolve(),
        new.pairs,
        new.told,
        new.calibrations,
        new.cameras,
        new.pose_types,
        new.baselines,
        new.angles,
    )
    write_atomic(path, text, force=force)
    try:
        load_dataset(path)
    except InputError as error:
        return error
    return None


def _name_of(folder: Path) -> str:
    """Return the folder's name without the letters that no data set's name has."""
    return re.sub(r"[^\w .+()-]|^\W+|\.(?=\.)", "", folder.name)[:MAX_IDENTIFIER].strip() or "data"
