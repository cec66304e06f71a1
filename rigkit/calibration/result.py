"""The result of a calibration: the camera, its residuals and uncertainty, and what was left out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np

from rigkit.calibration.board_shape import BoardShape
from rigkit.calibration.pupil import SolvedPupil, require_of_frame
from rigkit.calibration.solving.clustered import QUOTED, effective_freedom, widening
from rigkit.calibration.solving.solver import Convergence
from rigkit.calibration.views.repeats import cluster_numbers
from rigkit.cameras.base import Camera
from rigkit.cameras.moving_pupil import NearCamera, far_camera, pupil_shift_of_rays_mm
from rigkit.core.arrays import (
    BoolArray,
    FloatArray,
    IntArray,
    Pixels,
    Points,
    Rays,
    as_array,
    keep_arrays,
    keep_indices,
)
from rigkit.core.detections import BoardView
from rigkit.core.errors import InputError
from rigkit.core.findings import Finding
from rigkit.core.printing import drawn
from rigkit.geometry.rigid3 import Rigid3


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class ViewResult:
    """One board in one image, after the calibration.

    Attributes
    ----------
    image : name of the image.
    board_id : name of the board.
    cam_from_board : pose of the board.
    grid : (N, 2) int, (column, row) of each corner.
    pixels : (N, 2) measured corners.
    residuals_px : (N, 2) measured minus projected, of ALL corners of the view, outliers too; NaN where the board's
        corner does not project.
    kept : (N,) bool, False for outliers, which were not used.
    """

    image: str
    board_id: str
    cam_from_board: Rigid3
    grid: IntArray
    pixels: Pixels
    residuals_px: FloatArray
    kept: BoolArray

    def __post_init__(self) -> None:
        keep_indices(self, grid=(None, 2))
        n = len(self.grid)
        keep_arrays(self, pixels=(n, 2))
        keep_arrays(self, residuals_px=(n, 2), finite=False)
        kept = np.array(self.kept, dtype=bool)
        if kept.shape != (n,):
            raise InputError(f"view '{self.image}': `kept` must have one entry a corner ({n}), got {kept.shape}")
        kept.flags.writeable = False
        object.__setattr__(self, "kept", kept)

    @classmethod
    def of_views(
        cls, views: Sequence[BoardView], poses: Sequence[Rigid3], residuals_px: FloatArray, kept: BoolArray
    ) -> tuple[ViewResult, ...]:
        """Return the results of V views padded to C corners, `residuals_px` (V, C, 2) and `kept` (V, C).

        Both arrays are checked once for all views, which is much faster; the arrays of the views were checked before.
        """
        residuals_px = as_array(residuals_px, (len(views), None, 2), "residuals_px", finite=False)
        kept = np.array(kept, dtype=bool)
        kept.flags.writeable = False
        out = []
        for view, pose, residuals, keep in zip(views, poses, residuals_px, kept, strict=True):
            one, n = object.__new__(cls), len(view.grid)
            values = (view.image, view.board.board_id, pose, view.grid, view.pixels, residuals[:n], keep[:n])
            for name, value in zip(cls.__slots__, values, strict=True):
                object.__setattr__(one, name, value)
            out.append(one)
        return tuple(out)

    def __repr__(self) -> str:
        used = int(np.count_nonzero(self.kept))
        return (
            f"ViewResult('{self.image}', board '{self.board_id}': {used} of {len(self.grid)} corners used, RMS "
            f"{self.rms_px:.3f} px)"
        )

    @property
    def rms_px(self) -> float:
        """2-D RMS per corner, sqrt(mean |r|^2), over the kept corners; NaN if none is kept."""
        kept = self.residuals_px[self.kept]
        return float(np.sqrt((kept**2).sum(axis=1).mean())) if len(kept) else float("nan")


@dataclass(frozen=True, slots=True)
class Outlier:
    """A corner that was not used.

    Attributes
    ----------
    image, board_id : its image and board.
    column, row : its place on the board.
    residual_px : length of its residual; NaN where it does not project.
    """

    image: str
    board_id: str
    column: int
    row: int
    residual_px: float


@dataclass(frozen=True, slots=True)
class Candidate:
    """A model or board shape that was tried, and why it was or was not chosen.

    Attributes
    ----------
    name : name of the model and its size, or of the board shape.
    parameter_count : number of its parameters.
    rms_px : training error.
    heldout_rms_px : held-out error, by which candidates are chosen; None with too few images.
    chosen, reason : whether it was chosen, and why.
    """

    name: str
    parameter_count: int
    rms_px: float
    heldout_rms_px: float | None
    chosen: bool
    reason: str


@dataclass(frozen=True, eq=False, slots=True)
class Rival:
    """A camera of another model, size or board shape than the chosen one that the images support about as well.

    Attributes
    ----------
    name : its name among the candidates.
    camera : the camera.
    likely : probability that it is the better one, 0 to 1.
    """

    name: str
    camera: Camera
    likely: float


@dataclass(frozen=True, eq=False, kw_only=True)
class CalibrationCorners:
    """All corners of the views of a calibration, outliers too, view by view.

    Attributes
    ----------
    count : (V,) corners of each view.
    view : (N,) index of each corner's view.
    grid, pixels, residuals_px, kept : (N, 2), (N, 2), (N, 2) and (N,), as in `ViewResult`.
    points_mm : (N, 3) the corners in their board's frame, in its solved shape.
    rotation, translation_mm : (V, 3, 3) and (V, 3), cam_from_board of each view.
    """

    count: IntArray
    view: IntArray
    grid: IntArray
    pixels: Pixels
    residuals_px: FloatArray
    kept: BoolArray
    points_mm: Points
    rotation: FloatArray
    translation_mm: Points

    @property
    def used(self) -> tuple[Pixels, FloatArray]:
        """Pixels and residuals (M, 2) of the corners kept."""
        return self.pixels[self.kept], self.residuals_px[self.kept]

    def in_cam(self, chosen: IntArray) -> Points:
        """Return the corners with the indices `chosen` (M,) in the camera frame, (M, 3) mm."""
        view = self.view[chosen]
        turned = np.einsum("nij,nj->ni", self.rotation[view], self.points_mm[chosen])
        return np.asarray(turned + self.translation_mm[view])

    @cached_property
    def neighbour_correlation(self) -> float:
        """Correlation of the residuals of kept corners that are neighbours on their board, 0 if there are none: zero
        for noise, positive for errors of the lens or board model."""
        (columns, rows), kept = (self.grid.max(axis=0) + 1).tolist(), self.kept
        places = len(self.count) * rows * columns
        lattice, there = np.zeros((places, 2)), np.zeros(places)
        place = ((self.view * rows + self.grid[:, 1]) * columns + self.grid[:, 0])[kept]
        lattice[place], there[place] = self.residuals_px[kept], 1.0
        lattice, there = lattice.reshape(-1, rows, columns, 2), there.reshape(-1, rows, columns)
        squared = lattice[..., 0] ** 2 + lattice[..., 1] ** 2
        products, power = 0.0, 0.0
        for one, other in ((np.s_[:, :, 1:], np.s_[:, :, :-1]), (np.s_[:, 1:], np.s_[:, :-1])):
            products += float((lattice[one] * lattice[other]).sum())
            power += 0.5 * float((squared[one] * there[other] + squared[other] * there[one]).sum())
        return products / power if power > 0.0 else 0.0

    @classmethod
    def of(cls, views: Sequence[ViewResult], boards: Sequence[BoardShape]) -> Self:
        count = np.array([len(view.grid) for view in views])
        number = {board.board_id: k for k, board in enumerate(boards)}
        shown = np.array([number[view.board_id] for view in views])
        first = np.cumsum([0, *(len(board.points_mm) for board in boards)])[:-1]
        view, grid = np.repeat(np.arange(len(views)), count), np.concatenate([view.grid for view in views])
        columns = np.array([board.column_count for board in boards])
        row = first[shown][view] + grid[:, 1] * columns[shown][view] + grid[:, 0]
        return cls(
            count=count,
            view=view,
            grid=grid,
            pixels=np.concatenate([view.pixels for view in views]),
            residuals_px=np.concatenate([view.residuals_px for view in views]),
            kept=np.concatenate([view.kept for view in views]),
            points_mm=np.concatenate([board.points_mm for board in boards])[row],
            rotation=np.array([view.cam_from_board.rotation for view in views]),
            translation_mm=np.array([view.cam_from_board.translation_mm for view in views]),
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class Calibration:
    """A calibrated camera with everything a person needs to judge it.

    Attributes
    ----------
    camera : the camera.
    rms_px : training error: 2-D RMS per corner, sqrt(mean |residual|^2), kept corners of the views used. OpenCV's
        convention; sqrt(2) larger than an RMS per coordinate.
    heldout_rms_px : cross-validated error: the RMS of images that were left out of the fit, by k-fold cross-validation
        over images. Intrinsics and board shapes are then fixed, only the poses of the held-out boards are fitted.
        Residuals are weighted as in the solution, so that it is the error of a corner of median quality. None with
        fewer than three images.
    covariance : (P, P) of `camera.parameters`, of a Student's t distribution with `freedom` degrees of freedom.
    frame_covariance : (P + 6, P + 6) of the parameters and the mean motion of the boards (rad, mm). The uncertainty of
        a projection needs it to separate a change of the lens from a motion of the camera.
    sigma_px : standard deviation per coordinate of a corner of median quality, from the residuals.
    overdispersion : ratio of the scatter between images to that expected from independent corners, as a ratio of
        standard deviations, at least 1. The covariances include it.
    freedom : degrees of freedom of the covariances; infinite with too few images to estimate them. Quoted standard
        deviations account for them (`widening`).
    views : the views used, in the order given.
    dropped : (image, reason) of everything not used: whole images, or parts of images with views.
    disagreeing : images of `dropped` with too few corners that agree with the other views; not in files.
    outliers : corners of used views that were not used.
    candidates : models, degrees and board shapes tried.
    convergence : of the final solve.
    boards : shapes of the boards.
    verdicts : findings about the calibration, the headline first.
    rivals : other models that the images support about as well. Their difference from `camera` is part of the
        covariances where boards were, and of the projection's uncertainty elsewhere.
    pupil : movement of the entrance pupil; None for a central lens. For far points `camera` is exact with it too.
    """

    camera: Camera
    rms_px: float
    heldout_rms_px: float | None
    covariance: FloatArray
    frame_covariance: FloatArray
    sigma_px: float
    views: tuple[ViewResult, ...]
    dropped: tuple[tuple[str, str], ...]
    outliers: tuple[Outlier, ...]
    candidates: tuple[Candidate, ...]
    convergence: Convergence
    boards: tuple[BoardShape, ...]
    verdicts: tuple[Finding, ...] = ()
    overdispersion: float = 1.0
    freedom: float = float("inf")
    rivals: tuple[Rival, ...] = ()
    pupil: SolvedPupil | None = None
    disagreeing: tuple[str, ...] = ()

    _repr_html_ = drawn

    def __post_init__(self) -> None:
        p = self.camera.parameters.size
        keep_arrays(self, covariance=(p, p), frame_covariance=(p + 6, p + 6))
        require_of_frame(self.pupil, p + 6)
        if not self.views:
            raise InputError("calibration: no view was used; give images with boards")

    def __repr__(self) -> str:
        width, height = self.camera.size_px
        held = "not available" if self.heldout_rms_px is None else f"{self.heldout_rms_px:.4f} px"
        images = len({view.image for view in self.views})
        lines = [
            f"Calibration of a {self.camera.model} camera, {width}x{height} px: held-out RMS {held}, training RMS "
            f"{self.rms_px:.4f} px",
            f"  {self.corner_count} corners in {len(self.views)} views of {images} images; {len(self.outliers)} "
            f"corners and {self.images_left_out} images left out",
            *(f"  {finding}" for finding in self.verdicts[:1]),
        ]
        return "\n".join(lines)

    @cached_property
    def corners(self) -> CalibrationCorners:
        """All corners of all views."""
        return CalibrationCorners.of(self.views, self.boards)

    @cached_property
    def clusters(self) -> IntArray:
        """Number of the cluster of each view's image, (V,): near-duplicate images have the same (`cluster_numbers`)."""
        names = [view.image for view in self.views], [view.board_id for view in self.views]
        return cluster_numbers(*names, [view.pixels for view in self.views])

    @cached_property
    def near(self) -> Camera:
        """The camera that projects points in mm: `camera`, or a `NearCamera` where the pupil moves."""
        return self.camera if self.pupil is None else NearCamera.of(self.camera, self.pupil.terms)

    def with_near(self, camera: Camera) -> Self:
        """Return the calibration with another `near` camera of the same model, all else unchanged."""
        pupil = replace(self.pupil, terms=camera.pupil) if self.pupil and isinstance(camera, NearCamera) else None
        return replace(self, camera=far_camera(camera), pupil=pupil)

    def along(self, rays: Rays, range_mm: float) -> Points:
        """Return points (..., 3) in the camera frame, mm, at `range_mm` from the entrance pupil along rays (..., 3)."""
        points = range_mm * rays
        if self.pupil is not None:
            points[..., 2] += pupil_shift_of_rays_mm(rays, self.pupil.terms)
        return points

    @property
    def near_covariance(self) -> FloatArray:
        """Covariance of the parameters of `near` and the mean motion of the boards."""
        return self.frame_covariance if self.pupil is None else self.pupil.joint(self.frame_covariance)

    @property
    def parameter_sigmas(self) -> FloatArray:
        """Standard deviations of `camera.parameters`, (P,), widened so that two of them contain 95 % of the errors."""
        return self.widening * np.sqrt(np.diag(self.covariance))

    @cached_property
    def widening(self) -> float:
        """Factor on quoted standard deviations, so that two of them contain 95 % of the errors."""
        return self.widening_of(QUOTED)

    def widening_of(self, sigmas: float) -> float:
        """Return the factor with which so many standard deviations contain as much as of a normal distribution."""
        return widening(effective_freedom(self.freedom, self.overdispersion, len(self.covariance)), sigmas)

    @property
    def images_left_out(self) -> int:
        """Number of images without a used view."""
        return len({image for image, _ in self.dropped} - {view.image for view in self.views})

    @property
    def corner_count(self) -> int:
        """Number of corners used."""
        return sum(int(np.count_nonzero(view.kept)) for view in self.views)
