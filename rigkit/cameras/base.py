"""The interface of every central camera: project, unproject, and the derivatives of both.

Pixel (0, 0) is the centre of the top-left pixel; x right, y down, z forward. Fields of view beyond 180 degrees are
supported: rays are unit vectors and z may be negative.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike

from rigkit.core.arrays import (
    BoolArray,
    Coordinates,
    FloatArray,
    Pixels,
    Points,
    Projected,
    RayJacobians,
    Rays,
    as_array,
    as_floats,
)
from rigkit.core.errors import InputError

MAX_SIDE_PX = 2**20
"""Some sixty times the longest line sensor: a larger image size is a typing error."""
MAX_PARAMETER = 1e15
"""Parameters of real lenses are below (k3 of a lens of one degree: 1e12); products of much larger ones overflow."""


def image_center(size_px: tuple[int, int]) -> FloatArray:
    """Return the centre of the image, px: (width - 1) / 2, (height - 1) / 2, because (0, 0) is a pixel's centre."""
    return np.array([(size_px[0] - 1) / 2.0, (size_px[1] - 1) / 2.0])


@dataclass(frozen=True, eq=False, slots=True)
class RadialCurve:
    """Samples of the radial profile of a lens: the image radius as a function of the angle from the axis.

    Raises InputError: fewer than four samples off the axis, angles or radii that do not increase, or angles of 180
    degrees and more.

    Attributes
    ----------
    centre_px : (2,) pixel of the optical axis.
    theta_rad, radius_px : (N,) angles from the axis and distances from the centre, both increasing; samples on the
        axis are left out.
    """

    centre_px: FloatArray
    theta_rad: FloatArray
    radius_px: FloatArray

    def __post_init__(self) -> None:
        theta = as_array(self.theta_rad, (None,), "theta_rad")
        radius = as_array(self.radius_px, theta.shape, "radius_px")
        theta, radius = theta[theta > 0.0], radius[theta > 0.0]
        if theta.size < 4:
            raise InputError(f"radial curve: {theta.size} samples off the axis; at least 4 are needed")
        if (np.diff(theta) <= 0.0).any() or (np.diff(radius, prepend=0.0) <= 0.0).any():
            raise InputError("radial curve: angles and radii must both increase from the axis outwards")
        if theta[-1] >= np.pi:
            raise InputError(
                f"radial curve: it reaches {np.degrees(theta[-1]):.1f} degrees, not less than 180; check that angles "
                "are in radians"
            )
        object.__setattr__(self, "centre_px", as_array(self.centre_px, (2,), "centre_px"))
        object.__setattr__(self, "theta_rad", theta)
        object.__setattr__(self, "radius_px", radius)

    def below(self, limit_rad: float, model: str) -> tuple[FloatArray, FloatArray]:
        """Return angles and radii; raises InputError where they reach `limit_rad`, the limit of `model`."""
        if self.theta_rad[-1] >= limit_rad:
            raise InputError(
                f"radial curve: it reaches {np.degrees(self.theta_rad[-1]):.1f} degrees, a {model} camera sees less "
                f"than {np.degrees(limit_rad):.0f}; cut the curve or take a fisheye model"
            )
        return self.theta_rad, self.radius_px


@dataclass(frozen=True, eq=False, slots=True)
class Camera(ABC):
    """A central camera: all rays meet in one point.

    Attributes
    ----------
    size_px : (width, height)
    parameters : (P,) float64, read-only, in the order of `parameter_names()`.

    Every model is one file with one subclass and one line in `registry`. A model implements its formulas for flat
    arrays of coordinates (`_project`, `_unproject`, `_derivatives`); this class handles shapes, NaN and memory. A point
    or pixel is valid inside the model's field of view; `on_image` says whether a pixel is on the sensor.
    """

    size_px: tuple[int, int]
    parameters: FloatArray

    model: ClassVar[str]
    """Name in the registry and in files."""
    orders: ClassVar[tuple[int, ...]] = ()
    """Sizes of a model that has several: Brown's numbers of distortion terms, Scaramuzza's degrees."""
    closed_ranges: ClassVar[Mapping[str, tuple[float, float]]] = {}
    """Least and greatest values of parameters that are valid at both: a best fit may lie there."""

    @property
    def series(self) -> tuple[int, ...]:
        """Indices of the parameters that are terms of a power series in the radius, lowest first; empty for a closed
        formula."""
        return ()

    def __post_init__(self) -> None:
        _require_numbers(self.size_px, "camera size")
        size = as_array(self.size_px, (2,), "camera size")
        if (size < 1.0).any() or (size > MAX_SIDE_PX).any() or (size != np.round(size)).any():
            raise InputError(
                f"camera size {self.size_px}: width and height must be positive whole numbers, at most {MAX_SIDE_PX}"
            )
        object.__setattr__(self, "size_px", (int(size[0]), int(size[1])))
        self._keep(self.parameters)

    def _keep(self, parameters: ArrayLike) -> None:
        """Check and store the parameters, and compute values that depend on them."""
        _require_numbers(parameters, f"{self.model} parameters")
        array = as_array(parameters, (None,), f"{self.model} parameters")
        object.__setattr__(self, "parameters", array)
        names = self.parameter_names()
        if len(names) != array.size:
            raise InputError(
                f"{self.model} camera: {len(names)} parameters expected ({', '.join(names)}), got {array.size}"
            )
        if array.size and np.abs(array).max() > MAX_PARAMETER:
            worst = int(np.argmax(np.abs(array)))
            raise InputError(
                f"{self.model} camera: {names[worst]} = {array[worst]:g} is beyond ±{MAX_PARAMETER:g}, no lens's; "
                "check the number and its unit"
            )
        with np.errstate(all="ignore"):
            self._prepare()

    def __repr__(self) -> str:
        values = ", ".join(f"{name}={value:.6g}" for name, value in self.named(self.parameters).items())
        return f"{type(self).__name__}({self.size_px[0]}x{self.size_px[1]} px: {values})"

    def named(self, values: FloatArray) -> dict[str, float]:
        """Return the `values` (P,), of parameters or their standard deviations, by the parameters' names."""
        return dict(zip(self.parameter_names(), values.tolist(), strict=True))

    def _prepare(self) -> None:
        """Check the parameters and compute values that depend on them."""
        return

    @classmethod
    def from_radial_curve(cls, size_px: tuple[int, int], curve: RadialCurve, *, order: int | None = None) -> Self:
        """Return the camera of this model that fits a radial curve: the initial values of a calibration.

        Raises InputError: the model cannot represent the curve (a pinhole beyond 90 degrees), or has no such fit.

        Parameters
        ----------
        curve : pixel of the optical axis, and radii over angles.
        order : for models of several sizes: Brown's number of distortion terms, Scaramuzza's degree.
        """
        raise InputError(f"no '{cls.model}' camera starts at a radial curve")

    @abstractmethod
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the entries of `parameters`; the length may depend on the instance (polynomial degree)."""

    @property
    @abstractmethod
    def max_angle_rad(self) -> float:
        """Largest angle from the optical axis in the model's field of view; at most pi."""

    @abstractmethod
    def _project(self, x: FloatArray, y: FloatArray, z: FloatArray) -> Projected:
        """Return u, v, valid of flat coordinates; NaN has to be invalid, values at invalid places are arbitrary."""

    @abstractmethod
    def _unproject(self, u: FloatArray, v: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, BoolArray]:
        """Return the unit rays x, y, z and valid of flat pixels; the rest as in `_project`."""

    @abstractmethod
    def _derivatives(
        self, at: Coordinates, d_pixels_d_point: FloatArray, d_pixels_d_parameters: FloatArray | None
    ) -> Projected:
        """Project, fill `d_pixels_d_point` (2, 3, N) and, unless None, `d_pixels_d_parameters` (2, P, N)."""

    def project(self, points: Points) -> tuple[Pixels, BoolArray]:
        """Return the pixels (..., 2) of points (..., 3) in the camera frame, and which are valid.

        Points may have any length. Invalid ones (outside the field of view, at the centre, NaN) get NaN.
        """
        points = as_floats(points, (3,), "points")
        batch = points.shape[:-1]
        flat = points.reshape(-1, 3)
        with np.errstate(all="ignore"):
            u, v, valid = self._project(flat[:, 0], flat[:, 1], flat[:, 2])
        pixels = np.stack([u, v], axis=-1)
        _blank(pixels, valid)
        return pixels.reshape(*batch, 2), valid.reshape(batch)

    def unproject(self, pixels: Pixels) -> tuple[Rays, BoolArray]:
        """Return the unit rays (..., 3) of pixels (..., 2) in the camera frame, and which are valid (others are
        NaN)."""
        pixels = as_floats(pixels, (2,), "pixels")
        batch = pixels.shape[:-1]
        flat = pixels.reshape(-1, 2)
        with np.errstate(all="ignore"):
            x, y, z, valid = self._unproject(flat[:, 0], flat[:, 1])
        rays = np.stack([x, y, z], axis=-1)
        _blank(rays, valid)
        return rays.reshape(*batch, 3), valid.reshape(batch)

    def ray_jacobian(self, pixels: Pixels) -> RayJacobians:
        """Return d ray / d pixel (..., 3, 2) at pixels (..., 2); the columns are perpendicular to the ray.

        NaN where the pixel has no ray.
        """
        return self.rays_and_jacobians(pixels)[2]

    def rays_and_jacobians(self, pixels: Pixels) -> tuple[Rays, BoolArray, RayJacobians]:
        """Return what `unproject` and `ray_jacobian` do.

        Notes
        -----
        At a unit ray f the derivative J = d pixel / d point (2x3) has J f = 0, so the derivative of the inverse map
        into the sphere is the pseudo-inverse J^T (J J^T)^-1: one formula for every central camera.
        """
        rays, valid = self.unproject(pixels)
        x, y, z = rays.reshape(-1, 3).T
        d_pixels_d_point = np.empty((2, 3, x.size))
        with np.errstate(all="ignore"):
            self._derivatives((x, y, z), d_pixels_d_point, None)
            uu, uv, vv = (
                np.einsum("kn,kn->n", d_pixels_d_point[i], d_pixels_d_point[j], optimize=False)
                for i, j in ((0, 0), (0, 1), (1, 1))
            )
            determinant = uu * vv - uv * uv
            out = np.empty((3, 2, x.size))
            out[:, 0] = (d_pixels_d_point[0] * vv - d_pixels_d_point[1] * uv) / determinant
            out[:, 1] = (d_pixels_d_point[1] * uu - d_pixels_d_point[0] * uv) / determinant
        out[..., ~valid.reshape(-1)] = np.nan
        return rays, valid, np.moveaxis(out.reshape(3, 2, *valid.shape), (0, 1), (-2, -1))

    def project_with_jacobians(self, points: Points) -> tuple[Pixels, BoolArray, FloatArray, FloatArray]:
        """Return pixels, valid, d pixel / d point (..., 2, 3) in px/mm, and d pixel / d parameters (..., 2, P).

        The Jacobians are NaN where invalid. Their memory has the order (2, 3, ...) and (2, P, ...), so that moving the
        last two axes to the front gives long contiguous rows.
        """
        points = as_floats(points, (3,), "points")
        batch = points.shape[:-1]
        flat = points.reshape(-1, 3)
        d_pixels_d_point = np.zeros((2, 3, flat.shape[0]))
        d_pixels_d_parameters = np.zeros((2, self.parameters.size, flat.shape[0]))
        x, y, z = flat.T
        u, v, valid = self.derivatives(x, y, z, d_pixels_d_point, d_pixels_d_parameters)
        pixels = np.stack([u, v], axis=-1)
        if not valid.all():
            _blank(pixels, valid)
            d_pixels_d_point[..., ~valid] = np.nan
            d_pixels_d_parameters[..., ~valid] = np.nan
        return (
            pixels.reshape(*batch, 2),
            valid.reshape(batch),
            np.moveaxis(d_pixels_d_point.reshape(2, 3, *batch), (0, 1), (-2, -1)),
            np.moveaxis(d_pixels_d_parameters.reshape(2, self.parameters.size, *batch), (0, 1), (-2, -1)),
        )

    def derivatives(
        self,
        x: FloatArray,
        y: FloatArray,
        z: FloatArray,
        d_pixels_d_point: FloatArray,
        d_pixels_d_parameters: FloatArray | None,
    ) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Return u, v and valid, each (N,), of N points given by flat coordinates, and write the Jacobians into
        `d_pixels_d_point` (2, 3, N) and, unless None, `d_pixels_d_parameters` (2, P, N): `project_with_jacobians`
        without allocation.

        Invalid entries are arbitrary, also NaN. The caller has to fill `d_pixels_d_parameters` with zeros: entries that
        are zero for every camera of the model are not written.
        """
        with np.errstate(all="ignore"):
            return self._derivatives((x, y, z), d_pixels_d_point, d_pixels_d_parameters)

    def with_parameters(self, parameters: ArrayLike) -> Self:
        """Return a camera of the same model and size with other parameters.

        Raises InputError where they are invalid for the model; for a solver that is a refused step.
        """
        # The size was checked before, and a solver makes many cameras.
        out = object.__new__(type(self))
        object.__setattr__(out, "size_px", self.size_px)
        out._keep(parameters)
        return out

    @property
    def ends(self) -> FloatArray:
        """The least and the greatest values (2, P) of the parameters in `closed_ranges`, infinite for the others."""
        ranges = [self.closed_ranges.get(name, (-np.inf, np.inf)) for name in self.parameter_names()]
        return np.array(ranges, dtype=np.float64).reshape(-1, 2).T

    def stepped(self, step: FloatArray) -> Self:
        """Return the camera after the step (P,) of a solver, which stops at the `ends`: a minimum may lie there.

        Raises InputError where another parameter leaves its range.
        """
        return self.with_parameters(np.clip(self.parameters + step, *self.ends))

    def on_image(self, pixels: Pixels) -> BoolArray:
        """Return which pixels (..., 2) are on the sensor, up to half a pixel beyond the centres of its border
        pixels."""
        pixels = as_floats(pixels, (2,), "pixels")
        limit = np.array(self.size_px) - 0.5
        with np.errstate(invalid="ignore"):
            return np.asarray(((pixels >= -0.5) & (pixels <= limit)).all(axis=-1))

    @property
    def axis_px(self) -> Pixels:
        """Pixel (2,) of the optical axis; NaN if it is outside the field of view."""
        return self.project(np.array([0.0, 0.0, 1.0]))[0]

    @property
    def focal_px(self) -> float:
        """Pixels per radian on the optical axis, for any model."""
        _, _, d_pixels_d_point, _ = self.project_with_jacobians(np.array([0.0, 0.0, 1.0]))
        return float(np.sqrt(abs(np.linalg.det(d_pixels_d_point[:, :2]))))


def _require_numbers(values: object, what: str) -> None:
    """Raise InputError for strings and booleans, which numpy would convert to numbers."""
    entries = () if isinstance(values, np.ndarray) and values.dtype.kind in "iuf" else values
    for value in entries if isinstance(entries, list | tuple | np.ndarray) else (entries,):
        if isinstance(value, bool | np.bool_ | str | bytes):
            raise InputError(f"{what}: {value!r} is a {type(value).__name__}, a number is expected")


def _blank(values: FloatArray, valid: BoolArray) -> None:
    """Write NaN into the invalid rows of `values`."""
    if not valid.all():
        values[~valid] = np.nan
