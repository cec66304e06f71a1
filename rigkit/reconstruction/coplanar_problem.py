"""The least-squares problem of `coplanar_planes`: corners of two images on a few planes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from rigkit.cameras.base import Camera
from rigkit.core.arrays import BoolArray, FloatArray, Pixels, Points
from rigkit.core.errors import DegenerateError
from rigkit.core.matches import Matches
from rigkit.core.posetype import PoseType
from rigkit.geometry.board_pose import point_residuals
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3, skew, unit
from rigkit.optim.levenberg_marquardt import DenseProblem
from rigkit.reconstruction.board_planes import maximum_likelihood
from rigkit.reconstruction.geometry import PoseTypeDecision
from rigkit.relative_pose.refinement.level_frames import LevelFrames
from rigkit.relative_pose.refinement.refine import project_to_type
from rigkit.relative_pose.refinement.residuals import level_terms
from rigkit.relative_pose.solvers.pose import free_directions, translation_basis

STEP = 1e-6
"""Step of central differences, in each parameter's unit: far above rounding, far below any curvature."""


@dataclass(frozen=True, eq=False)
class CoplanarState:
    """Pose of unit baseline (rotation (3, 3), direction t (3,)) and planes m (K, 3) with m . x = 1."""

    rotation: FloatArray
    t: FloatArray
    planes: FloatArray

    def moved(self, change: FloatArray) -> CoplanarState:
        """Return the state after the step (rotation w, baseline b, dm / |m| of every plane), (5 + 3 K,)."""
        t = unit(self.t + change[3:5] @ translation_basis(self.t))
        size = np.linalg.norm(self.planes, axis=1, keepdims=True)
        return CoplanarState(
            exp_so3(change[:3]) @ self.rotation, t, self.planes + size * change[5:].reshape(self.planes.shape)
        )


@dataclass(frozen=True, eq=False)
class CoplanarProblem:
    """Matched corners on planes, with the pose-type prior.

    With m the plane of a ray d1, R d1 + t (m . d1) is the corner's direction in camera 2: a homography of rays. The
    residual is its distance, in px, to the corner seen there, whitened by s2^2 I + s1^2 G G^T with G the derivative by
    the first pixel. To first order that is the reprojection error in both images.

    Attributes
    ----------
    matches : corners, in the level frames if there are any; `board_index` is the plane's index.
    bases2 : (N, 2, 3), see `point_residuals`.
    kind, level_sigma_rad : the pose type and the standard deviation of its prior; None: it holds exactly.
    frames : the level frames, or None.
    """

    matches: Matches
    bases2: FloatArray
    kind: PoseType
    level_sigma_rad: float | None
    frames: LevelFrames | None

    @classmethod
    def of(cls, matches: Matches, decision: PoseTypeDecision) -> CoplanarProblem:
        """Return the problem of captured matches under a pose type."""
        frames = decision.level_frames
        seen = matches if frames is None else frames.matches(matches)
        bases = np.linalg.pinv(seen.jacobians2)
        return cls(seen, np.asarray(bases), decision.pose_type, decision.level_sigma_rad, frames)

    def select(self, which: BoolArray) -> CoplanarProblem:
        return replace(self, matches=self.matches.select(which), bases2=self.bases2[which])

    def with_cameras(self, cameras: tuple[Camera, Camera], pixels: tuple[Pixels, Pixels]) -> CoplanarProblem:
        """Return the same corners, at new pixels, for other cameras."""
        seen = replace(self.matches, pixels1=pixels[0], pixels2=pixels[1]).with_cameras(*cameras)
        seen = seen if self.frames is None else self.frames.matches(seen)
        return replace(self, matches=seen, bases2=np.asarray(np.linalg.pinv(seen.jacobians2)))

    def start(self, cam2_from_cam1: Rigid3, boards: Sequence[Rigid3], baseline_mm: float) -> CoplanarState:
        """Return the state of a pose and of boards' poses in camera 1, mm."""
        pose = cam2_from_cam1 if self.frames is None else self.frames.level_pose(cam2_from_cam1)
        if self.level_sigma_rad is None:
            rotation, t = project_to_type(pose, self.kind)
        else:
            rotation, t = np.array(pose.rotation), unit(pose.translation_mm)
        normals = np.array([board.rotation[:, 2] for board in boards])
        offsets = np.array([board.rotation[:, 2] @ board.translation_mm for board in boards]) / baseline_mm
        if not (np.abs(offsets) > 0.0).all():
            raise DegenerateError("a board's plane goes through the camera; take another image")
        planes = normals / offsets[:, None]
        return CoplanarState(rotation, t, planes if self.frames is None else planes @ self.frames.level1_from_cam1.T)

    def free(self, state: CoplanarState) -> BoolArray:
        """Return a mask (5 + 3 K,) of the free parameters."""
        kind = PoseType.GENERAL if self.level_sigma_rad is not None else self.kind
        free = np.ones(5 + state.planes.size, dtype=bool)
        free[:5] = np.isin(np.arange(5), free_directions(kind))
        return free

    def corners(self, state: CoplanarState) -> tuple[FloatArray, FloatArray]:
        """Return the whitened residuals (N, 2) and their Jacobian (N, 2, 5 + 3 K) with the whitening held fixed."""
        residual, by, _, whiten = self._unwhitened(state)
        return (whiten @ residual[..., None])[..., 0], whiten @ by

    def _unwhitened(self, state: CoplanarState) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return residuals (N, 2) px, Jacobians by the state and by the first pixel, and whitening (N, 2, 2)."""
        m = self.matches
        plane = state.planes[m.board_index]
        inverse_depth = np.sum(plane * m.rays1, axis=1)
        turned = m.rays1 @ state.rotation.T
        residual, by_ray = point_residuals(m.rays2, self.bases2, turned + inverse_depth[:, None] * state.t)
        by = np.zeros((len(m), 2, 5 + state.planes.size))
        by[:, :, :3] = -by_ray @ skew(turned)
        by[:, :, 3:5] = inverse_depth[:, None, None] * (by_ray @ translation_basis(state.t).T)
        along = (by_ray @ state.t)[:, :, None] * m.rays1[:, None, :] * np.linalg.norm(plane, axis=1)[:, None, None]
        columns = 5 + 3 * m.board_index[:, None] + np.arange(3)
        by[np.arange(len(m))[:, None], :, columns] = np.swapaxes(along, 1, 2)
        slope = by_ray @ (state.rotation + state.t[:, None] * plane[:, None, :]) @ m.jacobians1
        s1, s2 = m.sigma1_px[:, None, None] ** 2, m.sigma2_px[:, None, None] ** 2
        whiten = np.linalg.inv(np.linalg.cholesky(s2 * np.eye(2) + s1 * slope @ np.swapaxes(slope, 1, 2)))
        return residual, by, slope, whiten

    def linearise(self, state: CoplanarState) -> DenseProblem:
        """Return all whitened residuals, those of the pose-type prior last, with their Jacobian by free parameters."""
        residual, by = self.corners(state)
        rows, jacobian = [residual.ravel()], [by.reshape(-1, by.shape[-1])]
        if self.level_sigma_rad is not None:
            off, by_pose = level_terms(self.kind, state.rotation, state.t, translation_basis(state.t))
            rows.append(off / self.level_sigma_rad)
            jacobian.append(np.pad(by_pose / self.level_sigma_rad, ((0, 0), (0, state.planes.size))))
        return DenseProblem(np.concatenate(rows), np.concatenate(jacobian)[:, self.free(state)])

    def minimum(self, state: CoplanarState) -> CoplanarState:
        """Return the state of maximum likelihood near `state`."""
        return maximum_likelihood(state, self.linearise, CoplanarState.moved, self.free(state))

    def points(self, state: CoplanarState) -> tuple[Points, FloatArray]:
        """Return the maximum-likelihood points (N, 3) on the planes, and their covariances (N, 3, 3) for this state.

        Both images are used: the first pixel is corrected by the residual of the second.
        """
        m = self.matches
        residual, _, slope, _ = self._unwhitened(state)
        s1, s2 = m.sigma1_px[:, None, None] ** 2, m.sigma2_px[:, None, None] ** 2
        spread = np.linalg.inv(np.eye(2) / s1 + np.swapaxes(slope, 1, 2) @ slope / s2)
        shift = -(spread @ np.swapaxes(slope, 1, 2) @ residual[..., None]) / s2
        rays = unit(m.rays1 + (m.jacobians1 @ shift)[..., 0])
        plane = state.planes[m.board_index]
        depth = 1.0 / np.sum(plane * rays, axis=1)[:, None]
        by_ray = depth[..., None] * (np.eye(3) - depth[..., None] * rays[:, :, None] * plane[:, None, :])
        by_pixel = by_ray @ m.jacobians1
        return depth * rays, by_pixel @ spread @ np.swapaxes(by_pixel, 1, 2)

    def point_jacobians(self, state: CoplanarState) -> FloatArray:
        """Return the derivatives (F, N, 3) of the points by the free parameters, by central differences."""
        out = []
        for one in np.eye(5 + state.planes.size)[self.free(state)]:
            ahead, back = (self.points(state.moved(sign * STEP * one))[0] for sign in (1.0, -1.0))
            out.append((ahead - back) / (2.0 * STEP))
        return np.array(out)

    def in_camera(self, state: CoplanarState) -> tuple[Rigid3, FloatArray, FloatArray]:
        """Return cam2_from_cam1 of unit baseline, and the planes' normals (K, 3), facing camera 1, and offsets (K,)."""
        pose = Rigid3(state.rotation, state.t)
        size = np.linalg.norm(state.planes, axis=1)
        # m . x = 1 > 0 in front: m points away from the camera.
        normals = self.from_level1(-state.planes / size[:, None])
        return pose if self.frames is None else self.frames.camera_pose(pose), normals, -1.0 / size

    def parameter_jacobian(self, state: CoplanarState) -> FloatArray:
        """Return the derivatives (6 + 6 K, F) of the `BoardPlanes` parameters at unit baseline by the free ones."""
        count = len(state.planes)
        out = np.zeros((6 + 6 * count, 5 + 3 * count))
        out[:3, :3] = np.eye(3)
        out[3:6, 3:5] = translation_basis(state.t).T
        for k, plane in enumerate(state.planes):
            size = np.linalg.norm(plane)
            normal, own = -plane / size, slice(5 + 3 * k, 8 + 3 * k)
            # dn = -dm / |m| perpendicular to m is the rotation n x dn; the offset is -1 / |m|.
            out[6 + 6 * k : 9 + 6 * k, own] = -skew(normal)
            out[9 + 6 * k : 12 + 6 * k, own] = np.outer(normal, -normal) / size
        if self.frames is not None:
            back1, back2 = self.frames.level1_from_cam1.T, self.frames.level2_from_cam2.T
            blocks = out.reshape(2 + 2 * count, 3, -1)
            out = np.concatenate([back2 @ blocks[:2], back1 @ blocks[2:]]).reshape(out.shape)
        return np.asarray(out[:, self.free(state)])

    def lengths(self, state: CoplanarState, scale: float) -> tuple[FloatArray, FloatArray]:
        """Return the factors (6 + 6 K,) that convert these parameters to mm, and their derivatives by the scale."""
        pose, normals, offsets = self.in_camera(state)
        is_length = np.tile(np.repeat([False, True], 3), 1 + len(offsets))
        by_scale = np.zeros(len(is_length))
        by_scale[3:6] = pose.translation_mm
        by_scale[6:].reshape(-1, 6)[:, 3:] = offsets[:, None] * normals
        return np.where(is_length, scale, 1.0), by_scale

    def from_level1(self, vectors: FloatArray) -> FloatArray:
        """Return vectors (..., 3) of the level frame of camera 1 in the camera's frame."""
        return vectors if self.frames is None else np.asarray(vectors @ self.frames.level1_from_cam1)
