"""The cameras of a rig's session that are known before: lenses, or lenses and mounts, from files."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from rigkit.calibration.rig.known import KnownCameras
from rigkit.cameras.base import Camera
from rigkit.core.arrays import FloatArray
from rigkit.core.errors import InputError
from rigkit.geometry.rigid3 import Rigid3
from rigkit.io.rig_file import SavedRig, is_rig_file
from rigkit.io.rig_session import RigSession
from rigkit.workflows.camera_files import import_camera, is_rig, own_calibration, saved_rig
from rigkit.workflows.folder_session import Known

_log = logging.getLogger(__name__)


def with_known(session: RigSession, known: Known) -> RigSession:
    """Return the session with what files tell; what it says itself of them is replaced.

    Raises InputError for a number of files that is not that of the cameras.
    """
    if known.lenses:
        session = replace(session, lenses=known.of_cameras(list(session.cameras)))
    return session if known.rig is None else replace(session, known_rig=known.rig)


def with_known_first(session: RigSession) -> RigSession:
    """Return the session with the cameras of the known rig first, in its order: its frame stays that of its first.

    What of the rig has no images is warned of.
    """
    if session.known_rig is None:
        return session
    of_rig = list(_saved(session.known_rig, list(session.cameras)).cameras)
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
    """Return what the files of a session know of its cameras, with their covariances where they have one; None where it
    names no file.

    Raises InputError for files that are no cameras, a rig of which the first camera is not in the session, or one that
    leaves nothing to find.
    """
    if session.known_rig is None and not session.lenses:
        return None
    names = list(session.cameras)
    rig = SavedRig(cameras={}, covariance=None) if session.known_rig is None else _saved(session.known_rig, names)
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
            lens, alone[name] = _lens(path, name, names)
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
    """Return the covariance of all that is known, in the order that `KnownCameras` has; exact where no file says."""
    sizes = [camera.parameters.size for camera, _ in cameras.values()]
    ends = dict(zip(cameras, np.cumsum(sizes), strict=True))
    lenses = {name: slice(ends[name] - size, ends[name]) for name, size in zip(cameras, sizes, strict=True)}
    total = int(sum(sizes))
    out = np.zeros((total + 6 * max(len(mounted) - 1, 0),) * 2)
    if rig.covariance is not None:
        here = [np.arange(lenses[name].start, lenses[name].stop) for name in mounted]
        here += [np.arange(total + 6 * k, total + 6 * k + 6) for k in range(len(mounted) - 1)]
        there = _places_in(rig, mounted)
        out[np.ix_(np.concatenate(here), np.concatenate(here))] = rig.covariance[np.ix_(there, there)]
    for name, covariance in alone.items():
        if covariance is not None:
            out[lenses[name], lenses[name]] = covariance
    return out


def _places_in(rig: SavedRig, mounted: Sequence[str]) -> np.ndarray:
    """Return where the lenses and mounts of some cameras stand in the covariance of their rig."""
    lenses, mounts = {}, {}
    start = 0
    for name, (camera, _) in rig.cameras.items():
        lenses[name] = np.arange(start, start + camera.parameters.size)
        start += camera.parameters.size
    for name in list(rig.cameras)[1:]:
        mounts[name] = np.arange(start, start + 6)
        start += 6
    return np.concatenate([*(lenses[name] for name in mounted), *(mounts[name] for name in mounted[1:])])


def _saved(path: Path, names: Sequence[str]) -> SavedRig:
    """Return a rig of ours, or another tool's, whose cameras have numbers for names, with the first of `names`."""
    rig = saved_rig(path)
    if is_rig_file(path) or set(rig.cameras) & set(names):
        return rig
    return replace(rig, cameras=dict(zip(names, rig.cameras.values(), strict=False)))


def _lens(path: Path, name: str, names: Sequence[str]) -> tuple[Camera, FloatArray | None]:
    """Return a camera and its covariance, None where the file has none; of a rig that of the name."""
    if is_rig(path):
        rig = _saved(path, names)
        if name not in rig.cameras:
            raise InputError(f"'{path}' has no camera '{name}'; there are {', '.join(rig.cameras)}")
        own = _places_in(rig, [name])
        return rig.cameras[name][0], None if rig.covariance is None else rig.covariance[np.ix_(own, own)]
    if (calibration := own_calibration(path)) is not None:
        return calibration.camera, np.asarray(calibration.covariance)
    return import_camera(path), None
