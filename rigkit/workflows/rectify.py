"""Images as an ideal camera would have taken them: one, or two of a rig whose rows correspond."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from rigkit.core.errors import InputError
from rigkit.io.files import ensure_writable, write_together
from rigkit.io.images import read_image
from rigkit.rectification.rectify import RectifyMap, rectify_map, rotation_from_view_angles
from rigkit.rectification.stereo import StereoRectification, rectify_pair
from rigkit.rectification.targets import target_camera
from rigkit.workflows.camera_files import import_camera, import_rig

__all__ = ["RectifiedImage", "RectifyOptions", "rectify_image", "rectify_stereo_images"]

EIGHT_BIT = (".jpg", ".jpeg", ".bmp", ".webp")


@dataclass(frozen=True, slots=True, kw_only=True)
class RectifyOptions:
    """The view, and where it goes; a stereo pair's view is decided by its baseline, but for the projection."""

    output: Path
    """Image to write; of a pair, NAME-1 and NAME-2 beside it."""
    projection: Literal["perspective", "cylindrical", "equirectangular"] = "perspective"
    """Of the view."""
    hfov_deg: float | None = None
    """From the left edge to the right; None: suits the lens."""
    angles_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Yaw (to the right), pitch (up), roll (clockwise) of the view."""
    size_px: tuple[int, int] | None = None
    """Of the result; None: keeps the source's resolution."""
    interpolation: Literal["spline", "lanczos", "linear", "nearest"] = "spline"
    """Between pixels: spline keeps positions to a thousandth of a pixel, linear is quick."""
    force: bool = False
    """Replace files that exist; what was read is never replaced."""


@dataclass(frozen=True, eq=False, slots=True)
class RectifiedImage:
    """What was written, through which map, and the share of it (0 to 1) that the camera sees."""

    path: Path
    map: RectifyMap
    covered: float


def rectify_image(image: str | Path, camera: str | Path, options: RectifyOptions) -> RectifiedImage:
    """Write an image as an ideal camera would have taken it; `camera` is the calibration's file.

    Raises InputError for a view that the camera does not have, a damaged file, or one that cannot be written.
    """
    _ensure_kind(options.output)
    ensure_writable(options.output, force=options.force, inputs=(image, camera))
    source = import_camera(camera)
    hfov_rad = None if options.hfov_deg is None else np.radians(options.hfov_deg)
    target = target_camera(source, options.projection, hfov_rad=hfov_rad, size_px=options.size_px)
    rotation = rotation_from_view_angles(*np.radians(options.angles_deg))
    remap = rectify_map(source, target, target_from_cam=rotation)
    return _write([(image, options.output, remap)], options)[0]


def rectify_stereo_images(
    images: tuple[str | Path, str | Path],
    rig: str | Path,
    options: RectifyOptions,
    names: tuple[str, str] | None = None,
) -> tuple[tuple[RectifiedImage, ...], StereoRectification]:
    """Write two images taken at once by cameras `names` of a rig's file (None: its first two) so that a point has the
    same row in both; return what was written, and the geometry.

    Raises InputError for cameras that are not there, angles or a size of the view, a damaged file, or one that cannot
    be written.
    """
    _ensure_kind(options.output)
    if options.hfov_deg is not None or options.size_px is not None or any(options.angles_deg):
        raise InputError("rectify: the baseline decides the view of a stereo pair; leave out its angles and its size")
    cameras = import_rig(rig)
    both = list(names or list(cameras)[:2])
    missing = [name for name in both if name not in cameras]
    if missing or len(both) != 2:
        raise InputError(f"'{rig}': no camera '{', '.join(missing)}'; there are {', '.join(cameras)}")
    (camera1, cam1_from_rig), (camera2, cam2_from_rig) = (cameras[name] for name in both)
    out = options.output
    outputs = [out.with_name(f"{out.stem}-{i}{out.suffix}") for i in (1, 2)]
    ensure_writable(outputs, force=options.force, inputs=(*images, rig))
    pair = rectify_pair(camera1, camera2, cam2_from_rig @ cam1_from_rig.inverse(), projection=options.projection)
    return _write(list(zip(images, outputs, (pair.map1, pair.map2), strict=True)), options), pair


def _write(jobs: list[tuple[str | Path, Path, RectifyMap]], options: RectifyOptions) -> tuple[RectifiedImage, ...]:
    """Resample all (image, output, map), then write all."""
    covered = [float(remap.coverage().mean()) for _, _, remap in jobs]
    if min(covered) == 0.0:
        raise InputError("rectify: the camera sees nothing of this view; change --yaw-deg, --pitch-deg or --hfov-deg")
    files: dict[Path, str | bytes] = {}
    for image, output, remap in jobs:
        files[output] = _encoded(remap.image(read_image(image), interpolation=options.interpolation), output)
    write_together(files, force=options.force)
    return tuple(RectifiedImage(out, remap, share) for (_, out, remap), share in zip(jobs, covered, strict=True))


def _encoded(image: NDArray[Any], path: Path) -> bytes:
    suffix = path.suffix.lower()
    if suffix in EIGHT_BIT and image.dtype != np.uint8:
        raise InputError(f"'{path}': a {suffix} file has no 16-bit pixels; write a .png or .tif")
    _, data = cv2.imencode(suffix, image if image.ndim == 2 else np.ascontiguousarray(image[..., ::-1]))
    return bytes(data)


def _ensure_kind(path: Path) -> None:
    """Refuse a kind of image that cannot be written, before the work."""
    if not cv2.haveImageWriter(str(path)):
        raise InputError(f"'{path}': images of the kind '{path.suffix}' cannot be written; take .png, .tif or .jpg")
