"""JSON Schemas of calibration files. The readers take their keys from here; results are described by the docstrings of
their classes."""

from __future__ import annotations

from rigkit.calibration.result import Calibration, Candidate, Outlier
from rigkit.calibration.solving.solver import Convergence
from rigkit.cameras.registry import MODELS
from rigkit.core.findings import Severity
from rigkit.io.boards.board_file import DECLARED_BOARD
from rigkit.io.disk.schema_builders import (
    ANY_OF,
    BOOLEAN,
    INTEGER,
    NUMBER,
    TEXT,
    Schema,
    array,
    choice,
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

_POSE = described(matrix(3, 4), "3 x 4, rotation and translation (mm)")
_CAMERA = obj(
    {
        "model": described(choice(*MODELS), "camera model"),
        "size_px": described(row(2, INTEGER), "width and height of the image"),
        "parameters": described(
            table(NUMBER), "by name, in the model's order; pixels from the centre of the top left one"
        ),
    }
)
_FINDING: Schema = {
    ANY_OF: [
        obj(
            {
                "severity": described(choice(*(str(s) for s in Severity)), "good, look, or bad: do not use"),
                "message": described(TEXT, "what was found, with the evidence"),
                "image?": described(TEXT, "which image it is about"),
                "remedy?": described(TEXT, "what to do"),
                "reason?": described(TEXT, "why images are left out, where the message says it"),
                "contradiction?": described(TEXT, "how images contradict each other, where the message says it"),
            }
        ),
        described(TEXT, "the same in files of earlier versions"),
    ]
}
_MADE = obj(
    {
        "rigkit": described(TEXT, "version"),
        "written": described({"type": "string", "format": "date-time"}, "when, UTC"),
        "inputs": described(table(TEXT), "SHA-256 of what it was made from: the session, and all images together"),
        "images?": described(array(TEXT), "first digits of the SHA-256 of each image"),
    },
    "by what, when, and from what it was made",
)
_FREEDOM = described(
    nullable(NUMBER), "degrees of freedom of the covariances (Student's t); null: too few images to estimate"
)
_HELDOUT = described(
    nullable(NUMBER), "reprojection error on images not used, with fixed intrinsics and only board poses fitted"
)
_OF_CALIBRATION = of_dataclass(Calibration, only=("rms_px", "sigma_px", "overdispersion"))["properties"]
_VIEW = obj(
    {
        "image": described(TEXT, "its name"),
        "board_id": described(TEXT, "which board"),
        "cam_from_board": _POSE,
        "rms_px?": described(nullable(NUMBER), "reprojection error over the corners used"),
        "grid": described(matrix(columns=2), "column and row of each corner"),
        "pixels": described(matrix(columns=2), "the corners as measured"),
        "residuals_px": described(array(row(2, nullable(NUMBER))), "measured minus projected; null: does not project"),
        "kept": described(array(BOOLEAN), "false for outliers"),
    }
)
_SHAPE = obj(
    {
        "board_id": described(TEXT, "which board"),
        "kind": described(TEXT, "flat, warp or released"),
        "points_mm": described(matrix(columns=3), "its corners, row by row"),
        "bow_mm?": described(NUMBER, "largest departure from a plane"),
        "aspect?": described(NUMBER, "relative error of the squares' declared aspect, x over y"),
        "target?": DECLARED_BOARD,
    }
)
_PUPIL = described(
    obj(
        {
            "mm_per_rad2": described(NUMBER, "e1"),
            "mm_per_rad4": described(NUMBER, "e2"),
            "covariance": described(matrix(rows=2, columns=2), "of both"),
            "with_frame": described(
                matrix(columns=2), "cross-covariance with the quantities of `frame_covariance`, in a rig `covariance`"
            ),
        }
    ),
    "moving entrance pupil: the ray at the angle t (rad) from the axis starts at e1 t^2 + e2 t^4 mm on it; missing: "
    "central camera",
)
CALIBRATION_FILE = file(
    "rigkit.calibration/1",
    "A calibrated camera; with `camera` alone, a camera of another tool",
    {
        "made?": _MADE,
        "camera": described(_CAMERA, "the camera"),
        **optional(_OF_CALIBRATION),
        "heldout_rms_px?": _HELDOUT,
        "freedom?": _FREEDOM,
        "verdicts?": described(array(_FINDING), "findings, the headline first"),
        "candidates?": described(array(of_dataclass(Candidate)), "models, degrees and board shapes tried"),
        "rivals?": rows(
            {"name": described(TEXT, "among the candidates"), "likely": described(NUMBER, "0 to 1"), "camera": _CAMERA},
            "alternative models that the images support about as well, with the probability that each is better",
        ),
        "convergence?": described(of_dataclass(Convergence), "of the final solve"),
        "dropped?": described(array(row(2, TEXT)), "image and reason"),
        "outliers?": described(array(of_dataclass(Outlier)), "corners left out of views that were used"),
        "covariance?": described(matrix(), "of the parameters, in their order"),
        "frame_covariance?": described(matrix(), "of the parameters and the mean motion of the boards (rad, mm)"),
        "pupil?": _PUPIL,
        "boards?": described(array(_SHAPE), "solved board shapes"),
        "views?": described(array(_VIEW), "the views used"),
    },
)
RIG_FILE = file(
    "rigkit.rig/1",
    "Cameras of a rig",
    {
        "made?": _MADE,
        "cameras": rows(
            {
                "name": described(TEXT, "its name"),
                "camera": described(_CAMERA, "of the joint solution"),
                "cam_from_rig": _POSE,
                "rms_px": described(NUMBER, "training error in the rig"),
                "outline_px?": described(matrix(columns=2), "convex, around all corners that it saw"),
                "departures?": described(
                    obj(
                        {
                            "modes": described(matrix(), "independent displacements of the image, of one sigma each"),
                            "moves": described(matrix(), "change of the quantities of `covariance` with each"),
                            "means?": described(array(NUMBER), "expected amount of each, in sigmas"),
                        }
                    ),
                    "lens errors beyond the model",
                ),
                "pupil?": _PUPIL,
                "lag?": described(
                    obj({"frames": NUMBER, "sigma": NUMBER, "scatter": NUMBER}),
                    "time lag to the first camera, its standard deviation, and its jitter, in frame periods",
                ),
                "readout?": described(
                    obj(
                        {"frames": described(NUMBER, "that time"), "sigma": described(NUMBER, "its standard deviation")}
                    ),
                    "readout time of the rolling shutter, first to last row, in frame periods",
                ),
            },
            "the first is the rig's frame",
            min_items=1,
        ),
        "rms_px?": described(NUMBER, "training error of all cameras together"),
        "heldout_rms_px?": described(
            nullable(NUMBER), "held-out reprojection error of frames not used, one board pose for all cameras"
        ),
        "sigma_px?": described(NUMBER, "standard deviation of a corner of median quality, px"),
        "overdispersion?": described(NUMBER, "overdispersion: disagreement of frames over what corner noise explains"),
        "freedom?": _FREEDOM,
        "scale_sigma?": described(NUMBER, "relative standard deviation of all lengths, from the boards' squares"),
        "covariance?": described(
            matrix(), "of all intrinsics, camera by camera, then of the extrinsics of all but the first (rad, mm)"
        ),
        "boards?": rows(
            {
                "board_id": described(TEXT, "its name"),
                "target": DECLARED_BOARD,
                "points_mm?": described(matrix(columns=3), "corners, row by row, of one that is not flat"),
            },
            "boards used",
        ),
        "baselines?": rows(
            {"from": TEXT, "to": TEXT, "value_mm": NUMBER, "sigma_mm": NUMBER}, "distances between cameras"
        ),
        "verdicts?": described(array(_FINDING), "findings, the headline first"),
        "spread?": described(NUMBER, "former name of overdispersion"),
    },
)
BOARD_RIG_FILE = file(
    "rigkit.board_rig/1",
    "Rigidly mounted boards",
    {
        "rigs": rows(
            {
                "image_count": described(INTEGER, "images that show several of them"),
                "scale_sigma": described(NUMBER, "relative standard deviation of all lengths"),
                "freedom?": _FREEDOM,
                "angles?": rows({"a": TEXT, "b": TEXT, "value_deg": NUMBER, "sigma_deg": NUMBER}, "between the boards"),
                "boards": rows(
                    {
                        "board_id": TEXT,
                        "size": described(row(2, INTEGER), "columns and rows"),
                        "square_mm": described(row(2), "sides of a square"),
                        "square_sigma_mm": nullable(NUMBER),
                        "target_from_board": _POSE,
                        "points_mm": described(matrix(columns=3), "corners, row by row"),
                        "target?": DECLARED_BOARD,
                    },
                    "the first is the target's frame",
                ),
                "covariance": described(matrix(), "of the poses of all boards but the first (rad, mm)"),
            },
            "one entry a mount",
        )
    },
)
_FOUND = rows(
    {
        "board_id": described(nullable(TEXT), "null: boards of this size look alike"),
        "columns": INTEGER,
        "rows": INTEGER,
        "grid": described(array(row(2, {"type": "integer"})), "column and row of each corner"),
        "pixels": matrix(columns=2),
        "sigma_px": array(NUMBER),
    },
    "the boards found",
)
CORNERS_FILE = file(
    "rigkit.corners/2",
    "Corners kept beside a session",
    {
        "detector": described(TEXT, "hash of the code that found them, and the boards looked for"),
        "images": described(
            table(
                obj(
                    {
                        "sha256": described(TEXT, "of the image"),
                        "size_px": row(2, INTEGER),
                        "boards": _FOUND,
                        "lens": described(
                            nullable(obj({"key": described(TEXT, "of the lens"), "boards": _FOUND})),
                            "corners placed through a first calibration",
                        ),
                    }
                )
            ),
            "by name of the image",
        ),
    },
)


def keys_of(schema: Schema, *path: str) -> set[str]:
    """Return the keys that an object of a schema may have, or one in it: "cameras" leads to that key, into a list to
    its entries."""
    for key in path:
        schema = schema["properties"][key]
        schema = schema.get("items", schema)
    return set(schema["properties"])
