"""The files that people write (TOML), as JSON Schemas: every key with what it means. Tests hold them against the
readers; the tables of the documentation are made of them."""

from __future__ import annotations

from collections.abc import Mapping

from rigkit.affine.registry import AFFINE_METHODS
from rigkit.calibration.shape import SHAPES
from rigkit.cameras.registry import MODELS
from rigkit.core.patterns.registry import PATTERNS
from rigkit.core.planes import PLANE_CHOICES
from rigkit.core.posetype import PoseType
from rigkit.identification.board_ids import BOARD_SIDES
from rigkit.io.schema_words import (
    ANY_OF,
    BOOLEAN,
    INTEGER,
    NUMBER,
    PLAIN_KINDS,
    POSITIVE,
    TEXT,
    Schema,
    array,
    choice,
    file,
    obj,
    optional,
    row,
    rows,
    said,
    table,
)
from rigkit.study.study import NOISE_KINDS
from rigkit.synthetic.noise import NoisyImages

_COUNT: Schema = {"type": "integer", "minimum": 1}
_SIZE_WORDS = tuple(dict.fromkeys(pattern.size_word for pattern in PATTERNS.values()))


def _pattern_keys() -> dict[str, Schema]:
    """Return the keys of all patterns, each with the hint that its reader gives."""
    out: dict[str, Schema] = {}
    for name, pattern in PATTERNS.items():
        for key in pattern.keys:
            kind = POSITIVE if key.kind is float else PLAIN_KINDS[key.kind]
            known = out.get(key.name, {}).get("description", "")
            out[key.name] = said(kind, f"{known}{'; ' if known else ''}{name}: {key.hint}")
    return out


def _sizes() -> dict[str, Schema]:
    what = {"square": "side of a square", "tag": "AprilGrid: side of a tag with its border"}
    out: dict[str, Schema] = {}
    for word in _SIZE_WORDS:
        side = what.get(word, f"{word} between the centres of two circles")
        out[f"{word}_mm?"] = said(POSITIVE, f"{side}, as measured over many of them")
        out[f"{word}_x_mm?"] = said(POSITIVE, f"{side} along x, where the two differ")
        out[f"{word}_y_mm?"] = said(POSITIVE, f"{side} along y")
        out[f"{word}_sigma_mm?"] = said(POSITIVE, "how well it was measured: goes into every length")
    return out


BOARD_KEYS: Mapping[str, Schema] = {
    "type?": said(choice(*PATTERNS), "what is printed; by default chessboard, with a dictionary charuco"),
    "columns": said(_COUNT, "inner corners along x; of an AprilGrid tags, of a circle grid circles"),
    "rows": said(_COUNT, "the same along y"),
    **_sizes(),
    "printed_x_mm?": said(POSITIVE, "squares as laid out for printing, which rigkit board notes; with printed_y_mm"),
    "printed_y_mm?": said(POSITIVE, "the same along y"),
    **optional(_pattern_keys()),
}
BOARD_FILE = file(
    "rigkit.board/1",
    "A board as a person measured it",
    {"id?": said(TEXT, "its name; by default the file's"), **BOARD_KEYS},
)

_PATTERNS_OF_FILES = {ANY_OF: [TEXT, array(TEXT, 1)]}
_MODEL_KEYS: Mapping[str, Schema] = {
    "model?": said(choice("auto", *MODELS), "camera model; auto (default): the one that predicts best"),
    "degree?": said(_COUNT, "terms of brown (4, 5, 8), degree of scaramuzza; by default chosen by held-out error"),
    "board_shape?": said(choice("auto", *SHAPES), "flat, warp (print scale and bow), released (every corner), or auto"),
}
_HOW = said(TEXT, "by what it was measured: steel rule, set square, calipers")


def _measured(unit: str) -> dict[str, Schema]:
    return {
        f"value_{unit}": said(POSITIVE, f"as measured, {unit}"),
        f"sigma_{unit}": said(POSITIVE, "how far off the measurement may well be: one standard deviation"),
        "how": _HOW,
    }


def _between(unit: str, what: str) -> Schema:
    own = {"a": said(TEXT, what), "b": said(TEXT, "the other one"), **_measured(unit)}
    return obj(own)


_TRUTH: Mapping[str, Schema] = {
    "angles?": said(array(_between("deg", "a board")), "angles between boards, across their faces"),
    "distances?": said(
        array(_between("mm", "a place: plane1, plane1.centre, plane1[0,5]")), "distances between places"
    ),
}
_IMAGES = said(_PATTERNS_OF_FILES, "a pattern such as images/*.jpg, or a list of files and patterns")
SESSION_FILE = file(
    "rigkit.session/1",
    "What to calibrate, and how",
    {
        "images?": _IMAGES,
        "board?": said(TEXT, "file of the board in the images"),
        "boards?": said(array(TEXT, 1), "files of the boards, where there are several"),
        **_MODEL_KEYS,
        "frames?": said(
            choice("name", "number", "order"),
            "of several cameras, which images were taken together: those of one name, one number at the end of the "
            "name, or one place in the sorted list",
        ),
        "rig?": said(TEXT, "file of a rig whose cameras stay as they are, lens and mount: others are added to it"),
        "cameras?": rows(
            {
                "id": said(TEXT, "its name"),
                "images": _IMAGES,
                "calibration?": said(TEXT, "file of a lens that stays as it is: only the mount is found"),
                **_MODEL_KEYS,
            },
            "several cameras, instead of images; the first is the rig's frame",
            least=2,
        ),
        "baselines?": said(
            array(_between("mm", "a camera")), "what a person measured between two lenses: judged, not used"
        ),
        "rigid_boards?": rows(
            {
                "boards": said(array(TEXT, 2), "boards mounted to each other"),
                "layout?": said(table(choice(*BOARD_SIDES)), "which is which, of boards that look alike"),
                **_TRUTH,
            },
            "boards on one mount",
        ),
    },
)

DATASET_FILE = file(
    "rigkit.dataset/1",
    "Pairs of images, and what a person measured of them",
    {
        "name": said(TEXT, "of the data set"),
        "boards": rows(
            {
                "id": said(TEXT, "its name"),
                "file?": said(TEXT, "of the board, or its keys here"),
                **optional(BOARD_KEYS),
            },
            "the boards that stand there",
            least=1,
        ),
        "cameras": rows(
            {
                "id": said(TEXT, "its name"),
                "calibration": said(TEXT, "its file"),
                "session?": said(TEXT, "to calibrate it from; by default session.toml beside the calibration"),
            },
            "the cameras; one that was moved is one",
            least=1,
        ),
        "pairs": rows(
            {
                "id": said(TEXT, "its name"),
                "camera1": said(TEXT, "that took image1"),
                "camera2": said(TEXT, "that took image2"),
                "image1": said(TEXT, "file"),
                "image2": said(TEXT, "file"),
                "boards": said(array(TEXT, 1), "those that stand there"),
                "pose_type": said(
                    choice(*(str(kind) for kind in PoseType)),
                    "general; planar: turned about the vertical, moved in the horizontal plane; standard: "
                    "moved along x; forward: along z; auto: the images say",
                ),
                "level?": obj(
                    {
                        "sigma_deg?": said({"type": "number", "minimum": 0}, "how well it held; 0: exactly"),
                        "down1?": said(row(3), "which way is down in camera 1, for planar motion"),
                        "down2?": said(row(3), "the same in camera 2"),
                    },
                    "the spirit level; by default a carefully set one",
                ),
                "layout?": said(table(choice(*BOARD_SIDES)), "where boards that look alike stand, from camera 1"),
                "planes?": said(choice(*PLANE_CHOICES), "of this pair, where it differs"),
                "truth?": obj(
                    {"baseline?": obj(_measured("mm"), "distance of the two lenses"), **_TRUTH},
                    "what a person measured",
                ),
            },
            "two images of the same boards each",
            least=1,
        ),
        "images?": said(choice("real", "rendered"), "what they are: stands beside ratios to the paper's results"),
        "planes?": said(
            choice(*PLANE_CHOICES),
            "what planes, angles and clouds are built on: each point by itself (free, the default), the points of a "
            "board in one plane, or on its known lattice",
        ),
        "truth_table?": said(TEXT, "a CSV file with what was measured, kept in a spreadsheet"),
    },
)

_POSES = tuple(str(kind) for kind in PoseType if kind is not PoseType.AUTO)
_NUMBERS = array(NUMBER, 1)
_CELLS = obj(
    {
        "pose_type?": said(TEXT, "of the cells"),
        "sigma?": said({ANY_OF: [NUMBER, _NUMBERS]}, "one noise level, or several"),
        "method?": said(TEXT, "estimator or variant"),
        "plane?": said(_COUNT, "which board"),
    }
)
_ESTIMATION: Mapping[str, Schema] = {
    "support?": said(TEXT, "where directions come from: see rigkit simulate"),
    "det_scale?": said(TEXT, "the scale that DET3UDIR takes"),
}
STUDY_FILE = file(
    "rigkit.study/1",
    "A synthetic study",
    {
        "name": said(TEXT, "of the study and its files"),
        "title?": said(TEXT, "above tables and figures"),
        "trials": said(_COUNT, "how many scenes"),
        "seed": said(INTEGER, "of the random numbers"),
        "methods": said(array(TEXT, 1), f"estimators ({', '.join(AFFINE_METHODS)}) or variants"),
        "pose_types": said(array(choice(*_POSES), 1), "motions of the camera"),
        "noise": obj(
            {
                "on": said(choice(*NOISE_KINDS), "what is noisy"),
                **{f"sigma_{unit}?": said(_NUMBERS, f"levels, {unit}") for unit in NOISE_KINDS.values()},
                "images?": said(choice(*(str(images) for images in NoisyImages)), "which images"),
            },
            "standard deviations of the noise",
        ),
        "estimation?": obj(
            {
                **_ESTIMATION,
                "epipolar?": said(TEXT, "whose epipolar geometry is used"),
                "min_conditioning?": said(NUMBER, "below it directions determine no affinity"),
            },
            "how affinities are estimated",
        ),
        "variants?": rows(
            {"name": said(TEXT, "of the variant"), "method": said(TEXT, "estimator"), **_ESTIMATION},
            "estimators with options of their own",
        ),
        "scene?": obj(
            {
                "board?": obj({"columns": _COUNT, "rows": _COUNT, "square_mm": POSITIVE}, "the three boards"),
                "focal_px?": said(POSITIVE, "of the camera"),
                "baseline_mm?": said(POSITIVE, "of special motions"),
                "in_plane_deg?": said(NUMBER, "turn of the boards"),
                "centre_px?": said(row(2), "principal point"),
                "parallax_deg?": said(row(2), "range of general motions"),
            },
            "what is simulated",
        ),
        "claims?": rows(
            {
                "text": said(TEXT, "the statement"),
                "smaller": said(_CELLS, "cells whose medians are smaller"),
                "larger?": said(_CELLS, "than those of these cells"),
                "at_most_deg?": said(POSITIVE, "or than this"),
            },
            "statements to judge",
        ),
    },
)

PUBLIC_FILE = file(
    "rigkit.public/1",
    "A public capture, and what somebody measured of it",
    {
        "name": said(TEXT, "of the set"),
        "about": said(TEXT, "what it is"),
        "source": said(TEXT, "where it comes from"),
        "licence": said(TEXT, "of its files"),
        "rendered": said(BOOLEAN, "images of a computer, not of a camera"),
        "folder": said(TEXT, "where its files are in a folder of captures"),
        "boards?": rows({"id?": said(TEXT, "its name"), **BOARD_KEYS}, "boards in its images"),
        "measured?": rows(
            {
                "id": said(TEXT, "what was measured"),
                "value": NUMBER,
                "sigma?": said(POSITIVE, "where somebody stated one"),
                "unit": choice("mm", "deg", "px"),
                "how": _HOW,
            },
            "what is known of it",
        ),
        "files": said(table(TEXT), "SHA-256 of each file"),
        "urls?": said(table(TEXT), "whence to fetch them; after # a file in a .tar or .zip"),
    },
)
