"""Known cameras of a rig's session: lenses, or lenses with mounts, from files."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from rigkit.calibration.rig.mounted import MountedCameras
from rigkit.calibration.rig.solving.known import KnownCameras
from rigkit.cameras.base import Camera
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
    warn_if_exact,
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
        warn_if_exact(session.known_rig, rig.covariance)
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
    sources: list[tuple[MountedCameras, list[str]]] = [(rig, mounted)] if mounted else []
    rigs: dict[Path, tuple[MountedCameras, list[str]]] = {}
    for name, path in session.lenses.items():
        if name in cameras:
            continue
        source, own = rigs.get(path) or (_source_of_file(path, name, names), [])
        if name not in source.cameras:
            raise InputError(f"'{path}' has no camera '{name}'; there are {', '.join(source.cameras)}")
        cameras[name] = (source.cameras[name][0], None)
        own.append(name)
        if len(own) == 1:
            warn_if_exact(path, source.covariance)
            sources.append((source, own))
        if is_rig(path):
            # The errors of lenses of one rig are correlated.
            rigs[path] = source, own
    return KnownCameras.of(cameras, sources)


def _rig_with_names(path: Path, names: Sequence[str]) -> SavedRig:
    """Return a saved rig; the numbered cameras of another tool's get the first of `names`."""
    rig = rig_of_file(path)
    warn_of_pupils(path, rig)
    if is_rig_file(path) or set(rig.cameras) & set(names):
        return rig
    return replace(rig, cameras=dict(zip(names, rig.cameras.values(), strict=False)))


def _source_of_file(path: Path, name: str, names: Sequence[str]) -> MountedCameras:
    """Return the rig in a file, or its one camera as that called `name`; without a covariance where it states none."""
    if is_rig(path):
        rig = _rig_with_names(path, names)
        warn_if_bad(path, rig.verdicts)
        return rig
    if (calibration := calibration_of_file(path)) is None:
        return MountedCameras(cameras={name: (import_camera(path), Rigid3.identity())}, covariance=None)
    warn_if_bad(path, calibration.verdicts)
    warn_of_pupil(path, calibration)
    return MountedCameras.alone(name, calibration)
