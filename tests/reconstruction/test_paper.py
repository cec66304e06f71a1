"""The paper's pipeline: exact where its formulas are, five estimators that differ, errors as its inputs explain."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from helpers.tolerances import EXACT_REL

from rigkit.affine.registry import AFFINE_METHODS
from rigkit.cameras.pinhole import Pinhole
from rigkit.core.boards import Board
from rigkit.core.errors import InputError
from rigkit.core.posetype import PoseType
from rigkit.core.truth import MeasuredLength, PairTruth
from rigkit.geometry.rotation import rotation_angle
from rigkit.reconstruction.pairing import MatchedPair, match_pair
from rigkit.reconstruction.paper import MOTIONS, OWN_MOTIONS, reconstruct_as_paper
from rigkit.synthetic.pairs import StereoScene, trihedral_pair
from rigkit.validation.checks import validate

CAMERA = Pinhole((1624, 1240), np.array([1350.0, 1350.0, 805.0, 622.0]))
BOARDS = tuple(Board(name, 8, 6, 50.0, 50.0) for name in ("front", "floor", "right"))
KINDS = (PoseType.GENERAL, PoseType.PLANAR, PoseType.STANDARD, PoseType.FORWARD)
EXACT_DEG = 1e-4
"""Identification needs a sigma; with corners right to 1e-9 px nothing else is left."""


def made_pair(kind: PoseType, seed: int = 3) -> tuple[MatchedPair, StereoScene]:
    scene = trihedral_pair(BOARDS, CAMERA, kind, np.random.default_rng(seed))
    return match_pair("pair", CAMERA, CAMERA, *scene.detections(), BOARDS), scene


@pytest.mark.parametrize("motions", [MOTIONS, OWN_MOTIONS], ids=["as printed", "own solvers"])
@pytest.mark.parametrize("kind", KINDS)
def test_exact_corners_give_the_exact_pose_by_points_and_exact_affinities(kind: PoseType, motions: object) -> None:
    """Chords have the exact angle, so F2UDIR has exact affinities, and with them every constrained solver is exact."""
    pair, scene = made_pair(kind)
    found = reconstruct_as_paper(pair, pose_type=kind, affine_method="F2UDIR", motions=motions)  # type: ignore[arg-type]
    truth = scene.cam2_from_cam1
    assert np.rad2deg(rotation_angle(found.cam2_from_cam1.rotation @ truth.rotation.T)) < EXACT_DEG
    assert found.cam2_from_cam1.translation_mm == pytest.approx(truth.translation_mm, abs=1e-3)
    assert found.pose_covariance is None


def test_the_five_estimators_differ_in_pose_and_normals() -> None:
    """Chords' lengths are wrong to first order, and equal weights let every affinity pull the pose its own way."""
    pair, _ = made_pair(PoseType.PLANAR)
    rng = np.random.default_rng(0)
    first, second = (
        [
            replace(d, pixels=d.pixels + 0.1 * rng.normal(size=d.pixels.shape), sigma_px=np.full(len(d.grid), 0.1))
            for d in some
        ]
        for some in (pair.identity.detections1, pair.identity.detections2)
    )
    pair = match_pair("pair", CAMERA, CAMERA, first, second, BOARDS)
    reports = []
    for method in AFFINE_METHODS:
        found = reconstruct_as_paper(pair, pose_type=PoseType.PLANAR, affine_method=method)
        truth = PairTruth(MeasuredLength(300.0, 2.0, "rule"))
        reports.append(validate(found, truth, weighted=False))
    for one, other in combinations(reports, 2):
        assert abs(one.baseline_mm - other.baseline_mm) > 1e-4
        assert abs(one.boards[0].normal_errors.mean_deg - other.boards[0].normal_errors.mean_deg) > 1e-4


def test_planes_are_principal_components_of_all_points() -> None:
    pair, _ = made_pair(PoseType.GENERAL)
    found = reconstruct_as_paper(pair, pose_type="general", affine_method="2SDIR")
    report = validate(found, PairTruth(MeasuredLength(found.baseline_mm, 2.0, "rule")), weighted=False)
    for index, board in enumerate(report.boards):
        points = found.cloud.points_mm[found.cloud.board_index == index]
        normal = np.linalg.svd(points - points.mean(axis=0))[2][2]
        assert abs(normal @ board.plane.normal) == pytest.approx(1.0, abs=EXACT_REL)
        assert board.plane.used.all()


def test_a_pose_type_must_be_declared() -> None:
    pair, _ = made_pair(PoseType.GENERAL)
    with pytest.raises(InputError, match="declared pose type"):
        reconstruct_as_paper(pair, pose_type="auto", affine_method="2SDIR")
