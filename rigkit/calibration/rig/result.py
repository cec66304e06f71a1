"""The result of a rig calibration: cameras with their mounts, uncertainty, and boards mounted to each other."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from rigkit.calibration.certainty.displaced import LensModes, covariance_of_modes
from rigkit.calibration.pupil import SolvedPupil
from rigkit.calibration.result import Calibration
from rigkit.calibration.rig.board_rig import BoardRig
from rigkit.calibration.rig.mounted import MountedCameras
from rigkit.calibration.rig.solving.exposure_times import Lag
from rigkit.calibration.rig.solving.layout import Layout
from rigkit.calibration.rig.solving.shutters import Readout
from rigkit.calibration.solving.clustered import effective_freedom, widening
from rigkit.calibration.solving.solver import Convergence
from rigkit.cameras.base import Camera
from rigkit.cameras.uncertain import UncertainRig
from rigkit.core.arrays import FloatArray, keep_arrays
from rigkit.core.errors import InputError
from rigkit.core.findings import Finding
from rigkit.core.printing import drawn
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import skew


@dataclass(frozen=True, eq=False, slots=True)
class RigCamera:
    """A camera of a rig: its name, its mount, and its calibration in the rig's solution."""

    name: str
    cam_from_rig: Rigid3
    calibration: Calibration

    @property
    def camera(self) -> Camera:
        return self.calibration.camera

    @property
    def rms_px(self) -> float:
        """Its own 2-D RMS in the rig, px."""
        return self.calibration.rms_px


@dataclass(frozen=True, eq=False, kw_only=True)
class RigCalibration:
    """A calibrated rig.

    Attributes
    ----------
    cameras : in the order given; the first defines the rig's frame.
    rms_px : 2-D RMS per corner over all cameras, sqrt(mean |residual|^2).
    heldout_rms_px : cross-validated error: the same over held-out frames, by k-fold cross-validation over frames. All
        intrinsics, mounts and places of boards are then fixed, only one pose for each target is fitted, jointly to all
        cameras. None with too few frames.
    covariance : of all intrinsics, camera by camera, then of the mounts of all cameras but the first: left perturbation
        (rad) and translation (mm), six each. Of a Student's t distribution with `freedom` degrees of freedom.
    sigma_px : standard deviation of a corner per coordinate, of median quality.
    overdispersion : ratio of the scatter between frames to that expected from independent corners, as a ratio of
        standard deviations, at least 1. All covariances include it, and the change of cameras and mounts if the boards'
        corners were released.
    freedom : degrees of freedom of the covariances; infinite with too few frames to estimate them. Quoted standard
        deviations account for them (`widening`).
    single : each camera calibrated alone, with its own verdicts.
    convergence : of the joint solve.
    corner_count : corners used.
    shared_count : targets, counted in every frame, that several views share.
    left_out : (frame, target, reason) of targets on which the views disagree: each camera's own calibration uses them,
        the mounts do not.
    scale_sigma : relative standard deviation of all lengths, from the measurement of the boards' squares.
    board_rigs : boards that are mounted to each other.
    verdicts : findings about the rig, the headline first.
    departures : model inadequacy of each camera's lens, with the error of the rest of the rig; empty if unknown.
    pupils : moving pupils by camera name; their `with_frame` has the rows of `covariance`.
    lags : by name, of all cameras but the first; empty if they have a common trigger or the boards did not move.
    readouts : by name, of all cameras, where moving boards show that images are read row by row; else empty.
    """

    cameras: tuple[RigCamera, ...]
    rms_px: float
    heldout_rms_px: float | None
    covariance: FloatArray
    sigma_px: float
    overdispersion: float
    single: tuple[Calibration, ...]
    convergence: Convergence
    freedom: float = float("inf")
    corner_count: int = 0
    shared_count: int = 0
    left_out: tuple[tuple[str, str, str], ...] = ()
    scale_sigma: float = 0.0
    board_rigs: tuple[BoardRig, ...] = ()
    verdicts: tuple[Finding, ...] = ()
    departures: tuple[LensModes, ...] = ()
    pupils: Mapping[str, SolvedPupil] = field(default_factory=dict)
    lags: Mapping[str, Lag] = field(default_factory=dict)
    readouts: Mapping[str, Readout] = field(default_factory=dict)

    _repr_html_ = drawn

    def __post_init__(self) -> None:
        count = Layout.of_cameras(c.camera for c in self.cameras).count
        keep_arrays(self, covariance=(count, count))

    def __repr__(self) -> str:
        held = "not available" if self.heldout_rms_px is None else f"{self.heldout_rms_px:.4f} px"
        lines = [
            f"RigCalibration of {', '.join(camera.name for camera in self.cameras)}: held-out RMS {held}, training RMS "
            f"{self.rms_px:.4f} px",
            f"  {self.corner_count} corners, {self.shared_count} boards seen by several views at once, "
            f"{len(self.left_out)} left out",
            *(f"  {finding}" for finding in self.verdicts[:1]),
        ]
        return "\n".join(lines)

    def index(self, name: str) -> int:
        """Return the index of the camera `name`; raises InputError that lists the names."""
        names = [c.name for c in self.cameras]
        if name not in names:
            raise InputError(f"rig: no camera is called '{name}'; there are {', '.join(names)}")
        return names.index(name)

    def cam2_from_cam1(self, name1: str, name2: str) -> Rigid3:
        """Return the relative pose cam2_from_cam1 of two cameras."""
        first, second = self.cameras[self.index(name1)], self.cameras[self.index(name2)]
        return second.cam_from_rig @ first.cam_from_rig.inverse()

    def baseline_mm(self, name1: str, name2: str) -> tuple[float, float]:
        """Return the distance between the centres of two cameras and its standard deviation, mm.

        The standard deviation includes the covariance, model inadequacy and the measurement of the boards' squares.
        """
        first, second = self.index(name1), self.index(name2)
        difference = self._centre(second) - self._centre(first)
        length = float(np.linalg.norm(difference))
        if length == 0.0:
            raise InputError(
                f"rig: cameras '{name1}' and '{name2}' have the same centre; measure a baseline between others"
            )
        row = np.zeros(len(self.covariance))
        for k, sign in ((first, -1.0), (second, 1.0)):
            if k > 0:
                row[self.mount(k)] += sign * (difference / length @ self._centre_jacobian(k))
        variance = self.widening**2 * float(row @ self.covariance @ row)
        variance += float(row @ covariance_of_modes(self.departures, len(row)) @ row)
        return length, float(np.sqrt(max(variance, 0.0) + (length * self.scale_sigma) ** 2))

    @cached_property
    def widening(self) -> float:
        """Factor on quoted standard deviations, so that two of them contain 95 % of the errors."""
        return widening(effective_freedom(self.freedom, self.overdispersion, len(self.covariance)))

    @property
    def sigmas(self) -> FloatArray:
        """Standard deviations of the rows of `covariance`, model inadequacy included, widened so that two of them
        contain 95 % of the errors."""
        departures = covariance_of_modes(self.departures, len(self.covariance))
        return np.sqrt(np.diag(self.widening**2 * self.covariance + departures))

    @cached_property
    def mounted(self) -> MountedCameras:
        """The cameras and their uncertainty, without the record of their calibration."""
        return MountedCameras(
            cameras={c.name: (c.camera, c.cam_from_rig) for c in self.cameras},
            covariance=self.covariance,
            sigma_px=self.sigma_px,
            scale_sigma=self.scale_sigma,
            freedom=self.freedom,
            overdispersion=self.overdispersion,
            departures=self.departures,
            pupils=self.pupils,
        )

    @cached_property
    def quoted(self) -> UncertainRig:
        """The rig with departures, and its covariance widened (`widening`)."""
        quoted = self.mounted.quoted
        assert quoted is not None
        return quoted

    def mount(self, k: int) -> slice:
        """Return the slice of the mount of camera `k` > 0 in the covariance."""
        return Layout.of_cameras(c.camera for c in self.cameras).mount(k)

    def _centre(self, k: int) -> FloatArray:
        return self.cameras[k].cam_from_rig.inverse().translation_mm

    def _centre_jacobian(self, k: int) -> FloatArray:
        """Return d centre / d (w, dt) of c = -R^T t for R <- exp(w) R, t <- t + dt."""
        pose = self.cameras[k].cam_from_rig
        back = pose.rotation.T
        return np.concatenate([-back @ skew(pose.translation_mm), -back], axis=1)
