"""From matched corners of a pair to an oriented cloud in millimetres: the pose-type-aware pipeline.

Points give the epipolar geometry; directions (and, for F2UDIR and F3UDIR, that geometry) give an affinity at every
corner; affinities and epipolar geometry give normals.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from rigkit.affine.affinities import Affinities, EpipolarNormals
from rigkit.affine.geometry_noise import geometry_covariance
from rigkit.affine.normal import estimate_normals
from rigkit.affine.registry import affines_from_directions, needs_epipolar
from rigkit.cameras.base import Camera
from rigkit.cameras.uncertain import UncertainCamera
from rigkit.core.arrays import Affines, BoolArray, FloatArray, Mat3, Pixels, RayJacobians, Rays, in_8_bits
from rigkit.core.boards import Board
from rigkit.core.cloud import OrientedCloud
from rigkit.core.errors import DegenerateError, InputError
from rigkit.core.matches import Matches
from rigkit.core.planes import PLANE_CHOICES, Planes
from rigkit.core.posetype import PoseType
from rigkit.core.printing import brief, drawn
from rigkit.geometry.projection_jacobian import pair_projection_jacobians
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.sampson import sampson_of_matches
from rigkit.reconstruction.board_planes import BoardPlanes
from rigkit.reconstruction.coplanar_planes import coplanar_planes
from rigkit.reconstruction.geometry import PairGeometry, pair_geometry
from rigkit.reconstruction.lattice_planes import lattice_planes
from rigkit.reconstruction.metric import TriangulatedPoints
from rigkit.relative_pose.solvers.pose import essential_from_pose

if TYPE_CHECKING:
    from rigkit.reconstruction.pairing import MatchedPair

GREY = 160


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Reconstruction:
    """What the pipeline found for one pair with one affine estimator.

    Attributes
    ----------
    pair_id : name of the pair.
    pose_type : the pose type used (never AUTO).
    affine_method : "F2UDIR", "F3UDIR", "DET3UDIR", "2SDIR" or "3SDIR".
    camera1, camera2 : the calibrated cameras of the two images.
    boards : the boards reconstructed, in the order of `matches.board_index`.
    matches : points and affinities in the coordinates that the pipeline worked in (rectified views or raw pixels).
    pixels1, pixels2 : (N, 2) the same corners in the two images as captured.
    cam2_from_cam1 : relative pose, metric.
    pose_covariance : (6, 6) of (left rotation perturbation rad, translation mm), or None.
    E21 : (3, 3) essential matrix, unit Frobenius norm.
    cloud : points and normals in the frame of camera 1; row n belongs to match n.
    baseline_mm, baseline_sigma_mm : length of the translation and its predicted standard deviation.
    sampson_rms_px : rms Sampson distance of the corners from the epipolar geometry.
    notes : what was dropped, assumed or contradicted, in words.
    level_sigma_rad : how well the pose type was taken to hold in the refinement; None: exactly, or it is general.
    geometry, kept : of a pair with boards: what all its estimators share, and which (M,) of its corners have a normal
        by this one. None for other scenes.
    """

    pair_id: str
    pose_type: PoseType
    affine_method: str
    camera1: Camera
    camera2: Camera
    boards: tuple[Board, ...]
    matches: Matches
    pixels1: Pixels
    pixels2: Pixels
    cam2_from_cam1: Rigid3
    pose_covariance: FloatArray | None
    E21: Mat3
    cloud: OrientedCloud
    baseline_mm: float
    baseline_sigma_mm: float
    sampson_rms_px: float
    notes: tuple[str, ...] = ()
    level_sigma_rad: float | None = None
    geometry: PairGeometry | None = None
    kept: BoolArray | None = None

    __repr__ = brief
    _repr_html_ = drawn

    def measured_rays(self) -> tuple[Rays, Rays, RayJacobians, RayJacobians]:
        """Return the rays of `pixels1` and of `pixels2`, and their derivatives by the pixels."""
        rays1, _, jacobians1 = self.camera1.rays_and_jacobians(self.pixels1)
        rays2, _, jacobians2 = self.camera2.rays_and_jacobians(self.pixels2)
        return rays1, rays2, jacobians1, jacobians2

    def same_points(self, other: Reconstruction) -> bool:
        """Return whether both have the very same points: of one geometry, and the same corners."""
        if self.geometry is None or self.kept is None or other.kept is None:
            return self is other
        return self.geometry is other.geometry and np.array_equal(self.kept, other.kept)


def reconstruct_pair(
    pair: MatchedPair,
    *,
    pose_type: PoseType | str,
    affine_method: str = "3SDIR",
    level_sigma_rad: float | None = None,
    scale: str = "area",
    image1: NDArray[np.generic] | None = None,
    planes: Planes = "free",
) -> Reconstruction:
    """Reconstruct one pair with one affine estimator: `pair_geometry`, then `reconstruct_from`.

    Parameters, errors : of those two. For several estimators compute the geometry once. With other `planes`
    than "free" the points and normals are those of the boards' planes (`on_planes`), the intrinsics exact.
    """
    if planes not in PLANE_CHOICES:
        raise InputError(f"planes: '{planes}' is unknown; known: {', '.join(PLANE_CHOICES)}")
    geometry = pair_geometry(pair, pose_type=pose_type, level_sigma_rad=level_sigma_rad)
    free = reconstruct_from(geometry, affine_method=affine_method, scale=scale, image1=image1)
    return free if planes == "free" else on_planes(free, fit_planes(geometry, planes))


def reconstruct_from(
    geometry: PairGeometry,
    *,
    affine_method: str = "3SDIR",
    scale: str = "area",
    image1: NDArray[np.generic] | None = None,
) -> Reconstruction:
    """Return the oriented cloud of a pair by one affine estimator.

    Raises DegenerateError: no corner has both a point and a normal.

    Parameters
    ----------
    geometry : pose and points, from `pair_geometry`.
    affine_method : see `rigkit.affine.registry.AFFINE_METHODS`.
    scale : of DET3UDIR, see `affines_from_directions`.
    image1 : image of camera 1, (H, W) or (H, W, 3) RGB, uint8 or uint16: colours of the cloud.
    """
    pair, metric = geometry.pair, geometry.metric
    affinities = _affinities(pair, affine_method, geometry.E21, scale)
    matches = pair.matches.with_affinities(affinities.A21, affinities.sigma_A)
    cloud, kept = _cloud(geometry, affinities, affine_method, image1)
    notes = geometry.notes
    if not kept.all():
        lost = int((~kept).sum())
        notes = (*notes, f"{lost} of {len(kept)} corners have no {affine_method} normal or point and were left out")
    return Reconstruction(
        pair_id=pair.pair_id,
        pose_type=geometry.pose_type,
        affine_method=affine_method,
        camera1=pair.camera1,
        camera2=pair.camera2,
        boards=pair.boards,
        matches=matches.select(kept),
        pixels1=pair.captured.pixels1[kept],
        pixels2=pair.captured.pixels2[kept],
        cam2_from_cam1=metric.cam2_from_cam1,
        pose_covariance=metric.covariance,
        E21=geometry.E21,
        cloud=cloud,
        baseline_mm=metric.baseline_mm,
        baseline_sigma_mm=metric.baseline_sigma_mm,
        sampson_rms_px=geometry.refined.sampson_rms_px,
        notes=notes,
        level_sigma_rad=geometry.decision.level_sigma_rad,
        geometry=geometry,
        kept=kept,
    )


def _cloud(
    geometry: PairGeometry, affinities: Affinities, affine_method: str, image1: NDArray[np.generic] | None
) -> tuple[OrientedCloud, BoolArray]:
    """Return the oriented cloud and which corners are in it. Raises DegenerateError where it would be empty."""
    pair = geometry.pair
    affines: Callable[[EpipolarNormals], Affines] | None = None
    if needs_epipolar(affine_method):

        def affines(epipolar: EpipolarNormals) -> Affines:
            return affines_from_directions(pair.directions, affine_method, epipolar=epipolar).A21

    try:
        return oriented_cloud(
            geometry.points,
            pair.matches,
            geometry.metric.cam2_from_cam1,
            geometry.metric.covariance,
            affinities,
            affines=affines,
            colours=colours_at(image1, pair.captured.pixels1),
            board_ids=tuple(board.board_id for board in pair.boards),
        )
    except DegenerateError as error:
        raise DegenerateError(f"pair '{pair.pair_id}': {error}") from error


def fit_planes(
    geometry: PairGeometry,
    planes: Planes,
    known1: UncertainCamera | None = None,
    known2: UncertainCamera | None = None,
    *,
    one_camera: bool = False,
) -> BoardPlanes:
    """Return the boards' planes, "coplanar" or "lattice"; parameters and errors as of `lattice_planes`."""
    if planes not in ("coplanar", "lattice"):
        raise InputError(f"planes: '{planes}' are not fitted to both images; coplanar and lattice are")
    fit = lattice_planes if planes == "lattice" else coplanar_planes
    return fit(geometry, known1, known2, one_camera=one_camera)


def on_planes(reconstruction: Reconstruction, planes: BoardPlanes) -> Reconstruction:
    """Return the reconstruction with the points, normals and pose that planes fitted to both images give.

    Points of one board share the errors of its pose: their sigmas are each point's own, and planes fitted to them look
    more certain than they are. `planes` says how certain the boards' planes are. Points that are not on `planes` are
    left out, and a note says so.

    Raises DegenerateError: no point is on a board of `planes`.
    """
    cloud = reconstruction.cloud
    placed = np.zeros(len(cloud), dtype=bool)
    for k, board in enumerate(reconstruction.boards):
        own = cloud.board_index == k
        placed[own] = planes.has_points(board, cloud.grid[own])
    if not placed.any():
        raise DegenerateError(
            f"pair '{reconstruction.pair_id}': no point is on a board whose plane was fitted; "
            "take images that show whole boards"
        )
    baseline_mm, baseline_sigma_mm = planes.baseline_mm()
    lost = [b.board_id for b in reconstruction.boards if b.board_id not in planes.board_ids]
    new_notes = [f"left out, for their planes could not be fitted: {', '.join(lost)}"] if lost else []
    if planes.gross:
        new_notes.append(f"{planes.gross} corners lie far off the boards' planes and were left out")
    pixels1, pixels2 = reconstruction.pixels1[placed], reconstruction.pixels2[placed]
    m = Matches.from_cameras(reconstruction.camera1, reconstruction.camera2, pixels1, pixels2)
    E21 = essential_from_pose(planes.cam2_from_cam1)
    distances = sampson_of_matches(E21, m)
    return replace(
        reconstruction,
        matches=reconstruction.matches.select(placed),
        pixels1=pixels1,
        pixels2=pixels2,
        cam2_from_cam1=planes.cam2_from_cam1,
        pose_covariance=planes.full_covariance[:6, :6],
        E21=E21,
        sampson_rms_px=float(np.sqrt(np.mean(distances**2))),
        cloud=_cloud_on_planes(reconstruction, planes, placed),
        baseline_mm=baseline_mm,
        baseline_sigma_mm=baseline_sigma_mm,
        notes=(*reconstruction.notes, *new_notes),
        kept=None,
    )


def _cloud_on_planes(reconstruction: Reconstruction, planes: BoardPlanes, placed: BoolArray) -> OrientedCloud:
    """Return the points `placed` (N,) as the boards' planes have them."""
    cloud = reconstruction.cloud
    points_mm, normals = np.array(cloud.points_mm), np.array(cloud.normals)
    sigma_mm, normal_sigma_rad = np.array(cloud.sigma_mm), np.array(cloud.normal_sigma_rad)
    for k, board in enumerate(reconstruction.boards):
        rows = placed & (cloud.board_index == k)
        if rows.any():
            points_mm[rows], covariance = planes.points(board, cloud.grid[rows])
            sigma_mm[rows] = np.sqrt(np.linalg.eigvalsh(covariance)[:, -1])
            normals[rows] = planes.normal(board.board_id)
            normal_sigma_rad[rows] = np.sqrt(np.trace(planes.normal_covariance(board.board_id)))
    moved = replace(
        cloud,
        points_mm=points_mm,
        normals=normals,
        sigma_mm=sigma_mm,
        normal_sigma_rad=normal_sigma_rad,
        calibration_in_sigmas=len(planes.calibration_moves) > 0,
    )
    return moved.select(placed)


def _affinities(pair: MatchedPair, method: str, E21: Mat3, scale: str) -> Affinities:
    m = pair.matches
    epipolar = None
    if needs_epipolar(method):
        epipolar = EpipolarNormals.of_matches(m, E21)
    return affines_from_directions(pair.directions, method, epipolar=epipolar, scale=scale, noise=pair.noise)


def oriented_cloud(
    triangulated: TriangulatedPoints,
    matches: Matches,
    cam2_from_cam1: Rigid3,
    pose_covariance: FloatArray,
    affinities: Affinities,
    *,
    affines: Callable[[EpipolarNormals], Affines] | None = None,
    colours: NDArray[np.uint8],
    board_ids: tuple[str, ...] = (),
) -> tuple[OrientedCloud, BoolArray]:
    """Return the oriented cloud, and which (N,) of the matches are in it: those with a point and a normal.

    Raises DegenerateError: no match has both a point and a normal.

    Parameters
    ----------
    triangulated : the points, with their covariances.
    matches : the same points in the coordinates of the affinities.
    cam2_from_cam1, pose_covariance : the cloud has the unit of its translation.
    affinities : of the points.
    affines : affinities for an epipolar geometry, where they follow from it and so move with it.
    colours : (N, 3) of the points.
    """
    points, covariance, seen = triangulated
    m = matches
    J1, J2 = pair_projection_jacobians(points, m.rays1, m.jacobians1, m.rays2, m.jacobians2, cam2_from_cam1)
    geometry = geometry_covariance(m, cam2_from_cam1, affines or affinities.A21, pose_covariance)
    normals = estimate_normals(J1, J2, affinities.A21, covariance=affinities.covariance, geometry=geometry)
    kept = seen & normals.valid & np.isfinite(covariance).all(axis=(1, 2))
    if not kept.any():
        raise DegenerateError("no match has both a point and a normal; check affinities and baseline")
    cloud = OrientedCloud(
        points_mm=points[kept],
        normals=normals.normals[kept],
        colours=colours[kept],
        board_index=m.board_index[kept],
        grid=m.grid[kept],
        sigma_mm=np.sqrt(np.linalg.eigvalsh(covariance[kept])[:, -1]),
        normal_sigma_rad=normals.sigma_rad[kept],
        board_ids=board_ids,
    )
    return cloud, kept


def colours_at(image: NDArray[np.generic] | None, pixels: Pixels) -> NDArray[np.uint8]:
    """Return the colours at the nearest pixels, (N, 3); grey where there is no image."""
    if image is None:
        return np.full((len(pixels), 3), GREY, dtype=np.uint8)
    column, row = np.rint(pixels).astype(np.int64).T
    values = in_8_bits(image)[np.clip(row, 0, image.shape[0] - 1), np.clip(column, 0, image.shape[1] - 1)]
    grey = values[:, None] if values.ndim == 1 else values
    return np.ascontiguousarray(np.broadcast_to(grey, (len(pixels), 3)), dtype=np.uint8)
