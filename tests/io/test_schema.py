"""The published schemas against the readers, and against files that people wrote."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path

import jsonschema
import pytest
from helpers.data import REPOSITORY
from helpers.reconstructions import make_reconstruction
from helpers.schemas import faults

from rigkit.cli.main import main
from rigkit.core.errors import InputError
from rigkit.core.truth import MeasuredAngle, PairTruth
from rigkit.io.boards.board_file import load_board
from rigkit.io.disk.schema_builders import ANY_OF
from rigkit.io.manifests.manifest import load_dataset
from rigkit.io.manifests.public_set import load_public_set
from rigkit.io.manifests.rig_session import is_rig_session, load_rig_session
from rigkit.io.manifests.session import load_session
from rigkit.io.manifests.study_file import load_study
from rigkit.io.schema import SCHEMAS, key_rows
from rigkit.io.schema_names import SCHEMA_NAMES
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


def test_readers_take_what_the_published_schemas_have(tmp_path: Path) -> None:
    """The schema of a file that people write is its reader, so every key of these texts is one that is published."""
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


def test_keys_of_one_camera_and_of_rigs_do_not_mix(tmp_path: Path) -> None:
    """The schema of a session has both; a key that would be ignored is refused."""
    (tmp_path / "chess.toml").write_text(f'schema = "rigkit.board/1"\n{BOARDS["chess"]}')
    path, text = tmp_path / "one.toml", 'schema = "rigkit.session/1"\nboard = "chess.toml"\nimages = "*.png"\n'
    for key in ('frames = "name"', 'rig = "rig.json"'):
        path.write_text(text + key)
        with pytest.raises(InputError, match="unknown key"):
            load_session(path)


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
    assert tuple(SCHEMAS) == SCHEMA_NAMES
    listed = capsys.readouterr().out
    for name, schema in SCHEMAS.items():
        jsonschema.Draft202012Validator.check_schema(schema)
        assert name in listed
        rows = list(key_rows(schema))
        assert len(rows) > 5
        assert main(["schema", name]) == 0
        assert json.loads(capsys.readouterr().out) == schema
    for name in ("board", "session", "dataset", "study", "calibration", "rig"):
        undocumented = [
            key for key, _, words in key_rows(SCHEMAS[name]) if not words.removesuffix("(optional)").strip()
        ]
        assert len(undocumented) <= 9, (name, undocumented)
    assert main(["schema", "session", "--keys"]) == 0
    assert "cameras[].calibration" in capsys.readouterr().out
    assert main(["schema", "board", "--keys"]) == 0
    assert "`circles`  what is printed" in capsys.readouterr().out, "long cells are set apart, too"
    assert main(["schema", "nothing"]) == 2
    assert main(["schema", "rig", "-o", str(tmp_path / "rig.json")]) == 0
    assert ANY_OF in (tmp_path / "rig.json").read_text()
