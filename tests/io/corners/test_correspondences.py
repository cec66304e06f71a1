"""Correspondence files: read back exactly, AffineExtractor's layout, and refusals."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rigkit.affine.correspondences import Correspondences
from rigkit.cameras.pinhole import Pinhole
from rigkit.core.errors import InputError
from rigkit.core.matches import DirectionPairs
from rigkit.io.corners.correspondences import correspondences_text, read_correspondences

FIELDS = ("pixels1", "pixels2", "A21", "sigma_px", "sigma_A")


def example(rng: np.random.Generator, n: int = 7) -> Correspondences:
    A21 = np.eye(2) + 0.3 * rng.normal(size=(n, 2, 2))
    A21[2] = np.nan
    d1, d2 = rng.normal(size=(2, n, 3, 2))
    valid = np.ones((n, 3), dtype=bool)
    valid[1, 2] = False
    directions = DirectionPairs(image1=d1, image2=d2, valid=valid, scaled=False)
    q1, q2 = rng.uniform(0.0, 1000.0, (2, n, 2))
    return Correspondences(q1, q2, A21, directions, rng.uniform(0.1, 1.0, n), rng.uniform(0.01, 0.1, n))


def same(a: Correspondences, b: Correspondences) -> None:
    for name in FIELDS:
        first, second = getattr(a, name), getattr(b, name)
        assert (first is None) == (second is None)
        if first is not None:
            np.testing.assert_array_equal(first, second)
    assert (a.directions is None) == (b.directions is None)
    if a.directions is not None and b.directions is not None:
        np.testing.assert_array_equal(a.directions.valid, b.directions.valid)
        keep = a.directions.valid
        np.testing.assert_array_equal(a.directions.image1[keep], b.directions.image1[keep])
        np.testing.assert_array_equal(a.directions.image2[keep], b.directions.image2[keep])


def test_csv_comes_back_exactly(tmp_path: Path, rng: np.random.Generator) -> None:
    found = example(rng)
    (tmp_path / "a.csv").write_text(correspondences_text(found))
    same(read_correspondences(tmp_path / "a.csv"), found)


def test_points_alone(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("v1_px,u1_px,u2_px,v2_px\n2,1,3,4\n")
    found = read_correspondences(tmp_path / "a.csv")
    assert found.pixels1.tolist() == [[1.0, 2.0]]
    assert found.pixels2.tolist() == [[3.0, 4.0]]
    assert found.A21 is None
    assert found.directions is None


def test_npz(tmp_path: Path, rng: np.random.Generator) -> None:
    found = example(rng)
    assert found.directions is not None
    first = np.where(found.directions.valid[..., None], found.directions.image1, np.nan)
    arrays = {name: getattr(found, name) for name in FIELDS}
    np.savez(tmp_path / "a.npz", **arrays, directions1=first, directions2=found.directions.image2)
    same(read_correspondences(tmp_path / "a.npz"), found)


@pytest.mark.parametrize("separator", [" ", ", "])
def test_affine_extractor(tmp_path: Path, separator: str, rng: np.random.Generator) -> None:
    """a11 a21 a12 a22 tx ty x1 y1 x2 y2, with q2 = A q1 + t; x2, y2 keep the match from before the refinement."""
    n = 6
    A21 = np.eye(2) + 0.2 * rng.normal(size=(n, 2, 2))
    q1, q2 = rng.uniform(0.0, 1000.0, (2, n, 2))
    t = q2 - np.einsum("nij,nj->ni", A21, q1)
    columns = [A21[:, 0, 0], A21[:, 1, 0], A21[:, 0, 1], A21[:, 1, 1], *t.T, *q1.T, *(q2 + 1.5).T]
    lines = [separator.join(f"{value:.17e}" for value in row) for row in np.array(columns).T]
    (tmp_path / "AffsLK.txt").write_text("\n".join(lines) + "\n")
    found = read_correspondences(tmp_path / "AffsLK.txt")
    assert found.A21 is not None
    np.testing.assert_allclose(found.A21, A21, rtol=1e-15)
    np.testing.assert_allclose(found.pixels1, q1, rtol=1e-15)
    np.testing.assert_allclose(found.pixels2, q2, atol=1e-9)
    swapped = [
        separator.join(f"{value:.17e}" for value in row) for row in np.array(columns)[[0, 2, 1, 3, 4, 5, 8, 9, 6, 7]].T
    ]
    (tmp_path / "swapped.txt").write_text("\n".join(swapped))
    with pytest.raises(InputError, match="columns must be a11 a21 a12 a22"):
        read_correspondences(tmp_path / "swapped.txt")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "is empty"),
        ("u1_px,v1_px,u2_px\n1,2,3\n", "column 'v2_px' is missing"),
        ("u1_px,v1_px,u2_px,v2_px,a11\n1,2,3,4,5\n", "column 'a12' is missing"),
        ("u1_px,v1_px,u2_px,v2_px,a5\n1,2,3,4,5\n", "unknown column 'a5'"),
        ("u1_px,v1_px,u2_px,v2_px,v2_px\n1,2,3,4,5\n", "appears twice"),
        ("u1_px,v1_px,u2_px,v2_px\n1,2,3\n", "line 2: 3 cells, but the head has 4"),
        ("u1_px,v1_px,u2_px,v2_px\n1,2,x,4\n", "line 2: could not convert"),
        ("u1_px,v1_px,u2_px,v2_px\n1,2,,4\n", "NaN or infinite"),
        ("u1_px,v1_px,u2_px,v2_px,sigma_px\n1,2,3,4,0\n", "must be positive"),
        ("u1_px,v1_px,u2_px,v2_px,du1_1,dv1_1,du2_1\n1,2,3,4,5,6,7\n", "column 'dv2_1' is missing"),
        ("1 2 3\n", "without a header line ten are expected"),
    ],
)
def test_refused_in_words(tmp_path: Path, content: str, message: str) -> None:
    (tmp_path / "bad.csv").write_text(content)
    with pytest.raises(InputError, match=message) as caught:
        read_correspondences(tmp_path / "bad.csv")
    assert "bad.csv" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_other_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="check the path"):
        read_correspondences(tmp_path / "none.csv")
    (tmp_path / "image.csv").write_bytes(b"\x89PNG\xff\xfe")
    with pytest.raises(InputError, match="neither text nor NPZ"):
        read_correspondences(tmp_path / "image.csv")
    (tmp_path / "broken.npz").write_bytes(b"PK\x03\x04 nothing")
    with pytest.raises(InputError, match="damaged NPZ"):
        read_correspondences(tmp_path / "broken.npz")
    np.savez(tmp_path / "other.npz", points=np.zeros(3))
    with pytest.raises(InputError, match="unknown array 'points'"):
        read_correspondences(tmp_path / "other.npz")
    np.savez(tmp_path / "half.npz", pixels1=np.zeros((3, 2)))
    with pytest.raises(InputError, match="'pixels2' is missing"):
        read_correspondences(tmp_path / "half.npz")


def test_matches_leave_out_what_a_camera_does_not_see(rng: np.random.Generator) -> None:
    camera = Pinhole((1000, 1000), np.array([500.0, 500.0, 499.5, 499.5]))
    found = example(rng)
    matches, seen = found.matches(camera, camera)
    assert seen.all()
    np.testing.assert_array_equal(matches.pixels2, found.pixels2)
    np.testing.assert_array_equal(matches.sigma1_px, found.sigma_px)
    assert matches.A21 is not None
    assert len(found.select(np.arange(3)).matches(camera, camera)[0]) == 3
