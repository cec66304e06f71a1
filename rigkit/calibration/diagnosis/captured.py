"""Findings about how the images were taken: too few, too similar, boards at unsuitable poses, or not as a camera takes
them.

Reprojection errors do not show any of this. A calibration from such images is not called good, whatever its held-out
error.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from rigkit.calibration.certainty.coverage import corner_ranges, covered_by_boards
from rigkit.calibration.certainty.uncertainty import FarProjection, worst_direction
from rigkit.calibration.result import Calibration
from rigkit.cameras.base import image_center
from rigkit.cameras.compare import grid_pixels
from rigkit.core.arrays import BoolArray, FloatArray, Pixels, Rays, quantiles_of
from rigkit.core.findings import Finding, Severity, worst
from rigkit.core.printing import digits

FEW_IMAGES = 8
FAR_TOO_FEW = 3
"""Fewer images determine a lens, but not its error."""
TILTED_DEG = 15.0
TILTED_VIEWS = 3
PARALLEL_DEG = 8.0
"""Root mean squared angle of the boards' normals to their mean. Boards tilted by hand have 20 and more."""
UPRIGHT_DEG = 20.0
"""Boards are the same way up where NEARLY_ALL of them are rotated in the image by less than this."""
NEARLY_ALL = 0.9
ONE_DISTANCE = 1.15
"""Boards are at one distance where the far corners are within this factor of the near ones."""
ASKED_DEG = 95.0
"""Largest angle from the axis at which boards are expected: beyond it they would have to be next to the camera."""
GRID = (16, 12)
"""Pixels (columns, rows) at which coverage is evaluated."""
MIN_SHARE_COVERED = 2.0 / 3.0
"""Below this coverage the projection's uncertainty in the rest of the image is judged, too."""
MAX_TIMES_ERROR = 2.0
"""Largest uncertainty there, as a multiple of the error of the corners,"""
SMALL_PX = 0.1
"""or of that of a good corner on real images, if that is larger."""

SQUARE_WITHIN = 0.01
"""Deviation of the ratio of the focal lengths along x and y from 1, from which images are called stretched.

Sensors have square pixels: of 309 calibrations of REAL and RENDERED images, all that state the ratio to 0.25 % have it
within 0.4 % (stretched paper included). Resizing to another shape changes it by several per cent."""
STRETCH_SIGMAS = 4.0
"""The same in standard deviations, as far as few images know them: 7.6 with eight degrees of freedom. Boards that do
not determine the ratio are called by other findings."""

MAX_AXIS_OFF = 0.06
"""Distance of the optical axis from the image's middle, as a part of the longer side, from which images are called
cropped: three times the rms of 17 REAL cameras (0.002 to 0.035), which normally distributed distances exceed once in
8000. Images that are halves of wider ones have 0.056."""
MAX_DISTORTION_PART = 1e-4
"""Largest distortion, as a part of the corners' distance from their middle, of images without distortion. Lenses sold
as free of distortion have 1e-3, of which the best pinhole camera leaves a third or less (SIMULATED: 2e-4); REAL: 0.04
for bouguet and bumblebee2, 0.0 for both undistorted by OpenCV with the parameters of their own calibration (alpha 0 and
1)."""
LIMIT_FIELD_DEG = 30.0
"""Up to this angle off the axis. Beyond it the limit grows like distortion of the third order, with the square of the
tangent: REAL lenses of 71 degrees have 0.5."""
MIN_FIELD_DEG = 12.0
"""A lens that is seen less far off its axis may have so little distortion."""
MIN_IMAGES_OF_FIELD = 5
CORNERS_COMPARED = 500
"""Of more corners, every second, third, ... is used: the pinhole camera has eight unknowns."""
MIN_ALONG_AXIS = 0.2
"""Cosine of the angle from the axis that pinhole images hardly reach."""


@dataclass(frozen=True, eq=False, slots=True)
class Extent:
    """Coverage of the image: `pixels` (N, 2) of a grid where boards are expected, their `rays` (N, 3), and which are
    `covered` (N,) by a board."""

    pixels: Pixels
    rays: Rays
    covered: BoolArray

    @classmethod
    def of(cls, calibration: Calibration) -> Extent:
        pixels = grid_pixels(calibration.camera.size_px, GRID)
        rays, valid = calibration.camera.unproject(pixels)
        asked = valid & (np.where(valid, rays[..., 2], -1.0) > np.cos(np.radians(ASKED_DEG)))
        return cls(pixels[asked], rays[asked], covered_by_boards(calibration, pixels[asked]))

    @property
    def share(self) -> float:
        """Covered part of the image, of where boards are expected."""
        return float(self.covered.mean()) if len(self.covered) else 0.0

    @property
    def where(self) -> str:
        """Words for the covered part of the image, for which an error holds; empty for nearly all of it."""
        return (
            ""
            if self.share >= NEARLY_ALL
            else f" over the {100.0 * self.share:.0f} % of the image where boards were seen"
        )


def diagnose_capture(calibration: Calibration) -> list[Finding]:
    """Return findings about how the images were taken, the most severe first."""
    images, number = [view.image for view in calibration.views], calibration.clusters.tolist()
    few = list(_too_few(images, number))
    # Seven images in place of eight matter less than how they were taken.
    far_too_few = worst(few) is Severity.BAD
    return [
        *(_repeated(images, number) if _few_different(images, number) else []),
        *(few if far_too_few else []),
        *hardly_tilted(calibration),
        *_distances(calibration),
        *([] if far_too_few else few),
    ]


def hardly_tilted(c: Calibration) -> list[Finding]:
    """Return findings where boards are not tilted against the image, or all in the same way."""
    return [*_tilts(c), *_parallel(c)]


def few_repeated(calibration: Calibration) -> Iterator[Finding]:
    """Yield a finding about near-duplicate images where enough others are left."""
    images, number = [view.image for view in calibration.views], calibration.clusters.tolist()
    if not _few_different(images, number):
        yield from _repeated(images, number)


def _few_different(images: Sequence[str], number: Sequence[int]) -> bool:
    """Return whether few different images are left, or no more than half of all."""
    return len(set(number)) < FEW_IMAGES or 2 * len(set(number)) <= len(set(images))


def _axes(c: Calibration, axis: int) -> FloatArray:
    """Return the axis of every board in the camera frame, (V, 3)."""
    return c.corners.rotation[:, :, axis]


def _tilts(c: Calibration) -> Iterator[Finding]:
    """Yield a finding where few boards are tilted: boards parallel to the image do not determine the focal length."""
    tilted = int((np.abs(_axes(c, 2)[:, 2]) < np.cos(np.radians(TILTED_DEG))).sum())
    if tilted < min(TILTED_VIEWS, len(c.views)):
        yield Finding.bad(
            f"the board is tilted by more than {TILTED_DEG:.0f} degrees in only {tilted} of {len(c.views)} views, so "
            "the focal length is poorly determined",
            f"take at least {TILTED_VIEWS} with the board tilted by 20 to 50 degrees, about different axes",
        )


def _parallel(c: Calibration) -> Iterator[Finding]:
    """Yield a finding where all boards are parallel to each other: they have the same vanishing line."""
    normals = _axes(c, 2)
    middle = normals.sum(axis=0)
    cosines = normals @ middle / np.linalg.norm(middle)
    spread = float(np.degrees(np.sqrt(np.mean(np.arccos(np.clip(cosines, -1.0, 1.0)) ** 2))))
    if len(c.views) >= 2 and spread <= PARALLEL_DEG:
        yield Finding.look(
            f"all boards are nearly parallel to each other (within {spread:.1f} degrees, rms)",
            "tilt the board by 20 to 50 degrees, about different axes",
        )


def boards_never_rotated(c: Calibration) -> Iterator[Finding]:
    """Yield a finding where no board was rotated about its normal: the aspect ratios of pixels and squares are then
    correlated."""
    # Half a turn is equivalent to none: angles are doubled.
    along = _axes(c, 0) @ np.array([1.0, 1.0j, 0.0])
    doubled = (along / np.maximum(np.abs(along), np.finfo(float).tiny)) ** 2
    turned = 0.5 * np.degrees(np.abs(np.angle(doubled * np.conj(doubled.sum()))))
    if len(c.views) >= 2 and quantiles_of(turned, [NEARLY_ALL])[0] <= UPRIGHT_DEG:
        yield Finding.look(
            "the board was never rotated in the image plane: squares that are longer in one direction are absorbed by "
            "fx / fy",
            "rotate the board by 90 degrees in half of the images",
        )


def stretched_images(c: Calibration, *, upright: bool) -> Iterator[Finding]:
    """Yield a finding where pixels are not square; `upright`: no board was rotated about its normal."""
    step = 1e-3 * np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
    pixels, valid, _, d_pixels_d_parameters = c.camera.project_with_jacobians(np.column_stack([step, np.ones(4)]))
    along_x, along_y = pixels[0, 0] - pixels[1, 0], pixels[2, 1] - pixels[3, 1]
    if not valid.all() or min(along_x, along_y) <= 0.0:
        return
    stretch = float(np.log(along_x / along_y))
    gradient = (d_pixels_d_parameters[0, 0] - d_pixels_d_parameters[1, 0]) / along_x
    gradient = gradient - (d_pixels_d_parameters[2, 1] - d_pixels_d_parameters[3, 1]) / along_y
    sigma = c.widening_of(STRETCH_SIGMAS) * float(np.sqrt(max(gradient @ c.covariance @ gradient, 0.0)))
    if abs(stretch) <= max(SQUARE_WITHIN, STRETCH_SIGMAS * sigma):
        return
    narrower, other = ("x", "y") if stretch < 0.0 else ("y", "x")
    squares = ", or the board's squares are longer one way than the other" if upright else ""
    yield Finding.look(
        f"focal lengths are {100.0 * (1.0 - np.exp(-abs(stretch))):.1f} % smaller along {narrower} than along "
        f"{other}, although sensors have square pixels: a program or the camera has stretched the images{squares}",
        "give the images as the sensor has them, or use the calibration only for images stretched in the same way",
    )


def cropped_images(c: Calibration) -> Iterator[Finding]:
    """Yield a finding where the optical axis is far from the middle of the images."""
    axis, valid, _, d_pixels_d_parameters = c.camera.project_with_jacobians(np.array([0.0, 0.0, 1.0]))
    off, size = axis - image_center(c.camera.size_px), max(c.camera.size_px)
    sigma = c.widening_of(STRETCH_SIGMAS) * float(
        np.sqrt(np.trace(d_pixels_d_parameters @ c.covariance @ d_pixels_d_parameters.T))
    )
    far = float(np.linalg.norm(off))
    if not valid or not far > max(MAX_AXIS_OFF * size, STRETCH_SIGMAS * sigma):
        return
    along = int(np.argmax(np.abs(off)))
    # What is cut off on the left moves the middle to the right.
    side = (("right", "left"), ("bottom", "top"))[along][int(off[along] < 0.0)]
    yield Finding.look(
        f"the optical axis is {far:.0f} px from the middle of the images ({100.0 * far / size:.0f} % of their longer "
        f"side), although cameras have it there: all images seem cropped, most at the {side}, or the lens is shifted "
        "or tilted",
        "give the images as the sensor has them, or use the calibration only for images cropped in the same way",
    )


def _too_few(images: Sequence[str], number: Sequence[int]) -> Iterator[Finding]:
    count = len(set(number))
    if count >= FEW_IMAGES:
        return
    words = f"only {count} images" if count > 1 else "only 1 image"
    if len(set(images)) > count:
        where = f"only {count} different poses" if count > 1 else "a single pose"
        words = f"{len(set(images))} images show {where} of the boards"
    yield Finding(
        severity=Severity.BAD if count < FAR_TOO_FEW else Severity.LOOK,
        message=words,
        remedy=f"take at least {FEW_IMAGES}, better 15",
    )


def _repeated(images: Sequence[str], number: Sequence[int]) -> Iterator[Finding]:
    """Yield a finding about images that show the boards at the same place as another one."""
    first = dict(reversed(list(zip(number, images, strict=True))))
    again = {image: first[n] for n, image in zip(number, images, strict=True) if first[n] != image}
    if not again:
        return
    one, other = next(iter(again.items()))
    what = f"image '{one}' shows" if len(again) == 1 else f"{len(again)} images, the first of them '{one}', show"
    yield Finding.look(
        f"{what} the board at the pose of another image ('{other}'): near-duplicates count as one image",
        "move the board between images",
    )


def _distances(c: Calibration) -> Iterator[Finding]:
    """Yield a finding where all boards were at one distance: only tilts then give depth."""
    if len(c.views) < 2:
        return
    near, far = quantiles_of(corner_ranges(c), [0.05, 0.95])
    if far <= ONE_DISTANCE * near:
        yield Finding.look(
            "all boards were at the same distance", "take some images at half and some at twice the distance"
        )


def extrapolated(c: Calibration, extent: Extent, far: FarProjection) -> Iterator[Finding]:
    """Yield a finding where much of the image is extrapolated and uncertain."""
    if extent.share >= MIN_SHARE_COVERED or not len(extent.pixels):
        return
    worst = worst_direction(far.covariance(extent.rays[~extent.covered]))
    typical = float(np.sqrt(np.mean(worst**2)))
    error = c.rms_px if c.heldout_rms_px is None else c.heldout_rms_px
    if typical > MAX_TIMES_ERROR * max(error, SMALL_PX):
        yield Finding.look(
            f"{100 - round(100.0 * extent.share)} % of the image has no board corners: there the lens model is "
            f"extrapolated, with an uncertainty of {digits(typical)} px (one standard deviation, rms)",
            "take images with the board there, up to the image corners",
        )


def undistorted(calibration: Calibration, *, sure: bool) -> list[Finding]:
    """Return a finding if the images show no distortion, over a field in which nearly every lens has some; none unless
    the projection is `sure`: what a few parts of the image do not determine, the smallest model leaves out.

    The distortion is what is left of the lens after the pinhole camera that fits it best where boards were seen: to
    first order a pixel (u, v) of a pinhole that is turned a little is linear in 1, X, Y, XX, XY, YY with X = x / z,
    Y = y / z of its ray, where two coefficients of each of u and v are common (those of XX and XY in u are those of XY
    and YY in v: pixels are nearly square).
    """
    if not sure:
        return []
    pixels = calibration.corners.pixels[calibration.corners.kept]
    pixels = pixels[:: max(1, len(pixels) // CORNERS_COMPARED)]
    rays, valid = calibration.camera.unproject(pixels)
    if len({view.image for view in calibration.views}) < MIN_IMAGES_OF_FIELD or not valid.all():
        return []
    forward = float(rays[:, 2].min())
    if not MIN_ALONG_AXIS < forward < np.cos(np.radians(MIN_FIELD_DEG)):
        return []
    x, y = (rays[:, :2] / rays[:, 2:]).T
    zero, one = np.zeros_like(x), np.ones_like(x)
    along = np.stack([one, x, y, zero, zero, zero, x * x, x * y], axis=1)
    across = np.stack([zero, zero, zero, one, x, y, x * y, y * y], axis=1)
    system = np.concatenate([along, across])
    pinhole = system @ np.linalg.lstsq(system, pixels.T.ravel(), rcond=None)[0]
    distortion_px = np.hypot(*(pixels.T.ravel() - pinhole).reshape(2, -1))
    radius_px = np.hypot(*(pixels - pixels.mean(axis=0)).T)
    wider = (1.0 / forward**2 - 1.0) / np.tan(np.radians(LIMIT_FIELD_DEG)) ** 2
    if distortion_px.max() > MAX_DISTORTION_PART * max(wider, 1.0) * radius_px.max():
        return []
    angle = np.degrees(np.arccos(forward))
    return [
        Finding.look(
            f"the images show no distortion (at most {distortion_px.max():.2g} px, up to {angle:.0f} deg off axis), "
            "as hardly any lens takes them: they seem undistorted or rectified already, or rendered",
            "calibrate from the camera's own images if there are such; else apply no distortion to these again",
        )
    ]
