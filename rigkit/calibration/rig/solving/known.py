"""Known cameras of a rig: lenses, or lenses and mounts, that the joint solution holds.

They are held by priors so strong that no corner changes them. Their covariance is propagated to the other unknowns
(`rigkit.calibration.rig.assemble`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from rigkit.calibration.rig.solving.layout import Layout
from rigkit.calibration.rig.solving.solver import rig_normal
from rigkit.calibration.rig.solving.state import RigObservations, RigState
from rigkit.cameras.base import Camera
from rigkit.core.arrays import FloatArray, IntArray
from rigkit.core.errors import InputError
from rigkit.geometry.rigid3 import Rigid3

HOLD = 1e10
"""Information of these priors, as a multiple of that of the corners: a value changes by 1e-10 of the free change."""


@dataclass(frozen=True, eq=False, slots=True)
class KnownCameras:
    """Known values of some cameras of a rig.

    Attributes
    ----------
    cameras : by name, lens and cam_from_rig; None for an unknown mount. The first one with a mount defines the rig's
        frame, and has to be the first camera of the rig.
    covariance : (n, n) of all their parameters, camera by camera, then of the known mounts (rad, mm) except the first;
        None: exact.
    """

    cameras: Mapping[str, tuple[Camera, Rigid3 | None]]
    covariance: FloatArray | None = None

    def __post_init__(self) -> None:
        size = sum(camera.parameters.size for camera, _ in self.cameras.values()) + 6 * len(self.mounted[1:])
        if self.covariance is not None and self.covariance.shape != (size, size):
            raise InputError(f"known cameras: covariance of {self.covariance.shape}, expected {size} by {size}")

    @property
    def mounted(self) -> list[str]:
        """Names of the cameras whose mounts are known."""
        return [name for name, (_, mount) in self.cameras.items() if mount is not None]

    def of_lens(self, name: str) -> FloatArray | None:
        """Return the covariance of one camera's parameters; None: exact."""
        if self.covariance is None:
            return None
        if name not in self.cameras:
            raise InputError(f"known cameras: none is called '{name}'")
        layout = Layout.of_cameras(camera for camera, _ in self.cameras.values())
        own = layout.cameras[list(self.cameras).index(name)]
        return self.covariance[own, own]

    def index(self, names: Sequence[str], layout: Layout) -> IntArray:
        """Return the indices of the known values among the globals of a rig with the cameras `names`."""
        runs = [layout.cameras[names.index(name)] for name in self.cameras]
        runs += [run for name in self.mounted for run in (layout.mounts[names.index(name)],) if run is not None]
        return np.concatenate([np.arange(run.start, run.stop) for run in runs])

    def weights(self, observations: RigObservations, layout: Layout) -> FloatArray:
        """Return the prior information of every global, (G,); zero where it is free."""
        out = np.zeros(layout.count)
        for where, (_, information) in zip(layout.cameras, observations.held, strict=True):
            out[where] = np.diag(information)
        for run, held in zip(layout.mounts, observations.held_mounts, strict=True):
            if run is not None and held is not None:
                out[run] = np.diag(held[1])
        return out

    def mounts(self, names: Sequence[str], found: Sequence[Rigid3]) -> list[Rigid3]:
        """Return the mounts `found`, with known ones replaced."""
        known = [self.cameras.get(name, (None, None))[1] for name in names]
        return [first if mount is None else mount for mount, first in zip(known, found, strict=True)]

    def hold(self, observations: RigObservations, state: RigState, names: Sequence[str]) -> RigObservations:
        """Return the observations with priors at the known values, which the initial `state` has to contain."""
        layout = state.layout(observations)
        scale = np.diag(rig_normal(observations, state).gg)
        scale = HOLD * np.maximum(scale, np.finfo(float).eps * scale.max())
        held, mounts = [], []
        for c, name in enumerate(names):
            near = state.cameras[c].parameters
            known, mount = self.cameras.get(name, (None, None))
            lens = np.zeros((near.size, near.size)) if known is None else np.diag(scale[layout.cameras[c]])
            before = observations.held[c] if observations.held and known is None else (near, lens)
            held.append(before)
            run = layout.mounts[c]
            mounts.append(None if mount is None or run is None else (mount, np.diag(scale[run])))
        return replace(observations, held=tuple(held), held_mounts=tuple(mounts))
