"""Images as an ideal camera would have taken them: one, a folder or a video, or two of a rig whose rows correspond."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from rigkit.cameras.pinhole import camera_matrix
from rigkit.core.errors import InputError
from rigkit.core.printing import brief
from rigkit.core.progress import Progress, silent
from rigkit.io.disk.reading import about
from rigkit.io.disk.writing import ensure_writable, npz_bytes, write_atomic, write_together
from rigkit.io.manifests.rig_session import frames_of_images
from rigkit.io.media.images import Image, quiet_opencv, read_image_of, require_pixels, require_size
from rigkit.io.media.video import Video, is_video
from rigkit.rectification.crop import cropped
from rigkit.rectification.rectify import RectifyMap, rectify_map, rotation_from_view_angles
from rigkit.rectification.stereo import StereoRectification, rectify_pair
from rigkit.rectification.targets import target_camera
from rigkit.workflows.detect import images_in
from rigkit.workflows.inputs.camera_files import import_camera, import_pair
from rigkit.workflows.inputs.folder_session import cameras_in
from rigkit.workflows.inputs.paths import NamesFiles


@dataclass(frozen=True, eq=False, slots=True)
class _VideoFrame:
    """A frame of a video, for an image's file."""

    video: Video
    number: int

    @property
    def name(self) -> str:
        return f"{self.number:06d}.png"

    def __str__(self) -> str:
        return f"{self.video.source}, frame {self.number}"


Jobs = list[tuple[list[tuple[Path | _VideoFrame, Path]], RectifyMap]]
"""Of each map: the images, and where they go."""
_log = logging.getLogger(__name__)

EIGHT_BIT = (".jpg", ".jpeg", ".bmp", ".webp")


@dataclass(frozen=True, slots=True, kw_only=True)
class RectifyOptions(NamesFiles):
    """The view, and where to write it. A stereo pair's baseline decides its view, all but the projection."""

    output: Path
    """Image to write (of a pair, NAME-1 and NAME-2 beside it), or, without an ending, the folder to write into: images
    keep their names (frames of a video are 000000.png and so on), those of a rig have a folder a camera there."""
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
    crop: bool = False
    """Cut to the largest rectangle of which every pixel is seen, by both cameras of a pair."""
    maps: Path | None = None
    """npz file for the geometry: the target's K and rotation, maps for cv2.remap, and of a pair P1, P2 and Q (mm)."""
    force: bool = False
    """Replace files that exist; what was read is never replaced."""


@dataclass(frozen=True, eq=False, slots=True)
class RectifiedImage:
    """An image that was written, its map, and the share of it (0 to 1) that the camera sees."""

    path: Path
    map: RectifyMap
    covered: float

    __repr__ = brief


@dataclass(frozen=True, eq=False, slots=True)
class RectificationResult:
    """The images that were written.

    Attributes
    ----------
    failures : by image, why it could not be rectified.
    pair : the geometry of a stereo pair.
    """

    images: tuple[RectifiedImage, ...]
    failures: Mapping[str, InputError]
    pair: StereoRectification | None = None

    __repr__ = brief


def rectify_image(
    image: str | Path, camera: str | Path, options: RectifyOptions, *, progress: Progress = silent
) -> RectificationResult:
    """Write an image, or all of a folder or a video, as an ideal camera would have taken them; `camera` is the
    calibration's file.

    An image that cannot be read, or has another size, is among the failures and does not end the rest; its error is
    raised where there is no other. Raises InputError for a view that the camera does not have, a damaged calibration,
    or a file that cannot be written.
    """
    if holds_several(image) and options.output.suffix:
        what = "folder" if Path(image).is_dir() else "video"
        raise InputError(f"rectify: '{image}' is a {what}, so -o must name a folder, not '{options.output.name}'")
    with ExitStack() as stack:
        sources = _sources(Path(image), stack)
        jobs = _outputs(sources, options.output) if _is_folder(options.output) else [(sources[0], options.output)]
        _ensure_all([out for _, out in jobs], options, (*map(_file, sources), camera))
        source = import_camera(camera)
        if not np.isfinite(options.angles_deg).all():
            yaw, pitch, roll = options.angles_deg
            raise InputError(f"rectify: yaw {yaw:g}, pitch {pitch:g}, roll {roll:g}: three finite numbers are needed")
        hfov_rad = None if options.hfov_deg is None else np.radians(options.hfov_deg)
        _require_sizes(sources, source.size_px, camera)
        with about(camera):
            target = target_camera(source, options.projection, hfov_rad=hfov_rad, size_px=options.size_px)
            rotation = rotation_from_view_angles(*np.radians(options.angles_deg))
            remap = rectify_map(source, target, target_from_cam=rotation)
            if options.crop:
                (remap,) = cropped([remap])
            covered = _coverage([(jobs, remap)])
        done = _write([(jobs, remap)], covered, camera, options, progress)
    _write_maps([remap], None, options)
    return RectificationResult(*done)


def holds_several(source: str | Path) -> bool:
    """Say whether it is a folder or a video, not an image."""
    return Path(source).is_dir() or is_video(source)


def rectify_stereo_images(
    images: tuple[str | Path, str | Path] | str | Path,
    rig: str | Path,
    options: RectifyOptions,
    names: tuple[str, str] | None = None,
    *,
    progress: Progress = silent,
) -> RectificationResult:
    """Write images taken at once by two cameras of a rig so that a point has the same row in both. Pairs of which an
    image cannot be read or is missing are left out, as by `rectify_image`.

    Raises InputError: cameras that are not there, angles or a size of the view, a damaged rig, or a file that cannot be
    written.

    Parameters
    ----------
    images : two images; two folders; one folder of both cameras' images (left01, right01, or folders left and right);
        or two videos. Images of one name or number, and frames of one number, belong together, as for
        `calibrate_folders`. Where both are called as the cameras are, the names decide which image is whose; else the
        order does.
    rig : file of the rig, ours or another tool's.
    options : the view, without angles or a size.
    names : the two cameras; None: the rig's first two.
    """
    if options.hfov_deg is not None or options.size_px is not None or any(options.angles_deg):
        raise InputError("rectify: the baseline decides the view of a stereo pair; leave out its angles and its size")
    both, (camera1, camera2), cam2_from_cam1 = import_pair(rig, names)
    if names is None and not isinstance(images, (str, Path)):
        called = {Path(one).name if Path(one).is_dir() else Path(one).stem: one for one in images}
        images = (called[both[0]], called[both[1]]) if called.keys() == set(both) else images
    with ExitStack() as stack:
        sources, single = _pairs(images, both, stack)
        out = options.output
        if _is_folder(out):
            jobs = [_outputs(own, out / name) for own, name in zip(sources, both, strict=True)]
        elif len(sources[0]) > 1:
            raise InputError(f"rectify: these are several images, so -o must name a folder, not '{out.name}'")
        else:
            jobs = [[(own[0], out.with_name(f"{out.stem}-{i}{out.suffix}"))] for i, own in enumerate(sources, start=1)]
        _ensure_all(
            [to for job in jobs for _, to in job], options, (*(_file(source) for own in sources for source in own), rig)
        )
        for own, camera in zip(sources, (camera1, camera2), strict=True):
            _require_sizes(own, camera.size_px, rig)
        with about(rig):
            pair = rectify_pair(camera1, camera2, cam2_from_cam1, projection=options.projection)
            if options.crop:
                map1, map2 = cropped([pair.map1, pair.map2])
                pair = replace(pair, map1=map1, map2=map2)
            both_jobs = list(zip(jobs, (pair.map1, pair.map2), strict=True))
            covered = _coverage(both_jobs)
        written, failures = _write(both_jobs, covered, rig, options, progress)
    _write_maps([pair.map1, pair.map2], pair, options)
    return RectificationResult(written, {**single, **failures}, pair)


def _pairs(
    images: tuple[str | Path, str | Path] | str | Path, names: tuple[str, str], stack: ExitStack
) -> tuple[Sequence[Sequence[Path | _VideoFrame]], dict[str, InputError]]:
    """Return each camera's images, in one order, and why others have no partner."""
    if isinstance(images, (str, Path)):
        cameras = cameras_in([Path(images)])
        missing = [name for name in names if name not in cameras]
        if missing:
            there = ", ".join(cameras) if len(cameras) > 1 else "those of one camera only"
            raise InputError(
                f"rectify: in '{images}' no images are named after the rig's camera '{missing[0]}': there are {there}; "
                f"give two folders, that of '{names[0]}' first"
            )
        found = [sorted(p for folder, one in cameras[n] for p in folder.glob(one)) for n in names]
    elif not all(Path(image).is_dir() for image in images):
        one, two = images
        if is_video(one) != is_video(two) or Path(one).is_dir() != Path(two).is_dir():
            raise InputError(f"rectify: '{one}' and '{two}': give two images, two folders or two videos")
        own = [_sources(Path(image), stack) for image in images]
        if len(own[0]) != len(own[1]):
            _log.warning(
                f"rectify: '{one}' has {len(own[0])} frames and '{two}' {len(own[1])}: those of one number are paired"
            )
        count = min(len(sources) for sources in own)
        return [sources[:count] for sources in own], {}
    else:
        found = [list(images_in([Path(image)])) for image in images]
    try:
        of_moment = frames_of_images({str(k): [path.name for path in own] for k, own in enumerate(found)})
    except InputError:
        if len(found[0]) != len(found[1]):
            raise
        return found, {}
    frames = [{of_moment[str(k)][path.name]: path for path in own} for k, own in enumerate(found)]
    both = [frame for frame in frames[0] if frame in frames[1]]
    single = {
        str(path): InputError(f"'{path}': the other camera has no image of its name or number")
        for own in frames
        for frame, path in own.items()
        if frame not in both
    }
    return [[own[frame] for frame in both] for own in frames], single


def _sources(source: Path, stack: ExitStack) -> Sequence[Path | _VideoFrame]:
    """Return an image, those of a folder, or the frames of a video, which is open until `stack` ends."""
    if source.is_dir():
        return list(images_in([source]))
    if not is_video(source):
        return [source]
    with Video(source) as video:
        if video.live:
            raise InputError(f"rectify: '{source}' is a live camera, which has no end; record a video of it")
        count = video.passed_over()
    if count == 0:
        raise InputError(f"rectify: no frame of video '{source}' can be decoded; convert it to MP4")
    opened = stack.enter_context(Video(source, colour=True))
    return [_VideoFrame(opened, number) for number in range(count)]


def _file(source: Path | _VideoFrame) -> Path:
    return source.video.source if isinstance(source, _VideoFrame) else source


def _require_sizes(sources: Sequence[Path | _VideoFrame], size_px: tuple[int, int], calibration: str | Path) -> None:
    """Refuse a video, or an image that is alone, of another size, before the map: that takes as long as it is large."""
    first = sources[0]
    if isinstance(first, _VideoFrame):
        require_size(first.video.size_px, f"video '{first.video.source}'", size_px, calibration)
    elif len(sources) == 1:
        read_image_of(first, size_px, calibration)


def _is_folder(output: Path) -> bool:
    return not output.suffix or output.is_dir()


def _outputs(images: Sequence[Path | _VideoFrame], folder: Path) -> list[tuple[Path | _VideoFrame, Path]]:
    """Return (image, where it goes): with its name into the folder."""
    names = [one.name if cv2.haveImageWriter(one.name) else f"{Path(one.name).stem}.png" for one in images]
    return [(one, folder / name) for one, name in zip(images, names, strict=True)]


def _ensure_all(outputs: list[Path], options: RectifyOptions, inputs: tuple[str | Path, ...]) -> None:
    """Refuse what cannot be written, before the work."""
    for path in outputs:
        if not cv2.haveImageWriter(str(path)):
            raise InputError(f"'{path}': images of the kind '{path.suffix}' cannot be written; take .png, .tif or .jpg")
    ensure_writable([*outputs, options.maps], force=options.force, inputs=inputs)


def _coverage(jobs: Jobs) -> list[float]:
    """Return the part of each map that its camera sees; raises InputError for too large images and views of nothing."""
    for job, remap in jobs:
        require_pixels(remap.target.size_px, f"rectified image '{job[0][1]}' (--size)")
    covered = [float(remap.coverage().mean()) for _, remap in jobs]
    if min(covered) == 0.0:
        raise InputError("rectify: the camera sees nothing of this view; change --yaw-deg, --pitch-deg or --hfov-deg")
    return covered


def _write(
    jobs: Jobs, covered: Sequence[float], calibration: str | Path, options: RectifyOptions, progress: Progress
) -> tuple[tuple[RectifiedImage, ...], dict[str, InputError]]:
    """Resample and write the images of each map, one after the other; two images of a pair come together or not."""
    total, done, failures = len(jobs[0][0]), [], {}
    resamplers = [remap.resampler(options.interpolation) for _, remap in jobs]
    for i in range(total):
        files: dict[Path, str | bytes] = {}
        for (job, remap), resample in zip(jobs, resamplers, strict=True):
            source, to = job[i]
            try:
                files[to] = _rectified(source, to, remap.camera.size_px, calibration, resample)
            except InputError as error:
                if total == 1:
                    raise
                failures[str(source)] = error
        if len(files) == len(jobs):
            write_together(files, force=options.force)
            done += [RectifiedImage(job[i][1], m, share) for (job, m), share in zip(jobs, covered, strict=True)]
        progress("rectify", i + 1, total)
    return tuple(done), failures


def _rectified(
    source: Path | _VideoFrame,
    to: Path,
    size_px: tuple[int, int],
    calibration: str | Path,
    resample: Callable[[Image], Image],
) -> bytes:
    """Return the file of one image; raises InputError that names it."""
    if isinstance(source, Path):
        image = read_image_of(source, size_px, calibration)
    else:
        picture = source.video.frame(source.number)
        if picture is None:
            raise InputError(f"'{source}' cannot be decoded; convert the video to MP4")
        image = picture
    try:
        return _encoded(resample(image), to)
    except InputError as error:
        raise InputError(f"'{source}': {error}") from error
    except MemoryError as error:
        raise InputError(f"'{source}': {error or 'out of memory'}; use a smaller --size, or a smaller image") from error


def _write_maps(maps: list[RectifyMap], pair: StereoRectification | None, options: RectifyOptions) -> None:
    """Write the geometry as npz, where it is asked for."""
    if options.maps is None:
        return
    target = maps[0].target
    arrays: dict[str, NDArray[Any]] = {"size_px": np.array(target.size_px), "projection": np.array(options.projection)}
    fx, fy, cx, cy = target.parameters[:4]
    K = camera_matrix(fx, fy, cx, cy)
    for i, remap in enumerate(maps, start=1):
        end = "" if pair is None else str(i)
        arrays[f"map_x{end}"], arrays[f"map_y{end}"] = remap.maps()
        arrays[f"target_from_cam{end}"] = remap.target_from_cam
    arrays["K"] = K
    if pair is not None and options.projection == "perspective":
        along = float(pair.rect2_from_rect1.translation_mm[0])
        arrays["P1"], arrays["P2"] = np.hstack([K, np.zeros((3, 1))]), np.hstack([K, K @ [[along], [0.0], [0.0]]])
        arrays["Q"] = np.array(
            [[1.0, 0, 0, -cx], [0, fx / fy, 0, -cy * fx / fy], [0, 0, 0, fx], [0, 0, -1.0 / along, 0]]
        )
    write_atomic(options.maps, npz_bytes(arrays), force=options.force)


def _encoded(image: NDArray[Any], path: Path) -> bytes:
    suffix = path.suffix.lower()
    if suffix in EIGHT_BIT and image.dtype != np.uint8:
        raise InputError(f"'{path}': a {suffix} file has no 16-bit pixels; write a .png or .tif")
    try:
        with quiet_opencv():
            done, data = cv2.imencode(suffix, image if image.ndim == 2 else np.ascontiguousarray(image[..., ::-1]))
    except cv2.error:
        done = False
    if not done:
        size = f"{image.shape[1]} x {image.shape[0]}"
        raise InputError(f"'{path}': a {suffix} file takes no image of {size} px; write a .png or .tif, or --size")
    return bytes(data)
