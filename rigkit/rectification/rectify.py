"""Maps from the image of one camera to that of another with the same centre: pixels exactly, images by resampling."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from rigkit.cameras.base import Camera
from rigkit.cameras.compare import grid_pixels
from rigkit.core.arrays import BoolArray, FloatArray, Mat3, Pixels, as_array
from rigkit.core.errors import InputError
from rigkit.geometry.rotation import nearest_rotation

Interpolation = Literal["spline", "lanczos", "linear", "nearest"]

ROTATION_INPUT_TOLERANCE = 1e-6
"""A matrix whose entries differ more than this from the nearest rotation is a mistake, not rounding."""
CHUNK_PIXELS = 1 << 18
"""Pixels resampled at a time: bounds the memory of large targets."""
MAX_KEPT_SAMPLES = 8_000_000
"""Samples of a map that are kept for several images: 24 bytes each."""
_Band = tuple[slice, list[tuple[Pixels, BoolArray]]]
"""Rows of the target, and for each sample of their pixels: source pixels of the valid ones, and which are valid."""
SCALE_SAMPLES = 41
"""Points along each side of a target at which the scale between target and source is evaluated."""
MAX_SUPERSAMPLING = 8
"""Samples per pixel and axis at the most."""


@dataclass(frozen=True, eq=False, slots=True)
class RectifyMap:
    """The map from images of `camera` to images of `target`, a camera with the same centre and another orientation.

    Attributes
    ----------
    target_from_cam : (3, 3) rotation.
    """

    camera: Camera
    target: Camera
    target_from_cam: Mat3

    def pixels(self, pixels: Pixels) -> tuple[Pixels, BoolArray]:
        """Return the pixels of the target (..., 2) that show pixels (..., 2) of the camera, and which are valid."""
        rays, seen = self.camera.unproject(pixels)
        out, valid = self.target.project(rays @ self.target_from_cam.T)
        return out, valid & seen

    def source_pixels(self, pixels: Pixels) -> tuple[Pixels, BoolArray]:
        """Return the pixels of the camera (..., 2) that pixels (..., 2) of the target show, and which are valid."""
        rays, seen = self.target.unproject(pixels)
        out, valid = self.camera.project(rays @ self.target_from_cam)
        return out, valid & seen

    def jacobians(self, pixels: Pixels) -> FloatArray:
        """Return d target pixel / d camera pixel (..., 2, 2) at pixels (..., 2) of the camera; NaN where invalid.

        An affinity A21 of raw images becomes J2 A21 J1^-1 in rectified ones, a covariance C becomes J C J^T.
        """
        rays, _ = self.camera.unproject(pixels)
        _, _, d_pixels_d_point, _ = self.target.project_with_jacobians(rays @ self.target_from_cam.T)
        return np.asarray(d_pixels_d_point @ self.target_from_cam @ self.camera.ray_jacobian(pixels))

    def scale(self, pixels: Pixels) -> FloatArray:
        """Return target pixels per camera pixel (...,), the root of the ratio of areas; `sigma_px` scales with it."""
        return np.asarray(np.sqrt(np.abs(np.linalg.det(self.jacobians(pixels)))))

    def image(
        self, image: NDArray[Any], *, interpolation: Interpolation = "spline", antialias: bool = True, fill: float = 0.0
    ) -> NDArray[Any]:
        """Return the image (h, w) or (h, w, channels) as `target` sees it, in the same dtype.

        Parameters
        ----------
        interpolation : "spline" is the cubic B-spline that passes through the samples: it keeps positions exactly,
            which OpenCV's cubic and Lanczos kernels do to some hundredths of a pixel only.
        antialias : average several samples per pixel where the target has a lower resolution than the source.
        fill : value of the pixels outside the camera's image.

        Raises InputError for an image of another size than the camera's.
        """
        bands = self._sampled_bands(self._supersampling() if antialias else 1)
        return self._resampled(np.asarray(image), interpolation, bands, fill)

    def resampler(self, interpolation: Interpolation) -> Callable[[NDArray[Any]], NDArray[Any]]:
        """Return a function that does what `image` does; a map of at most MAX_KEPT_SAMPLES is computed only once."""
        samples = self._supersampling()
        keeps = samples * samples * self.target.size_px[0] * self.target.size_px[1] <= MAX_KEPT_SAMPLES
        kept = list(self._sampled_bands(samples)) if keeps else None

        def resample(image: NDArray[Any]) -> NDArray[Any]:
            bands = self._sampled_bands(samples) if kept is None else kept
            return self._resampled(np.asarray(image), interpolation, bands, 0.0)

        return resample

    def maps(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return the source columns and rows (h, w) of the target's pixels for cv2.remap; -1 outside the source."""
        columns, rows = self.target.size_px
        u, v = np.full((2, rows, columns), -1.0, dtype=np.float32)
        for band, ((source, seen),) in self._sampled_bands(1):
            u[band][seen], v[band][seen] = source.T
        return u, v

    def _sampled_bands(self, samples: int) -> Iterator[_Band]:
        """Yield bands of rows, of at most about CHUNK_PIXELS pixels, with the source pixels of `samples`^2 samples."""
        columns, rows = self.target.size_px
        shifts = (np.arange(samples) + 0.5) / samples - 0.5
        step = max(1, CHUNK_PIXELS // columns)
        for first in range(0, rows, step):
            band = slice(first, min(first + step, rows))
            grid = np.stack(np.meshgrid(np.arange(float(columns)), np.arange(float(first), band.stop)), axis=-1)
            found = []
            for dv in shifts:
                for du in shifts:
                    source, valid = self.source_pixels(grid + np.array([du, dv]))
                    valid &= self.camera.on_image(source)
                    found.append((source[valid], valid))
            yield band, found

    def _resampled(
        self, image: NDArray[Any], interpolation: Interpolation, bands: Iterable[_Band], fill: float
    ) -> NDArray[Any]:
        width, height = self.camera.size_px
        if image.shape[:2] != (height, width) or image.ndim not in (2, 3):
            shown = f"{image.shape[1]} x {image.shape[0]} px" if image.ndim in (2, 3) else f"shape {image.shape}"
            raise InputError(
                f"image of {shown}, but the camera was calibrated at {width} x {height}; take the image size of the "
                "calibration"
            )
        sampler = _Sampler(image, interpolation)
        columns, rows = self.target.size_px
        out = np.full((rows, columns, *image.shape[2:]), _as_dtype(np.asarray(fill, dtype=np.float64), image.dtype))
        for band, found in bands:
            total, weight = np.zeros(out[band].shape), np.zeros(out[band].shape[:2])
            for source, valid in found:
                total[valid] += sampler(source)
                weight += valid
            # A pixel counts as seen if at least half of its samples are.
            seen = weight >= 0.5 * len(found)
            mean = total[seen] / weight[seen].reshape(-1, *(1,) * (image.ndim - 2))
            out[band][seen] = _as_dtype(mean, image.dtype)
        return out

    def coverage(self) -> BoolArray:
        """Return which pixels (h, w) of the target the camera sees."""
        columns, rows = self.target.size_px
        out = np.empty((rows, columns), dtype=bool)
        for band, ((_, valid),) in self._sampled_bands(1):
            out[band] = valid
        return out

    def _supersampling(self) -> int:
        """Return the samples per pixel and axis: the 90 % quantile of source pixels per target pixel, rounded."""
        source, valid = self.source_pixels(grid_pixels(self.target.size_px, (SCALE_SAMPLES, SCALE_SAMPLES)))
        source = source[valid & self.camera.on_image(source)]
        scale = self.scale(source) if source.size else np.ones(1)
        scale = scale[np.isfinite(scale) & (scale > 0.0)]
        if not scale.size:
            return 1
        return int(np.clip(np.round(1.0 / np.quantile(scale, 0.1)), 1, MAX_SUPERSAMPLING))


def rectify_map(camera: Camera, target: Camera, *, target_from_cam: ArrayLike | None = None) -> RectifyMap:
    """Return the map from images of `camera` to images of `target`.

    Raises InputError: `target_from_cam` is not a rotation.

    Parameters
    ----------
    target_from_cam : (3, 3) rotation, x_in_target = target_from_cam @ x_in_cam; None: the identity.
    """
    matrix = as_array(np.eye(3) if target_from_cam is None else target_from_cam, (3, 3), "target_from_cam")
    rotation = nearest_rotation(matrix)
    if np.abs(rotation - matrix).max() > ROTATION_INPUT_TOLERANCE:
        raise InputError("target_from_cam: not a rotation matrix (orthonormal, determinant +1)")
    return RectifyMap(camera, target, as_array(rotation, (3, 3), "target_from_cam"))


def rotation_from_view_angles(yaw_rad: float, pitch_rad: float, roll_rad: float = 0.0) -> Mat3:
    """Return target_from_cam of a view turned by `yaw_rad` to the right, `pitch_rad` up, `roll_rad` clockwise.

    Yaw turns about the camera's y axis, then pitch about the new x axis, then roll about the new viewing direction.
    """
    cy, sy = np.cos(yaw_rad), np.sin(yaw_rad)
    cp, sp = np.cos(pitch_rad), np.sin(pitch_rad)
    cr, sr = np.cos(roll_rad), np.sin(roll_rad)
    yaw = np.array([[cy, 0.0, sy], [0.0, 1.0, 0.0], [-sy, 0.0, cy]])
    pitch = np.array([[1.0, 0.0, 0.0], [0.0, cp, -sp], [0.0, sp, cp]])
    roll = np.array([[cr, -sr, 0.0], [sr, cr, 0.0], [0.0, 0.0, 1.0]])
    return np.asarray((yaw @ pitch @ roll).T)


class _Sampler:
    """Interpolates an image; beyond its border the outermost pixels are repeated."""

    def __init__(self, image: NDArray[Any], interpolation: Interpolation) -> None:
        self._shape = image.shape[2:]
        self._flag: int | None = {
            "spline": None,
            "lanczos": cv2.INTER_LANCZOS4,
            "linear": cv2.INTER_LINEAR,
            "nearest": cv2.INTER_NEAREST,
        }.get(interpolation, -1)
        if self._flag == -1:
            raise InputError(f"interpolation '{interpolation}' is unknown; known: spline, lanczos, linear, nearest")
        planes = np.moveaxis(image.reshape(*image.shape[:2], -1), -1, 0)
        if self._flag is None:
            from scipy import ndimage

            self._planes: list[NDArray[Any]] = [
                ndimage.spline_filter(p.astype(np.float64), order=3, mode="mirror") for p in planes
            ]
        else:
            self._planes = [np.ascontiguousarray(p, dtype=np.float32) for p in planes]

    def __call__(self, pixels: Pixels) -> FloatArray:
        """Return the values (N, *channels) at pixels (N, 2)."""
        if not pixels.size:
            return np.zeros((0, *self._shape))
        if self._flag is None:
            from scipy import ndimage

            height, width = self._planes[0].shape
            v, u = np.clip(pixels[:, 1], 0.0, height - 1.0), np.clip(pixels[:, 0], 0.0, width - 1.0)
            values = [ndimage.map_coordinates(p, (v, u), order=3, mode="mirror", prefilter=False) for p in self._planes]
        else:
            # remap takes images of at most 32767 columns: the list of pixels is folded into rows.
            width = 4096
            padded: NDArray[np.float32] = np.zeros((2, -(-len(pixels) // width) * width), dtype=np.float32)
            padded[:, : len(pixels)] = pixels.T
            columns, rows = padded.reshape(2, -1, width)
            values = [
                cv2.remap(p, columns, rows, self._flag, borderMode=cv2.BORDER_REPLICATE).reshape(-1)[: len(pixels)]
                for p in self._planes
            ]
        return np.stack(values, axis=-1).astype(np.float64).reshape(len(pixels), *self._shape)


def _as_dtype(image: FloatArray, dtype: np.dtype[Any]) -> NDArray[Any]:
    """Return the image rounded and clipped to an integer dtype, or cast to another one."""
    if np.issubdtype(dtype, np.integer):
        info = np.iinfo(dtype)
        return np.clip(np.rint(image), info.min, info.max).astype(dtype)
    return image.astype(dtype)
