"""The contract of every central camera: project, unproject, and the derivatives of both.

Pixel (0, 0) is the centre of the top-left pixel; x right, y down, z forward. Fields of view beyond 180 degrees are
ordinary: rays are unit vectors and z may be negative.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike

from rigkit.arrays import BoolArray, FloatArray, Pixels, Points, RayJacobians, Rays, as_array
from rigkit.errors import InputError

__all__ = ["Camera", "image_center"]


def image_center(size_px: tuple[int, int]) -> FloatArray:
    """Return the centre of the image, px: (width - 1) / 2, (height - 1) / 2, because (0, 0) is a pixel's centre."""
    return np.array([(size_px[0] - 1) / 2.0, (size_px[1] - 1) / 2.0])


@dataclass(frozen=True, eq=False, slots=True)
class Camera(ABC):
    """A central camera: every pixel sees along one ray through one centre.

    Attributes
    ----------
    size_px : (width, height)
    parameters : (P,) float64, read-only, in the order of `parameter_names()`.

    Every model is one file with one subclass and one line in `registry`. The class-level functions
    `parameter_names` and the four methods below are all that the rest of rigkit uses.
    """

    size_px: tuple[int, int]
    parameters: FloatArray

    model: ClassVar[str]
    """Name in the registry and in files."""

    def __post_init__(self) -> None:
        width, height = (int(v) for v in self.size_px)
        if width < 1 or height < 1:
            raise InputError(f"camera size {self.size_px}: width and height must be positive")
        object.__setattr__(self, "size_px", (width, height))
        array = as_array(self.parameters, (None,), f"{self.model} parameters")
        object.__setattr__(self, "parameters", array)
        names = self.parameter_names()
        if len(names) != array.size:
            raise InputError(
                f"{self.model} camera: {len(names)} parameters expected ({', '.join(names)}), got {array.size}"
            )

    @abstractmethod
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the entries of `parameters`; the length may depend on the instance (polynomial degree)."""

    @abstractmethod
    def project(self, points: Points) -> tuple[Pixels, BoolArray]:
        """Return the pixels of points (..., 3) given in the camera frame, and where they are valid.

        The length of a point does not matter. Invalid (outside the model's field of view, at the centre, NaN): NaN.
        """

    @abstractmethod
    def unproject(self, pixels: Pixels) -> tuple[Rays, BoolArray]:
        """Return the unit rays of pixels (..., 2) in the camera frame, and where they are valid (NaN elsewhere)."""

    @abstractmethod
    def ray_jacobian(self, pixels: Pixels) -> RayJacobians:
        """Return d ray / d pixel (..., 3, 2) at pixels (..., 2); the columns are perpendicular to the ray."""

    @abstractmethod
    def project_with_jacobians(self, points: Points) -> tuple[Pixels, BoolArray, FloatArray, FloatArray]:
        """Return pixels, valid, d pixel / d point (..., 2, 3) in px/mm, and d pixel / d parameters (..., 2, P)."""

    def with_parameters(self, parameters: ArrayLike) -> Self:
        """Return the same model and size with other parameters."""
        return type(self)(self.size_px, np.asarray(parameters, dtype=np.float64))

    @property
    def focal_px(self) -> float:
        """Pixels per radian on the optical axis: the scale of an angular error, whatever the model."""
        centre, _ = self.project(np.array([0.0, 0.0, 1.0]))
        jacobian = self.ray_jacobian(centre)
        return float(1.0 / np.sqrt(abs(np.linalg.det(jacobian[:2]))))
