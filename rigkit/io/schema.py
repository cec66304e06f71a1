"""JSON Schemas (draft 2020-12) of every file that rigkit reads or writes, by the name in its `schema` key.

Those of results are described by the docstrings of their classes.
"""

from __future__ import annotations

import json
from collections.abc import Iterator

from rigkit.core.claims import Verdict
from rigkit.io.boards.board_file import BOARD_FILE
from rigkit.io.calibrations.history_file import HistoryEntry
from rigkit.io.calibrations.schema_calibration import BOARD_RIG_FILE, CALIBRATION_FILE, CORNERS_FILE, RIG_FILE
from rigkit.io.disk.schema_builders import (
    ANY_OF,
    BOOLEAN,
    INTEGER,
    NUMBER,
    TEXT,
    Schema,
    array,
    described,
    file,
    matrix,
    nullable,
    obj,
    of_dataclass,
    optional,
    row,
    rows,
    table,
)
from rigkit.io.manifests.manifest import DATASET_FILE
from rigkit.io.manifests.public_set import PUBLIC_FILE
from rigkit.io.manifests.session import SESSION_FILE
from rigkit.io.manifests.study_file import STUDY_FILE
from rigkit.study.table import StudyCell
from rigkit.validation.check import Check
from rigkit.validation.checks import ANGLE_ERRORS, ValidationReport
from rigkit.validation.fitted_planes import AngleResult
from rigkit.validation.planes import NormalErrors

_VALUE = nullable(NUMBER)
_CHECKS = described(array(of_dataclass(Check)), "comparisons with measured quantities")
_ANGLE = of_dataclass(AngleResult)
_ANGLE["properties"] |= dict.fromkeys(ANGLE_ERRORS, _VALUE)
_NORMALS = of_dataclass(NormalErrors)
_BOARD_RESULT = obj(
    {
        "board": TEXT,
        "points": INTEGER,
        "normal": row(3),
        "offset_mm": NUMBER,
        "normal_sigma_deg?": _VALUE,
        "flatness_rms_mm?": NUMBER,
        "flatness_peak_mm?": NUMBER,
        "normal_errors": described(_NORMALS, "of the estimated normals against the plane"),
        "coplanar_normal_errors?": described(nullable(_NORMALS), "against the plane of coplanar points"),
        "lattice_normal_errors?": described(nullable(_NORMALS), "against the plane of the board's known lattice"),
        "square_x_ratio?": NUMBER,
        "square_y_ratio?": NUMBER,
        "skew_deg?": NUMBER,
        "right_handed?": BOOLEAN,
    }
)
_OF_REPORT = of_dataclass(
    ValidationReport, only=("pose_type", "affine_method", "baseline_mm", "baseline_sigma_mm", "planes")
)
VALIDATION_FILE = file(
    "rigkit.validation/1",
    "The verdict on one pair by one estimator",
    {
        "pair": described(TEXT, "its name"),
        **optional(_OF_REPORT["properties"]),
        "passed": described(BOOLEAN, "whether everything measured was checked, and every check passed"),
        "points?": described(INTEGER, "reconstructed"),
        "sampson_rms_px?": described(_VALUE, "of the corners from their epipolar curves"),
        "checks": _CHECKS,
        "unchecked": described(array(TEXT), "checks that were not possible, and why"),
        "angles": described(array(_ANGLE), "between each two boards"),
        "boards": described(array(_BOARD_RESULT), "plane, normals and frame of each board"),
        "notes?": array(TEXT),
    },
)
CROSSCHECK_FILE = file(
    "rigkit.crosscheck/1",
    "Comparison of a pair with independent methods",
    {
        "pair": TEXT,
        "affine_method?": TEXT,
        "passed": BOOLEAN,
        "methods": rows(
            {
                "name": TEXT,
                "rotation_difference_deg?": _VALUE,
                "direction_difference_deg?": _VALUE,
                "baseline_mm?": _VALUE,
                "angles_deg?": rows({"a": TEXT, "b": TEXT, "angle": NUMBER, "sigma": _VALUE}),
                "rms_px?": _VALUE,
                "variance_factor?": _VALUE,
                "used?": INTEGER,
                "excluded?": INTEGER,
            }
        ),
        "checks": _CHECKS,
        "skipped?": described(array(TEXT), "methods not applicable, and why"),
        "diagnosis?": array(TEXT),
    },
)
_CELL: Schema = {
    ANY_OF: [
        _VALUE,
        TEXT,
        obj(
            {
                "value": {ANY_OF: [_VALUE, TEXT]},
                "sigma?": NUMBER,
                "paper?": described(NUMBER, "value printed in the paper"),
                "best?": BOOLEAN,
                "failed?": BOOLEAN,
            }
        ),
    ]
}
_TABLES = rows(
    {
        "key": TEXT,
        "title": TEXT,
        "note?": TEXT,
        "units?": described(table(TEXT), "by column"),
        "rows": described(array(table(_CELL)), "by column"),
    }
)
TABLES_FILE = file("rigkit.tables/1", "Tables of a result", {"tables": _TABLES})
_PAGE = {
    "headline": described(TEXT, "the result in the user's units"),
    "badge": described(TEXT, "verdict in a word or two; empty: none"),
    "passed": described(nullable(BOOLEAN), "null: neither good nor bad"),
    "sentences": described(array(TEXT), "below the headline"),
    "basis": described(TEXT, "data that the result is based on"),
    "tables": described(_TABLES, "every table of the page"),
}
PAGE_FILE = file(
    "rigkit.page/1",
    "What a page says, the `page` of `--json`",
    {**_PAGE, "parts": described(table(obj(_PAGE)), "the same of each camera or pair, by name")},
)
_GRID = array(array(_VALUE))
CERTIFICATE_FILE = file(
    "rigkit.certificate/1",
    "Error bound of a measurement",
    {
        "quantity": described(TEXT, "length, depth, plane or angle"),
        "size_mm?": NUMBER,
        "distance_mm?": NUMBER,
        "confidence?": NUMBER,
        "cameras?": array(TEXT),
        "unit": described(TEXT, "of all bounds and sigmas"),
        "worst": described(_VALUE, "the largest bound where it is certified; if it is so nowhere, in view"),
        "median?": described(_VALUE, "of the bounds there"),
        "in_view?": described(NUMBER, "share of the image that sees all of it"),
        "coarse?": described(NUMBER, "share of that in which no bound is certified"),
        "shares_where_worst?": described(table(NUMBER), "of the variance, by cause, at the place of `worst`"),
        "findings?": array(TEXT),
        "u_px?": described(array(NUMBER), "columns of the grid"),
        "v_px?": described(array(NUMBER), "rows of the grid"),
        "bound": described(_GRID, "over the grid; null: out of view"),
        "sigma?": described(table(_GRID), "by cause"),
    },
)
STUDY_RESULT_FILE = file(
    "rigkit.study_result/1",
    "The numbers of a synthetic study",
    {
        "study": described({"type": "object"}, "the study, as its file has it"),
        "cells": array(of_dataclass(StudyCell)),
        "claims": rows(
            {
                **optional(of_dataclass(Verdict)["properties"], "against", "comparisons", "holds_in"),
                "verdict": described(TEXT, "in words"),
            }
        ),
    },
)
HISTORY_FILE = file(
    "rigkit.history/1",
    "One line of a register of checks (JSON lines)",
    {
        **optional(
            of_dataclass(HistoryEntry, without=("amounts",))["properties"],
            "temperature_c",
            "reference",
            "digest",
            "baseline",
        ),
        "amounts": described(
            table(row(2)), "by quantity and unit: value and standard deviation, as if it alone had changed"
        ),
    },
)
_ROBOT_POSE = matrix(3, 4)
HAND_EYE_FILE = file(
    "rigkit.hand_eye/1",
    "Hand-eye calibration",
    {
        "cam_from_hand?": described(_ROBOT_POSE, "of a camera on the hand"),
        "base_from_board?": described(_ROBOT_POSE, "with it"),
        "cam_from_base?": described(_ROBOT_POSE, "of a fixed camera beside a robot"),
        "hand_from_board?": described(_ROBOT_POSE, "with it"),
        "covariance": described(matrix(), "of both poses (rad, mm), twelve by twelve"),
        "freedom?": described(nullable(NUMBER), "degrees of freedom of the covariance (Student's t); null: infinite"),
        "robot_sigma_deg?": described(NUMBER, "rotations of the robot's poses, about each axis, by the scatter, deg"),
        "robot_sigma_mm?": described(NUMBER, "their translations, along each axis, mm"),
        "rms_px": NUMBER,
        "image_rms_px?": described(table(NUMBER), "by image"),
        "median_apart_mm?": described(
            NUMBER, "median distance of the board's centre between image and robot poses, mm"
        ),
        "median_apart_deg?": described(NUMBER, "median rotation between image and robot poses, deg"),
        "left_out_deg?": described(table(NUMBER), "images left out as outliers, and the angle by which they disagree"),
        "contradicting?": described(
            table(obj({"deg": NUMBER, "mm": NUMBER})),
            "images left out because all others contradict their robot pose, and what is wrong with it",
        ),
    },
)

RESULT_FILES = (
    CERTIFICATE_FILE,
    CROSSCHECK_FILE,
    HAND_EYE_FILE,
    HISTORY_FILE,
    PAGE_FILE,
    STUDY_RESULT_FILE,
    TABLES_FILE,
    VALIDATION_FILE,
)
"""The schemas of all results but calibrations."""


_OF_PEOPLE = (BOARD_FILE, DATASET_FILE, PUBLIC_FILE, SESSION_FILE, STUDY_FILE)
_OF_CALIBRATIONS = (BOARD_RIG_FILE, CALIBRATION_FILE, CORNERS_FILE, RIG_FILE)
SCHEMAS: dict[str, Schema] = {
    str(schema["properties"]["schema"]["const"]).removeprefix("rigkit.").partition("/")[0]: schema
    for schema in (*_OF_PEOPLE, *_OF_CALIBRATIONS, *RESULT_FILES)
}
"""Schemas by name, such as "session" or "calibration"."""
_KIND_WORDS = {"string": "text", "object": "table", "boolean": "true or false", "integer": "whole number"}


def schema_text(name: str) -> str:
    """Return the schema as the content of a file."""
    return json.dumps(SCHEMAS[name], indent=1, ensure_ascii=False) + "\n"


def key_rows(schema: Schema, prefix: str = "") -> Iterator[tuple[str, str, str]]:
    """Yield (key, type, description) of every key of a schema; `prefix` is that of inner objects."""
    required = schema.get("required", [])
    for key, own in schema["properties"].items():
        if key == "schema":
            continue
        words = own.get("description", "")
        yield f"{prefix}{key}", _kind(own), words if key in required else f"{words} (optional)".strip()
        inner = _inner(own)
        if inner is not None:
            yield from key_rows(inner, f"{prefix}{key}{'[]' if own.get('type') == 'array' else ''}.")


def _inner(schema: Schema) -> Schema | None:
    """Return the object schema that `schema` is, or is a list or choice of; None if there is none."""
    if "properties" in schema:
        return schema
    for one in (schema.get("items"), schema.get("additionalProperties"), *schema.get(ANY_OF, ())):
        found = _inner(one) if isinstance(one, dict) else None
        if found is not None:
            return found
    return None


def _kind(schema: Schema) -> str:
    """Return the type of a schema in words."""
    if "const" in schema or "enum" in schema:
        return ", ".join(f"`{value}`" for value in schema.get("enum", [schema.get("const")]))
    if ANY_OF in schema:
        return " or ".join(dict.fromkeys(filter(None, map(_kind, schema[ANY_OF]))))
    kind = schema.get("type", "")
    if kind == "array":
        return f"list of {_kind(schema['items'])}".replace("list of list of number", "matrix")
    return _KIND_WORDS.get(kind, str(kind))
