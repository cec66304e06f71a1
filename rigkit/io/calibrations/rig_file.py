"""Rig files (JSON): cameras with poses and covariance ("rigkit.rig/1"), and boards on one mount likewise
("rigkit.board_rig/1"). Lengths in mm; covariances are of left perturbations (rad) and translations (mm)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from itertools import combinations, zip_longest
from pathlib import Path
from typing import Any

import numpy as np

from rigkit.calibration.board_shape import BoardShape
from rigkit.calibration.certainty.coverage import outline_of_corners
from rigkit.calibration.certainty.displaced import LensModes
from rigkit.calibration.pupil import SolvedPupil, require_of_frame
from rigkit.calibration.rig.board_rig import BoardRig, MountedBoard
from rigkit.calibration.rig.mounted import MountedCameras
from rigkit.calibration.rig.result import RigCalibration
from rigkit.calibration.rig.solving.exposure_times import Lag
from rigkit.calibration.rig.solving.layout import Layout
from rigkit.cameras.base import Camera
from rigkit.core.arrays import Pixels, Points, as_array, as_covariance, without_nan
from rigkit.core.boards import Board
from rigkit.core.errors import InputError
from rigkit.core.findings import Finding
from rigkit.core.identifiers import check_identifier
from rigkit.geometry.rigid3 import Rigid3
from rigkit.io.boards.board_file import board_of_values, board_values
from rigkit.io.calibrations.calibration_file import (
    Made,
    camera_from_json,
    camera_to_json,
    damage_reported,
    findings_from_json,
    findings_to_json,
    pupil_from_json,
    pupil_to_json,
)
from rigkit.io.calibrations.schema_calibration import BOARD_RIG_FILE, RIG_FILE, keys_of
from rigkit.io.disk.json_reader import freedom, integer, json_schema, json_text, positive, read_json, real, reals
from rigkit.kernels.departures import DISPLACEMENTS

RIG_SCHEMA = "rigkit.rig/1"
BOARDS_SCHEMA = "rigkit.board_rig/1"
RIG_KEYS = keys_of(RIG_FILE)
RIG_CAMERA_KEYS = keys_of(RIG_FILE, "cameras")
_NO_MODES: dict[str, Any] = {"modes": [], "moves": [], "means": []}
PLACED_KEYS = keys_of(BOARD_RIG_FILE, "rigs", "boards")


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class SavedRig(MountedCameras):
    """The content of a rig file; fields that another tool's file lacks have their defaults.

    Attributes
    ----------
    boards : boards of the calibration.
    boards_mm : solved corners (N, 3) of those that are not flat, by name.
    outlines : convex hull (N, 2) of all corners that a camera saw, px, by name.
    verdicts : verdicts on the calibration.
    lags : by name, of cameras that do not expose with the first.
    """

    boards: tuple[Board, ...] = ()
    boards_mm: Mapping[str, Points] = field(default_factory=dict)
    outlines: Mapping[str, Pixels] = field(default_factory=dict)
    verdicts: tuple[Finding, ...] = ()
    lags: Mapping[str, Lag] = field(default_factory=dict)


def rig_text(rig: RigCalibration, made: Made | None = None) -> str:
    """Return the content of a rig file, with its provenance `made`."""
    pairs = [(a, b, *rig.baseline_mm(a, b)) for a, b in combinations([c.name for c in rig.cameras], 2)]
    data = {
        "schema": RIG_SCHEMA,
        **({} if made is None else {"made": made}),
        "heldout_rms_px": rig.heldout_rms_px,
        "rms_px": rig.rms_px,
        "sigma_px": rig.sigma_px,
        "overdispersion": rig.overdispersion,
        "freedom": without_nan(rig.freedom),
        "scale_sigma": rig.scale_sigma,
        "verdicts": findings_to_json(rig.verdicts),
        "baselines": [{"from": a, "to": b, "value_mm": v, "sigma_mm": s} for a, b, v, s in pairs],
        "cameras": [
            {
                "name": c.name,
                "camera": camera_to_json(c.camera),
                "cam_from_rig": c.cam_from_rig.matrix()[:3].tolist(),
                "rms_px": c.rms_px,
                "outline_px": outline_of_corners(c.calibration).round(1).tolist(),
                **({} if own is None else {"departures": _modes_to_json(own)}),
                **({} if c.name not in rig.pupils else {"pupil": pupil_to_json(rig.pupils[c.name])}),
                **({} if c.name not in rig.lags else {"lag": asdict(rig.lags[c.name])}),
                **({} if c.name not in rig.readouts else {"readout": asdict(rig.readouts[c.name])}),
            }
            for c, own in zip_longest(rig.cameras, rig.departures)
        ],
        "covariance": rig.covariance.tolist(),
        "boards": [
            {
                "board_id": shape.board_id,
                "target": board_values(shape.board),
                **({} if shape.kind == "flat" else {"points_mm": shape.points_mm.tolist()}),
            }
            for shape in _shapes_of(rig)
        ],
    }
    return json_text(data)


def _shapes_of(rig: RigCalibration) -> tuple[BoardShape, ...]:
    """Return the shapes of the declared boards that the cameras saw, from the first of these cameras."""
    shapes = [shape for camera in rig.cameras for shape in camera.calibration.boards if shape.declared is not None]
    return tuple({shape.board_id: shape for shape in reversed(shapes)}.values())


def load_rig(path: str | Path) -> dict[str, tuple[Camera, Rigid3]]:
    """Return camera and cam_from_rig by name; raises InputError as `load_saved_rig`."""
    return dict(load_saved_rig(path).cameras)


def load_saved_rig(path: str | Path) -> SavedRig:
    """Return the content of a rig file.

    Raises InputError for a missing or damaged file, another schema or an unknown key.
    """
    data = _read(path, RIG_SCHEMA, RIG_KEYS)
    cameras: dict[str, tuple[Camera, Rigid3]] = {}
    outlines: dict[str, Pixels] = {}
    departures: dict[str, Any] = {}
    pupils: dict[str, SolvedPupil] = {}
    lags: dict[str, Lag] = {}
    with damage_reported(path):
        for entry in data["cameras"]:
            if set(entry) | {"outline_px", "departures", "pupil", "lag", "readout"} != RIG_CAMERA_KEYS:
                raise InputError(
                    f"'{path}': a camera must have the keys {', '.join(sorted(RIG_CAMERA_KEYS))}, no others"
                )
            camera = camera_from_json(entry["camera"], path)
            name = check_identifier(entry["name"], "camera")
            if name in cameras:
                raise InputError(f"'{path}': two cameras are called '{name}'; calibrate again")
            cameras[name] = (camera, Rigid3.from_matrix(reals(entry["cam_from_rig"])))
            if "departures" in entry:
                departures[name] = entry["departures"]
            if "pupil" in entry:
                pupils[name] = pupil_from_json(entry["pupil"])
            if "outline_px" in entry:
                outlines[name] = as_array(reals(entry["outline_px"]), (None, 2), "outline_px")
            if "lag" in entry:
                lags[name] = Lag(*(real(entry["lag"][key]) for key in ("frames", "sigma", "scatter")))
        if not cameras:
            raise InputError(f"'{path}': no camera in it; calibrate again")
        size = Layout.of_cameras(camera for camera, _ in cameras.values()).count
        for pupil in pupils.values():
            require_of_frame(pupil, size)
        beyond = tuple(_modes(departures.get(name, _NO_MODES), size) for name in cameras) if departures else ()
        return SavedRig(
            cameras=cameras,
            covariance=as_covariance(data["covariance"], "covariance", size) if "covariance" in data else None,
            sigma_px=positive(data["sigma_px"]) if "sigma_px" in data else None,
            scale_sigma=real(data.get("scale_sigma", 0.0)),
            freedom=freedom(data.get("freedom")),
            overdispersion=positive(data.get("overdispersion", data.get("spread", 1.0))),
            boards=tuple(board_of_values(entry["target"], entry["board_id"]) for entry in data.get("boards", ())),
            boards_mm={
                entry["board_id"]: as_array(reals(entry["points_mm"]), (None, 3), "points_mm")
                for entry in data.get("boards", ())
                if "points_mm" in entry
            },
            outlines=outlines,
            departures=beyond,
            pupils=pupils,
            verdicts=findings_from_json(data.get("verdicts", ())),
            lags=lags,
        )


def _modes_to_json(own: LensModes) -> dict[str, Any]:
    return {"modes": own.modes.T.tolist(), "moves": own.moves.T.tolist(), "means": own.means.tolist()}


def _modes(entry: dict[str, Any], size: int) -> LensModes:
    """Return the modes of a lens beyond its model, from rows of modes and of the parameter changes with them."""
    if set(entry) | {"means"} != set(_NO_MODES):
        raise ValueError(f"departures have the keys {', '.join(_NO_MODES)}, no others")
    modes, moves = reals(entry["modes"]), reals(entry["moves"])
    count = len(modes)
    if not count:
        return LensModes(np.zeros((DISPLACEMENTS, 0)), np.zeros((size, 0)), np.zeros(0))
    return LensModes(
        as_array(modes.T, (DISPLACEMENTS, count), "modes"),
        as_array(moves.T, (size, count), "moves"),
        as_array(reals(entry.get("means", [0.0] * count)), (count,), "means"),
    )


def is_rig_file(path: str | Path) -> bool:
    """Return whether a file is a rig file; False if it cannot be read."""
    return json_schema(path) == RIG_SCHEMA


def is_board_rigs_file(path: str | Path) -> bool:
    """Return whether a file holds boards on one mount."""
    return json_schema(path) == BOARDS_SCHEMA


def board_rigs_text(rigs: Sequence[BoardRig]) -> str:
    """Return the content of a file of boards on one mount, with their angles."""
    data = {
        "schema": BOARDS_SCHEMA,
        "rigs": [
            {
                "image_count": rig.image_count,
                "scale_sigma": rig.scale_sigma,
                "freedom": without_nan(rig.freedom),
                "angles": [
                    {"a": a, "b": b, "value_deg": value, "sigma_deg": sigma}
                    for a, b in combinations(rig.names, 2)
                    for value, sigma in (rig.angle_deg(a, b),)
                ],
                "boards": [
                    {
                        "board_id": placed.board.board_id,
                        "size": list(placed.board.size),
                        "square_mm": [placed.board.square_x_mm, placed.board.square_y_mm],
                        "square_sigma_mm": placed.board.square_sigma_mm,
                        "target_from_board": placed.target_from_board.matrix()[:3].tolist(),
                        "points_mm": placed.points_mm.tolist(),
                        "target": board_values(placed.board),
                    }
                    for placed in rig.boards
                ],
                "covariance": rig.covariance.tolist(),
            }
            for rig in rigs
        ],
    }
    return json_text(data)


def load_board_rigs(path: str | Path) -> tuple[BoardRig, ...]:
    """Return the boards on one mount; raises InputError like `load_saved_rig`."""
    data = _read(path, BOARDS_SCHEMA, keys_of(BOARD_RIG_FILE))
    with damage_reported(path):
        return tuple(_mount(rig, path) for rig in data["rigs"])


def _mount(rig: dict[str, Any], path: str | Path) -> BoardRig:
    boards = tuple(_placed(entry, path) for entry in rig["boards"])
    names = [placed.board.board_id for placed in boards]
    if len(set(names)) < max(len(names), 2):
        raise ValueError(f"a mount has two boards or more, each with another name, here {', '.join(names)}")
    covariance = as_covariance(rig["covariance"], "covariance", 6 * (len(boards) - 1))
    images = integer(rig["image_count"])
    known = freedom(rig["freedom"]) if "freedom" in rig else float(max(images - 1, 1))
    return BoardRig(boards, covariance, images, real(rig["scale_sigma"]), known)


def _placed(entry: dict[str, Any], path: str | Path) -> MountedBoard:
    if set(entry) | {"target"} != PLACED_KEYS:
        raise InputError(f"'{path}': a board must have the keys {', '.join(sorted(PLACED_KEYS))}, and no others")
    name = check_identifier(entry["board_id"], "board")
    if "target" in entry:
        board = board_of_values(entry["target"], name)
    else:
        (columns, rows), (along_x, along_y), sigma = entry["size"], entry["square_mm"], entry["square_sigma_mm"]
        known = None if sigma is None else real(sigma)
        size = integer(columns), integer(rows)
        board = Board(name, *size, real(along_x), real(along_y), square_sigma_mm=known)
    return MountedBoard(board, reals(entry["points_mm"]), Rigid3.from_matrix(reals(entry["target_from_board"])))


def _read(path: str | Path, schema: str, keys: set[str]) -> dict[str, Any]:
    return read_json(path, schema, keys, "rig file", remedy="calibrate again")
