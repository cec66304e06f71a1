"""The published schemas against the readers, which know their keys themselves, and against files that people wrote."""

from __future__ import annotations

import json
import tomllib
from collections import defaultdict
from pathlib import Path

import jsonschema
import pytest
from helpers.data import REPOSITORY
from helpers.reconstructions import make_reconstruction
from helpers.schemas import faults

from rigkit.cli.main import main
from rigkit.core.truth import MeasuredAngle, PairTruth
from rigkit.io.board_file import load_board
from rigkit.io.manifest import load_dataset
from rigkit.io.public_set import load_public_set
from rigkit.io.rig_session import is_rig_session, load_rig_session
from rigkit.io.schema import SCHEMAS, key_rows
from rigkit.io.schema_words import ANY_OF
from rigkit.io.session import load_session
from rigkit.io.study_file import load_study
from rigkit.io.toml_reader import TomlTable
from rigkit.report.tables import tables_to_json
from rigkit.validation.checks import validate
from rigkit.validation.crosscheck import crosscheck
from rigkit.validation.tables import build_tables

BOARDS = {
    "chess": "columns = 9\nrows = 6\nsquare_mm = 30.0\nprinted_x_mm = 30.0\nprinted_y_mm = 30.0\n",
    "charuco": 'type = "charuco"\ncolumns = 4\nrows = 4\nsquare_mm = 30.0\n'
    'marker_mm = 20.0\ndictionary = "DICT_5X5_100"\n',
    "april": 'type = "aprilgrid"\ncolumns = 6\nrows = 6\ntag_mm = 88.0\nspacing = 0.3\n',
    "circles": 'type = "circles"\ncolumns = 7\nrows = 5\ndistance_mm = 20.0\n',
}
SESSION = """schema = "rigkit.session/1"
boards = ["chess.toml", "april.toml"]
model = "brown"
degree = 5
frames = "number"
rig = "rig.json"
[[cameras]]
id = "left"
images = "left*.png"
calibration = "left.json"
[[cameras]]
id = "right"
images = ["right*.png"]
model = "brown"
[[baselines]]
a = "left"
b = "right"
value_mm = 100.0
sigma_mm = 1.0
how = "rule"
[[rigid_boards]]
boards = ["chess", "april"]
layout = { chess = "left" }
angles = [ { a = "chess", b = "april", value_deg = 90.0, sigma_deg = 0.3, how = "square" } ]
distances = [ { a = "chess.centre", b = "april", value_mm = 90.0, sigma_mm = 0.3, how = "rule" } ]
"""
DATASET = """schema = "rigkit.dataset/1"
name = "mine"
truth_table = "truth.csv"
[[boards]]
id = "a"
file = "chess.toml"
[[cameras]]
id = "c"
calibration = "left.json"
session = "one.toml"
[[pairs]]
id = "p"
camera1 = "c"
camera2 = "c"
image1 = "1.png"
image2 = "2.png"
boards = ["a"]
pose_type = "planar"
level = { sigma_deg = 0.2, down1 = [0.0, 1.0, 0.1], down2 = [0.0, 1.0, 0.1] }
layout = { a = "left" }
[pairs.truth]
baseline = { value_mm = 100.0, sigma_mm = 1.0, how = "rule" }
distances = [ { a = "a[0,0]", b = "a[1,0]", value_mm = 30.0, sigma_mm = 1.0, how = "rule" } ]
"""
STUDY = """schema = "rigkit.study/1"
name = "small"
title = "Small"
trials = 2
seed = 1
methods = ["F3UDIR"]
pose_types = ["general"]
[noise]
on = "corners"
sigma_px = [0.5]
images = "both"
[estimation]
support = "line"
[scene]
board = { columns = 6, rows = 8, square_mm = 40.0 }
[[variants]]
name = "mine"
method = "F3UDIR"
[[claims]]
text = "small"
smaller = { method = "F3UDIR", sigma = [0.5], pose_type = "general", plane = 1 }
at_most_deg = 20.0
"""
Asked = dict[tuple[str, ...], set[str]]


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> Asked:
    """Where in which file readers asked for which keys."""
    found: Asked = defaultdict(set)
    paths: dict[int, tuple[str, ...]] = {}
    kept: list[TomlTable] = []
    table, tables, done = TomlTable.table, TomlTable.tables, TomlTable.done

    def below(parent: TomlTable, child: TomlTable, key: str) -> TomlTable:
        kept.append(child)
        paths[id(child)] = (*_root(parent), key)
        return child

    def _root(own: TomlTable) -> tuple[str, ...]:
        name = str(own._values.get("schema", "")).removeprefix("rigkit.").partition("/")[0]
        return paths.get(id(own)) or (name,)

    def note(self: TomlTable) -> None:
        found[_root(self)] |= set(self._known)
        kept.append(self)
        done(self)

    monkeypatch.setattr(TomlTable, "table", lambda self, key, *, hint: below(self, table(self, key, hint=hint), key))
    monkeypatch.setattr(
        TomlTable, "tables", lambda self, key, *, hint: tuple(below(self, t, key) for t in tables(self, key, hint=hint))
    )
    monkeypatch.setattr(TomlTable, "done", note)
    return found


def keys_at(path: tuple[str, ...]) -> set[str]:
    """The keys that the published schema has there."""
    schema = SCHEMAS[path[0]]
    for key in path[1:]:
        schema = schema["properties"][key]
        schema = schema.get("items", schema)
    return set(schema["properties"])


def test_readers_ask_for_the_keys_that_are_published(asked: Asked, tmp_path: Path) -> None:
    for name, text in BOARDS.items():
        path = tmp_path / f"{name}.toml"
        path.write_text(f'schema = "rigkit.board/1"\n{text}')
        load_board(path)
    for name in ("left.json", "rig.json"):
        (tmp_path / name).write_text("{}")
    for name, text in (("session", SESSION), ("dataset", DATASET), ("study", STUDY)):
        (tmp_path / f"{name}.toml").write_text(text)
    (tmp_path / "one.toml").write_text('schema = "rigkit.session/1"\nboard = "chess.toml"\nimages = "*.png"\n')
    (tmp_path / "truth.csv").write_text("pair\n")
    load_rig_session(tmp_path / "session.toml")
    load_session(tmp_path / "one.toml")
    with pytest.raises(Exception, match=r"truth\.csv"):
        load_dataset(tmp_path)
    (tmp_path / "dataset.toml").write_text(DATASET.replace('truth_table = "truth.csv"\n', ""))
    load_dataset(tmp_path)
    load_study(tmp_path / "study.toml")
    for path in sorted((REPOSITORY / "datasets").glob("*/*.toml")):
        loaders = {"public": load_public_set, "synthetic": load_study, "lab-a": load_dataset}
        loaders[path.parent.name](path)
    # A board's size in its own word: the others are not asked for. A dataset's or public set's board may be any.
    sizes = {key for key in keys_at(("board",)) if key.endswith("_mm")} | {"id", "file"}
    kinds = keys_at(("board",))
    seen = {place for place in asked if place[0] in SCHEMAS}
    assert len(seen) >= 20
    for place in seen:
        published, known = keys_at(place), asked[place]
        # A baseline is asked for there only to say where else it belongs.
        known = known - {"baseline"} if place[-1] == "rigid_boards" else known
        assert known <= published, (place, known - published)
        missing = published - known
        if "boards" in place[1:] or place == ("board",):
            missing -= sizes if place == ("board",) else kinds
        if place == ("session",):
            missing -= {"board", "boards", "images"}
        if place[0] == "session" and place[1:] == ("cameras",):
            missing -= {"degree", "board_shape"}
        if place[:2] == ("study", "noise"):
            missing -= {"sigma_deg", "sigma_px"}
        assert not missing, (place, missing)


@pytest.mark.parametrize("folder", ["datasets", "calib"])
def test_files_of_this_repository_are_of_their_schemas(folder: str) -> None:
    files = sorted((REPOSITORY / folder).rglob("*.toml"))
    assert len(files) >= 4
    for path in files:
        assert faults(tomllib.loads(path.read_text())) == [], path


def test_what_is_written_of_a_session_is_of_its_schema(tmp_path: Path) -> None:
    """The reader takes them, so the schema has to."""
    (tmp_path / "session.toml").write_text(SESSION)
    assert is_rig_session(tmp_path / "session.toml")
    for text in (SESSION, DATASET, STUDY):
        assert faults(tomllib.loads(text)) == []
        assert faults(tomllib.loads(text + "\n[stray]\n")) != []


def test_results_are_of_their_schemas() -> None:
    made = make_reconstruction()
    report = validate(made, PairTruth(angles=(MeasuredAngle("plane1", "plane2", 90.0, 0.3, "square"),)))
    for text in (report.to_json(), crosscheck(made).to_json(), tables_to_json(build_tables([report]))):
        document = json.loads(text)
        assert document["schema"].startswith("rigkit.")
        assert faults(document) == []
        assert faults({**document, "stray": 1}) != []


def test_every_key_is_said_and_every_schema_is_one(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert main(["schema"]) == 0
    listed = capsys.readouterr().out
    for name, schema in SCHEMAS.items():
        jsonschema.Draft202012Validator.check_schema(schema)
        assert name in listed
        rows = list(key_rows(schema))
        assert len(rows) > 5
        assert main(["schema", name]) == 0
        assert json.loads(capsys.readouterr().out) == schema
    for name in ("board", "session", "dataset", "study", "calibration", "rig"):
        untold = [key for key, _, words in key_rows(SCHEMAS[name]) if not words.removesuffix("(optional)").strip()]
        assert len(untold) <= 9, (name, untold)
    assert main(["schema", "session", "--keys"]) == 0
    assert "cameras[].calibration" in capsys.readouterr().out
    assert main(["schema", "nothing"]) == 2
    assert main(["schema", "rig", "-o", str(tmp_path / "rig.json")]) == 0
    assert ANY_OF in (tmp_path / "rig.json").read_text()
