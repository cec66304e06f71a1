"""F2UDIR and F3UDIR against the paper's 6x6 system and against crossing planes in space; degenerate directions."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.affine_scenes import FISHEYE, REGULAR, Corners, angles_deg, see, special_boards, turned
from helpers.tolerances import EXACT_REL

from rigkit.affine.affinities import EpipolarNormals
from rigkit.affine.normal import normals_from_affines
from rigkit.affine.registry import affines_from_directions
from rigkit.core.arrays import FloatArray
from rigkit.core.matches import DirectionPairs
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3, skew, unit

SAME_NORMAL_DEG = 1e-9
POSE = Rigid3(exp_so3(np.array([0.1, -0.3, 0.15])), [-260.0, 60.0, 90.0])
BOARD = Rigid3(exp_so3(np.array([0.5, -0.4, 0.3])), [-100.0, -140.0, 900.0])
STANDARD = Rigid3(np.eye(3), [-300.0, 0.0, 0.0])
FORWARD = Rigid3(np.eye(3), [0.0, 0.0, -300.0])


def epipolar_alignment(directions: DirectionPairs, epipolar: EpipolarNormals) -> FloatArray:
    """Return |unit(d2) . unit(n2)|, (N, K): 0 where a direction lies along its epipolar line and tells nothing."""
    d2, n2 = directions.image2, epipolar.n2[:, None, :]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(
            np.abs((d2 * n2).sum(-1)) / (np.hypot(d2[..., 0], d2[..., 1]) * np.hypot(n2[..., 0], n2[..., 1]))
        )


@pytest.fixture(params=[REGULAR, FISHEYE], ids=["pinhole", "fisheye"])
def corners(request: pytest.FixtureRequest) -> Corners:
    out = see(request.param, request.param, POSE, [BOARD])
    assert out is not None
    return out


def paper_system(d1: np.ndarray, d2: np.ndarray, n1: np.ndarray, n2: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The 6x6 system in (a1..a4, alpha_1, alpha_2): alpha_i d_i2 = A d_i1 and A^T n2 = -n1."""
    M = np.zeros((6, 6))
    for i in range(2):
        M[2 * i, :2] = M[2 * i + 1, 2:4] = d1[i]
        M[2 * i : 2 * i + 2, 4 + i] = -d2[i]
    M[4, [0, 2]] = M[5, [1, 3]] = n2
    return M, np.concatenate([np.zeros(4), -n1])


def test_equals_the_papers_system(corners: Corners, rng: np.random.Generator) -> None:
    """Also with noise: two directions determine A exactly, there is nothing to trade off."""
    directions = turned(corners.directions(), 3.0, rng)
    found = affines_from_directions(directions, "F2UDIR", epipolar=corners.epipolar, min_conditioning=0.0)
    for i in range(len(corners)):
        M, right = paper_system(directions.image1[i], directions.image2[i], corners.n1[i], corners.n2[i])
        expected = np.linalg.solve(M, right)[:4].reshape(2, 2)
        np.testing.assert_allclose(found.A21[i], expected, rtol=1e-7, atol=1e-9)


def test_determinant_of_the_papers_system(corners: Corners, rng: np.random.Generator) -> None:
    """|det| = |d2_1 . n2| |d2_2 . n2| |d1_1 x d1_2|: where the conditioning comes from."""
    directions = turned(corners.directions(), 3.0, rng)
    for i in range(len(corners)):
        d1, d2, n2 = directions.image1[i, :2], directions.image2[i, :2], corners.n2[i]
        M, _ = paper_system(d1, d2, corners.n1[i], n2)
        expected = abs(d2[0] @ n2) * abs(d2[1] @ n2) * abs(d1[0, 0] * d1[1, 1] - d1[0, 1] * d1[1, 0])
        assert abs(np.linalg.det(M)) == pytest.approx(expected, rel=EXACT_REL)


def test_equals_crossing_planes_in_space(corners: Corners, rng: np.random.Generator) -> None:
    """Two directions back-project to planes; they cross in the tangents; the tangents span the surface."""
    directions = turned(corners.directions(), 3.0, rng)
    tangents = []
    for k in range(2):
        planes = [
            np.einsum("nij,ni->nj", J, np.stack([-d[:, k, 1], d[:, k, 0]], axis=1))
            for J, d in ((corners.J1, directions.image1), (corners.J2, directions.image2))
        ]
        tangents.append(np.cross(*planes))
    crossing = unit(np.cross(tangents[0], tangents[1]))
    crossing *= -np.sign(np.sum(crossing * corners.points, axis=1, keepdims=True))
    found = affines_from_directions(directions, "F2UDIR", epipolar=corners.epipolar, min_conditioning=0.0)
    normals, valid = normals_from_affines(corners.J1, corners.J2, found.A21)
    assert valid.all()
    assert angles_deg(normals, crossing).max() < SAME_NORMAL_DEG * 10.0


def test_three_directions_minimise_the_angular_residual(corners: Corners, rng: np.random.Generator) -> None:
    directions = turned(corners.directions(), 3.0, rng)
    found = affines_from_directions(directions, "F3UDIR", epipolar=corners.epipolar)
    u1, u2 = unit(directions.image1), unit(directions.image2)
    n2 = unit(corners.n2)
    m = np.stack([-n2[:, 1], n2[:, 0]], axis=1)

    def cost(A: np.ndarray) -> np.ndarray:
        mapped = np.einsum("nij,nkj->nki", A, u1)
        return np.sum((u2[..., 0] * mapped[..., 1] - u2[..., 1] * mapped[..., 0]) ** 2, axis=1)

    best = cost(found.A21)
    assert np.abs(np.einsum("nij,ni->nj", found.A21, corners.n2) + corners.n1).max() < 1e-12 * np.abs(corners.n1).max()
    for _ in range(30):
        step = 0.01 * rng.normal(size=(len(corners), 2))
        assert (cost(found.A21 + m[:, :, None] * step[:, None, :]) >= best).all()


def test_soft_rows_tend_to_the_hard_ones(corners: Corners, rng: np.random.Generator) -> None:
    """On exact data both are exact; with noise the paper's soft rows no longer fulfil the epipolar equations."""
    e = corners.epipolar
    exact = affines_from_directions(corners.directions(), "F3UDIR", epipolar=e, epipolar_rows="soft")
    np.testing.assert_allclose(exact.A21, corners.A21, atol=1e-8)
    noisy = turned(corners.directions(), 3.0, rng)
    soft = affines_from_directions(noisy, "F3UDIR", epipolar=e, epipolar_rows="soft").A21
    hard = affines_from_directions(noisy, "F3UDIR", epipolar=e).A21
    assert np.nanmax(np.abs(soft - hard)) > 1e-3
    i = 11
    u1, u2 = unit(noisy.image1[i]), unit(noisy.image2[i])
    length = np.linalg.norm(corners.n2[i])
    rows = [np.outer([-b[1], b[0]], a).ravel() for a, b in zip(u1, u2, strict=True)]
    rows += [np.outer(corners.n2[i], axis).ravel() / length for axis in np.eye(2)]
    right = np.concatenate([np.zeros(3), -corners.n1[i] / length])
    np.testing.assert_allclose(soft[i].ravel(), np.linalg.lstsq(np.array(rows), right, rcond=None)[0], rtol=1e-8)


def test_normals_of_epipolar_lines_from_F_and_from_rays_agree() -> None:
    c = see(REGULAR, REGULAR, POSE, [BOARD])
    assert c is not None
    K_inv = np.linalg.inv(REGULAR.K)
    e = EpipolarNormals.from_F(K_inv.T @ skew(POSE.translation_mm) @ POSE.rotation @ K_inv, c.pixels1, c.pixels2)
    residual = np.einsum("nij,ni->nj", c.A21, e.n2) + e.n1
    assert np.abs(residual).max() < 1e-12 * np.abs(e.n2).max()
    np.testing.assert_allclose(unit(np.concatenate([e.n1, e.n2], 1)), unit(np.concatenate([c.n1, c.n2], 1)), atol=1e-10)


def along_the_edges(c: Corners) -> DirectionPairs:
    """Return the exact directions along the two edges of each square."""
    return DirectionPairs(
        image1=c.exact1[:, :2],
        image2=c.exact2[:, :2],
        valid=np.ones((len(c), 2), dtype=bool),
        scaled=True,
        kinds=("h", "v"),
    )


class TestDegenerateDirections:
    """Edges parallel to the baseline lie along their epipolar lines, wherever they are seen."""

    @staticmethod
    def scene(motion: Rigid3, turn_deg: float) -> Corners:
        out = see(REGULAR, REGULAR, motion, special_boards(turn_deg))
        assert out is not None
        return out

    @pytest.mark.parametrize(
        ("motion", "singular"), [(STANDARD, [0, 1]), (FORWARD, [1, 2])], ids=["standard", "forward"]
    )
    def test_which_planes_are_singular(self, motion: Rigid3, singular: list[int]) -> None:
        c = self.scene(motion, 0.0)
        aligned = epipolar_alignment(c.directions(), c.epipolar)[:, :2].min(axis=1)
        for plane in range(3):
            on = c.plane == plane
            if plane in singular:
                assert aligned[on].max() < 1e-9
            else:
                assert np.median(aligned[on]) > 0.05

    def test_two_directions_only_are_flagged(self) -> None:
        c = self.scene(STANDARD, 0.0)
        two = along_the_edges(c)
        found = affines_from_directions(two, "F2UDIR", epipolar=c.epipolar)
        assert not found.valid[c.plane <= 1].any()
        assert np.isnan(found.A21[c.plane <= 1]).all()
        assert found.valid[c.plane == 2].mean() > 0.8
        three = affines_from_directions(two, "F3UDIR", epipolar=c.epipolar)
        assert not three.valid[c.plane <= 1].any()
        assert (three.conditioning[c.plane <= 1] < 1e-7).all()

    def test_the_diagonal_steps_in(self, rng: np.random.Generator) -> None:
        c = self.scene(STANDARD, 0.0)
        found = affines_from_directions(turned(c.directions(), 0.05, rng), "F2UDIR", epipolar=c.epipolar)
        floor = c.plane == 1
        assert found.valid[floor].mean() > 0.5
        normals, valid = normals_from_affines(c.J1, c.J2, found.A21)
        assert np.median(angles_deg(normals, c.normals)[floor & valid]) < 3.0

    def test_without_the_limit_the_answer_is_noise(self, rng: np.random.Generator) -> None:
        """What the paper's formula does here: the error does not shrink with the noise."""
        c = self.scene(STANDARD, 0.0)
        directions = turned(c.directions(), 1e-4, rng)
        found = affines_from_directions(directions, "F2UDIR", epipolar=c.epipolar, min_conditioning=0.0)
        normals, valid = normals_from_affines(c.J1, c.J2, found.A21)
        assert np.median(angles_deg(normals, c.normals)[valid & (c.plane == 1)]) > 20.0

    def test_boards_turned_by_25_degrees_are_well(self) -> None:
        c = self.scene(STANDARD, 25.0)
        found = affines_from_directions(c.directions(), "F2UDIR", epipolar=c.epipolar)
        assert found.valid[c.plane == 0].all()
        assert found.valid[c.plane == 2].all()

    def test_conditioning_is_the_smaller_alignment_of_perpendicular_directions(self) -> None:
        c = self.scene(STANDARD, 25.0)
        two = along_the_edges(c)
        found = affines_from_directions(two, "F2UDIR", epipolar=c.epipolar, min_conditioning=0.0)
        # The board in front: its edges are perpendicular in the image too.
        on = c.plane == 0
        np.testing.assert_allclose(
            found.conditioning[on], epipolar_alignment(two, c.epipolar).min(axis=1)[on], rtol=1e-9
        )

    def test_epipole_is_invalid(self) -> None:
        c = self.scene(FORWARD, 25.0)
        n1, n2 = c.n1.copy(), c.n2.copy()
        n1[5] = n2[5] = 0.0
        found = affines_from_directions(c.directions(), "F3UDIR", epipolar=EpipolarNormals(n1, n2))
        assert not found.valid[5]
