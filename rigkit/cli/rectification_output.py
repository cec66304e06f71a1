"""Descriptions of the rectified images that `rigkit rectify` wrote, as text and as JSON values."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rigkit.workflows.rectify import RectifiedImage


def image_to_dict(one: RectifiedImage, projection: str) -> dict[str, Any]:
    """Return a rectified image as JSON values."""
    from rigkit.io.calibrations.calibration_file import camera_to_json

    target = one.map.target
    return {
        "image": str(one.path),
        "projection": projection,
        **camera_to_json(target),
        "target_from_cam": one.map.target_from_cam.tolist(),
        "covered": one.covered,
    }


def grouped_by_description(images: Sequence[RectifiedImage], projection: str) -> list[tuple[str, list[Path]]]:
    """Return descriptions of images, each with the images of one folder that share it."""
    out: dict[tuple[Path, str], list[Path]] = {}
    for one in images:
        out.setdefault((one.path.parent, _words(one, projection)), []).append(one.path)
    return [(words, paths) for (_, words), paths in out.items()]


def _words(one: RectifiedImage, projection: str) -> str:
    target = one.map.target
    (width, height), focal = target.size_px, target.named(target.parameters)["fx"]
    return (
        f"{projection}, {width} x {height} px, focal length {focal:.2f} px, "
        f"{100.0 * one.covered:.1f} % of it seen by the camera"
    )
