"""Calibration files (JSON, schema "rigkit.calibration/1").

A file with `schema` and `camera` alone is enough for `load_camera`: cameras of other tools are stored so. Lengths are
in mm, pixel (0, 0) is the centre of the top-left pixel, residuals are measured minus projected, NaN is null.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any, TypeVar, get_type_hints

import numpy as np

from rigkit.calibration.board_shape import BoardShape
from rigkit.calibration.pupil import SolvedPupil
from rigkit.calibration.result import Calibration, Candidate, Outlier, Rival, ViewResult
from rigkit.calibration.solving.solver import Convergence
from rigkit.cameras.base import Camera
from rigkit.cameras.plausible import fault_of_lens
from rigkit.cameras.registry import camera_model
from rigkit.core.arrays import as_covariance, as_indices, without_nan
from rigkit.core.errors import InputError
from rigkit.core.findings import Finding, Severity
from rigkit.geometry.rigid3 import Rigid3
from rigkit.io.boards.board_file import board_of_values, board_values
from rigkit.io.calibrations.schema_calibration import CALIBRATION_FILE, keys_of
from rigkit.io.disk.json_reader import freedom, integer, json_schema, positive, read_json, real, reals
from rigkit.io.disk.reading import on_one_line, usable_path
from rigkit.io.disk.writing import write_atomic

CALIBRATION_SCHEMA = "rigkit.calibration/1"
CAMERA_KEYS = keys_of(CALIBRATION_FILE, "camera")
CALIBRATION_KEYS = keys_of(CALIBRATION_FILE)
Made = Mapping[str, Any]
"""Provenance of a file: see `rigkit.workflows.outputs.provenance.provenance_of`."""
LATER_KEYS = {"overdispersion", "freedom", "made", "rivals", "pupil"}
"""Optional keys: older files lack them, and central cameras have no pupil."""
TERMS_OF_PUPIL = ("mm_per_rad2", "mm_per_rad4")


def save_calibration(path: str | Path, calibration: Calibration, *, force: bool = False) -> None:
    """Write the calibration; raises InputError if the file exists and `force` is not set."""
    write_atomic(path, calibration_text(calibration), force=force)


def calibration_text(calibration: Calibration, made: Made | None = None) -> str:
    """Return the content of a calibration file, with its provenance `made`."""
    c = calibration
    data = {
        "schema": CALIBRATION_SCHEMA,
        **({} if made is None else {"made": made}),
        "camera": camera_to_json(c.camera),
        "rms_px": c.rms_px,
        "heldout_rms_px": c.heldout_rms_px,
        "sigma_px": c.sigma_px,
        "verdicts": findings_to_json(c.verdicts),
        "candidates": [asdict(v) for v in c.candidates],
        "rivals": [{"name": r.name, "likely": r.likely, "camera": camera_to_json(r.camera)} for r in c.rivals],
        "convergence": asdict(c.convergence),
        "dropped": [list(v) for v in c.dropped],
        "outliers": [asdict(v) for v in c.outliers],
        "overdispersion": c.overdispersion,
        "freedom": c.freedom,
        "covariance": c.covariance.tolist(),
        "frame_covariance": c.frame_covariance.tolist(),
        **({} if c.pupil is None else {"pupil": pupil_to_json(c.pupil)}),
        "boards": [
            {
                "board_id": b.board_id,
                "kind": b.kind,
                "bow_mm": b.bow_mm,
                "aspect": b.aspect,
                "points_mm": b.points_mm.tolist(),
                **({} if b.declared is None else {"target": board_values(b.declared)}),
            }
            for b in c.boards
        ],
        "views": [_view_out(v) for v in c.views],
    }
    return _dumps(data)


def save_camera(path: str | Path, camera: Camera, *, force: bool = False) -> None:
    """Write a camera without a calibration."""
    write_atomic(path, _dumps({"schema": CALIBRATION_SCHEMA, "camera": camera_to_json(camera)}), force=force)


def load_camera(path: str | Path) -> Camera:
    """Return the camera of a calibration file.

    Raises InputError for a missing or damaged file, another schema, an unknown key or model, or wrong parameters.
    """
    return _camera_in(_read(path), path)


def load_calibration(path: str | Path) -> Calibration:
    """Return the whole calibration; raises InputError as `load_camera`, and for a file with a camera only."""
    return _calibration_in(_read(path), path)


def load_calibration_or_camera(path: str | Path) -> Calibration | Camera:
    """Return the whole calibration, or the camera of a file with a camera only. Raises InputError as `load_camera`."""
    data = _read(path)
    return _calibration_in(data, path) if "covariance" in data else _camera_in(data, path)


def _camera_in(data: dict[str, Any], path: str | Path) -> Camera:
    if "camera" not in data:
        raise InputError(f"'{path}': 'camera' is missing; calibrate again")
    return camera_from_json(data["camera"], path)


def _calibration_in(data: dict[str, Any], path: str | Path) -> Calibration:
    missing = sorted(CALIBRATION_KEYS - LATER_KEYS - set(data))
    if "covariance" in missing and "camera" in data:
        raise InputError(
            f"'{path}': a camera without covariance, as imported from another program; run `rigkit calibrate` on "
            "images of that camera, and give its result"
        )
    if missing:
        raise InputError(f"'{path}': no {', '.join(missing)}; calibrate again")
    with damage_reported(path):
        camera = camera_from_json(data["camera"], path)
        size = camera.parameters.size
        boards = tuple(_shape_in(v) for v in data["boards"])
        sizes = {board.board_id: board.declared.size for board in boards if board.declared is not None}
        if unknown_boards := {str(view["board_id"]) for view in data["views"]} - {board.board_id for board in boards}:
            raise ValueError(f"a view of board '{min(unknown_boards)}', which is not among 'boards'")
        return Calibration(
            camera=camera,
            rms_px=real(data["rms_px"]),
            heldout_rms_px=None if data["heldout_rms_px"] is None else real(data["heldout_rms_px"]),
            covariance=as_covariance(data["covariance"], "covariance", size),
            frame_covariance=as_covariance(data["frame_covariance"], "frame_covariance", size + 6),
            sigma_px=positive(data["sigma_px"]),
            views=tuple(_view_in(v, sizes) for v in data["views"]),
            dropped=tuple((str(image), str(reason)) for image, reason in data["dropped"]),
            outliers=tuple(_entry(Outlier, _null_as_nan(v)) for v in data["outliers"]),
            candidates=tuple(_entry(Candidate, _null_as_nan(v, ("rms_px",))) for v in data["candidates"]),
            convergence=_entry(Convergence, data["convergence"]),
            boards=boards,
            verdicts=findings_from_json(data["verdicts"]),
            overdispersion=positive(data.get("overdispersion", 1.0)),
            freedom=freedom(data.get("freedom")),
            rivals=tuple(_rival_in(v, path) for v in data.get("rivals", ())),
            pupil=pupil_from_json(data["pupil"]) if "pupil" in data else None,
        )


@contextmanager
def damage_reported(path: str | Path) -> Iterator[None]:
    """Turn any error that a damaged file causes in the block into an InputError that names the file."""
    try:
        yield
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError, InputError) as error:
        # Messages of an InputError are not truncated: they end with the remedy.
        words = " ".join(str(error).split()) if isinstance(error, InputError) else on_one_line(error)
        if str(path) not in words:
            # The remedy must not be repeated.
            damage_words = (
                f"damaged: {words}" if words.endswith("calibrate again") else f"damaged ({words}); calibrate again"
            )
            words = f"'{path}': {damage_words}"
        raise InputError(words) from error


def _read(path: str | Path) -> dict[str, Any]:
    source = usable_path(path)
    if not source.exists():
        raise InputError(f"calibration '{source}' does not exist; run `rigkit calibrate` first")
    remedy = "calibrate again, or bring another program's camera in with `rigkit export FILE -o camera.json`"
    if (json_schema(source) or "").startswith("rigkit.rig/"):
        raise InputError(
            f"'{source}' is a rig, but a single camera is needed here; give the file of the one camera, which is "
            f"called as '{source.stem}-NAME.json' beside it"
        )
    return read_json(source, CALIBRATION_SCHEMA, CALIBRATION_KEYS, "calibration file", remedy=remedy)


def camera_to_json(camera: Camera) -> dict[str, Any]:
    """Return the JSON of a camera."""
    parameters = camera.named(camera.parameters)
    return {"model": camera.model, "size_px": list(camera.size_px), "parameters": parameters}


def camera_from_json(data: Any, path: str | Path) -> Camera:
    """Return the camera of `camera_to_json`; raises InputError that names the file `path`."""
    if not isinstance(data, dict) or set(data) != CAMERA_KEYS or not isinstance(data["parameters"], dict):
        raise InputError(f"'{path}': 'camera' must have the keys {', '.join(sorted(CAMERA_KEYS))}, and no others")
    try:
        width, height = (integer(v) for v in data["size_px"])
        values = np.array([real(v) for v in data["parameters"].values()])
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(f"'{path}': camera: {error}; size_px must be [width, height], parameters numbers") from error
    try:
        camera = camera_model(str(data["model"]))((width, height), values)
    except InputError as error:
        raise InputError(f"'{path}': camera: {error}; calibrate again") from error
    names = camera.parameter_names()
    if tuple(data["parameters"]) != names:
        raise InputError(f"'{path}': parameters of a {camera.model} camera must be {', '.join(names)}, in this order")
    if (fault := fault_of_lens(camera)) is not None:
        raise InputError(f"'{path}': camera: {fault}; calibrate again")
    return camera


def findings_to_json(findings: Sequence[Finding]) -> list[dict[str, str]]:
    """Return the JSON of findings, without empty fields."""
    return [{key: str(value) for key, value in asdict(f).items() if value is not None} for f in findings]


def findings_from_json(data: Sequence[Any]) -> tuple[Finding, ...]:
    """Return the findings of a file; older files have them as lines that begin with the severity."""
    out = []
    for entry in data:
        if isinstance(entry, str):
            severity, _, message = entry.partition(": ")
            entry = {"severity": severity, "message": message}
        out.append(Finding(**{**entry, "severity": Severity(entry["severity"])}))
    return tuple(out)


def _view_out(view: ViewResult) -> dict[str, Any]:
    return {
        "image": view.image,
        "board_id": view.board_id,
        "cam_from_board": view.cam_from_board.matrix()[:3].tolist(),
        "rms_px": view.rms_px,
        "grid": view.grid.tolist(),
        "pixels": view.pixels.tolist(),
        "residuals_px": view.residuals_px.tolist(),
        "kept": view.kept.tolist(),
    }


def _rival_in(data: dict[str, Any], path: str | Path) -> Rival:
    return Rival(str(data["name"]), camera_from_json(data["camera"], path), real(data["likely"]))


def pupil_to_json(pupil: SolvedPupil) -> dict[str, Any]:
    """Return the JSON of a pupil."""
    return {
        **dict(zip(TERMS_OF_PUPIL, pupil.terms.tolist(), strict=True)),
        "covariance": pupil.covariance.tolist(),
        "with_frame": pupil.with_frame.tolist(),
    }


def pupil_from_json(data: dict[str, Any]) -> SolvedPupil:
    """Return the pupil of `pupil_to_json`; raises KeyError, TypeError, ValueError or InputError for anything else."""
    if set(data) != {*TERMS_OF_PUPIL, "covariance", "with_frame"}:
        raise ValueError(f"'pupil' must have the keys {', '.join(TERMS_OF_PUPIL)}, covariance, with_frame")
    terms = np.array([real(data[name]) for name in TERMS_OF_PUPIL])
    return SolvedPupil(terms, as_covariance(data["covariance"], "pupil", len(terms)), reals(data["with_frame"]))


def _view_in(data: dict[str, Any], sizes: Mapping[str, tuple[int, int]]) -> ViewResult:
    """Return a view; `sizes` are (columns, rows) of the declared boards."""
    grid, kept = as_indices(data["grid"], (None, 2), "grid"), data["kept"]
    if not all(isinstance(one, bool) for one in kept):
        raise ValueError("what 'kept' says of a corner must be true or false")
    if ((grid < 0) | (grid >= sizes.get(data["board_id"], grid + 1))).any():
        raise ValueError(f"corners of '{data['image']}' beyond the board '{data['board_id']}'")
    return ViewResult(
        image=str(data["image"]),
        board_id=str(data["board_id"]),
        cam_from_board=Rigid3.from_matrix(reals(data["cam_from_board"])),
        grid=grid,
        pixels=reals(data["pixels"]),
        residuals_px=reals(data["residuals_px"], nullable=True),
        kept=np.array(kept, dtype=bool),
    )


def _shape_in(data: dict[str, Any]) -> BoardShape:
    declared = board_of_values(data["target"], data["board_id"]) if "target" in data else None
    values = {**data, "points_mm": reals(data["points_mm"]), "declared": declared}
    return _entry(BoardShape, {k: v for k, v in values.items() if k != "target"})


def _null_as_nan(values: dict[str, Any], nullable: tuple[str, ...] = ("residual_px",)) -> dict[str, Any]:
    return {k: math.nan if v is None and k in nullable else v for k, v in values.items()}


Entry = TypeVar("Entry", Outlier, Candidate, Convergence, BoardShape)


def _entry(kind: type[Entry], values: dict[str, Any]) -> Entry:
    """Return the dataclass of these values; raises TypeError or ValueError if a field has another type."""
    for name, wanted in get_type_hints(kind).items():
        value = values.get(name)
        # Not isinstance: a bool is an int in Python.
        if wanted in (str, int, bool) and type(value) is not wanted:
            raise TypeError(f"'{name}' is {value!r}, not {wanted.__name__}")
        number = wanted is float or (wanted == float | None and value is not None)
        if number and name in values and value is not math.nan:
            real(value)
    return kind(**values)


def _dumps(data: dict[str, Any]) -> str:
    """Return JSON with null for NaN, with one line for each key, and for each object of a list."""
    lines = []
    for key, value in data.items():
        if isinstance(value, list) and value and isinstance(value[0], dict):
            text = "[\n  " + ",\n  ".join(_json_line(v) for v in value) + "\n ]"
        else:
            text = _json_line(value)
        lines.append(f' "{key}": {text}')
    return "{\n" + ",\n".join(lines) + "\n}\n"


def _json_line(value: Any) -> str:
    return json.dumps(without_nan(value), allow_nan=False)
