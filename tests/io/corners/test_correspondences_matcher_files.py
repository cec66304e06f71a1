"""Files of other matchers: equal matches for every naming; points without affinities get them from the images."""

from __future__ import annotations

import sqlite3
from pathlib import Path

import numpy as np
import pytest
from helpers.textured_scene import Corner

from rigkit.affine.correspondences import Correspondences
from rigkit.affine.features import match_affine_features, need_alignment, with_affinities
from rigkit.cameras.pinhole import Pinhole
from rigkit.core.errors import DegenerateError, InputError
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3
from rigkit.io.corners.correspondences import read_correspondences

COUNT = 40
IMAGES = ("left.png", "right.png")


@pytest.fixture
def points(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Keypoints of two images, of which the last 30 of the second are not matched, and which match."""
    first, second = rng.uniform(10.0, 300.0, (COUNT, 2)), rng.uniform(10.0, 300.0, (COUNT + 30, 2))
    return first, second, np.stack([np.arange(COUNT), rng.permutation(COUNT)], axis=1)


def test_arrays_of_matchers(tmp_path: Path, points: tuple[np.ndarray, np.ndarray, np.ndarray]) -> None:
    first, second, pairs = points
    partner = np.full(COUNT, -1)
    partner[::2] = pairs[::2, 1]
    even = pairs[::2]
    cases = {
        "lightglue": ({"keypoints0": first[None], "keypoints1": second[None], "matches": pairs}, pairs),
        "superglue": ({"keypoints0": first, "keypoints1": second, "matches0": partner}, even),
        "loftr": ({"mkpts0": first[pairs[:, 0]], "mkpts1": second[pairs[:, 1]], "mconf": np.ones(COUNT)}, pairs),
    }
    for name, (arrays, expected) in cases.items():
        np.savez(tmp_path / f"{name}.npz", **arrays)
        found = read_correspondences(tmp_path / f"{name}.npz")
        np.testing.assert_allclose(found.pixels1, first[expected[:, 0]])
        np.testing.assert_allclose(found.pixels2, second[expected[:, 1]])
        assert need_alignment(found)


def test_frames_give_affinities(tmp_path: Path, rng: np.random.Generator) -> None:
    first = rng.normal(size=(COUNT, 2, 3)) + np.eye(2, 3)
    A21 = np.eye(2) + 0.2 * rng.normal(size=(COUNT, 2, 2))
    second = np.concatenate([A21 @ first[..., :2], rng.normal(size=(COUNT, 2, 1))], axis=-1)
    np.savez(tmp_path / "lafs.npz", lafs0=first[None], lafs1=second[None])
    found = read_correspondences(tmp_path / "lafs.npz")
    assert found.A21 is not None
    np.testing.assert_allclose(found.A21, A21, atol=1e-9)
    np.testing.assert_allclose(found.pixels2, second[..., 2])
    assert need_alignment(found)


def database(path: Path, first: np.ndarray, second: np.ndarray, pairs: np.ndarray) -> None:
    """What COLMAP writes: the second image has the smaller number."""
    with sqlite3.connect(path) as db:
        db.execute("CREATE TABLE images (image_id INTEGER, name TEXT)")
        db.executemany("INSERT INTO images VALUES (?, ?)", [(7, f"a/{IMAGES[0]}"), (3, f"a/{IMAGES[1]}")])
        db.execute("CREATE TABLE keypoints (image_id INTEGER, rows INTEGER, cols INTEGER, data BLOB)")
        for k, values in ((7, first), (3, second)):
            blob = values.astype(np.float32).tobytes()
            db.execute("INSERT INTO keypoints VALUES (?, ?, ?, ?)", (k, *values.shape, blob))
        for table in ("matches", "two_view_geometries"):
            db.execute(f"CREATE TABLE {table} (pair_id INTEGER, rows INTEGER, cols INTEGER, data BLOB)")
        blob = pairs[:, ::-1].astype(np.uint32).tobytes()
        db.execute("INSERT INTO matches VALUES (?, ?, 2, ?)", (2147483647 * 3 + 7, len(pairs), blob))


@pytest.mark.parametrize("columns", [2, 4, 6])
def test_a_database_of_colmap(
    tmp_path: Path, points: tuple[np.ndarray, np.ndarray, np.ndarray], rng: np.random.Generator, columns: int
) -> None:
    first, second, pairs = points
    more = [np.column_stack([rng.uniform(1.0, 3.0, len(p)), rng.uniform(-3.0, 3.0, len(p))]) for p in (first, second)]
    if columns == 6:
        turned = [(m[:, 0] * np.cos(m[:, 1]), m[:, 0] * np.sin(m[:, 1])) for m in more]
        more = [np.column_stack([c, -s, s, c]) for c, s in turned]
    keypoints = [np.column_stack([p + 0.5, m])[:, :columns] for p, m in zip((first, second), more, strict=True)]
    database(tmp_path / "db.db", keypoints[0], keypoints[1], pairs)
    found = read_correspondences(tmp_path / "db.db", IMAGES)
    np.testing.assert_allclose(found.pixels1, first[pairs[:, 0]], atol=1e-4)
    np.testing.assert_allclose(found.pixels2, second[pairs[:, 1]], atol=1e-4)
    assert (found.A21 is None) == (columns == 2)
    if found.A21 is not None:
        # A similarity, by the ratio of the scales.
        ratio = np.linalg.norm(found.A21, axis=(1, 2)) / np.sqrt(2.0)
        size = [np.hypot(*m[:, [0, 2]].T) if columns == 6 else m[:, 0] for m in more]
        np.testing.assert_allclose(ratio, size[1][pairs[:, 1]] / size[0][pairs[:, 0]], rtol=1e-4)
    with pytest.raises(InputError, match="0 images called"):
        read_correspondences(tmp_path / "db.db", ("other.png", IMAGES[1]))
    with pytest.raises(InputError, match="give the two of the pair"):
        read_correspondences(tmp_path / "db.db")


def test_inconsistent_arrays_are_refused(tmp_path: Path, points: tuple[np.ndarray, np.ndarray, np.ndarray]) -> None:
    first, second, pairs = points
    for arrays, words in (
        ({"keypoints0": first, "keypoints1": second}, "must say which match"),
        ({"keypoints0": first, "keypoints1": second, "matches": pairs + COUNT}, "indices of"),
        ({"lafs0": np.zeros((4, 2, 2)), "lafs1": np.zeros((4, 2, 2))}, "local affine frames"),
    ):
        np.savez(tmp_path / "wrong.npz", **arrays)
        with pytest.raises(InputError, match=words):
            read_correspondences(tmp_path / "wrong.npz")
    (tmp_path / "wrong.db").write_bytes(b"SQLite format 3\x00" + bytes(200))
    with pytest.raises(InputError, match="no database of COLMAP's"):
        read_correspondences(tmp_path / "wrong.db", IMAGES)


def test_bare_points_get_their_affinities_from_the_images() -> None:
    rng = np.random.default_rng(3)
    corner, camera = Corner.of_a_room(), Pinhole((320, 240), np.array([280.0, 280.0, 159.5, 119.5]))
    turn = exp_so3(np.array([0.02, -0.2, 0.25]))
    poses = (Rigid3.identity(), Rigid3(turn, -turn @ [280.0, -30.0, 40.0]))
    images = [corner.image(camera, pose, rng) for pose in poses]
    known = match_affine_features(*images)
    rough = known.pixels2 + rng.normal(0.0, 0.7, known.pixels2.shape)
    found = with_affinities(Correspondences(known.pixels1, rough), *images)
    assert len(found) > 0.6 * len(known)
    expected, seen = camera.project(poses[1].apply(corner.surface(camera, found.pixels1)[0]))
    assert seen.all()
    assert np.median(np.linalg.norm(found.pixels2 - expected, axis=1)) < 0.1
    assert not need_alignment(found)
    flat = [np.full_like(image, 90) for image in images]
    with pytest.raises(DegenerateError, match="could be aligned"):
        with_affinities(Correspondences(known.pixels1, rough), *flat)


def test_images_without_texture_align_nothing(rng: np.random.Generator) -> None:
    flat, places = np.full((64, 64), 90, dtype=np.uint8), rng.uniform(20.0, 44.0, (8, 2))
    with pytest.raises(DegenerateError, match="none of 8 matches could be aligned"):
        with_affinities(Correspondences(places, places), flat, flat)
