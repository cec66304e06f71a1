"""The files of results (JSON), as JSON Schemas: described by the fields of the classes that they are made of."""

from __future__ import annotations

from rigkit.core.claims import Verdict
from rigkit.io.calibrations.history_file import HistoryEntry
from rigkit.io.disk.schema_words import (
    ANY_OF,
    BOOLEAN,
    INTEGER,
    NUMBER,
    TEXT,
    Schema,
    array,
    file,
    matrix,
    nullable,
    obj,
    of_dataclass,
    optional,
    row,
    rows,
    said,
    table,
)
from rigkit.study.table import StudyCell
from rigkit.validation.check import Check
from rigkit.validation.checks import ANGLE_ERRORS, ValidationReport
from rigkit.validation.fitted_planes import AngleResult
from rigkit.validation.planes import NormalErrors

_VALUE = nullable(NUMBER)
_CHECKS = said(array(of_dataclass(Check)), "every quantity measured beside ours")
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
        "normal_errors": said(_NORMALS, "of the estimated normals against the plane"),
        "coplanar_normal_errors?": said(nullable(_NORMALS), "against the plane of coplanar points"),
        "lattice_normal_errors?": said(nullable(_NORMALS), "against the plane of the board's known lattice"),
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
        "pair": said(TEXT, "its name"),
        **optional(_OF_REPORT["properties"]),
        "passed": said(BOOLEAN, "whether everything measured was checked, and every check passed"),
        "points?": said(INTEGER, "reconstructed"),
        "sampson_rms_px?": said(_VALUE, "of the corners from their epipolar curves"),
        "checks": _CHECKS,
        "unchecked": said(array(TEXT), "what could not be checked, and why"),
        "angles": said(array(_ANGLE), "between each two boards"),
        "boards": said(array(_BOARD_RESULT), "plane, normals and frame of each board"),
        "notes?": array(TEXT),
    },
)
CROSSCHECK_FILE = file(
    "rigkit.crosscheck/1",
    "A pair by other methods",
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
        "skipped?": said(array(TEXT), "methods that could not be used, and why"),
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
                "paper?": said(NUMBER, "what the paper printed there"),
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
        "units?": said(table(TEXT), "by column"),
        "rows": said(array(table(_CELL)), "by column"),
    }
)
TABLES_FILE = file("rigkit.tables/1", "Tables of a result", {"tables": _TABLES})
_PAGE = {
    "headline": said(TEXT, "the result in the user's units"),
    "badge": said(TEXT, "the verdict in a word or two; empty: none"),
    "passed": said(nullable(BOOLEAN), "null: neither good nor bad"),
    "sentences": said(array(TEXT), "below the headline"),
    "basis": said(TEXT, "what the result rests on"),
    "tables": said(_TABLES, "every table of the page"),
}
PAGE_FILE = file(
    "rigkit.page/1",
    "What a page says, the `page` of `--json`",
    {**_PAGE, "parts": said(table(obj(_PAGE)), "the same of each camera or pair, by name")},
)
_GRID = array(array(_VALUE))
CERTIFICATE_FILE = file(
    "rigkit.certificate/1",
    "How wrong a measurement may be",
    {
        "quantity": said(TEXT, "length, depth, plane or angle"),
        "size_mm?": NUMBER,
        "distance_mm?": NUMBER,
        "confidence?": NUMBER,
        "cameras?": array(TEXT),
        "unit": said(TEXT, "of all bounds and sigmas"),
        "worst": _VALUE,
        "median?": _VALUE,
        "in_view?": said(NUMBER, "share of the image that sees all of it"),
        "shares_where_worst?": said(table(NUMBER), "of the variance, by cause"),
        "findings?": array(TEXT),
        "u_px?": said(array(NUMBER), "columns of the grid"),
        "v_px?": said(array(NUMBER), "rows of the grid"),
        "bound": said(_GRID, "over the grid; null: out of view"),
        "sigma?": said(table(_GRID), "by cause"),
    },
)
STUDY_RESULT_FILE = file(
    "rigkit.study_result/1",
    "The numbers of a synthetic study",
    {
        "study": said({"type": "object"}, "the study, as its file has it"),
        "cells": array(of_dataclass(StudyCell)),
        "claims": rows(
            {
                **optional(of_dataclass(Verdict)["properties"], "against", "comparisons", "holds_in"),
                "verdict": said(TEXT, "in words"),
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
        "amounts": said(table(row(2)), "by cause and unit: value and standard deviation, as if it alone had changed"),
    },
)
_ROBOT_POSE = matrix(3, 4)
HAND_EYE_FILE = file(
    "rigkit.hand_eye/1",
    "Where a camera sits on a robot",
    {
        "cam_from_hand?": said(_ROBOT_POSE, "of a camera on the hand"),
        "base_from_board?": said(_ROBOT_POSE, "with it"),
        "cam_from_base?": said(_ROBOT_POSE, "of a camera that stands before a robot"),
        "hand_from_board?": said(_ROBOT_POSE, "with it"),
        "covariance": said(matrix(), "of both poses (rad, mm), twelve by twelve"),
        "freedom?": said(nullable(NUMBER), "degrees of freedom of the covariance, which is Student's; null: infinite"),
        "rms_px": NUMBER,
        "image_rms_px?": said(table(NUMBER), "by image"),
        "median_apart_mm?": said(NUMBER, "of the boards' middles as seen from where the robot has them, median"),
        "median_apart_deg?": said(NUMBER, "of the boards' turns, likewise"),
        "left_out_deg?": said(table(NUMBER), "images whose pose does not go with them, and by what angle"),
    },
)
