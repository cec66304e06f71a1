"""Comparison of two calibrations, rigs, or sets of boards on one mount, given their covariances."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from rigkit.calibration.compare import CalibrationComparison, compare_calibrations
from rigkit.calibration.rig.compare import RigDifference, compare_board_rigs, compare_mounts
from rigkit.cameras.compare import CameraDifference, compare_cameras
from rigkit.core.errors import InputError
from rigkit.core.printing import brief
from rigkit.io.calibrations.rig_file import SavedRig, is_board_rigs_file, is_rig_file, load_board_rigs
from rigkit.io.disk.reading import about, paths_of
from rigkit.io.disk.writing import ensure_writable, write_atomic
from rigkit.report.pictures.figures import difference_png
from rigkit.workflows.inputs.camera_files import (
    calibration_of_file,
    camera_text,
    import_camera,
    is_rig,
    rig_of_file,
    warn_if_bad,
)
from rigkit.workflows.options.cameras import DiffOptions

_log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False, slots=True)
class CameraPair:
    """The difference of two cameras.

    Attributes
    ----------
    difference : over the image of the first.
    compared : the same with both covariances; None where a file has none, such as those of other tools.
    """

    difference: CameraDifference
    compared: CalibrationComparison | None

    __repr__ = brief

    @property
    def same(self) -> bool | None:
        """Whether both are the same camera; None where that cannot be decided."""
        return None if self.compared is None else self.compared.same


@dataclass(frozen=True, eq=False, slots=True)
class RigPair:
    """The difference of two rigs.

    Attributes
    ----------
    mounts : the difference of the cameras' poses.
    cameras : by name, the difference of each lens, tested where the calibrations are stored with both rigs.
    """

    mounts: RigDifference
    cameras: Mapping[str, CameraPair]

    __repr__ = brief

    @property
    def same(self) -> bool | None:
        """Whether both are the same rig; None where that cannot be decided."""
        known = [s for s in (self.mounts.same, *(c.same for c in self.cameras.values())) if s is not None]
        return all(known) if known else None


@dataclass(frozen=True, eq=False, slots=True)
class BoardsPair:
    """The differences of boards on one mount, by the name of the first of each mount."""

    targets: Mapping[str, RigDifference]

    @property
    def same(self) -> bool:
        """Whether every board has kept its pose."""
        return all(target.same is not False for target in self.targets.values())


def diff(a: str | Path, b: str | Path, options: DiffOptions | None = None) -> CameraPair | RigPair | BoardsPair:
    """Compare two files of calibrations, of rigs, or of boards on one mount.

    Raises InputError for files of different kinds, rigs of other cameras or boards, or a map that cannot be written.
    """
    (a, b), options = paths_of((a, b)), options or DiffOptions()
    ensure_writable(options.report, force=options.force, inputs=(a, b))
    boards = [is_board_rigs_file(path) for path in (a, b)]
    if any(boards):
        if not all(boards):
            raise InputError(
                f"diff: '{b if boards[0] else a}' is no file of boards on one mount, as the other one is; "
                "give two such files"
            )
        if options.output is not None:
            raise InputError(f"diff: a map is of two cameras, '{a}' and '{b}' are boards; leave out -o")
        with about(a, b):
            return _boards(a, b)
    rigs = [is_rig(path) for path in (a, b)]
    if all(rigs):
        if options.output is not None:
            raise InputError(
                f"diff: a map is of two cameras, '{a}' and '{b}' are rigs; give the calibrations beside them, "
                "rig-CAMERA.json"
            )
        with about(a, b):
            return _rigs(a, b)
    if any(rigs):
        other = b if rigs[0] else a
        camera_text(other)  # A file that cannot be read is named as such.
        raise InputError(f"diff: a rig and a camera; compare '{other}' with the calibration beside the rig")
    ensure_writable(options.output, force=options.force, inputs=(a, b))
    if options.output is not None and options.output.suffix.lower() != ".png":
        raise InputError(f"diff: the map is a picture, '{options.output}' is no name of one; give a name in .png")
    with about(a, b):
        pair = _cameras(a, b)
    if options.output is not None:
        write_atomic(options.output, difference_png(pair.difference), force=options.force)
    return pair


def _boards(a: Path, b: Path) -> BoardsPair:
    first, second = ({rig.names[0]: rig for rig in load_board_rigs(path)} for path in (a, b))
    if list(first) != list(second):
        raise InputError(
            f"diff: '{a}' has mounts of {', '.join(first)}, '{b}' of {', '.join(second)}; give files of the same boards"
        )
    return BoardsPair({name: compare_board_rigs(rig, second[name]) for name, rig in first.items()})


def _cameras(a: Path, b: Path) -> CameraPair:
    first, second = calibration_of_file(a), calibration_of_file(b)
    if first is None or second is None:
        return CameraPair(compare_cameras(import_camera(a), import_camera(b)), None)
    warn_if_bad(a, first.verdicts)
    warn_if_bad(b, second.verdicts)
    if (first.pupil is None) != (second.pupil is None):
        _log.warning(
            "'%s' has a moving entrance pupil, '%s' was calibrated without: as a central camera it is accurate at the "
            "boards' distance only, and distant points are compared here",
            *((b, a) if first.pupil is None else (a, b)),
        )
    compared = compare_calibrations(first, second)
    return CameraPair(compared.difference, compared)


def _rigs(a: Path, b: Path) -> RigPair:
    first, second = rig_of_file(a), rig_of_file(b)
    warn_if_bad(a, first.verdicts)
    warn_if_bad(b, second.verdicts)
    first, second = _named_like(first, second, a), _named_like(second, first, b)
    names = list(first.cameras)
    if names != list(second.cameras):
        raise InputError(
            f"diff: '{a}' has the cameras {', '.join(names)}, '{b}' {', '.join(second.cameras)}; give rigs of the same "
            "cameras"
        )
    mounts = compare_mounts(first, second)
    cameras = {}
    for name in names:
        paths = [path.with_name(f"{path.stem}-{name}.json") for path in (a, b)]
        if all(path.is_file() for path in paths):
            cameras[name] = _cameras(*paths)
        else:
            cameras[name] = CameraPair(compare_cameras(first.cameras[name][0], second.cameras[name][0]), None)
    return RigPair(mounts, cameras)


def _named_like(rig: SavedRig, other: SavedRig, path: Path) -> SavedRig:
    """Return another tool's rig, whose cameras are numbered, with the names of the other rig in their order."""
    if is_rig_file(path) or len(rig.cameras) != len(other.cameras):
        return rig
    return replace(rig, cameras=dict(zip(other.cameras, rig.cameras.values(), strict=True)))
