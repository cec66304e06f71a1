"""A camera and how sure it is: what all that is measured with it propagates."""

from __future__ import annotations

from dataclasses import dataclass

from rigkit.cameras.base import Camera
from rigkit.core.arrays import FloatArray
from rigkit.geometry.principal_axes import principal_axes


@dataclass(frozen=True, eq=False, slots=True)
class UncertainCamera:
    """A camera and the covariance (P, P) of its parameters."""

    camera: Camera
    covariance: FloatArray

    def moved(self) -> list[Camera]:
        """Return the camera moved by one standard deviation along each principal axis of the covariance. The axes are
        independent: the squares of what they change in a quantity add up to its variance."""
        camera = self.camera
        return [camera.with_parameters(camera.parameters + axis) for axis in principal_axes(self.covariance)]
