"""Reconstruct an oriented point cloud, in mm, from the matched board corners of an image pair.

Points give the epipolar geometry. Directions give an affinity at every corner; F2UDIR and F3UDIR use the epipolar
geometry as well. Affinities and epipolar geometry give the surface normals.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rigkit.affine.affinities import Affinities, EpipolarNormals
from rigkit.affine.normal import estimate_normals, geometry_covariance
from rigkit.affine.registry import affines_from_directions, needs_epipolar
from rigkit.cameras.base import Camera
from rigkit.cameras.uncertain import UncertainCamera
from rigkit.core.arrays import Affines, BoolArray, FloatArray, Mat3, Pixels, RayJacobians, Rays, in_8_bits
from rigkit.core.boards import Board
from rigkit.core.choices import PLANE_CHOICES, Planes
from rigkit.core.cloud import OrientedCloud
from rigkit.core.errors import DegenerateError, InputError
from rigkit.core.matches import Matches
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
from rigkit.reconstruction.pairing import MatchedPair
from rigkit.relative_pose.solvers.pose import essential_from_pose

GREY = 160


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Reconstruction:
    """The reconstruction of one pair with one affine estimator.

    Attributes
    ----------
    pair_id : name of the pair.
    pose_type : the pose type used (never AUTO).
    affine_method : "F2UDIR", "F3UDIR", "DET3UDIR", "2SDIR" or "3SDIR".
    camera1, camera2 : the calibrated cameras of the two images.
    boards : the reconstructed boards, in the order of `matches.board_index`.
    matches : points and affinities, in rectified views or raw pixels.
    pixels1, pixels2 : (N, 2) the same corners in the captured images.
    cam2_from_cam1 : relative pose, metric.
    pose_covariance : (6, 6) of (left rotation perturbation rad, translation mm), or None.
    E21 : (3, 3) essential matrix, unit Frobenius norm.
    cloud : points and normals in the frame of camera 1; row n belongs to match n.
    baseline_mm, baseline_sigma_mm : length of the translation and its predicted standard deviation.
    sampson_rms_px : RMS Sampson distance of the corners.
    notes : warnings: what was left out, assumed or contradicted.
    level_sigma_rad : standard deviation of the pose-type prior; None: the type holds exactly, or is general.
    geometry, kept : for a pair with boards: the geometry that all estimators share, and a mask (M,) of its corners
        that have a normal by this estimator. None for other scenes.
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
        """Return the rays (N, 3) of `pixels1` and of `pixels2`, and their Jacobians (N, 3, 2) by the pixels."""
        rays1, _, jacobians1 = self.camera1.rays_and_jacobians(self.pixels1)
        rays2, _, jacobians2 = self.camera2.rays_and_jacobians(self.pixels2)
        return rays1, rays2, jacobians1, jacobians2

    def same_points(self, other: Reconstruction) -> bool:
        """Return whether both share one geometry and the same corners, and so the same points."""
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

    See these two for parameters and errors. To compare several estimators, compute the geometry once. With `planes`
    "coplanar" or "lattice", points and normals are those of planes fitted to the boards (`on_planes`), with exact
    intrinsics.
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

    Raises DegenerateError if no corner has both a point and a normal.

    Parameters
    ----------
    geometry : pose and points, from `pair_geometry`.
    affine_method : see `rigkit.affine.registry.AFFINE_METHODS`.
    scale : scale estimate of DET3UDIR, see `affines_from_directions`.
    image1 : image of camera 1, (H, W) or (H, W, 3) RGB, uint8 or uint16, for the colours of the cloud.
    """
    pair, metric = geometry.pair, geometry.metric
    epipolar = EpipolarNormals.of_matches(pair.matches, geometry.E21) if needs_epipolar(affine_method) else None
    affinities = affines_from_directions(
        pair.directions, affine_method, epipolar=epipolar, scale=scale, noise=pair.noise
    )
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
    """Return the oriented cloud and a mask of the corners in it. Raises DegenerateError if it would be empty."""
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
    """Fit the boards' planes by `coplanar_planes` or `lattice_planes`; see the latter for parameters and errors."""
    if planes not in ("coplanar", "lattice"):
        raise InputError(f"planes: '{planes}' are not fitted to both images; coplanar and lattice are")
    fit = lattice_planes if planes == "lattice" else coplanar_planes
    return fit(geometry, known1, known2, one_camera=one_camera)


def on_planes(reconstruction: Reconstruction, planes: BoardPlanes) -> Reconstruction:
    """Return the reconstruction with the points, normals and pose of planes that were fitted to both images.

    Errors of points on one board are correlated through its pose, but a point's sigma is only its own. So take the
    uncertainty of a plane from `planes`, not from a fit to these points. Points that are not on `planes` are left out,
    with a note.

    Raises DegenerateError if no point is on a board of `planes`.
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
    """Return the cloud of the points `placed` (mask (N,)), moved onto the boards' planes."""
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
    """Return the oriented cloud, and a mask (N,) of the matches in it: those with a point and a normal.

    Raises DegenerateError if no match has both.

    Parameters
    ----------
    triangulated : the points, with their covariances.
    matches : the same points in the coordinates of the affinities.
    cam2_from_cam1, pose_covariance : the pose; the cloud has the unit of its translation.
    affinities : of the points.
    affines : for estimators that use the epipolar geometry: function that returns the affinities for a given one, so
        that the pose's uncertainty propagates through them.
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
    """Return the colours (N, 3) of the nearest pixels; grey if there is no image."""
    if image is None:
        return np.full((len(pixels), 3), GREY, dtype=np.uint8)
    column, row = np.rint(pixels).astype(np.int64).T
    values = in_8_bits(image)[np.clip(row, 0, image.shape[0] - 1), np.clip(column, 0, image.shape[1] - 1)]
    grey = values[:, None] if values.ndim == 1 else values
    return np.ascontiguousarray(np.broadcast_to(grey, (len(pixels), 3)), dtype=np.uint8)
