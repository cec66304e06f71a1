"""Target files of other tools: Kalibr's target.yaml, BoofCV's calibration_target.yaml, caliscope's charuco.toml, and
the settings of OpenCV's calibration sample (XML or YAML)."""

from __future__ import annotations

import logging
import tomllib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from rigkit.core.errors import InputError, printable
from rigkit.interop.opencv_storage import parse_storage
from rigkit.io.disk.reading import read_text

FOREIGN_SUFFIXES = (".yaml", ".yml", ".xml")
"""Endings of other tools' target files."""

Values = dict[str, Any]
INCH_MM = 25.4
YES, NO = ("true", "yes", "on", "1"), ("false", "no", "off", "0", "", "none")
"""Words of YAML and C for a truth value, also in quotes."""
KALIBR_TAGS = "tagrows", "tag_rows", "tagcols", "tag_cols", "tagsize", "tag_size", "tagspacing", "tag_spacing"
KALIBR_GRIDS = "targetcols", "targetrows", "rowspacingmeters", "colspacingmeters", "spacingmeters", "asymmetricgrid"
KALIBR_KEYS = {"target_type", "codeoffset", *KALIBR_TAGS, *KALIBR_GRIDS}
"""Keys of Kalibr's target.yaml, in lower case."""

_log = logging.getLogger(__name__)


def foreign_board(path: str | Path) -> Values | None:
    """Return another tool's target as the keys of a board file; None for a board file of rigkit's.

    Lengths in files of BoofCV and OpenCV have no unit and count as mm.

    Raises InputError for a missing file, or one without a target.
    """
    source = Path(path)
    if source.suffix.lower() == ".toml":
        return _caliscope(source)
    if source.suffix.lower() not in FOREIGN_SUFFIXES:
        return None
    values: Mapping[str, Any] = parse_storage(read_text(source), str(source))
    # OpenCV's sample writes its settings as a mapping of that name.
    values = settings if isinstance(settings := values.get("Settings"), dict) else values
    for known, read in READERS:
        if known in values:
            if read is _kalibr:
                _name_unused(values, source)
            try:
                return read(values)
            except NotImplementedError as error:
                raise InputError(
                    f"'{source}': {error}: rigkit has no such target; print another (rigkit board)"
                ) from error
            except (KeyError, TypeError, ValueError, OverflowError) as error:
                raise InputError(
                    f"'{source}': no target: {type(error).__name__} {error}; is the file whole?"
                ) from error
    raise InputError(
        f"'{source}': neither a target of Kalibr (target_type), BoofCV (ConfigCalibrationTarget) nor OpenCV "
        "(BoardSize_Width); write a board file"
    )


def _kalibr(values: Mapping[str, Any]) -> Values:
    # https://github.com/ethz-asl/kalibr/wiki/calibration-targets: lengths in m, tagSpacing a ratio.
    kind = values["target_type"]
    if kind == "aprilgrid":
        rows, columns = (
            _first_of(values, f"tag{axis_name}", f"tag_{axis_name.lower()}") for axis_name in ("Rows", "Cols")
        )
        size, spacing = _first_of(values, "tagSize", "tag_size"), _first_of(values, "tagSpacing", "tag_spacing")
        # A line of older files of Kalibr's, and of forks.
        first = {"first_tag": values["codeOffset"]} if "codeOffset" in values else {}
        target = {"columns": columns, "rows": rows, "tag_mm": _mm(size), "spacing": float(spacing), **first}
        return {"type": "aprilgrid", **target}
    # Kalibr counts the inner corners of checkerboards, as rigkit does.
    size = {"columns": values["targetCols"], "rows": values["targetRows"]}
    if kind == "checkerboard":
        sides = {
            f"square_{a}_mm": _mm(values[f"{axis_name}SpacingMeters"]) for a, axis_name in (("x", "col"), ("y", "row"))
        }
        return {**size, **sides}
    if kind == "circlegrid":
        return _circles(size, _mm(values["spacingMeters"]), asymmetric=_yes(values.get("asymmetricGrid", False)))
    raise NotImplementedError(f"target_type {kind}")


def _boofcv(values: Mapping[str, Any]) -> Values:
    target = values[BOOFCV]
    grid, kind = target["grid"], target.get("type", "CHESSBOARD")
    rows, columns = grid["numRows"], grid["numCols"]
    if kind == "CHESSBOARD":
        # BoofCV counts squares.
        return {"columns": columns - 1, "rows": rows - 1, "square_mm": float(grid["shapeSize"])}
    if kind not in ("CIRCLE_GRID", "CIRCLE_HEXAGONAL"):
        raise NotImplementedError(f"type {kind}")
    lengths = {"distance_mm": float(grid["shapeDistance"]), "diameter_mm": float(grid["shapeSize"])}
    if kind == "CIRCLE_GRID":
        return {"type": "circles", "columns": columns, "rows": rows, **lengths}
    if columns % 2:
        counts = f"{columns // 2 + 1} and {columns // 2}"
        raise NotImplementedError(f"{columns} columns, whose rows have {counts} circles in turn")
    # BoofCV counts half steps along a row; on its pages every second row is shifted to the left.
    staggered = {"layout": "hexagonal", "stagger": "left"}
    return {"type": "circles", **staggered, "columns": columns // 2, "rows": rows, **lengths}


def _opencv(values: Mapping[str, Any]) -> Values:
    # The settings of samples/cpp/tutorial_code/calib3d/camera_calibration; squares in the user's unit, mm by default.
    # In the sample's XML words stand in quotes.
    kind, square = str(values.get("Calibrate_Pattern", "CHESSBOARD")).strip('"'), float(values["Square_Size"])
    size = {"columns": int(values["BoardSize_Width"]), "rows": int(values["BoardSize_Height"])}
    if kind == "CHARUCOBOARD":
        # The only board whose squares OpenCV counts.
        inner = {"columns": size["columns"] - 1, "rows": size["rows"] - 1}
        marker = {"dictionary": str(values["ArUco_Dict_Name"]).strip('"'), "marker_mm": float(values["Marker_Size"])}
        return {"type": "charuco", **inner, "square_mm": square, **marker}
    if kind in ("CIRCLES_GRID", "ASYMMETRIC_CIRCLES_GRID"):
        return _circles(size, square, asymmetric=kind.startswith("ASYMMETRIC"))
    if kind != "CHESSBOARD":
        raise NotImplementedError(f"Calibrate_Pattern {kind}")
    return {**size, "square_mm": square}


def _circles(size: Values, spacing_mm: float, *, asymmetric: bool) -> Values:
    """Return a grid of circles; the spacing of an asymmetric one is half the distance of two circles in a row."""
    if asymmetric:
        return {"type": "circles", **size, "distance_mm": 2.0 * spacing_mm, "layout": "asymmetric"}
    return {"type": "circles", **size, "distance_mm": spacing_mm}


def _caliscope(source: Path) -> Values | None:
    try:
        values = tomllib.loads(read_text(source))
    except (tomllib.TOMLDecodeError, RecursionError, ValueError):
        # The reader of board files reports the error.
        return None
    if "schema" in values or not {"columns", "rows", "dictionary", "aruco_scale"} <= set(values):
        return None
    try:
        unit = {"cm": 10.0, "mm": 1.0, "inch": INCH_MM, "inches": INCH_MM, "m": 1e3}[values.get("units", "cm")]
        if "square_size_overide_cm" in values or "square_size_override_cm" in values:
            square = 10.0 * float(values.get("square_size_overide_cm") or values["square_size_override_cm"])
        else:
            square = unit * min(
                float(values["board_width"]) / values["columns"], float(values["board_height"]) / values["rows"]
            )
        marker = square * float(values["aruco_scale"])
        size = {"columns": int(values["columns"]) - 1, "rows": int(values["rows"]) - 1}
    except (KeyError, TypeError, ValueError, OverflowError, ZeroDivisionError) as error:
        raise InputError(f"'{source}': no ChArUco board of caliscope: {error}; is the file whole?") from error
    return {
        "type": "charuco",
        **size,
        "square_mm": square,
        "dictionary": values["dictionary"],
        "marker_mm": marker,
        "legacy_pattern": bool(values.get("legacy_pattern", False)),
        "inverted": bool(values.get("inverted", False)),
    }


def _first_of(values: Mapping[str, Any], *names: str) -> Any:
    return next(values[name] for name in (*names, names[0]) if name in values or name == names[-1])


def _yes(value: Any) -> bool:
    """Return a value that may stand in quotes; raises ValueError for one that is neither yes nor no."""
    word = str(value).strip().lower()
    if word not in YES + NO:
        raise ValueError(f"'{value}' is neither true nor false")
    return word in YES


def _name_unused(values: Mapping[str, Any], source: Path) -> None:
    """Log the keys of a target of Kalibr's that no reader uses: forks have more of them."""
    # Keys in lower case come first, of which the file has the other.
    unused = {key.lower(): printable(key) for key in map(str, values) if key.lower() not in KALIBR_KEYS}
    if unused:
        _log.warning("'%s': not used: %s; look whether they describe another board", source, ", ".join(unused.values()))


def _mm(metres: Any) -> float:
    return 1e3 * float(metres)


BOOFCV = "boofcv.alg.fiducial.calib.ConfigCalibrationTarget"
READERS: tuple[tuple[str, Callable[[Mapping[str, Any]], Values]], ...] = (
    ("target_type", _kalibr),
    (BOOFCV, _boofcv),
    ("BoardSize_Width", _opencv),
)
"""Key that identifies a file, and the reader."""
