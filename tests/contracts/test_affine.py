"""What every affine estimator of the registry must do."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.affine_scenes import FISHEYE, REGULAR, Corners, see, turned
from helpers.tolerances import EXACT_REL

from rigkit.affine.affinities import DirectionNoise, EpipolarNormals
from rigkit.affine.registry import AFFINE_METHODS, affines_from_directions, needs_epipolar
from rigkit.core.errors import InputError
from rigkit.core.matches import DirectionPairs
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3

POSE = Rigid3(exp_so3(np.array([0.1, -0.3, 0.15])), [-260.0, 60.0, 90.0])
BOARDS = [
    Rigid3(exp_so3(np.array([0.5, -0.4, 0.3])), [-100.0, -140.0, 900.0]),
    Rigid3(exp_so3(np.array([-0.3, 0.5, -1.2])), [-80.0, 160.0, 1000.0]),
]
METHODS = pytest.mark.parametrize("method", AFFINE_METHODS)
COVARIANT = pytest.mark.parametrize("method", ["F2UDIR", "2SDIR", "3SDIR"])
MC_RELATIVE = 0.12
"""Second moments of 4000 trials have a standard error of 2 to 3 %; first order is good to a few per cent here."""


@pytest.fixture(params=[REGULAR, FISHEYE], ids=["pinhole", "fisheye"])
def corners(request: pytest.FixtureRequest) -> Corners:
    out = see(request.param, request.param, POSE, BOARDS)
    assert out is not None
    return out


@METHODS
def test_exact_directions_give_the_exact_affinity(method: str, corners: Corners) -> None:
    found = affines_from_directions(corners.directions(), method, epipolar=corners.epipolar, min_conditioning=0.0)
    assert found.valid.all()
    error = np.abs(found.A21 - corners.A21).max(axis=(1, 2))
    assert (error * found.conditioning**2 < EXACT_REL).all()
    assert len(found) == len(corners)


@METHODS
def test_one_corner_is_the_same_as_many(method: str, corners: Corners, rng: np.random.Generator) -> None:
    directions = turned(corners.directions(), 2.0, rng)
    many = affines_from_directions(directions, method, epipolar=corners.epipolar)
    for i in (0, 17, len(corners) - 1):
        one = DirectionPairs(
            image1=directions.image1[i : i + 1], image2=directions.image2[i : i + 1], valid=directions.valid[i : i + 1]
        )
        e = EpipolarNormals(corners.n1[i : i + 1], corners.n2[i : i + 1])
        np.testing.assert_array_equal(affines_from_directions(one, method, epipolar=e).A21[0], many.A21[i])


@METHODS
def test_no_corners(method: str) -> None:
    empty = DirectionPairs(image1=np.zeros((0, 3, 2)), image2=np.zeros((0, 3, 2)), valid=np.zeros((0, 3), dtype=bool))
    found = affines_from_directions(empty, method, epipolar=EpipolarNormals(np.zeros((0, 2)), np.zeros((0, 2))))
    assert found.A21.shape == (0, 2, 2)


@METHODS
def test_blocks_join_seamlessly(method: str, corners: Corners, rng: np.random.Generator) -> None:
    repeat = np.tile(np.arange(len(corners)), 300)
    assert len(repeat) > 20000
    big = corners.select(repeat)
    directions = turned(corners.directions(), 2.0, rng)
    tiled = DirectionPairs(
        image1=directions.image1[repeat], image2=directions.image2[repeat], valid=directions.valid[repeat]
    )
    few = affines_from_directions(directions, method, epipolar=corners.epipolar)
    many = affines_from_directions(tiled, method, epipolar=big.epipolar)
    np.testing.assert_array_equal(many.A21, few.A21[repeat])
    np.testing.assert_array_equal(many.conditioning, few.conditioning[repeat])


@METHODS
def test_lengths_matter_only_where_they_should(method: str, corners: Corners, rng: np.random.Generator) -> None:
    directions = turned(corners.directions(), 2.0, rng)
    factor = rng.uniform(0.3, 3.0, (len(corners), 3, 1))
    stretched = DirectionPairs(image1=directions.image1, image2=directions.image2 * factor, valid=directions.valid)
    before = affines_from_directions(directions, method, epipolar=corners.epipolar).A21
    after = affines_from_directions(stretched, method, epipolar=corners.epipolar).A21
    if not needs_epipolar(method):
        assert np.nanmedian(np.abs(before - after)) > 0.01
    else:
        np.testing.assert_allclose(after, before, rtol=1e-7)


@METHODS
def test_the_epipolar_geometry_has_no_scale(method: str, corners: Corners) -> None:
    scaled = EpipolarNormals(-7e4 * corners.n1, -7e4 * corners.n2)
    directions = corners.directions()
    first = affines_from_directions(directions, method, epipolar=corners.epipolar)
    second = affines_from_directions(directions, method, epipolar=scaled)
    np.testing.assert_allclose(second.A21, first.A21, rtol=1e-9)


@METHODS
def test_bad_directions_are_left_out(method: str, corners: Corners) -> None:
    first, second = corners.exact1.copy(), corners.exact2.copy()
    valid = np.ones(first.shape[:2], dtype=bool)
    second[0, 1] = np.nan
    first[1, 2] = 0.0
    valid[2, 0] = False
    valid[3] = False
    first[4, :2] = np.nan
    directions = DirectionPairs(image1=first, image2=second, valid=valid)
    found = affines_from_directions(directions, method, epipolar=corners.epipolar, min_conditioning=0.0)
    enough = {True: 3, False: 2}[method == "DET3UDIR"]
    assert found.valid[:5].tolist() == [enough == 2] * 3 + [False, False]
    assert np.isnan(found.A21[~found.valid]).all()
    good = found.valid
    assert good.sum() >= len(corners) - 5
    error = np.abs(found.A21 - corners.A21).max(axis=(1, 2))[good]
    assert (error * found.conditioning[good] ** 2 < EXACT_REL).all()


@METHODS
def test_parallel_directions_are_invalid(method: str, corners: Corners) -> None:
    first, second = corners.exact1.copy(), corners.exact2.copy()
    first[7], second[7] = (
        first[7, :1] * np.array([[1.0], [2.0], [-1.0]]),
        second[7, :1] * np.array([[1.0], [2.0], [-1.0]]),
    )
    directions = DirectionPairs(image1=first, image2=second, valid=np.ones(first.shape[:2], dtype=bool))
    found = affines_from_directions(directions, method, epipolar=corners.epipolar)
    assert not found.valid[7]
    assert not found.conditioning[7] > 1e-6
    assert np.isnan(found.A21[7]).all()


@COVARIANT
def test_covariant_under_linear_changes_of_the_pixels(method: str, corners: Corners, rng: np.random.Generator) -> None:
    """d1' = L1 d1, d2' = L2 d2, n1' = L1^-T n1, n2' = L2^-T n2 must give L2 A L1^-1, with noisy directions too."""
    L1, L2 = np.eye(2) + 0.4 * rng.normal(size=(2, 2, 2))
    directions = turned(corners.directions(), 3.0, rng)
    changed = DirectionPairs(image1=directions.image1 @ L1.T, image2=directions.image2 @ L2.T, valid=directions.valid)
    epipolar = EpipolarNormals(corners.n1 @ np.linalg.inv(L1), corners.n2 @ np.linalg.inv(L2))
    before = affines_from_directions(directions, method, epipolar=corners.epipolar, min_conditioning=0.0).A21
    after = affines_from_directions(changed, method, epipolar=epipolar, min_conditioning=0.0).A21
    expected = L2 @ before @ np.linalg.inv(L1)
    scale = np.abs(expected).max(axis=(1, 2), keepdims=True)
    np.testing.assert_allclose((after - expected) / scale, 0.0, atol=1e-7)


@pytest.mark.parametrize("method", ["F3UDIR", "DET3UDIR"])
def test_least_squares_of_angles_is_not_covariant(method: str, corners: Corners, rng: np.random.Generator) -> None:
    """Over-determined angular least squares depends on the pixels' metric: it must be done in pixels, not elsewhere."""
    L = np.array([[1.0, 0.3], [0.0, 0.4]])
    directions = turned(corners.directions(), 3.0, rng)
    if method == "DET3UDIR":
        more = [np.concatenate([d, d[:, :1] - d[:, 1:2]], axis=1) for d in (directions.image1, directions.image2)]
        directions = DirectionPairs(
            image1=more[0], image2=more[1], valid=np.ones((len(corners), 4), dtype=bool), kinds=("h", "v", "d", "e")
        )
    changed = DirectionPairs(
        image1=directions.image1 @ L.T,
        image2=directions.image2 @ L.T,
        valid=directions.valid,
        scaled=True,
        kinds=directions.kinds,
    )
    epipolar = EpipolarNormals(corners.n1 @ np.linalg.inv(L), corners.n2 @ np.linalg.inv(L))
    before = affines_from_directions(directions, method, epipolar=corners.epipolar).A21
    after = affines_from_directions(changed, method, epipolar=epipolar).A21
    assert np.nanmedian(np.abs(after - L @ before @ np.linalg.inv(L))) > 1e-4


@METHODS
def test_input_is_not_changed(method: str, corners: Corners) -> None:
    directions = corners.directions()
    copies = [v.copy() for v in (directions.image1, directions.image2, corners.n1, corners.n2)]
    affines_from_directions(directions, method, epipolar=corners.epipolar)
    for now, before in zip((directions.image1, directions.image2, corners.n1, corners.n2), copies, strict=True):
        np.testing.assert_array_equal(now, before)


@pytest.mark.parametrize(
    ("method", "scale"),
    [*((m, "area") for m in AFFINE_METHODS), ("DET3UDIR", "ls"), ("DET3UDIR", "sqmean"), ("DET3UDIR", "diagonal")],
)
def test_predicted_covariance_agrees_with_monte_carlo(
    method: str, scale: str, corners: Corners, rng: np.random.Generator
) -> None:
    """Directions with unequal, correlated noise, the diagonal being the sum of the edges, as on a chessboard."""
    trials = 4000
    found = affines_from_directions(corners.directions(), method, epipolar=corners.epipolar)
    # Biased scales have covariances about their own answers: they are tried where they are right, nearly a similarity.
    spread = np.linalg.cond(corners.A21)
    pick = int(np.argmin(spread)) if scale in ("sqmean", "diagonal") else int(np.nanargmax(found.conditioning))
    chosen = np.full(trials, pick)
    halves = 0.1 * np.array([[[1.0, 0.0], [0.3, 0.5]], [[0.7, 0.2], [0.0, 0.9]]])
    joint = np.concatenate(
        [np.concatenate([halves[0], 0.02 * np.eye(2)], 1), np.concatenate([0.0 * halves[0], halves[1]], 1)]
    )
    edges = joint @ joint.T
    noise = DirectionNoise(np.tile(edges, (1, 1, 1)), np.tile(0.5 * edges, (1, 1, 1))).with_sum(0, 1)
    one = corners.select(np.array([pick]))
    predicted = affines_from_directions(
        one.directions(), method, epipolar=one.epipolar, noise=noise, scale=scale, min_conditioning=0.0
    )
    assert predicted.covariance is not None
    c = corners.select(chosen)
    images = []
    for exact, factor in ((c.exact1, 1.0), (c.exact2, np.sqrt(0.5))):
        draw = factor * (rng.normal(size=(trials, 4)) @ joint.T).reshape(trials, 2, 2)
        images.append(exact + np.concatenate([draw, draw.sum(axis=1, keepdims=True)], axis=1))
    noisy = DirectionPairs(image1=images[0], image2=images[1], valid=np.ones((trials, 3), dtype=bool))
    sample = affines_from_directions(noisy, method, epipolar=c.epipolar, scale=scale, min_conditioning=0.0)
    assert sample.valid.all()
    measured = np.cov(sample.A21.reshape(-1, 4).T)
    size = np.trace(measured)
    assert np.abs(np.trace(predicted.covariance[0]) / size - 1.0) < MC_RELATIVE
    assert np.abs(predicted.covariance[0] - measured).max() < MC_RELATIVE * size
    assert predicted.sigma_A is not None
    assert predicted.sigma_A[0] == pytest.approx(np.sqrt(size / 4.0), rel=MC_RELATIVE)


def test_covariance_is_nan_where_invalid_and_ignores_noise_of_unused_directions(corners: Corners) -> None:
    directions = corners.directions()
    valid = directions.valid.copy()
    valid[0] = False
    valid[1, 2] = False
    some = DirectionPairs(image1=directions.image1, image2=directions.image2, valid=valid)
    blocks = np.tile(0.01 * np.eye(2), (len(corners), 3, 1, 1))
    blocks[1, 2] = np.nan
    noise = DirectionNoise.independent(blocks, blocks)
    for method in ("F3UDIR", "3SDIR"):
        found = affines_from_directions(some, method, epipolar=corners.epipolar, noise=noise)
        assert found.covariance is not None
        assert np.isnan(found.covariance[0]).all()
        assert np.isfinite(found.covariance[1]).all()


def test_misuse_is_refused_in_words(corners: Corners) -> None:
    directions = corners.directions()
    unscaled = DirectionPairs(image1=directions.image1, image2=directions.image2, valid=directions.valid, scaled=False)
    two = DirectionPairs(
        image1=directions.image1[:, :2],
        image2=directions.image2[:, :2],
        valid=directions.valid[:, :2],
        scaled=True,
        kinds=("h", "v"),
    )
    e = corners.epipolar
    cases: list[tuple[DirectionPairs, str, dict[str, object], str]] = [
        (directions, "4SDIR", {}, "unknown; known: F2UDIR"),
        (directions, "F2UDIR", {}, "needs the epipolar geometry"),
        (unscaled, "2SDIR", {}, "needs the lengths"),
        (unscaled, "DET3UDIR", {}, "needs the lengths"),
        (two, "DET3UDIR", {}, "needs 3 directions"),
        (directions, "DET3UDIR", {"scale": "mean"}, "affine scale 'mean' is unknown"),
        (directions, "F3UDIR", {"epipolar": e, "epipolar_rows": "firm"}, "known: hard, soft"),
        (directions, "F3UDIR", {"epipolar": EpipolarNormals(corners.n1[:5], corners.n2[:5])}, "epipolar normals of 5"),
    ]
    for pairs, method, options, message in cases:
        with pytest.raises(InputError, match=message):
            affines_from_directions(pairs, method, **options)  # type: ignore[arg-type]
    assert affines_from_directions(unscaled, "F3UDIR", epipolar=e).valid.all()
    assert affines_from_directions(unscaled, "DET3UDIR", determinant=np.linalg.det(corners.A21)).valid.all()


def test_the_registry_knows_what_each_needs() -> None:
    assert [m for m in AFFINE_METHODS if needs_epipolar(m)] == ["F2UDIR", "F3UDIR"]
    assert [m for m in AFFINE_METHODS if not needs_epipolar(m)] == ["DET3UDIR", "2SDIR", "3SDIR"]
