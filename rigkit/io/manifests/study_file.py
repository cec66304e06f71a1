"""Study files for `rigkit simulate`, written by a person."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

from rigkit.affine.registry import AFFINE_METHODS
from rigkit.core.boards import Board
from rigkit.core.posetype import PoseType
from rigkit.io.disk.schema_builders import (
    ANY_OF,
    COUNT,
    INTEGER,
    NAME,
    NUMBER,
    POSITIVE,
    TEXT,
    Schema,
    array,
    choice,
    described,
    file,
    obj,
    row,
    rows,
    texts,
)
from rigkit.io.disk.toml_reader import TomlTable, read_toml
from rigkit.study.study import NOISE_KINDS, Claim, Study, Variant
from rigkit.synthetic.noise import NoisyImages

DEFAULTS: Mapping[str, Any] = {f.name: f.default for f in fields(Study) if f.name in ("support", "det_scale")}
"""Default values of a study: those of the paper."""

_SIDE: Schema = {"type": "integer", "minimum": 3}
_NUMBERS = array(NUMBER, 1)
_CELLS = obj(
    {
        "pose_type?": described(TEXT, "of the cells", "general"),
        "sigma?": described({ANY_OF: [NUMBER, _NUMBERS]}, "one noise level, or several", 3.0),
        "method?": described(TEXT, "estimator or variant", "3SDIR"),
        "plane?": described(COUNT, "which board", 1),
    }
)
_ESTIMATION: Mapping[str, Schema] = {
    "support?": described(TEXT, "where directions come from: see rigkit simulate", "patch"),
    "det_scale?": described(TEXT, "the scale that DET3UDIR takes", "area"),
}
STUDY_FILE = file(
    "rigkit.study/1",
    "A synthetic study",
    {
        "name": described(NAME, "of the study and its files", "general-motion"),
        "title?": described(TEXT, "above tables and figures", "General motion"),
        "trials": described(COUNT, "how many scenes", 100),
        "seed": described(INTEGER, "of the random numbers", 1),
        "methods": described(texts(1), f"estimators ({', '.join(AFFINE_METHODS)}) or variants", ["F2UDIR", "3SDIR"]),
        "pose_types": described(
            texts(1, choice(*(str(kind) for kind in PoseType if kind is not PoseType.AUTO))),
            "motions of the camera",
            ["general"],
        ),
        "noise": obj(
            {
                "on": described(choice(*NOISE_KINDS), "what is noisy"),
                **{
                    f"sigma_{unit}?": described(_NUMBERS, f"levels, {unit}", [0.0, 1.0])
                    for unit in NOISE_KINDS.values()
                },
                "images?": described(choice(*map(str, NoisyImages)), "which images"),
            },
            "standard deviations of the noise",
        ),
        "estimation?": obj(
            {
                **_ESTIMATION,
                "epipolar?": described(TEXT, "whose epipolar geometry is used", "truth"),
                "min_conditioning?": described(NUMBER, "below it directions determine no affinity", 0.05),
            },
            "how affinities are estimated",
        ),
        "variants?": rows(
            {
                "name": described(TEXT, "of the variant", "3SDIR, patch"),
                "method": described(TEXT, "estimator", "3SDIR"),
                **_ESTIMATION,
            },
            "estimators with options of their own",
        ),
        "scene?": obj(
            {
                "board?": described(
                    obj({"columns": _SIDE, "rows": _SIDE, "square_mm": POSITIVE}),
                    "the three boards",
                    {"columns": 6, "rows": 8, "square_mm": 40.0},
                ),
                "focal_px?": described(POSITIVE, "of the camera", 1350.0),
                "baseline_mm?": described(POSITIVE, "of special motions", 300.0),
                "in_plane_deg?": described(NUMBER, "turn of the boards", 25.0),
                "centre_px?": described(row(2), "principal point", [800.0, 620.0]),
                "parallax_deg?": described(row(2), "range of general motions", [40.0, 70.0]),
            },
            "what is simulated",
        ),
        "claims?": rows(
            {
                "text": described(TEXT, "the statement", "3SDIR is better than F2UDIR"),
                "smaller": described(_CELLS, "cells whose medians are smaller", {"method": "3SDIR"}),
                "larger?": described(_CELLS, "than those of these cells; or at_most_deg", {"method": "F2UDIR"}),
                "at_most_deg?": described(POSITIVE, "or than this", 20.0),
            },
            "statements to judge",
        ),
    },
)


def load_study(path: str | Path) -> Study:
    """Return the study of a file.

    Raises InputError for unknown keys or values, and if one of name, trials, seed, pose_types, methods and noise is
    missing.
    """
    top = read_toml(path, STUDY_FILE)
    noise, estimation, scene = top["noise"], dict(top.get("estimation", {})), dict(top.get("scene", {}))
    typical = {key: estimation.get(key, default) for key, default in DEFAULTS.items()}
    if "board" in scene:
        side = scene["board"]["square_mm"]
        scene["board"] = Board("study", scene["board"]["columns"], scene["board"]["rows"], side, side)
    if "images" in noise:
        scene["images"] = NoisyImages(noise["images"])
    with top.located():
        return Study(
            name=top["name"],
            title=top.get("title", top["name"]),
            **{key: top[key] for key in ("trials", "seed", "methods")},
            pose_types=tuple(map(PoseType, top["pose_types"])),
            noise=noise["on"],
            sigmas=noise[f"sigma_{NOISE_KINDS[noise['on']]}"],
            variants=tuple(Variant(**typical | dict(entry)) for entry in top.get("variants", ())),
            claims=tuple(map(_claim, top.get("claims", ()))),
            **estimation,
            **scene,
        )


def _claim(entry: TomlTable) -> Claim:
    limit = entry.get("at_most_deg")
    larger: dict[str, Any] | None = dict(entry["larger"]) if "larger" in entry or limit is None else None
    return Claim(entry["text"], dict(entry["smaller"]), larger, limit)
