"""Manifests: every key that a person may write, and one clear line for every mistake."""

from __future__ import annotations

from pathlib import Path

import pytest

from rigkit.core.errors import InputError
from rigkit.core.posetype import PoseType
from rigkit.core.truth import Feature
from rigkit.io.manifests.manifest import load_dataset

REPO = Path(__file__).parents[3]
TEXT = """
schema = "rigkit.dataset/1"
name = "small"

[[boards]]
id = "left"
file = "board.toml"

[[boards]]
id = "floor"
columns = 7
rows = 6
square_x_mm = 28.0
square_y_mm = 28.1
square_sigma_mm = 0.05

[[cameras]]
id = "cam"
calibration = "cam/calibration.json"

[[pairs]]
id = "first"
camera1 = "cam"
camera2 = "cam"
image1 = "a.png"
image2 = "b.png"
pose_type = "forward"
level = { sigma_deg = 0.2 }
boards = ["left", "floor"]
layout = { left = "left", floor = "floor" }

[pairs.truth]
baseline = { value_mm = 200.0, sigma_mm = 2.0, how = "steel rule" }
angles = [ { a = "left", b = "floor", value_deg = 90.0, sigma_deg = 0.3, how = "set square" } ]
distances = [ { a = "left.centre", b = "floor[6,5]", value_mm = 400.0, sigma_mm = 1.0, how = "steel rule" } ]
"""


def write(folder: Path, text: str = TEXT) -> Path:
    (folder / "cam").mkdir(exist_ok=True)
    (folder / "cam" / "session.toml").touch()
    (folder / "board.toml").write_text('schema = "rigkit.board/1"\ncolumns = 8\nrows = 6\nsquare_mm = 50.0\n')
    (folder / "dataset.toml").write_text(text)
    return folder


def test_everything_that_a_person_wrote_arrives(tmp_path: Path) -> None:
    dataset = load_dataset(write(tmp_path))
    assert (dataset.name, dataset.root) == ("small", tmp_path)
    pair = dataset.pair("first")
    assert pair.pose_type is PoseType.FORWARD
    assert pair.level_sigma_deg == 0.2
    assert pair.board_ids == ("left", "floor")
    assert pair.layout == {"left": "left", "floor": "floor"}
    assert [(b.size, b.square_x_mm, b.square_y_mm) for b in pair.boards] == [((8, 6), 50.0, 50.0), ((7, 6), 28.0, 28.1)]
    assert pair.image2 == tmp_path / "b.png"
    assert pair.camera1.calibration == tmp_path / "cam" / "calibration.json"
    assert pair.camera1.session == tmp_path / "cam" / "session.toml"
    assert pair.truth.baseline is not None
    assert (pair.truth.baseline.value_mm, pair.truth.baseline.how) == (200.0, "steel rule")
    assert (pair.truth.angles[0].b, pair.truth.angles[0].sigma_deg) == ("floor", 0.3)
    assert pair.truth.distances[0].b == Feature("floor", (6, 5))
    assert pair.truth.count == 3


def test_the_file_itself_may_be_given(tmp_path: Path) -> None:
    assert load_dataset(write(tmp_path) / "dataset.toml").name == "small"


def test_optional_facts_may_be_left_out(tmp_path: Path) -> None:
    text = TEXT[: TEXT.index("[pairs.truth]")].replace("level =", "# level").replace("layout =", "# layout")
    pair = load_dataset(write(tmp_path, text)).pairs[0]
    assert (pair.level_sigma_deg, pair.layout, pair.truth.count) == (None, {}, 0)


def test_the_level_may_be_exact_and_that_of_each_camera_known(tmp_path: Path) -> None:
    exact = load_dataset(write(tmp_path, TEXT.replace("sigma_deg = 0.2 }", "sigma_deg = 0 }"))).pairs[0]
    assert (exact.level_sigma_deg, exact.down) == (0.0, None)
    planar = TEXT.replace('"forward"', '"planar"')
    down = "level = { down1 = [0.0, 0.98, 0.17], down2 = [0, 1, 0] }"
    pair = load_dataset(write(tmp_path, planar.replace("level = { sigma_deg = 0.2 }", down))).pairs[0]
    assert (pair.level_sigma_deg, pair.down) == (None, ((0.0, 0.98, 0.17), (0.0, 1.0, 0.0)))
    both = planar.replace("sigma_deg = 0.2 }", "sigma_deg = 0.1, down1 = [0, 1, 0], down2 = [0, 1, 0] }")
    assert load_dataset(write(tmp_path, both)).pairs[0].level_sigma_deg == 0.1


WRONG = [
    ("sigma_deg = 0.2", "sigma_deg = -0.2", ["must not be negative", "0: exactly level"]),
    ("sigma_deg = 0.2", "down1 = [0, 1, 0], down2 = [0, 1, 0]", ["for planar motion, not for 'forward'"]),
    ('forward"\nlevel = { sigma_deg = 0.2', 'planar"\nlevel = { down1 = [0, 1, 0]', ["'down2' is missing"]),
    (
        'forward"\nlevel = { sigma_deg = 0.2',
        'planar"\nlevel = { down1 = [0, 1], down2 = [0, 1, 0]',
        ["'down1' must be three numbers"],
    ),
    ('name = "small"', "", ["'name' is missing", 'name = "my-lab"']),
    ('"rigkit.dataset/1"', '"rigkit.dataset/2"', ["another version"]),
    ('"rigkit.dataset/1"', '"rigkit.session/1"', ["rigkit.dataset/1"]),
    ('schema = "rigkit.dataset/1"', "", ["'schema' is missing"]),
    ('pose_type = "forward"', "", ["[[pairs]] 'first'", "'pose_type' is missing", "general, planar"]),
    ('pose_type = "forward"', 'pose_type = "sideways"', ["'sideways'", "standard, forward, auto"]),
    ("level =", "levl =", ["[[pairs]] 'first'", "unknown key 'levl'", "did you mean 'level'"]),
    ("sigma_deg = 0.2", "sigma = 0.2", ["unknown key 'sigma'; did you mean 'sigma_deg'"]),
    ("value_mm = 200.0, sigma_mm = 2.0", "value_mm = 200.0", ["'baseline'", "'sigma_mm' is missing"]),
    ("value_mm = 200.0", "value_mm = -200.0", ["must be positive"]),
    ("value_mm = 200.0", 'value_mm = "200 mm"', ["must be a number"]),
    (', how = "steel rule" }\nangles', " }\nangles", ["'how' is missing"]),
    (
        'b = "floor", value_deg',
        'b = "ceiling", value_deg',
        ["'ceiling' is not in this pair", "left, floor"],
    ),
    ('a = "left", b = "floor", value_deg', 'a = "floor", b = "floor", value_deg', ["name two boards"]),
    ("value_deg = 90.0", "value_deg = 270.0", ["more than 180"]),
    ("floor[6,5]", "floor[7,5]", ["outside the 7x6"]),
    ("left.centre", "left[0,0]", ["looks the same turned", "left.centre"]),
    ("floor[6,5]", "floor[6;5]", ["'floor[6;5]' is not in this pair"]),
    ('"left.centre", b = "floor[6,5]"', '"left", b = "floor"', ["two planes"]),
    ('camera1 = "cam"', 'camera1 = "kam"', ["camera1 'kam' is not declared", "known: cam"]),
    ('boards = ["left", "floor"]', 'boards = ["left", "flor"]', ["board 'flor' is not declared"]),
    ('boards = ["left", "floor"]', "boards = []", ["'boards' is empty"]),
    ('boards = ["left", "floor"]', 'boards = ["left", "left"]', ["twice"]),
    ('boards = ["left", "floor"]', "boards = 2", ["list of strings"]),
    ('layout = { left = "left"', 'layout = { left = "attic"', ["left, right, floor"]),
    ('id = "floor"', 'id = "left"', ["'left' is declared twice"]),
    ('id = "first"', 'id = "../first"', ["letters, digits"]),
    ("columns = 7", "", ["'floor'", "'columns' is missing"]),
    ("columns = 7", "columns = 7.5", ["whole number"]),
    ("columns = 7", "columns = 1", ["at least 2"]),
    ("square_y_mm = 28.1", "", ["'square_y_mm' is missing"]),
    ("square_x_mm = 28.0\nsquare_y_mm = 28.1", "", ["'square_mm' is missing"]),
    ("board.toml", "bord.toml", ["bord.toml", "does not exist"]),
    ("cam/calibration.json", "kam/calibration.json", ["[[cameras]] 'cam'", "kam/calibration.json"]),
    ("[[pairs]]", "[pairs]", ["'pairs' must be a list of tables"]),
    ("name =", "name", ["not valid TOML", "line 3"]),
]


@pytest.mark.parametrize(("old", "new", "words"), WRONG)
def test_what_is_wrong_is_said_in_one_line(tmp_path: Path, old: str, new: str, words: list[str]) -> None:
    assert old in TEXT
    with pytest.raises(InputError) as caught:
        load_dataset(write(tmp_path, TEXT.replace(old, new, 1)))
    message = str(caught.value)
    assert "\n" not in message
    assert ".toml" in message
    for word in words:
        assert word in message


def test_every_table_refuses_unknown_keys(tmp_path: Path) -> None:
    lines = TEXT.splitlines()
    places = [i for i, line in enumerate(lines) if line.startswith(("name", "id", "baseline", "level", "layout"))]
    assert len(places) >= 7
    for i in places:
        broken = [*lines]
        broken[i] = broken[i].replace("{ ", "{ surplus = 1, ") if "{" in broken[i] else broken[i] + "\nsurplus = 1"
        with pytest.raises(InputError, match="surplus"):
            load_dataset(write(tmp_path, "\n".join(broken)))


def test_what_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"has no dataset\.toml"):
        load_dataset(tmp_path)
    with pytest.raises(InputError, match="does not exist"):
        load_dataset(tmp_path / "none")
    dataset = load_dataset(write(tmp_path))
    with pytest.raises(InputError, match=r"pair 'second' is not declared; known: first"):
        dataset.pair("second")
    with pytest.raises(InputError, match=r"pair 'first': image1 .*a\.png"):
        dataset.pair("first").require_images()


def test_lab_a_is_what_its_makers_measured() -> None:
    dataset = load_dataset(REPO / "datasets" / "lab-a")
    assert len(dataset.pairs) == 8
    for pair in dataset.pairs:
        lens, _, pose = pair.pair_id.partition("-")
        assert pair.camera1.camera_id == pair.camera2.camera_id == lens
        assert str(pair.pose_type) == pose
        assert len(pair.truth.angles) == 3
        assert (pair.truth.baseline is not None) == (pose in ("standard", "forward"))
        pair.require_images()
    assert [p.pair_id for p in dataset.select(["fisheye-planar", "regular-forward"]).pairs] == [
        "regular-forward",
        "fisheye-planar",
    ]


def test_planes_are_of_all_pairs_or_of_one(tmp_path: Path) -> None:
    assert load_dataset(write(tmp_path, TEXT)).pairs[0].planes == "free"
    whole = TEXT.replace('name = "', 'planes = "coplanar"\nname = "', 1)
    assert load_dataset(write(tmp_path, whole)).pairs[0].planes == "coplanar"
    own = whole.replace("pose_type =", 'planes = "lattice"\npose_type =', 1)
    assert load_dataset(write(tmp_path, own)).pairs[0].planes == "lattice"
    with pytest.raises(InputError, match="free, coplanar, lattice"):
        load_dataset(write(tmp_path, whole.replace('"coplanar"', '"flat"')))


def test_a_camera_is_found_by_its_name() -> None:
    dataset = load_dataset(REPO / "datasets" / "lab-a")
    assert dataset.camera("fisheye").camera_id == "fisheye"
    with pytest.raises(InputError, match="regular"):
        dataset.camera("wide")
