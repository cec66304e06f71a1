"""Which boards the images of a folder show: what a manifest starts from."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rigkit.core.errors import InputError
from rigkit.core.progress import Progress, silent
from rigkit.detection.detect import detect_boards
from rigkit.io.images import read_image, to_grey
from rigkit.io.manifest_writer import Sighting, board_sizes

__all__ = ["sight_boards"]


def sight_boards(images: Sequence[Path], progress: Progress = silent) -> tuple[list[Sighting], list[InputError]]:
    """Return what boards each image shows, and why others could not be read. Raises InputError where none could."""
    found: list[Sighting] = []
    unreadable: list[InputError] = []
    for done, path in enumerate(images, start=1):
        try:
            image = read_image(path)
            sizes = board_sizes(detect_boards(to_grey(image)))
            found.append(Sighting(path, (image.shape[1], image.shape[0]), sizes))
        except InputError as error:
            unreadable.append(error)
        progress("looking for boards", done, len(images))
    if not found and unreadable:
        raise unreadable[0]
    return found, unreadable
