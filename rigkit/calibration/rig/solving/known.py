"""Known cameras of a rig: lenses, or lenses and mounts, that the joint solution holds.

They are held by priors so strong that no corner changes them. Their covariance, and the departures of the lenses from
their models, are propagated to the other unknowns (`rigkit.calibration.rig.assemble`).

The images may be those from which the lenses were calibrated. In least squares the errors of the mounts given the
lenses are independent of the lenses' errors, whether the lenses come from other images, from these by the solution of
the same rig, or from those of each camera alone: in each case the lens's error is orthogonal to what board poses, and
mounts through them, change.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np

from rigkit.calibration.certainty.displaced import LensModes, covariance_of_modes
from rigkit.calibration.rig.mounted import MountedCameras
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
    covariance : (n, n) of all their parameters, camera by camera, then of the known mounts (rad, mm) except the first,
        widened for its degrees of freedom; None: exact.
    departures : by name, modes of lenses beyond their models, with the error (n, M) of all these parameters; they are
        not in `covariance`. Those of other lenses are estimated from the images.
    """

    cameras: Mapping[str, tuple[Camera, Rigid3 | None]]
    covariance: FloatArray | None = None
    departures: Mapping[str, LensModes] = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        cameras: Mapping[str, tuple[Camera, Rigid3 | None]],
        sources: Iterable[tuple[MountedCameras, Sequence[str]]],
    ) -> Self:
        """Return known cameras whose errors come from calibrations that are independent of each other: each with the
        names of the cameras that are its. Cameras of sources without a covariance are exact."""
        size, departures = _size(cameras), dict[str, LensModes]()
        covariance, stated = np.zeros((size, size)), False
        for source, names in sources:
            if (known := source.widened_covariance) is None:
                continue
            stated, mounted = True, all(cameras[name][1] is not None for name in names)
            here, there = (_indices(own, names, mounted=mounted) for own in (cameras, source.cameras))
            for name, modes in zip(source.cameras, source.departures, strict=False):
                if name in names:
                    moves = np.zeros((size, modes.moves.shape[1]))
                    moves[here] = modes.moves[there]
                    departures[name] = replace(modes, moves=moves)
                else:
                    known = known + covariance_of_modes((modes,), len(known))
            covariance[np.ix_(here, here)] = known[np.ix_(there, there)]
        return cls(cameras, covariance if stated else None, departures)

    def __post_init__(self) -> None:
        size = _size(self.cameras)
        if self.covariance is not None and self.covariance.shape != (size, size):
            raise InputError(f"known cameras: covariance of {self.covariance.shape}, expected {size} by {size}")

    @property
    def mounted(self) -> list[str]:
        """Names of the cameras whose mounts are known."""
        return [name for name, (_, mount) in self.cameras.items() if mount is not None]

    def of_lens(self, name: str) -> FloatArray | None:
        """Return the covariance of one camera's parameters, without departures; None: exact."""
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


def _size(cameras: Mapping[str, tuple[Camera, Rigid3 | None]]) -> int:
    """Return the number of values of known cameras."""
    mounted = sum(mount is not None for _, mount in cameras.values())
    return sum(camera.parameters.size for camera, _ in cameras.values()) + 6 * max(mounted - 1, 0)


def _indices(cameras: Mapping[str, tuple[Camera, object]], names: Sequence[str], *, mounted: bool) -> IntArray:
    """Return the indices, in the covariance of `cameras`, of the lenses of those called `names`, and of their mounts
    where `mounted`; the first of them then defines the frame."""
    layout = Layout.of_cameras(camera for camera, _ in cameras.values())
    chosen = [list(cameras).index(name) for name in names]
    runs = [layout.cameras[k] for k in chosen] + [layout.mount(k) for k in chosen[1:] if mounted]
    return np.concatenate([np.arange(run.start, run.stop) for run in runs])
