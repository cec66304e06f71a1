"""`rigkit rectify`: images, folders or videos resampled to an ideal camera, or stereo pairs with corresponding rows."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rigkit.cameras.pinhole import camera_matrix
from rigkit.core.errors import InputError
from rigkit.core.identifiers import known_name
from rigkit.core.printing import brief, counted
from rigkit.core.progress import Progress, silent
from rigkit.io.disk.reading import about, paths_of
from rigkit.io.disk.writing import ensure_writable, npz_bytes, write_atomic, write_together
from rigkit.io.media.images import Image, quiet_opencv, read_image_of, require_pixels, require_size
from rigkit.io.media.video import Video, is_video
from rigkit.rectification.crop import cropped
from rigkit.rectification.rectify import RectifyMap, rectify_map, rotation_from_view_angles
from rigkit.rectification.stereo import StereoRectification, rectify_pair
from rigkit.rectification.targets import target_camera
from rigkit.workflows.detect import images_in
from rigkit.workflows.inputs.camera_files import import_camera, import_pair, rig_of_file
from rigkit.workflows.inputs.folder_session import cameras_in, images_of_camera
from rigkit.workflows.inputs.frames import moments_beside
from rigkit.workflows.moments import grouped_by_moment, warn_of_several_cameras
from rigkit.workflows.options.base import FrameRule
from rigkit.workflows.options.cameras import RectifyOptions


@dataclass(frozen=True, eq=False, slots=True)
class _VideoFrame:
    """A frame of a video, used like an image file."""

    video: Video
    number: int
    moment: int

    @property
    def name(self) -> str:
        return f"{self.moment:06d}.png"

    def __str__(self) -> str:
        return f"{self.video.source}, frame {self.number}"


Jobs = list[tuple[list[tuple[Path | _VideoFrame, Path]], RectifyMap]]
"""For each map: pairs of (source, output file), and the map."""
_log = logging.getLogger(__name__)

EIGHT_BIT = (".jpg", ".jpeg", ".bmp", ".webp")


@dataclass(frozen=True, eq=False, slots=True)
class RectifiedImage:
    """A written image, its map, and the fraction of its pixels that the camera sees."""

    path: Path
    map: RectifyMap
    covered: float

    __repr__ = brief


@dataclass(frozen=True, eq=False, slots=True)
class RectificationResult:
    """The written images.

    Attributes
    ----------
    failures : errors by image that could not be rectified.
    pair : geometry of a stereo pair, else None.
    """

    images: tuple[RectifiedImage, ...]
    failures: Mapping[str, InputError]
    pair: StereoRectification | None = None

    __repr__ = brief


def rectify_image(
    image: str | Path | Sequence[str | Path],
    camera: str | Path,
    options: RectifyOptions,
    *,
    progress: Progress = silent,
) -> RectificationResult:
    """Resample an image, all images of a folder or video, or several of these, to an ideal camera; `camera` is the
    calibration file.

    An image that cannot be read or has another size goes into `failures`; its error is raised if it is the only image.
    Raises InputError for a view outside the camera's field, a damaged calibration, or a file that cannot be written.
    """
    given = paths_of(image)
    if holds_several(given) and options.output.suffix:
        what = "are several images" if len(given) > 1 else "is a folder" if given[0].is_dir() else "is a video"
        named = f"'{given[0]}'" + (", ..." if len(given) > 1 else "")
        raise InputError(f"rectify: {named} {what}, so -o must name a folder, not '{options.output.name}'")
    with ExitStack() as stack:
        sources = [source for one in given for source in _sources(one, stack)]
        warn_of_several_cameras(given)
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


def holds_several(sources: Sequence[str | Path]) -> bool:
    """Return whether `sources` are several, or one folder or video."""
    return len(sources) > 1 or Path(sources[0]).is_dir() or is_video(sources[0])


def rectify_stereo_images(
    images: tuple[str | Path, str | Path] | str | Path,
    rig: str | Path,
    options: RectifyOptions,
    names: tuple[str, str] | None = None,
    *,
    progress: Progress = silent,
) -> RectificationResult:
    """Rectify simultaneous images of two cameras of a rig, so that a point has the same row in both. Images that cannot
    be read or have no partner go into `failures`.

    Raises InputError: unknown cameras, given angles or size, a damaged rig, or a file that cannot be written.

    Parameters
    ----------
    images : two images; two folders; one folder of both cameras' images (left01, right01, or folders left and right);
        or two videos. Images of the same name or number are paired, as are frames of the same number. If both are
        named after the cameras (right, left; right01, left01), the names assign them to the cameras, else their order.
    rig : file of the rig, of rigkit or another tool.
    options : the view, without angles and size.
    names : the two cameras; None: those that the images are named after, else the rig's first two.
    """
    if options.hfov_deg is not None or options.size_px is not None or any(options.angles_deg):
        raise InputError(
            "rectify: the baseline determines the view of a stereo pair; leave out the view's angles and --size"
        )
    if names is None and not isinstance(images, (str, Path)):
        images, names = _assigned(images, tuple(rig_of_file(rig).cameras))
    both, (camera1, camera2), cam2_from_cam1 = import_pair(rig, names)
    with ExitStack() as stack:
        sources, single = _pairs(images, both, stack, options.frames)
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


def _assigned(
    images: tuple[str | Path, str | Path], cameras: Sequence[str]
) -> tuple[tuple[str | Path, str | Path], tuple[str, str] | None]:
    """Return the images in the order of their `cameras`, and these two, if the images' names differ by the names of two
    cameras only; else the images as given, and None."""
    one, two = (Path(image).name if Path(image).is_dir() else Path(image).stem for image in images)
    for first, second in combinations(cameras, 2):
        if first in one and one.replace(first, second) == two:
            return images, (first, second)
        if second in one and one.replace(second, first) == two:
            return images[::-1], (first, second)
    return images, None


def _pairs(
    images: tuple[str | Path, str | Path] | str | Path, names: tuple[str, str], stack: ExitStack, how: FrameRule | None
) -> tuple[Sequence[Sequence[Path | _VideoFrame]], dict[str, InputError]]:
    """Return the paired images of each camera, and the errors of images without a partner."""
    if isinstance(images, (str, Path)):
        cameras = cameras_in([Path(images)])
        own_names = [known_name(name, cameras) for name in names]
        missing = [name for name, own in zip(names, own_names, strict=True) if own is None]
        if missing:
            there = ", ".join(cameras) if len(cameras) > 1 else "those of one camera only"
            raise InputError(
                f"rectify: in '{images}' no images are named after the rig's camera '{missing[0]}': there are {there}; "
                f"give two folders, that of '{names[0]}' first"
            )
        found = [images_of_camera(cameras[own]) for own in own_names if own is not None]
    elif not all(Path(image).is_dir() for image in images):
        one, two = images
        if is_video(one) != is_video(two) or Path(one).is_dir() != Path(two).is_dir():
            raise InputError(f"rectify: '{one}' and '{two}': give two images, two folders or two videos")
        own = [_sources(Path(image), stack) for image in images]
        films = [[frame for frame in sources if isinstance(frame, _VideoFrame)] for sources in own]
        counts = {Path(image): len(film) for image, film in zip(images, films, strict=True)}
        timed = moments_beside(counts) if all(films) else None
        if timed is not None:
            return [[replace(film[at[k]], moment=moment) for moment, at in timed] for k, film in enumerate(films)], {}
        if len(own[0]) != len(own[1]):
            _log.warning(
                f"rectify: '{one}' has {len(own[0])} frames and '{two}' {len(own[1])}: those of one number are paired"
            )
        count = min(len(sources) for sources in own)
        return [sources[:count] for sources in own], {}
    else:
        found = [list(images_in([Path(image)])) for image in images]
    moments, single = grouped_by_moment(found, how)
    alone = {str(path): InputError(f"'{path}': the other camera has no image of its name or number") for path in single}
    return list(zip(*moments, strict=True)), alone


def _sources(source: Path, stack: ExitStack) -> Sequence[Path | _VideoFrame]:
    """Return an image, the images of a folder, or the frames of a video, which stays open until `stack` closes."""
    if source.is_dir():
        return list(images_in([source]))
    if not is_video(source):
        return [source]
    with Video(source) as video:
        if video.live:
            raise InputError(f"rectify: '{source}' is a live camera, which has no end; record a video of it")
        count = video.skip_to_end()
    if count == 0:
        raise InputError(f"rectify: no frame of video '{source}' can be decoded; convert it to MP4")
    opened = stack.enter_context(Video(source, colour=True))
    return [_VideoFrame(opened, number, number) for number in range(count)]


def _file(source: Path | _VideoFrame) -> Path:
    return source.video.source if isinstance(source, _VideoFrame) else source


def _require_sizes(sources: Sequence[Path | _VideoFrame], size_px: tuple[int, int], calibration: str | Path) -> None:
    """Raise InputError for a video or a single image of another size, before the map is computed."""
    first = sources[0]
    if isinstance(first, _VideoFrame):
        require_size(first.video.size_px, f"video '{first.video.source}'", size_px, calibration)
    elif len(sources) == 1:
        read_image_of(first, size_px, calibration)


def _is_folder(output: Path) -> bool:
    return not output.suffix or output.is_dir()


def _outputs(images: Sequence[Path | _VideoFrame], folder: Path) -> list[tuple[Path | _VideoFrame, Path]]:
    """Return (source, output file in `folder`)."""
    names = [one.name if cv2.haveImageWriter(one.name) else f"{Path(one.name).stem}.png" for one in images]
    return [(one, folder / name) for one, name in zip(images, names, strict=True)]


def _ensure_all(outputs: list[Path], options: RectifyOptions, inputs: tuple[str | Path, ...]) -> None:
    """Raise InputError for files that cannot be written."""
    for path in outputs:
        if not cv2.haveImageWriter(str(path)):
            raise InputError(f"'{path}': images of the kind '{path.suffix}' cannot be written; take .png, .tif or .jpg")
    ensure_writable([*outputs, options.maps], force=options.force, inputs=inputs)


def _coverage(jobs: Jobs) -> list[float]:
    """Return the fraction of each map that its camera sees; raises InputError for too large images and for zero."""
    for job, remap in jobs:
        require_pixels(remap.target.size_px, f"rectified image '{job[0][1]}' (--size)")
    covered = [float(remap.coverage().mean()) for _, remap in jobs]
    if min(covered) == 0.0:
        raise InputError(
            "rectify: this view is outside the camera's field of view; change --yaw-deg, --pitch-deg or --hfov-deg"
        )
    return covered


def _write(
    jobs: Jobs, covered: Sequence[float], calibration: str | Path, options: RectifyOptions, progress: Progress
) -> tuple[tuple[RectifiedImage, ...], dict[str, InputError]]:
    """Resample and write the images of each map in turn; both images of a pair are written together or not at all."""
    total, failures = len(jobs[0][0]), dict[str, InputError]()
    done: list[RectifiedImage] = []
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
            try:
                write_together(files, force=options.force)
            except InputError as error:
                before = f"; written before it: {counted(len(done), 'image')}" if done else ""
                raise InputError(f"{error}{before}") from error
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
    """Return the file content of one resampled image; raises InputError that names it."""
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
    """Write the geometry to `options.maps`, if given."""
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
