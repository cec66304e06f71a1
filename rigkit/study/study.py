"""Run synthetic studies: errors of normals for noisy directions or corners.

A study is a grid of pose types, noise levels and affine estimators. Trials are divided into chunks of fixed size with
their own random generators, so that results do not depend on the number of processes. Source: L. Hajder, "Affine
Correspondences in Stereo Vision: Theory, Practice, and Limitations", synthetic tests.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rigkit.affine.affinities import EpipolarNormals
from rigkit.affine.directions import direction_field
from rigkit.affine.normal import normals_from_affines
from rigkit.affine.registry import AFFINE_METHODS, affines_from_directions, needs_epipolar
from rigkit.affine.unscaled import SCALES
from rigkit.cameras.pinhole import Pinhole
from rigkit.core.arrays import FloatArray, Mat3, Pixels
from rigkit.core.boards import Board
from rigkit.core.choices import SUPPORTS
from rigkit.core.detections import BoardDetection
from rigkit.core.errors import InputError
from rigkit.core.matches import DirectionPairs
from rigkit.core.posetype import PoseType
from rigkit.geometry.rotation import angle_between
from rigkit.synthetic.lattice import chord_directions, harmonic_directions
from rigkit.synthetic.noise import NoisyImages, corner_noise, rotate_directions
from rigkit.synthetic.poses import PairBatch, general_pairs, special_pairs

CHUNK_TRIALS = 50
"""Trials that share a random generator. Changing it changes the numbers of every study."""
STUDY_PLANES = 3
BOARD = Board("study", 6, 8, 40.0, 40.0)
"""The paper's synthetic boards."""
NOISE_KINDS = {"directions": "deg", "corners": "px"}


@dataclass(frozen=True, slots=True)
class Claim:
    """A claim about medians: each cell of `smaller` is below each cell of `larger`, or at most a limit.

    Attributes
    ----------
    text : the claim in words.
    smaller, larger : selections of cells by any of method, pose_type, plane, sigma, each a value or several. Cells are
        compared if they agree in all keys that not both sides name.
    at_most_deg : instead of `larger`: upper limit of all cells of `smaller`.
    """

    text: str
    smaller: dict[str, Any]
    larger: dict[str, Any] | None = None
    at_most_deg: float | None = None

    def __post_init__(self) -> None:
        if (self.larger is None) == (self.at_most_deg is None):
            raise InputError(f"claim '{self.text}': give either what is larger or a limit (at_most_deg)")


@dataclass(frozen=True, slots=True)
class Variant:
    """A named variant of an affine estimator with its own directions and scale."""

    name: str
    method: str
    support: str
    det_scale: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Study:
    """Definition of a synthetic study.

    Attributes
    ----------
    name, title : for files and figures.
    seed : of all random numbers.
    trials : pairs of views per pose type.
    pose_types : without AUTO.
    methods : affine estimators, or names of `variants`.
    noise : "directions" (sigmas in degrees, lengths kept) or "corners" (sigmas in px, everything computed from them).
    sigmas : noise levels.
    images : which image is noisy.
    support : corners that directions are estimated from, see `direction_field`; "chord" in the paper.
    det_scale : scale of DET3UDIR, see `affines_from_directions`; "sqmean" in the paper.
    variants : estimators with another support or scale than the study's, for comparison.
    epipolar : "truth", or "estimated" from the noisy corners by the eight-point method (corner noise only).
    board, focal_px, centre_px : target and camera.
    parallax_deg : of general pairs. baseline_mm, in_plane_deg : of the others.
    min_conditioning : affinities below are left out and counted; 0 keeps all.
    claims : checked in the report.
    """

    name: str
    title: str
    seed: int
    trials: int
    pose_types: tuple[PoseType, ...]
    methods: tuple[str, ...]
    noise: str
    sigmas: tuple[float, ...]
    images: NoisyImages = NoisyImages.BOTH
    support: str = "chord"
    det_scale: str = "sqmean"
    variants: tuple[Variant, ...] = ()
    epipolar: str = "truth"
    board: Board = BOARD
    focal_px: float = 1350.0
    centre_px: tuple[float, float] = (800.0, 620.0)
    parallax_deg: tuple[float, float] = (40.0, 70.0)
    baseline_mm: float = 300.0
    in_plane_deg: float = 25.0
    min_conditioning: float = 0.0
    claims: tuple[Claim, ...] = ()

    def __post_init__(self) -> None:
        for value, known, what in (
            (self.noise, tuple(NOISE_KINDS), "noise"),
            (self.epipolar, ("truth", "estimated"), "epipolar"),
            *((v.support, SUPPORTS, "support") for v in self.estimators),
            *((v.det_scale, SCALES, "det_scale") for v in self.estimators),
            *((v.method, AFFINE_METHODS, "method") for v in self.estimators),
        ):
            if value not in known:
                raise InputError(f"study '{self.name}': {what} '{value}' is unknown; known: {', '.join(known)}")
        if not (self.methods and self.sigmas and self.pose_types) or self.trials < 1:
            raise InputError(f"study '{self.name}': one method, one sigma, one pose type and one trial at least")
        if PoseType.AUTO in self.pose_types:
            raise InputError(f"study '{self.name}': pose type 'auto' cannot be simulated; name the pose types")
        if min(self.sigmas) < 0.0:
            raise InputError(f"study '{self.name}': a negative sigma; give 0 or more")
        if self.epipolar == "estimated" and self.noise != "corners":
            raise InputError(f"study '{self.name}': epipolar = \"estimated\" needs noise on corners, not on directions")
        if min(self.board.size) < 3:
            raise InputError(f"study '{self.name}': the board needs 3x3 inner corners at least")

    @property
    def estimators(self) -> tuple[Variant, ...]:
        """The estimators that `methods` name."""
        named = {variant.name: variant for variant in self.variants}
        return tuple(named.get(m, Variant(m, m, self.support, self.det_scale)) for m in self.methods)

    @property
    def unit(self) -> str:
        """Unit of the noise levels."""
        return NOISE_KINDS[self.noise]

    def to_dict(self) -> dict[str, Any]:
        """Return everything that determines the results, for provenance and to recognise earlier results."""
        out = {name: getattr(self, name) for name in self.__slots__ if name != "claims"}
        out["board"] = {"columns": self.board.columns, "rows": self.board.rows, "square_mm": self.board.square_x_mm}
        out["variants"] = [asdict(variant) for variant in self.variants]
        return {key: [str(v) for v in value] if key == "pose_types" else value for key, value in out.items()}


def chunk_count(study: Study) -> int:
    return -(-study.trials // CHUNK_TRIALS)


def run_chunk(study: Study, index: int) -> NDArray[np.float32]:
    """Return angles between estimated and true normals, degrees, NaN without an estimate.

    Shape (pose types, sigmas, methods, trials of this chunk, corners). Angles are between lines, at most 90 degrees:
    the sign of a normal is given by the camera, not by the estimator. Depends only on the study and `index`.
    """
    trials = min(CHUNK_TRIALS, study.trials - index * CHUNK_TRIALS)
    corners = STUDY_PLANES * study.board.corner_count
    shape = (len(study.pose_types), len(study.sigmas), len(study.methods), trials, corners)
    out = np.empty(shape, dtype=np.float32)
    for p, pose_type in enumerate(study.pose_types):
        rng = np.random.default_rng([study.seed, list(PoseType).index(pose_type), index])
        scene = _Scene(study, _pairs(study, pose_type, trials, rng))
        for s, sigma in enumerate(study.sigmas):
            out[p, s] = scene.errors(sigma, rng)
    return out


def _pairs(study: Study, pose_type: PoseType, trials: int, rng: np.random.Generator) -> PairBatch:
    if pose_type is PoseType.GENERAL:
        return general_pairs(study.board, trials, rng, parallax_deg=study.parallax_deg)
    return special_pairs(
        study.board, trials, pose_type, rng, baseline_mm=study.baseline_mm, in_plane_deg=study.in_plane_deg
    )


class _Scene:
    """The noise-free part of a batch of trials, flattened over trials and corners."""

    def __init__(self, study: Study, pairs: PairBatch) -> None:
        self.study = study
        self.shape = pairs.points_mm.shape[:2]
        k = np.array([[study.focal_px, 0.0, study.centre_px[0]], [0.0, study.focal_px, study.centre_px[1]], [0, 0, 1]])
        points1, points2 = pairs.points_mm, pairs.points_in_2()
        self.pixels1, self.pixels2 = (_project(p, k) for p in (points1, points2))
        self.jacobian1 = _jacobian(points1, study.focal_px).reshape(-1, 2, 3)
        jacobian2 = _jacobian(points2, study.focal_px) @ pairs.rotation21[:, None]
        self.jacobian2 = jacobian2.reshape(-1, 2, 3)
        inverse = np.linalg.inv(k)
        self.F21 = inverse.T @ pairs.essential() @ inverse
        self.normals = pairs.normals[:, pairs.board_index].reshape(-1, 3)
        self.supports = tuple(dict.fromkeys(variant.support for variant in study.estimators))
        self.clean = {support: self._directions(self.pixels1, self.pixels2, support) for support in self.supports}
        self.normals_of_lines = _epipolar_normals(self.F21, self.pixels1, self.pixels2)

    def _directions(self, pixels1: Pixels, pixels2: Pixels, support: str) -> DirectionPairs:
        board, trials = self.study.board, self.shape[0]
        lattices = [p.reshape(trials, STUDY_PLANES, board.rows, board.columns, 2) for p in (pixels1, pixels2)]
        both = [self._lattice_directions(lattice, support).reshape(-1, 3, 2) for lattice in lattices]
        return DirectionPairs(
            image1=both[0], image2=both[1], valid=np.asarray(np.isfinite(np.stack(both)).all(axis=(0, -1)))
        )

    def _lattice_directions(self, lattices: Pixels, support: str) -> FloatArray:
        """Return the directions of lattices (trials, planes, rows, columns, 2), in a batch if there is a formula."""
        if support == "chord":
            return chord_directions(lattices)
        if support == "neighbours":
            return harmonic_directions(lattices)
        study, board = self.study, self.study.board
        view = Pinhole((1, 1), np.array([study.focal_px, study.focal_px, *study.centre_px]))
        grid, sigma = board.grid(), np.ones(board.corner_count)
        out = np.empty((*lattices.shape[:-1], 3, 2))
        flat = out.reshape(-1, board.corner_count, 3, 2)
        for index, pixels in enumerate(lattices.reshape(-1, board.corner_count, 2)):
            seen = BoardDetection(board.board_id, board.columns, board.rows, grid, pixels, sigma)
            flat[index] = direction_field(seen, view, support="line" if support == "line" else "patch").vectors
        return out

    def errors(self, sigma: float, rng: np.random.Generator) -> FloatArray:
        """Return the angular errors, degrees, (methods, trials, corners)."""
        study = self.study
        lines = self.normals_of_lines
        if study.noise == "directions":
            angle = np.radians(sigma)
            noisy = {s: rotate_directions(d, angle, rng, images=study.images) for s, d in self.clean.items()}
        else:
            pixels1, pixels2 = corner_noise(self.pixels1, self.pixels2, sigma, rng, images=study.images)
            noisy = {support: self._directions(pixels1, pixels2, support) for support in self.supports}
            F21 = _eight_point(pixels1, pixels2) if study.epipolar == "estimated" else self.F21
            lines = _epipolar_normals(F21, pixels1, pixels2)
        out = []
        for variant in study.estimators:
            affinities = affines_from_directions(
                noisy[variant.support],
                variant.method,
                epipolar=lines if needs_epipolar(variant.method) else None,
                scale=variant.det_scale,
                min_conditioning=study.min_conditioning,
            )
            normals, _ = normals_from_affines(self.jacobian1, self.jacobian2, affinities.A21)
            angle = np.degrees(angle_between(normals, self.normals)).reshape(self.shape)
            out.append(np.minimum(angle, 180.0 - angle))
        return np.stack(out)


def _project(points: FloatArray, k: Mat3) -> Pixels:
    return np.asarray(points[..., :2] / points[..., 2:] * k[0, 0] + k[:2, 2])


def _jacobian(points: FloatArray, focal_px: float) -> FloatArray:
    """Return d pixel / d point (..., 2, 3) of a pinhole."""
    x, y, z = np.moveaxis(points, -1, 0)
    zero = np.zeros_like(x)
    rows = [np.stack([1.0 / z, zero, -x / z**2], axis=-1), np.stack([zero, 1.0 / z, -y / z**2], axis=-1)]
    return np.asarray(focal_px * np.stack(rows, axis=-2))


def _epipolar_normals(F21: Mat3, pixels1: Pixels, pixels2: Pixels) -> EpipolarNormals:
    """Return the flattened normals of the epipolar lines of pixels (T, N, 2) for T fundamental matrices."""
    n2 = pixels1 @ np.swapaxes(F21[:, :2, :2], 1, 2) + F21[:, None, :2, 2]
    n1 = pixels2 @ F21[:, :2, :2] + F21[:, None, 2, :2]
    return EpipolarNormals(n1.reshape(-1, 2), n2.reshape(-1, 2))


def _eight_point(pixels1: Pixels, pixels2: Pixels) -> Mat3:
    """Return fundamental matrices (T, 3, 3) of T pairs by the normalised eight-point method."""
    normalised, transforms = [], []
    for pixels in (pixels1, pixels2):
        mean = pixels.mean(axis=1, keepdims=True)
        scale = np.sqrt(2.0) / np.linalg.norm(pixels - mean, axis=-1).mean(axis=1)
        transform = np.zeros((len(pixels), 3, 3))
        transform[:, 0, 0] = transform[:, 1, 1] = scale
        transform[:, :2, 2] = -scale[:, None] * mean[:, 0]
        transform[:, 2, 2] = 1.0
        ones = np.ones((*pixels.shape[:2], 1))
        normalised.append(np.concatenate([(pixels - mean) * scale[:, None, None], ones], axis=-1))
        transforms.append(transform)
    rows = (normalised[1][..., :, None] * normalised[0][..., None, :]).reshape(*pixels1.shape[:2], 9)
    _, vectors = np.linalg.eigh(np.swapaxes(rows, 1, 2) @ rows)
    u, s, vt = np.linalg.svd(vectors[:, :, 0].reshape(-1, 3, 3))
    s[:, 2] = 0.0
    return np.asarray(np.swapaxes(transforms[1], 1, 2) @ (u * s[:, None, :]) @ vt @ transforms[0])
