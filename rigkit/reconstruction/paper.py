"""The pipeline of the paper, to compare rigkit's own with what was published.

L. Hajder, "Affine Correspondences in Stereo Vision: Theory, Practice, and Limitations". Points give F. Chords to the
neighbouring corners and F give an affinity at every corner. Points and affinities, equally weighted, give F again by a
linear solver that is constrained by the pose type. The points are triangulated, and the squares give the scale. Nothing
is refined or weighted by noise, and no uncertainty is predicted. The formulas are the corrected ones, marked `Erratum:`
where they are implemented.

The paper uses the planar solver for standard and forward pairs too (`MOTIONS`). `OWN_MOTIONS` uses the solvers that are
constrained to these pose types.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from rigkit.affine.affinities import Affinities, EpipolarNormals
from rigkit.affine.registry import affines_from_directions, needs_epipolar
from rigkit.core.errors import DegenerateError, InputError
from rigkit.core.posetype import PoseType
from rigkit.geometry.rigid3 import Rigid3
from rigkit.reconstruction.metric import triangulate_matches
from rigkit.reconstruction.pairing import MatchedPair
from rigkit.reconstruction.reconstruct import Reconstruction, colours_at, oriented_cloud
from rigkit.reconstruction.scale import metric_scale
from rigkit.relative_pose.solvers.pose import choose_pose
from rigkit.relative_pose.solvers.registry import fundamental_for

MOTIONS: Mapping[PoseType, str] = {
    PoseType.GENERAL: "general",
    PoseType.PLANAR: "planar",
    PoseType.STANDARD: "planar",
    PoseType.FORWARD: "planar",
}
"""The paper's solver for each pose type."""
OWN_MOTIONS: Mapping[PoseType, str] = {**MOTIONS, PoseType.STANDARD: "standard-rows", PoseType.FORWARD: "forward-roll"}
"""The most constrained solver for each pose type."""
PAPER_SCALE = "sqmean"
"""The scale that the paper uses in DET3UDIR."""


def reconstruct_as_paper(
    pair: MatchedPair, *, pose_type: PoseType | str, affine_method: str, motions: Mapping[PoseType, str] = MOTIONS
) -> Reconstruction:
    """Reconstruct a pair by the paper's pipeline with one affine estimator.

    Raises InputError for pose type AUTO; DegenerateError if the geometry does not determine the pose, or no corner has
    both a point and a normal.

    Parameters
    ----------
    pair : matched corners; their directions are estimated again, as chords to the neighbours.
    pose_type : as declared; the paper has no way to choose one.
    affine_method : see `rigkit.affine.registry.AFFINE_METHODS`.
    motions : solver that re-estimates the epipolar geometry, by pose type.
    """
    kind = PoseType(pose_type)
    if kind not in motions:
        raise InputError(f"pair '{pair.pair_id}': the paper's pipeline needs a declared pose type, not '{kind}'")
    chords = pair.in_chain(pair.chain, support="chord")
    m = chords.matches
    try:
        affinities = _affinities(chords, affine_method)
        with_affinities = m.with_affinities(affinities.A21, None)
        estimate = fundamental_for(kind, motion=motions[kind]).solve(with_affinities, "equal")
        allowed = PoseType.PLANAR if motions[kind] == "planar" else kind
        pose = choose_pose(estimate.E21, m.rays1, m.rays2, allowed)
        metric = _in_mm(pair, pose)
        # The pipeline predicts no covariance of the pose: sigmas are those of the corners alone.
        cloud, kept = oriented_cloud(
            triangulate_matches(pair.captured, metric),
            m,
            metric,
            np.zeros((6, 6)),
            affinities,
            colours=colours_at(None, pair.captured.pixels1),
            board_ids=tuple(board.board_id for board in pair.boards),
        )
    except DegenerateError as error:
        raise DegenerateError(f"pair '{pair.pair_id}', {affine_method}: {error}") from error
    return Reconstruction(
        pair_id=pair.pair_id,
        pose_type=kind,
        affine_method=affine_method,
        camera1=pair.camera1,
        camera2=pair.camera2,
        boards=pair.boards,
        matches=with_affinities.select(kept),
        pixels1=pair.captured.pixels1[kept],
        pixels2=pair.captured.pixels2[kept],
        cam2_from_cam1=metric,
        pose_covariance=None,
        E21=estimate.E21,
        cloud=cloud,
        baseline_mm=float(np.linalg.norm(metric.translation_mm)),
        baseline_sigma_mm=float("nan"),
        sampson_rms_px=float(np.sqrt(np.mean(estimate.residuals_px**2))),
        notes=pair.notes,
    )


def _in_mm(pair: MatchedPair, pose: Rigid3) -> Rigid3:
    """Return a pose of unit baseline in mm, scaled by the boards' squares with equal weights."""
    points = triangulate_matches(pair.captured, pose).points
    scale, _, _ = metric_scale(points, pair.captured.board_index, pair.captured.grid, pair.boards)
    return Rigid3(pose.rotation, scale * pose.translation_mm)


def _affinities(chords: MatchedPair, method: str) -> Affinities:
    """Return the affinities at the corners; directions along their epipolar lines are kept.

    Notes
    -----
    The first F is that of general motion, whatever the pose type. Affinities of F2UDIR and F3UDIR fulfil the geometry
    that they were computed with, so re-estimation with the same solver only returns it, contrary to what the paper
    hopes. F3UDIR stacks its epipolar rows with the directions in least squares, as printed.
    """
    epipolar = None
    if needs_epipolar(method):
        E21 = fundamental_for("general").solve(chords.matches, "equal").E21
        epipolar = EpipolarNormals.of_matches(chords.matches, E21)
    return affines_from_directions(
        chords.directions, method, epipolar=epipolar, scale=PAPER_SCALE, epipolar_rows="soft", min_conditioning=0.0
    )
