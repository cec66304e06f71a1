"""Board poses, and board shapes, for a camera whose intrinsics are known and held fixed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike

from rigkit.calibration.assemble import with_covariance
from rigkit.calibration.calibrate import FOLDS
from rigkit.calibration.choosing.choice import FittedModel, heldout_squares
from rigkit.calibration.choosing.models_tried import Request, enough_agree, with_board_shape
from rigkit.calibration.diagnosis.verdicts import diagnose
from rigkit.calibration.result import Calibration, Candidate
from rigkit.calibration.solving.fit import Fit, fit_kept, posed
from rigkit.calibration.solving.linearise import normal_equations
from rigkit.calibration.solving.solver import Convergence
from rigkit.calibration.views.observations import Observations
from rigkit.calibration.views.usable import usable_views
from rigkit.cameras.base import Camera
from rigkit.core.arrays import BoolArray, Coordinates, FloatArray, Projected
from rigkit.core.detections import BoardView
from rigkit.core.errors import DegenerateError
from rigkit.core.findings import Finding

MAX_LENS_RESIDUAL_PX = 1.0
"""Above this 2-D RMS the lens is not that of the images, or their size or focus is another one."""


def posed_calibration(
    views: Sequence[BoardView],
    camera: Camera,
    covariance: FloatArray | None = None,
    *,
    board: str = "flat",
    folds: int = FOLDS,
) -> Calibration:
    """Return a calibration in which only the boards' poses and shapes are estimated; the camera stays `camera`.

    With flat boards the held-out error is the training error, as no image influenced the camera.

    Raises InputError: no usable view, or corners outside the camera's image; DegenerateError: no view fits the camera.

    Parameters
    ----------
    views : detected boards.
    camera : the known camera.
    covariance : (P, P) of its parameters; None: it is exact.
    board, folds : as for `calibrate`.
    """
    observations, fit, dropped = _on_flat_boards(views, camera)
    observations, fit, heldout_px, candidates = _shaped(observations, fit, board, folds)
    p = camera.parameters.size
    frame = np.zeros((p + 6, p + 6))
    if covariance is not None:
        frame[:p, :p] = covariance
    result = with_covariance(observations, fit, heldout_px, dropped, candidates, frame)
    return replace(result, verdicts=diagnose(result, _large_residual(result), in_force=("model", "board_shape")))


def _on_flat_boards(
    views: Sequence[BoardView], camera: Camera
) -> tuple[Observations, Fit, tuple[tuple[str, str], ...]]:
    """Return the views that fit the lens, their poses for flat boards, and the reasons for dropping the others."""
    used, dropped = usable_views(views, camera.size_px)
    observations = Observations.from_views(used)
    state, kept = posed(observations, camera)
    fits = enough_agree(kept.sum(axis=1), observations.present.sum(axis=1))
    if not fits.any():
        raise DegenerateError(
            "no view fits the known lens: is it of another camera, image size or focus? calibrate the lens again"
        )
    dropped += tuple(
        (view.image, "fewer than half of its corners fit the known lens; retake it")
        for view, ok in zip(used, fits, strict=True)
        if not ok
    )
    chosen = np.flatnonzero(fits)
    observations, state, kept = observations.subset(chosen), state.subset(chosen), kept[chosen]
    data = normal_equations(observations, state, np.where(kept, observations.weight, 0.0))
    freedom = 2 * int(kept.sum()) - 6 * len(chosen)
    if freedom <= 0:
        raise DegenerateError("no more corners than unknowns; take views with more corners")
    sigma = float(np.sqrt(data.costs.sum() / freedom))
    return observations, Fit(state, data, kept, sigma, Convergence(0, True, "only poses were solved for")), dropped


def _shaped(
    observations: Observations, fit: Fit, board: str, folds: int
) -> tuple[Observations, Fit, float | None, tuple[Candidate, ...]]:
    """Return the fit with the board shape asked for, its held-out error, and the candidates; the lens is held."""
    lens = fit.state.camera
    held = fit_kept(observations, replace(fit.state, camera=HeldLens(lens.size_px, np.zeros(0), lens)), fit.kept)
    flat = FittedModel("board flat", held, heldout_squares(observations, held, folds))
    request = Request(size_px=lens.size_px, model=lens.model, board=board, folds=folds)
    observations, chosen, _, candidates = with_board_shape(observations, flat, request)
    if chosen is flat:
        return observations, fit, fit.rms_px, tuple(candidates)
    state = replace(chosen.fit.state, camera=lens)
    data = normal_equations(observations, state, chosen.fit.weight(observations))
    return observations, replace(chosen.fit, state=state, data=data), chosen.heldout_px, tuple(candidates)


def _large_residual(result: Calibration) -> tuple[Finding, ...]:
    if result.rms_px <= MAX_LENS_RESIDUAL_PX:
        return ()
    message = f"the known lens leaves {result.rms_px:.2f} px RMS: is it of another camera, image size or focus?"
    return (Finding.bad(message, "calibrate the lens again from these images"),)


@dataclass(frozen=True, eq=False, slots=True, repr=False)
class HeldLens(Camera):
    """The camera `lens` without free parameters."""

    lens: Camera

    model: ClassVar[str] = "held"

    def parameter_names(self) -> tuple[str, ...]:
        return ()

    def with_parameters(self, parameters: ArrayLike) -> Self:
        return self

    @property
    def max_angle_rad(self) -> float:
        return self.lens.max_angle_rad

    def _project(self, x: FloatArray, y: FloatArray, z: FloatArray) -> Projected:
        return self.lens._project(x, y, z)

    def _unproject(self, u: FloatArray, v: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, BoolArray]:
        return self.lens._unproject(u, v)

    def _derivatives(
        self, at: Coordinates, d_pixels_d_point: FloatArray, d_pixels_d_parameters: FloatArray | None
    ) -> Projected:
        return self.lens._derivatives(at, d_pixels_d_point, None)
