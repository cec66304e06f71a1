"""Cameras on one mount with their uncertainty: what the calibration of a rig determines, and its file stores."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Self

from rigkit.calibration.certainty.departures import Departures
from rigkit.calibration.certainty.displaced import LensModes, lens_modes, with_modes
from rigkit.calibration.pupil import SolvedPupil
from rigkit.calibration.result import Calibration
from rigkit.calibration.rig.solving.layout import Layout
from rigkit.calibration.solving.clustered import effective_freedom, widening
from rigkit.cameras.base import Camera
from rigkit.cameras.moving_pupil import NearCamera
from rigkit.cameras.uncertain import UncertainRig
from rigkit.core.arrays import FloatArray
from rigkit.geometry.rigid3 import Rigid3


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class MountedCameras:
    """Cameras on one mount.

    Attributes
    ----------
    cameras : central camera and cam_from_rig by name; the first camera defines the rig's frame.
    covariance : of all intrinsics, camera by camera, then of the poses of all cameras but the first: left perturbation
        (rad) and translation (mm); None if unknown. The error of the squares' size is not included.
    sigma_px : standard deviation of a corner's coordinate.
    scale_sigma : relative standard deviation of all lengths, from that of the boards' squares; 0 if not stated.
    freedom : degrees of freedom of the covariance.
    overdispersion : ratio of the scatter of frames to that of independent corners.
    departures : modes of each lens beyond its model; empty if unknown.
    expected : part of the covariance from errors that are expected, of cameras with departures among the parameters.
    pupils : moving entrance pupils by name.
    """

    cameras: Mapping[str, tuple[Camera, Rigid3]]
    covariance: FloatArray | None
    sigma_px: float | None = None
    scale_sigma: float = 0.0
    freedom: float = math.inf
    overdispersion: float = 1.0
    departures: tuple[LensModes, ...] = ()
    expected: FloatArray | None = None
    pupils: Mapping[str, SolvedPupil] = field(default_factory=dict)

    @classmethod
    def alone(cls, name: str, calibration: Calibration) -> Self:
        """Return a camera that was calibrated alone, in its own frame; central."""
        departures, camera = Departures.of(calibration), calibration.camera
        count = camera.parameters.size
        return cls(
            cameras={name: (camera, Rigid3.identity())},
            covariance=departures.near_covariance[:count, :count],
            sigma_px=departures.noise.sigma_px,
            freedom=calibration.freedom,
            overdispersion=departures.noise.overdispersion,
            departures=(lens_modes(calibration),),
        )

    @property
    def lenses(self) -> tuple[Camera, ...]:
        """The central cameras, without their poses."""
        return tuple(camera for camera, _ in self.cameras.values())

    @property
    def poses(self) -> tuple[Rigid3, ...]:
        """cam_from_rig of each camera."""
        return tuple(pose for _, pose in self.cameras.values())

    @property
    def near_cameras(self) -> dict[str, tuple[Camera, Rigid3]]:
        """The cameras for points in mm: a `NearCamera` if the pupil moves."""
        return {
            name: (NearCamera.of(camera, self.pupils[name].terms) if name in self.pupils else camera, pose)
            for name, (camera, pose) in self.cameras.items()
        }

    @property
    def layout(self) -> Layout:
        """Slices of lenses and mounts in the covariance."""
        return Layout.of_cameras(self.lenses)

    @property
    def widened_covariance(self) -> FloatArray | None:
        """The covariance, widened so that two standard deviations contain 95 % of the errors; without departures."""
        if self.covariance is None:
            return None
        return (
            widening(effective_freedom(self.freedom, self.overdispersion, len(self.covariance))) ** 2 * self.covariance
        )

    @property
    def with_departures(self) -> Self:
        """The same with the modes of the lenses as further parameters; unchanged without a covariance."""
        if self.covariance is None:
            return self
        lenses, covariance, expected = with_modes(self.lenses, self.covariance, self.departures)
        cameras = dict(zip(self.cameras, zip(lenses, self.poses, strict=True), strict=True))
        return replace(self, cameras=cameras, covariance=covariance, expected=expected, departures=())

    @property
    def quoted(self) -> UncertainRig | None:
        """The rig with departures, and its covariance widened for the degrees of freedom, so that two standard
        deviations contain 95 % of errors; None without a covariance."""
        whole = replace(self, covariance=self.widened_covariance).with_departures
        if whole.covariance is None:
            return None
        return UncertainRig(
            cameras=whole.lenses, cam_from_rig=whole.poses, covariance=whole.covariance, scale_sigma=self.scale_sigma
        )
