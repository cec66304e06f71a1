"""The files of calibrations (JSON), as JSON Schemas: every key with what it means. The readers take their keys from
here; results are described by the fields of their own classes."""

from __future__ import annotations

from rigkit.calibration.result import Calibration, Candidate, Outlier
from rigkit.calibration.solving.solver import Convergence
from rigkit.cameras.registry import MODELS
from rigkit.core.findings import Severity
from rigkit.io.boards.board_file import DECLARED_BOARD
from rigkit.io.disk.schema_words import (
    ANY_OF,
    BOOLEAN,
    INTEGER,
    NUMBER,
    TEXT,
    Schema,
    array,
    choice,
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

_POSE = said(matrix(3, 4), "3 x 4, rotation and translation (mm)")
_CAMERA = obj(
    {
        "model": said(choice(*MODELS), "camera model"),
        "size_px": said(row(2, INTEGER), "width and height of the image"),
        "parameters": said(table(NUMBER), "by name, in the model's order; pixels from the centre of the top left one"),
    }
)
_FINDING: Schema = {
    ANY_OF: [
        obj(
            {
                "severity": said(choice(*(str(s) for s in Severity)), "good, look, or bad: do not use"),
                "message": said(TEXT, "what is the matter, and how one can tell"),
                "image?": said(TEXT, "which image it is about"),
                "remedy?": said(TEXT, "what to do"),
            }
        ),
        said(TEXT, "as former files have it"),
    ]
}
_MADE = obj(
    {
        "rigkit": said(TEXT, "version"),
        "written": said({"type": "string", "format": "date-time"}, "when, UTC"),
        "inputs": said(table(TEXT), "SHA-256 of what it was made from: the session, and all images together"),
    },
    "by what, when, and from what it was made",
)
_FREEDOM = said(
    nullable(NUMBER), "degrees of freedom of the covariances, which are Student's; null: too few images to know"
)
_HELDOUT = said(
    nullable(NUMBER), "the headline: RMS over images that took no part, the lens frozen and only poses fitted"
)
_OF_CALIBRATION = of_dataclass(Calibration, only=("rms_px", "sigma_px", "overdispersion"))["properties"]
_VIEW = obj(
    {
        "image": said(TEXT, "its name"),
        "board_id": said(TEXT, "which board"),
        "cam_from_board": _POSE,
        "rms_px?": said(nullable(NUMBER), "over the corners kept"),
        "grid": said(matrix(columns=2), "column and row of each corner"),
        "pixels": said(matrix(columns=2), "the corners as measured"),
        "residuals_px": said(array(row(2, nullable(NUMBER))), "measured minus projected; null: does not project"),
        "kept": said(array(BOOLEAN), "false for outliers"),
    }
)
_SHAPE = obj(
    {
        "board_id": said(TEXT, "which board"),
        "kind": said(TEXT, "flat, warp or released"),
        "points_mm": said(matrix(columns=3), "its corners, row by row"),
        "bow_mm?": said(NUMBER, "largest departure from a plane"),
        "aspect?": said(NUMBER, "how much longer its squares are along x than stated, against y"),
        "target?": DECLARED_BOARD,
    }
)
_PUPIL = said(
    obj(
        {
            "mm_per_rad2": said(NUMBER, "e1"),
            "mm_per_rad4": said(NUMBER, "e2"),
            "covariance": said(matrix(rows=2, columns=2), "of both"),
            "with_frame": said(matrix(columns=2), "of both with what `frame_covariance`, in a rig `covariance`, is of"),
        }
    ),
    "how the entrance pupil moves: the ray at the angle t from the axis starts at e1 t^2 + e2 t^4 mm on it; missing: "
    "all rays start at one point",
)
CALIBRATION_FILE = file(
    "rigkit.calibration/1",
    "A calibrated camera; with `camera` alone, a camera of another tool",
    {
        "made?": _MADE,
        "camera": said(_CAMERA, "the camera"),
        **optional(_OF_CALIBRATION),
        "heldout_rms_px?": _HELDOUT,
        "freedom?": _FREEDOM,
        "verdicts?": said(array(_FINDING), "what is good and what is not, the headline first"),
        "candidates?": said(array(of_dataclass(Candidate)), "models, degrees and board shapes tried"),
        "rivals?": rows(
            {"name": said(TEXT, "among the candidates"), "likely": said(NUMBER, "0 to 1"), "camera": _CAMERA},
            "lenses of other models that the images support about as well, and how likely each is the better one",
        ),
        "convergence?": said(of_dataclass(Convergence), "of the final solve"),
        "dropped?": said(array(row(2, TEXT)), "image and why it was not used"),
        "outliers?": said(array(of_dataclass(Outlier)), "corners left out of views that were used"),
        "covariance?": said(matrix(), "of the parameters, in their order"),
        "frame_covariance?": said(matrix(), "of the parameters and the mean motion of the boards (rad, mm)"),
        "pupil?": _PUPIL,
        "boards?": said(array(_SHAPE), "boards as the solution has them"),
        "views?": said(array(_VIEW), "the views used"),
    },
)
RIG_FILE = file(
    "rigkit.rig/1",
    "Cameras on one mount",
    {
        "made?": _MADE,
        "cameras": rows(
            {
                "name": said(TEXT, "its name"),
                "camera": said(_CAMERA, "as all cameras together have it"),
                "cam_from_rig": _POSE,
                "rms_px": said(NUMBER, "training error in the rig"),
                "outline_px?": said(matrix(columns=2), "convex, around all corners that it saw"),
                "departures?": said(
                    obj({"modes": matrix(), "moves": matrix()}),
                    "what its lens may do beyond its model: independent displacements of the image of one sigma each, "
                    "and how much what `covariance` is of is off with them",
                ),
                "pupil?": _PUPIL,
                "lag?": said(
                    obj({"frames": NUMBER, "sigma": NUMBER, "scatter": NUMBER}),
                    "by how much it takes its pictures after the first, the standard deviation of that, and by how "
                    "much its pictures lag differently, in the usual time between two frames",
                ),
            },
            "the first is the rig's frame",
            min_items=1,
        ),
        "rms_px?": said(NUMBER, "training error of all cameras together"),
        "heldout_rms_px?": said(nullable(NUMBER), "of frames that took no part, one pose for all cameras"),
        "sigma_px?": said(NUMBER, "standard deviation of a corner of median quality"),
        "overdispersion?": said(NUMBER, "by how much more frames disagree than the corners' scatter explains"),
        "freedom?": _FREEDOM,
        "scale_sigma?": said(NUMBER, "relative standard deviation of all lengths, from the boards' squares"),
        "covariance?": said(
            matrix(), "of all parameters, camera by camera, then of the mounts of all but the first (rad, mm)"
        ),
        "boards?": rows({"board_id": said(TEXT, "its name"), "target": DECLARED_BOARD}, "what was calibrated with"),
        "baselines?": rows(
            {"from": TEXT, "to": TEXT, "value_mm": NUMBER, "sigma_mm": NUMBER}, "distances between cameras"
        ),
        "verdicts?": said(array(_FINDING), "what is good and what is not, the headline first"),
        "spread?": said(NUMBER, "what overdispersion was called"),
    },
)
BOARD_RIG_FILE = file(
    "rigkit.board_rig/1",
    "Boards on one mount",
    {
        "rigs": rows(
            {
                "image_count": said(INTEGER, "images that show several of them"),
                "scale_sigma": said(NUMBER, "relative standard deviation of all lengths"),
                "freedom?": _FREEDOM,
                "angles?": rows({"a": TEXT, "b": TEXT, "value_deg": NUMBER, "sigma_deg": NUMBER}, "between the boards"),
                "boards": rows(
                    {
                        "board_id": TEXT,
                        "size": said(row(2, INTEGER), "columns and rows"),
                        "square_mm": said(row(2), "sides of a square"),
                        "square_sigma_mm": nullable(NUMBER),
                        "target_from_board": _POSE,
                        "points_mm": said(matrix(columns=3), "corners, row by row"),
                        "target?": DECLARED_BOARD,
                    },
                    "the first is the target's frame",
                ),
                "covariance": said(matrix(), "of the places of all boards but the first (rad, mm)"),
            },
            "one entry a mount",
        )
    },
)
_FOUND = rows(
    {
        "board_id": said(nullable(TEXT), "null: boards of this size look alike"),
        "columns": INTEGER,
        "rows": INTEGER,
        "grid": said(array(row(2, {"type": "integer"})), "column and row of each corner"),
        "pixels": matrix(columns=2),
        "sigma_px": array(NUMBER),
    },
    "the boards found",
)
CORNERS_FILE = file(
    "rigkit.corners/2",
    "Corners kept beside a session",
    {
        "detector": said(TEXT, "hash of the code that found them, and the boards looked for"),
        "images": said(
            table(
                obj(
                    {
                        "sha256": said(TEXT, "of the image"),
                        "size_px": row(2, INTEGER),
                        "boards": _FOUND,
                        "lens": said(
                            nullable(obj({"key": said(TEXT, "of the lens"), "boards": _FOUND})),
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
