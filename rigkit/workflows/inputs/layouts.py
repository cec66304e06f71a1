"""How the images of several cameras may be arranged: by the structure of their paths, without a list of words.

One part of the paths names the camera, and the rest, equal for all cameras, the moment: linke Kamera/07.png,
frame07_A.png, frame_0007/left.png. Images of one camera may be named like that, too (near_1, far_1; a folder for each
day), so only the boards in the images decide: `rigkit.workflows.inputs.layout_evidence`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from rigkit.core.errors import InputError
from rigkit.core.identifiers import is_identifier, natural_key
from rigkit.io.manifests.rig_session import NAME_PART, frames_of_images

MAX_CAMERAS = 8
MIN_MOMENTS = 3
"""Fewer pairs of images do not show whether boards move alike between two cameras."""
MIN_SHARE = 0.5
"""Part of all images that must be of moments of which every camera has one."""


@dataclass(frozen=True, eq=False, slots=True)
class CameraLayout:
    """Images by camera and moment.

    Attributes
    ----------
    cameras : the images of each camera, by moment.
    shared : the moments of which every camera has an image.
    """

    cameras: Mapping[str, Mapping[str, Path]]
    shared: tuple[str, ...]

    def __str__(self) -> str:
        names = list(self.cameras)
        shown = ", ".join(f"'{name}'" for name in names[:2]) + (" ..." if len(names) > 2 else "")
        return f"{len(names)} cameras ({shown}) with {len(self.shared)} moments"


def layouts_of(images: Sequence[Path]) -> list[CameraLayout]:
    """Return the ways in which `images` may be those of several cameras, of at most MAX_CAMERAS, fewest cameras first:
    moments may be taken for cameras where boards only move sideways, and there are more of them."""
    layouts = (_layout(images, names) for names in _names(images))
    return sorted((one for one in layouts if one is not None), key=lambda one: len(one.cameras))


def _names(images: Sequence[Path]) -> Iterator[list[str]]:
    """Yield the names of the camera of each image, for each part of the paths that may be one."""
    folders = [image.parent.parts for image in images]
    if len(set(folders)) == 1:
        parts = [NAME_PART.findall(image.stem) for image in images]
        if len({len(own) for own in parts}) == 1:
            yield from map(list, zip(*parts, strict=True))
    elif len({len(own) for own in folders}) == 1:
        differ = [list(names) for names in zip(*folders, strict=True) if len(set(names)) > 1]
        if len(differ) == 1:
            yield differ[0]
        yield [image.stem for image in images]


def _layout(images: Sequence[Path], names: Sequence[str]) -> CameraLayout | None:
    """Return the layout of images with these names of their cameras, None where they are not those of cameras."""
    cameras = sorted(set(names), key=natural_key)
    if not 2 <= len(cameras) <= MAX_CAMERAS or not all(map(is_identifier, cameras)):
        return None
    layout = layout_by_names(
        {camera: [i for i, n in zip(images, names, strict=True) if n == camera] for camera in cameras}
    )
    return layout if layout and len(cameras) * len(layout.shared) >= MIN_SHARE * len(images) else None


def layout_by_names(images: Mapping[str, Sequence[Path]]) -> CameraLayout | None:
    """Return the layout of the images of each camera by their names; None where these share too few moments."""
    try:
        frames = frames_of_images({camera: list(map(str, own)) for camera, own in images.items()})
    except InputError:
        return None
    moments = {camera: {frames[camera][str(i)]: i for i in own} for camera, own in images.items()}
    shared = sorted(set.intersection(*map(set, moments.values())), key=natural_key)
    return CameraLayout(moments, tuple(shared)) if len(shared) >= MIN_MOMENTS else None
