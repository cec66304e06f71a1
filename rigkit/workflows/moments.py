"""Grouping the images of several cameras by moment: by the names of files and folders, else in the order given."""

from __future__ import annotations

import logging
import re
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from rigkit.core.errors import InputError
from rigkit.core.printing import counted
from rigkit.io.manifests.rig_session import frames_of_images
from rigkit.workflows.detect import images_in
from rigkit.workflows.inputs.folder_session import cameras_in, images_of_camera
from rigkit.workflows.options.base import FrameRule

_log = logging.getLogger(__name__)

ImagesByMoment = list[list[Path]]
"""The images of every moment, one per camera."""


def warn_of_several_cameras(sources: Sequence[Path]) -> None:
    """Warn of a folder whose images are of several cameras by their names, where those of one are meant."""
    for source in filter(Path.is_dir, sources):
        with suppress(InputError):
            if len(cameras := list(cameras_in([source]))) > 1:
                _log.warning(
                    f"by their names the images in '{source}' are of {len(cameras)} cameras ({', '.join(cameras)}), "
                    "and all are taken as one camera's; give those of one"
                )


def moments_of(
    names: Sequence[str], sources: Sequence[Path], how: FrameRule | None = None
) -> tuple[ImagesByMoment, list[Path]]:
    """Return the moments of the cameras `names`, and the images without a partner.

    Sources are one folder per camera, named like the cameras or in their order; one folder, as for `cameras_in`; or the
    images themselves. These are grouped by the names of files or folders if these are equal but for the camera's name,
    else moment by moment, in the order of the cameras. `how` pairs the images of folders (`frames_of_images`). Raises
    InputError for unequal numbers of images.
    """
    if len(names) == 1:
        moments = [[image] for image in images_in(sources)]
        warn_of_several_cameras(sources)
        return moments, []
    if not all(source.is_dir() for source in sources):
        images = list(images_in(sources))
        return _by_names(names, images) or _in_order(names, images), []
    if len(sources) == 1:
        found = {name: images_of_camera(own) for name, own in cameras_in(sources, len(names)).items()}
    else:
        found = {f"{k}": list(images_in([source])) for k, source in enumerate(sources)}
        if {source.name for source in sources} == set(names):
            found = {source.name: own for source, own in zip(sources, found.values(), strict=True)}
    if len(found) != len(names):
        raise InputError(
            f"a rig of {len(names)} cameras ({', '.join(names)}) needs a folder of images for each, got {len(found)}"
        )
    columns = [found[name] for name in names] if set(found) == set(names) else list(found.values())
    return grouped_by_moment(columns, how)


def grouped_by_moment(
    columns: Sequence[Sequence[Path]], how: FrameRule | None = None
) -> tuple[ImagesByMoment, list[Path]]:
    """Return the moments of which every camera has an image of the same name or number, and the images without a
    partner; images are paired in order where names give no pairs. `how` as for `frames_of_images`.

    Raises InputError where they give none, and the cameras have unequal numbers of images.
    """
    places = [f"{own[0].parent}" for own in columns]
    keys = places if len(set(places)) == len(places) else [f"{k}" for k in range(len(places))]
    try:
        known = frames_of_images(
            {key: [path.name for path in own] for key, own in zip(keys, columns, strict=True)}, how
        )
    except InputError:
        if how is not None or len({len(own) for own in columns}) > 1:
            raise
        return [list(moment) for moment in zip(*columns, strict=True)], []
    frames = [{known[key][path.name]: path for path in own} for key, own in zip(keys, columns, strict=True)]
    shared = [frame for frame in frames[0] if all(frame in own for own in frames)]
    if not shared:
        raise InputError(
            "no frame has an image of every camera (same name or number); give images that were taken together"
        )
    single = [path for own in frames for frame, path in own.items() if frame not in shared]
    if single and how is None and len({len(own) for own in columns}) == 1:
        _log.warning(
            f"{counted(len(shared), 'moment')} by names or numbers, of {counted(len(columns[0]), 'image')} of every "
            "camera; if the sorted lists correspond one by one: --frames order"
        )
    return [[own[frame] for own in frames] for frame in shared], single


def _by_names(names: Sequence[str], images: Sequence[Path]) -> ImagesByMoment:
    """Return the moments of images whose names, or whose folders' names, are equal but for the camera's name; [] where
    some are not."""
    found: dict[tuple[str, str], dict[str, Path]] = {}
    for image in images:
        own = _sides(names, image.stem, f"{image.parent}") or _sides(names, image.parent.name, image.stem)
        if len(own) != 1:
            return []
        ((name, moment),) = own.items()
        if name in found.setdefault(moment, {}):
            return []
        found[moment][name] = image
    missing = [name for name in names if not any(name in moment for moment in found.values())]
    # A camera may be called as images are numbered.
    if missing and not any(name.isdigit() for name in names):
        raise InputError(
            f"by their names no image is of camera '{missing[0]}'; give images of each of {', '.join(names)}"
        )
    if any(len(moment) < len(names) for moment in found.values()):
        return []
    return [[moment[name] for name in names] for moment in found.values()]


def _sides(names: Sequence[str], text: str, other: str) -> dict[str, tuple[str, str]]:
    """Return for each camera whose name is in `text` the text without the name, and `other`."""
    out = {}
    for name in names:
        more = r"\d" if name[-1].isdigit() else "[a-z]"
        parts = re.split(rf"(?<![a-z]){re.escape(name)}(?!{more})", text, maxsplit=1, flags=re.IGNORECASE)
        if len(parts) == 2:
            out[name] = ("*".join(parts), other)
    return out


def _in_order(names: Sequence[str], images: Sequence[Path]) -> ImagesByMoment:
    if len(images) % len(names):
        raise InputError(
            f"{counted(len(images), 'different image')} of {len(names)} cameras ({', '.join(names)}); give as many of "
            "each camera"
        )
    return [list(images[k : k + len(names)]) for k in range(0, len(images), len(names))]
