"""The names that `import rigkit` offers, used as the README shows them."""

from __future__ import annotations

import ast
import inspect
import re
from pathlib import Path
from typing import get_type_hints

import numpy as np
from helpers.data import REPOSITORY

import rigkit
from rigkit.cli.main import VERBS

CAMERA = REPOSITORY / "calib" / "cameras" / "mvca020_fe185" / "calibration.json"
IMAGES = REPOSITORY / "datasets" / "lab-a" / "images" / "fisheye-standard"


def test_from_images_to_a_cloud_in_a_few_lines(tmp_path: Path) -> None:
    camera = rigkit.load_camera(CAMERA)
    boards = [rigkit.Board(name, 8, 6, 50.0, 50.0) for name in ("plane1", "plane2", "plane3")]
    found1, found2 = (
        rigkit.detect_boards(rigkit.read_image(IMAGES / f"view{n}.jpg"), boards, min_corners=12) for n in (1, 2)
    )
    pair = rigkit.match_pair("mine", camera, camera, found1, found2, boards)
    reconstruction = rigkit.reconstruct_pair(pair, pose_type="standard", affine_method="3SDIR")
    assert len(reconstruction.cloud) == 144
    # A rule said 300 +- 2 mm.
    assert abs(reconstruction.baseline_mm - 300.0) < 4.0
    rigkit.write_ply(tmp_path / "cloud.ply", reconstruction.cloud)
    again = rigkit.read_ply(tmp_path / "cloud.ply")
    assert np.array_equal(again.points_mm, reconstruction.cloud.points_mm)

    estimate = rigkit.fundamental_for("planar").solve(pair.matches, weights=None)
    assert np.linalg.norm(estimate.E21) == 1.0 or abs(np.linalg.norm(estimate.E21) - 1.0) < 1e-12
    affinities = rigkit.affines_from_directions(pair.directions, "3SDIR", F21=None)
    assert affinities.A21.shape == (144, 2, 2)
    assert affinities.valid.all()
    flat = rigkit.match_pair("mine", camera, camera, found1, found2, boards, chain="rectified")
    F21 = rigkit.fundamental_for("general").solve(flat.matches).F21
    with_F = rigkit.affines_from_directions(flat.directions, "F3UDIR", F21=F21)
    assert with_F.valid.sum() > 100


def test_rectification_of_points_and_images_agree() -> None:
    from rigkit.cameras.pinhole import Pinhole
    from rigkit.geometry.rotation import exp_so3

    camera = rigkit.load_camera(CAMERA)
    image = rigkit.read_image(IMAGES / "view1.jpg")
    target = Pinhole((1000, 800), np.array([560.0, 560.0, 499.5, 399.5]))
    remap = rigkit.rectify_map(camera, target, target_from_cam=exp_so3(np.array([0.3, 0.05, 0.0])))
    seen = rigkit.detect_boards(remap.image(image))
    pixels = np.concatenate([d.pixels for d in rigkit.detect_boards(image)])
    mapped, valid = remap.pixels(pixels)
    assert valid.all()
    found = np.concatenate([d.pixels for d in seen])
    near = np.linalg.norm(found[:, None] - mapped[None], axis=2).min(axis=1)
    assert len(found) == 144
    assert np.sqrt(np.mean(near**2)) < 0.1  # px: interpolation and a stretched view


def test_names_for_type_checkers_are_those_that_are_imported_on_first_use() -> None:
    """The stub that type checkers read is what the package reads, and nothing in it goes by another name."""
    tree = ast.parse(Path(str(rigkit.__file__)).with_suffix(".pyi").read_text(encoding="utf-8"))
    declared = {
        alias.name: node.module
        for node in tree.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
        if alias.asname == alias.name
    }
    assert declared == vars(rigkit)["_homes"]()
    assert sorted(declared) == rigkit.__all__ == sorted(set(dir(rigkit)) - {"__all__", "__version__"})


def test_types_of_public_names_can_be_read() -> None:
    """By tools that read annotations while the program runs: notebooks, forms, validators."""
    for name in rigkit.__all__:
        public = getattr(rigkit, name)
        inside = vars(public).values() if isinstance(public, type) else ()
        functions = [getattr(own, "fget", None) or getattr(own, "__func__", own) for own in inside]
        for annotated in (public, *filter(inspect.isfunction, functions)):
            get_type_hints(annotated)


def test_every_verb_has_its_functions_on_the_page_of_python() -> None:
    rows = re.findall(
        r"^\| (`\w+`.*) \| (.*) \|$", (REPOSITORY / "docs/pages/python.md").read_text("utf-8"), re.MULTILINE
    )
    verbs = {verb for reported, _ in rows for verb in re.findall(r"`(\w+)`", reported)}
    assert verbs == set(VERBS) - {"init", "schema"}
    functions = {name for _, reported in rows for name in re.findall(r"`(\w+)`", reported)}
    assert functions <= set(rigkit.__all__)


def test_the_version_is_the_installed_ones() -> None:
    assert tuple(int(part) for part in rigkit.__version__.split(".")[:2]) >= (0, 1)
