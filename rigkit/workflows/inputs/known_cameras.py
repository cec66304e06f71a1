"""Known cameras of a rig's session: lenses, or lenses with mounts, from files."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from rigkit.calibration.rig.solving.known import KnownCameras
from rigkit.calibration.rig.solving.layout import Layout
from rigkit.cameras.base import Camera
from rigkit.core.arrays import FloatArray, IntArray
from rigkit.core.errors import InputError
from rigkit.geometry.rigid3 import Rigid3
from rigkit.io.calibrations.rig_file import SavedRig, is_rig_file
from rigkit.io.manifests.rig_session import RigSession
from rigkit.workflows.inputs.camera_files import (
    calibration_of_file,
    import_camera,
    is_rig,
    rig_of_file,
    warn_if_bad,
    warn_of_pupil,
    warn_of_pupils,
)
from rigkit.workflows.options.cameras import Known

_log = logging.getLogger(__name__)


def with_known(session: RigSession, known: Known) -> RigSession:
    """Return the session with the lens files and rig file of `known` in place of its own.

    Raises InputError if the number of lens files does not fit the cameras.
    """
    if known.lenses:
        session = replace(session, lenses=known.of_cameras(list(session.cameras)))
    return session if known.rig is None else replace(session, known_rig=known.rig)


def known_cameras_first(session: RigSession) -> RigSession:
    """Return the session with the cameras of the known rig first, in its order, so that the rig's frame stays the same.

    Warns of cameras of the rig that have no images.
    """
    if session.known_rig is None:
        return session
    of_rig = list(_rig_with_names(session.known_rig, list(session.cameras)).cameras)
    known = [name for name in of_rig if name in session.cameras]
    if len(known) < len(of_rig):
        without = ", ".join(name for name in of_rig if name not in known)
        _log.warning(
            f"'{session.known_rig}': without images here, {without} will not be in the new rig; give images of all its "
            "cameras to keep them"
        )
    order = [*known, *(name for name in session.cameras if name not in known)]
    return replace(session, cameras={name: session.cameras[name] for name in order})


def known_cameras(session: RigSession) -> KnownCameras | None:
    """Return the known cameras of a session, with the covariances that their files have; None if it names no file.

    Raises InputError for files without cameras, a rig whose first camera is not in the session, or one that has all
    cameras of the session.
    """
    if session.known_rig is None and not session.lenses:
        return None
    names = list(session.cameras)
    rig = (
        SavedRig(cameras={}, covariance=None)
        if session.known_rig is None
        else _rig_with_names(session.known_rig, names)
    )
    if session.known_rig is not None:
        warn_if_bad(session.known_rig, rig.verdicts)
    mounted = [name for name in rig.cameras if name in names]
    if rig.cameras:
        first = next(iter(rig.cameras))
        if first not in names:
            raise InputError(
                f"'{session.known_rig}': its first camera, '{first}', is none of {', '.join(names)}; give that camera "
                "this id"
            )
        if len(mounted) == len(names):
            raise InputError(
                f"'{session.known_rig}' has all cameras already ({', '.join(names)}), so there is none to add; "
                "give the images of a new one, too"
            )
    cameras: dict[str, tuple[Camera, Rigid3 | None]] = {name: rig.cameras[name] for name in mounted}
    alone: dict[str, FloatArray | None] = {}
    for name, path in session.lenses.items():
        if name not in cameras:
            lens, alone[name] = _camera_and_covariance(path, name, names)
            cameras[name] = (lens, None)
    if rig.covariance is None and all(covariance is None for covariance in alone.values()):
        return KnownCameras(cameras)
    return KnownCameras(cameras, _covariance(cameras, rig, mounted, alone))


def _covariance(
    cameras: dict[str, tuple[Camera, Rigid3 | None]],
    rig: SavedRig,
    mounted: Sequence[str],
    alone: dict[str, FloatArray | None],
) -> FloatArray:
    """Return the covariance of all known parameters, in the order of `KnownCameras`; zero where no file states one."""
    layout = Layout.of_cameras(camera for camera, _ in cameras.values())
    lenses = dict(zip(cameras, layout.cameras, strict=True))
    total = layout.cameras[-1].stop + 6 * max(len(mounted) - 1, 0)
    out = np.zeros((total, total))
    if (known := rig.covariance_with_departures) is not None:
        here, there = _covariance_indices(cameras, mounted), _covariance_indices(rig.cameras, mounted)
        out[np.ix_(here, here)] = known[np.ix_(there, there)]
    for name, covariance in alone.items():
        if covariance is not None:
            out[lenses[name], lenses[name]] = covariance
    return out


def _covariance_indices(cameras: Mapping[str, tuple[Camera, object]], mounted: Sequence[str]) -> IntArray:
    """Return the indices, in the covariance of `cameras`, of the lenses and mounts of those named `mounted`."""
    layout = Layout.of_cameras(camera for camera, _ in cameras.values())
    chosen = [list(cameras).index(name) for name in mounted]
    runs = [layout.cameras[k] for k in chosen] + [layout.mount(k) for k in chosen[1:]]
    return np.concatenate([np.arange(run.start, run.stop) for run in runs])


def _rig_with_names(path: Path, names: Sequence[str]) -> SavedRig:
    """Return a saved rig; the numbered cameras of another tool's get the first of `names`."""
    rig = rig_of_file(path)
    warn_of_pupils(path, rig)
    if is_rig_file(path) or set(rig.cameras) & set(names):
        return rig
    return replace(rig, cameras=dict(zip(names, rig.cameras.values(), strict=False)))


def _camera_and_covariance(path: Path, name: str, names: Sequence[str]) -> tuple[Camera, FloatArray | None]:
    """Return the camera of a file (of a rig's file, the one called `name`) and its covariance, or None."""
    if is_rig(path):
        rig = _rig_with_names(path, names)
        if name not in rig.cameras:
            raise InputError(f"'{path}' has no camera '{name}'; there are {', '.join(rig.cameras)}")
        warn_if_bad(path, rig.verdicts)
        own, known = _covariance_indices(rig.cameras, [name]), rig.covariance_with_departures
        return rig.cameras[name][0], None if known is None else known[np.ix_(own, own)]
    if (calibration := calibration_of_file(path)) is not None:
        warn_if_bad(path, calibration.verdicts)
        warn_of_pupil(path, calibration)
        return calibration.camera, np.asarray(calibration.covariance)
    return import_camera(path), None
