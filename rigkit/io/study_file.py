"""Study files: what `rigkit simulate` computes, written by a person."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from typing import Any

from rigkit.core.boards import Board
from rigkit.core.posetype import PoseType
from rigkit.io.toml_reader import TomlTable, read_toml
from rigkit.study.study import NOISE_KINDS, Claim, Study, Variant
from rigkit.study.table import CELL_KEYS
from rigkit.synthetic.noise import NoisyImages

STUDY_SCHEMA = "rigkit.study/1"
KNOWN_POSE_TYPES = tuple(str(p) for p in PoseType if p is not PoseType.AUTO)

DEFAULTS = {f.name: f.default for f in fields(Study) if f.name in ("support", "det_scale")}
"""What a study that says nothing of them works with: the paper's."""


def load_study(path: str | Path) -> Study:
    """Read a study.

    Raises
    ------
    InputError
        Unknown keys or values, or one of name, trials, seed, pose_types, methods and noise is missing.
    """
    source = Path(path)
    top = read_toml(source, STUDY_SCHEMA)
    name = top.identifier("name", hint='name = "general-motion"')
    options: dict[str, Any] = {
        "title": top.text("title", hint='title = "..."') if top.has("title") else name,
        "trials": top.integer("trials", hint="trials = 100", at_least=1),
        "seed": top.integer("seed", hint="seed = 1"),
        "methods": top.texts("methods", hint='methods = ["F2UDIR", "3SDIR"]'),
    }
    kinds = top.texts("pose_types", hint='pose_types = ["general"]')
    for kind in kinds:
        if kind not in KNOWN_POSE_TYPES:
            raise top.error(f"'pose_types' names '{kind}', which is unknown; known: {', '.join(KNOWN_POSE_TYPES)}")
    options["pose_types"] = tuple(PoseType(kind) for kind in kinds)
    options |= _noise(top.table("noise", hint='[noise] with on = "directions" and sigma_deg = [0, 3, 10]'))
    if top.has("estimation"):
        options |= _estimation(top.table("estimation", hint="[estimation]"))
    if top.has("variants"):
        defaults = {key: options.get(key, DEFAULTS[key]) for key in ("support", "det_scale")}
        variants = top.tables("variants", hint='[[variants]] with name = "3SDIR, patch"')
        options["variants"] = tuple(_variant(table, defaults) for table in variants)
    if top.has("scene"):
        options |= _scene(top.table("scene", hint="[scene]"))
    if top.has("claims"):
        options["claims"] = tuple(_claim(t) for t in top.tables("claims", hint='[[claims]] with text = "..."'))
    top.done()
    with top.located():
        return Study(name=name, **options)


def _noise(table: TomlTable) -> dict[str, Any]:
    kind = table.text("on", hint='on = "directions" (or "corners")', choices=tuple(NOISE_KINDS))
    key = f"sigma_{NOISE_KINDS[kind]}"
    out: dict[str, Any] = {"noise": kind, "sigmas": table.numbers(key, hint=f"{key} = [0.0, 1.0]")}
    if table.has("images"):
        images = tuple(str(i) for i in NoisyImages)
        out["images"] = NoisyImages(table.text("images", hint='images = "both"', choices=images))
    table.done()
    return out


def _estimation(table: TomlTable) -> dict[str, Any]:
    out: dict[str, Any] = {}
    for key in ("support", "det_scale", "epipolar"):
        if table.has(key):
            out[key] = table.text(key, hint=f'{key} = "..."')
    if table.has("min_conditioning"):
        out["min_conditioning"] = table.number("min_conditioning", hint="min_conditioning = 0.05", positive=False)
    table.done()
    return out


def _scene(table: TomlTable) -> dict[str, Any]:
    out: dict[str, Any] = {}
    if table.has("board"):
        inner = table.table("board", hint="board = { columns = 6, rows = 8, square_mm = 40 }")
        columns = inner.integer("columns", hint="columns = 6", at_least=3)
        rows = inner.integer("rows", hint="rows = 8", at_least=3)
        square = inner.number("square_mm", hint="square_mm = 40")
        inner.done()
        out["board"] = Board("study", columns, rows, square, square)
    for key in ("focal_px", "baseline_mm"):
        if table.has(key):
            out[key] = table.number(key, hint=f"{key} = 300.0")
    if table.has("in_plane_deg"):
        out["in_plane_deg"] = table.number("in_plane_deg", hint="in_plane_deg = 25.0", positive=False)
    for key in ("centre_px", "parallax_deg"):
        if table.has(key):
            values = table.numbers(key, hint=f"{key} = [40.0, 70.0]")
            if len(values) != 2:
                raise table.error(f"'{key}' must be two numbers, got {len(values)}")
            out[key] = values
    table.done()
    return out


def _variant(table: TomlTable, defaults: dict[str, str]) -> Variant:
    name = table.text("name", hint='name = "3SDIR, patch"')
    method = table.text("method", hint='method = "3SDIR"')
    chosen = dict(defaults)
    for key in defaults:
        if table.has(key):
            chosen[key] = table.text(key, hint=f'{key} = "..."')
    table.done()
    return Variant(name, method, **chosen)


def _claim(table: TomlTable) -> Claim:
    text = table.text("text", hint='text = "3SDIR is better than F2UDIR"')
    smaller = _cells(table.table("smaller", hint='smaller = { method = "3SDIR" }'))
    larger, limit = None, None
    if table.has("at_most_deg"):
        limit = table.number("at_most_deg", hint="at_most_deg = 20.0")
    if table.has("larger") or limit is None:
        larger = _cells(table.table("larger", hint='larger = { method = "F2UDIR" }, or at_most_deg = 20.0'))
    table.done()
    return Claim(text, smaller, larger, limit)


def _cells(table: TomlTable) -> dict[str, Any]:
    """Return a selection of cells; the noise may be one level or a list of them."""
    which: dict[str, Any] = {}
    for key in CELL_KEYS:
        if table.has(key):
            if key == "plane":
                which[key] = table.integer(key, hint="plane = 1", at_least=1)
            elif key == "sigma":
                hint = "sigma = 3.0, or [1.0, 2.0, 3.0]"
                several = table.is_list(key)
                which[key] = table.numbers(key, hint=hint) if several else table.number(key, hint=hint, positive=False)
            else:
                which[key] = table.text(key, hint=f'{key} = "..."')
    table.done()
    return which
