"""Writing cameras and rigs in other tools' formats."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from rigkit.calibration.certainty.coverage import outline_of_corners
from rigkit.calibration.result import Calibration
from rigkit.cameras.base import Camera
from rigkit.core.arrays import Pixels
from rigkit.core.errors import InputError
from rigkit.core.printing import brief
from rigkit.interop.camera_formats import FOREIGN_FORMATS
from rigkit.interop.exchange import Written
from rigkit.interop.rigs import RIG_FORMATS, ForeignRig, Outlines, Rig, write_rig
from rigkit.io.calibrations.calibration_file import save_camera
from rigkit.io.calibrations.rig_file import is_rig_file, load_saved_rig
from rigkit.io.disk.reading import about
from rigkit.io.disk.writing import ensure_writable, write_atomic, write_together
from rigkit.workflows.inputs.camera_files import (
    calibration_of_file,
    import_camera,
    import_rig,
    warn_if_bad,
    warn_of_pupil,
)
from rigkit.workflows.inputs.formats import CAMERA_FORMATS, FOREIGN_ENDINGS
from rigkit.workflows.options.cameras import ExportCameraOptions

RIG_ENDINGS = {"colmap": ".json"}
"""File endings of rigs that differ from those of cameras."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class ExportedCamera:
    """The source camera, the format written, and the largest difference of the file from the camera, px."""

    camera: Camera
    kind: str
    max_error_px: float

    __repr__ = brief


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class ExportedRig:
    """The format written, the largest difference of a camera from its source, px, and the files."""

    kind: str
    max_error_px: float
    written: tuple[Path, ...]

    __repr__ = brief


def export_camera(source: str | Path, options: ExportCameraOptions) -> ExportedCamera:
    """Write the camera of a file in another format; notes for users of the new file go to the log.

    Raises InputError for a source that is no camera, a format that cannot represent it, or a file that cannot be
    written.
    """
    kind = options.kind or ("rigkit" if options.output.suffix == ".json" else None)
    if kind not in CAMERA_FORMATS:
        raise InputError(f"export: say the camera's format with --to, one of {', '.join(CAMERA_FORMATS)}")
    ensure_writable(options.output, force=options.force, inputs=[source])
    with about(source):
        camera = import_camera(source, options.source_kind, size_px=options.size_px)
    if kind == "rigkit":
        save_camera(options.output, camera, force=options.force)
        return ExportedCamera(camera=camera, kind=kind, max_error_px=0.0)
    with about(source):
        known = calibration_of_file(source)
        outline = None if known is None else outline_of_corners(known)
        done = _written_camera(camera, kind, outline)
    write_atomic(options.output, done.text, force=options.force)
    if done.note:
        _log.info(done.note)
    return ExportedCamera(camera=camera, kind=kind, max_error_px=done.max_error_px)


def export_rig(source: str | Path, options: ExportCameraOptions, names: Sequence[str] = ()) -> ExportedRig:
    """Write a rig's file (of rigkit or another tool) in another format; `names` selects cameras and their order.

    A single selected camera may also be written in rigkit's format and in those of cameras alone. Formats with one file
    for each camera get OUT-NAME.
    Raises InputError for a source that is no rig, a format without rigs, an unknown camera, or a file that cannot be
    written.
    """
    kind = options.kind or ("rigkit" if options.output.suffix == ".json" and len(names) == 1 else None)
    if kind is None:
        raise InputError(
            f"export: say the rig's format with --to, one of {', '.join(RIG_FORMATS)}, or take one camera out: --names "
            "ONE -o ONE.json"
        )
    rig = import_rig(source, size_px=options.size_px)
    warn_if_bad(source)
    missing = [name for name in names if name not in rig]
    if missing or len(set(names)) != len(names):
        raise InputError(
            f"'{source}': no camera '{', '.join(missing) or names[0]}' to pick; there are {', '.join(rig)}"
        )
    rig = {name: rig[name] for name in names or rig}
    if kind == "rigkit" and len(rig) == 1:
        ensure_writable(options.output, force=options.force, inputs=[source])
        save_camera(options.output, next(iter(rig.values()))[0], force=options.force)
        return ExportedRig(kind=kind, max_error_px=0.0, written=(options.output,))
    with about(source):
        outlines = load_saved_rig(source).outlines if is_rig_file(source) else {}
        if len(rig) == 1 and kind in FOREIGN_ENDINGS and (kind not in RIG_FORMATS or RIG_FORMATS[kind].stereo_only):
            ((name, (camera, _)),) = rig.items()
            done = _written_camera(camera, kind, outlines.get(name))
            foreign = ForeignRig({"": done.text}, done.max_error_px, (done.note,) if done.note else ())
        else:
            foreign = write_rig(rig, kind, outlines)
    files = {_camera_path(options.output, key): text for key, text in foreign.files.items()}
    ensure_writable(list(files), force=options.force, inputs=[source])
    write_together(dict(files), force=options.force)
    for note in foreign.notes:
        _log.info(note)
    return ExportedRig(kind=kind, max_error_px=foreign.max_error_px, written=tuple(files))


def foreign_rig_files(rig: Rig, result: Path, kinds: Sequence[str], outlines: Outlines) -> dict[Path, str]:
    """Return the files (path -> content) of a rig in each of the formats `kinds` that can hold it.

    They are named after the rig's file `result` and fitted inside the `outlines` of the images that corners covered.
    Notes for their users go to the log; so does a warning about a format that cannot represent this rig.
    """
    files: dict[Path, str] = {}
    said: set[str] = set()
    for kind, places in foreign_rig_paths(list(rig), result, kinds).items():
        try:
            foreign = write_rig(rig, kind, outlines)
        except InputError as error:
            _log.warning(f"no {kind} file of the rig: {error}")
            continue
        files |= dict(zip(places, foreign.files.values(), strict=True))
        if notes := [note for note in foreign.notes if note not in said]:
            _log.info(f"{', '.join(map(str, places))}: {'; '.join(notes)}")
        said |= set(notes)
    return files


def foreign_rig_paths(names: Sequence[str], result: Path, kinds: Sequence[str]) -> dict[str, list[Path]]:
    """Return the paths of `foreign_rig_files` by format, for cameras of these names."""
    out = {}
    for kind in kinds:
        known = RIG_FORMATS.get(kind)
        if known is not None and not (known.stereo_only and len(names) != 2):
            whole = result.with_name(f"{result.stem}-{kind}{RIG_ENDINGS.get(kind, FOREIGN_ENDINGS[kind])}")
            out[kind] = [_camera_path(whole, key) for key in known.keys(names)]
    return out


def _camera_path(path: Path, name: str) -> Path:
    """Return the path for one camera; `path` itself for "", which stands for all cameras."""
    return path.with_name(f"{path.stem}-{name}{path.suffix}") if name else path


def foreign_files(calibration: Calibration, result: Path, kinds: Sequence[str]) -> dict[Path, str]:
    """Return the files (path -> content) of a camera in other tools' formats, named after its calibration's file
    `result`. Notes for their users go to the log.

    Raises InputError for a format that cannot represent the camera.
    """
    files = {}
    said: dict[str, Path] = {}
    paths = foreign_paths(result, kinds)
    outline = outline_of_corners(calibration) if kinds else None
    if paths:
        warn_of_pupil(", ".join(map(str, paths)), calibration)
    for kind, path in zip(kinds, paths, strict=True):
        done = _written_camera(calibration.camera, kind, outline)
        files[path] = done.text
        # OpenCV and ROS have the same models.
        same = said.setdefault(done.note.partition(" has no ")[2] or done.note, path)
        if done.note:
            _log.info(f"{path}: {done.note if same == path else f'the same lens as in {same}'}")
    return files


def foreign_paths(result: Path, kinds: Sequence[str]) -> list[Path]:
    """Return the paths of `foreign_files`; raises InputError for an unknown format."""
    unknown = [kind for kind in kinds if kind not in FOREIGN_ENDINGS]
    if unknown:
        raise InputError(f"export: '{unknown[0]}' is none of the known formats {', '.join(FOREIGN_ENDINGS)}")
    return [result.with_name(f"{result.stem}-{kind}{FOREIGN_ENDINGS[kind]}") for kind in kinds]


def _written_camera(camera: Camera, kind: str, outline: Pixels | None) -> Written:
    """Return the camera in another format, compared with the original inside the `outline`."""
    write = FOREIGN_FORMATS[kind].write
    assert write is not None
    return write(camera, outline)
