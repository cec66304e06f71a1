"""`rigkit init`: pairs among the images of a folder, and the manifest file."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from rigkit.core.boards import Board
from rigkit.core.errors import InputError
from rigkit.core.identifiers import MAX_IDENTIFIER
from rigkit.core.printing import counted
from rigkit.core.progress import Progress, silent
from rigkit.detection.detect import detect_boards
from rigkit.io.disk.writing import write_atomic
from rigkit.io.manifests.manifest import load_dataset
from rigkit.io.manifests.manifest_writer import (
    FoundPair,
    ImageBoards,
    NewManifest,
    group_pairs,
    image_boards,
    manifest_text,
)
from rigkit.io.media.images import read_image, require_size, to_grey
from rigkit.workflows.inputs.camera_files import camera_with_calibration
from rigkit.workflows.inputs.identify_board import suggestion


@dataclass(frozen=True, eq=False, slots=True)
class FoundPairs:
    """The pairs of a folder, the errors of images that cannot be read, and the pairs that show again what another one
    does, with that."""

    pairs: tuple[FoundPair, ...]
    unreadable: tuple[InputError, ...]
    repeated: tuple[tuple[FoundPair, FoundPair], ...] = ()


def find_pairs(
    root: Path, images: Sequence[Path], boards: Sequence[Board] = (), *, progress: Progress = silent
) -> FoundPairs:
    """Return the pairs among `images` below `root` that show `boards`, by default chessboards of any size.

    Raises InputError if no image can be read, or none shows such a board.
    """
    shown: list[ImageBoards] = []
    unreadable: list[InputError] = []
    for done, path in enumerate(images, start=1):
        try:
            image = read_image(path)
            found = detect_boards(to_grey(image), boards or None)
            shown.append(image_boards(path, (image.shape[1], image.shape[0]), found))
        except InputError as error:
            unreadable.append(error)
        progress("looking for boards", done, len(images))
    if not shown and unreadable:
        raise unreadable[0]
    if not any(image.boards for image in shown):
        what = "none of the boards given" if boards else "no chessboard"
        seen = suggestion(images).words
        such = f"they show --board {seen}, with MM measured" if seen else "give other boards with --board"
        raise InputError(f"init: {what} is found in {counted(len(shown), 'image')}; {such}")
    pairs: list[FoundPair] = []
    repeated: list[tuple[FoundPair, FoundPair]] = []
    # Captures are above the folders of their results, whose names may have the captures' within them.
    for pair in sorted(
        group_pairs(shown, root), key=lambda one: (len(one.first.image.parts), len(one.first.image.stem))
    ):
        before = next((one for one in pairs if pair.repeats(one)), None)
        if before is None:
            pairs.append(pair)
        else:
            repeated.append((pair, before))
    return FoundPairs(tuple(sorted(pairs, key=lambda one: one.name)), tuple(unreadable), tuple(repeated))


def write_manifest(new: NewManifest, path: Path, *, force: bool = False) -> InputError | None:
    """Write the manifest; return the error of loading it if it is incomplete, else None.

    Raises InputError if the file exists, unless `force`, or cannot be written, and for images of another size than the
    calibration of their camera.
    """
    for name, file in new.calibrations.items():
        calibration = path.parent / file
        if calibration.is_file():
            size_px = camera_with_calibration(calibration)[0].size_px
            for pair in new.pairs:
                for image, own in zip((pair.first, pair.second), new.cameras[pair.name], strict=True):
                    if own == name:
                        require_size(image.size_px, f"image '{image.image}'", size_px, calibration)
    write_atomic(path, manifest_text(new, path.parent.resolve()), force=force)
    try:
        load_dataset(path)
    except InputError as error:
        return error
    return None


def name_of_folder(folder: Path) -> str:
    """Return the folder's name without characters that names of data sets cannot have."""
    return re.sub(r"[^\w .+()-]|^\W+|\.(?=\.)", "", folder.name)[:MAX_IDENTIFIER].strip() or "data"
