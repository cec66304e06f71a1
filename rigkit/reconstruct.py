"""From matched corners of a pair to an oriented cloud in millimetres: the pose-type-aware pipeline."""

from __future__ import annotations

from dataclasses import dataclass

from rigkit.arrays import FloatArray, Mat3, Pixels
from rigkit.boards import Board
from rigkit.cameras.base import Camera
from rigkit.cloud import OrientedCloud
from rigkit.geometry.rigid3 import Rigid3
from rigkit.matches import Matches
from rigkit.posetype import PoseType

__all__ = ["Reconstruction"]


@dataclass(frozen=True, eq=False, slots=True)
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
