"""The files that a calibration writes, known before it runs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rigkit.workflows.inputs.camera_files import file_of_camera
from rigkit.workflows.options.cameras import CalibrateOptions
from rigkit.workflows.outputs.export_camera import foreign_paths, foreign_rig_paths


def calibration_paths(names: Sequence[str], options: CalibrateOptions, *, rigid_boards: bool = False) -> list[Path]:
    """Return the files that the calibration of cameras of these names writes, perhaps with boards on one mount."""
    out = []
    if (output := options.output) is not None:
        cameras = [camera_path(names, output, name) for name in names]
        out += [output, *cameras] if len(names) > 1 else cameras
        out += [path for one in cameras for path in foreign_paths(one, camera_exports(names, options))]
        out += [path for places in _rig_exports(names, options).values() for path in places]
        out += [boards_path(output)] if rigid_boards else []
    return out if options.report is None else [*out, options.report]


def camera_path(names: Sequence[str], output: Path, name: str) -> Path:
    """Return the path of one camera's calibration."""
    return file_of_camera(output, name) if len(names) > 1 else output


def boards_path(output: Path) -> Path:
    """Return the path of the file of boards on one mount."""
    return output.with_name(f"{output.stem}-boards.json")


def camera_exports(names: Sequence[str], options: CalibrateOptions) -> list[str]:
    """Return the requested formats that hold one camera a file; a rig's file has the lenses already."""
    whole = _rig_exports(names, options)
    return [kind for kind in options.exports if kind not in whole]


def _rig_exports(names: Sequence[str], options: CalibrateOptions) -> dict[str, list[Path]]:
    """Return, by requested format that holds a whole rig, its files."""
    if options.output is None or len(names) < 2:
        return {}
    return foreign_rig_paths(names, options.output, options.exports)
