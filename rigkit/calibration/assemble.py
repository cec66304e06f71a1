"""The result of a solved model: residuals, covariances, outliers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rigkit.calibration.board_shape import BoardShape
from rigkit.calibration.certainty.covariance import GlobalCovariance, PoseJacobians
from rigkit.calibration.choosing.between_models import RivalFit, between_models
from rigkit.calibration.pupil import without_pupil
from rigkit.calibration.result import Calibration, Candidate, Outlier, ViewResult
from rigkit.calibration.solving.clustered import Clustered
from rigkit.calibration.solving.fit import Fit, not_identifiable
from rigkit.calibration.solving.normal_equations import Residuals
from rigkit.calibration.solving.shape import ShapeModel
from rigkit.calibration.solving.state import State
from rigkit.calibration.views.observations import Observations
from rigkit.cameras.moving_pupil import far_camera
from rigkit.core.arrays import BoolArray, FloatArray
from rigkit.core.errors import DegenerateError
from rigkit.geometry.rigid3 import Rigid3

UNKNOWN_SHARE = 0.05
"""The camera is not determined where the projection is uncertain by this part of the image's width at the corners."""
MIN_RESULT_SIGMA_PX = 0.02
"""Smallest standard deviation of a corner in that test: exact data would pass it by rounding errors alone."""


def assemble(
    observations: Observations,
    fit: Fit,
    heldout_px: float | None,
    dropped: tuple[tuple[str, str], ...],
    candidates: tuple[Candidate, ...],
    rivals: Sequence[RivalFit] = (),
) -> Calibration:
    """Return the result without verdicts; `rivals` are other models that the images support about as well."""
    covariance, clustered = _covariance(observations, fit)
    covariance += between_models(observations, fit, rivals, np.sqrt(np.diag(covariance)[:-6]))
    return replace(
        with_covariance(observations, fit, heldout_px, dropped, candidates, covariance),
        overdispersion=clustered.overdispersion,
        freedom=clustered.freedom,
        rivals=tuple(one.rival for one in rivals),
    )


def with_covariance(
    observations: Observations,
    fit: Fit,
    heldout_px: float | None,
    dropped: tuple[tuple[str, str], ...],
    candidates: tuple[Candidate, ...],
    covariance: FloatArray,
) -> Calibration:
    """Return the result without verdicts and rivals, with a given `covariance` (P + 6, P + 6) of the parameters and the
    boards' mean motion."""
    camera, covariance, pupil = without_pupil(fit.state.camera, covariance)
    p = camera.parameters.size
    return Calibration(
        camera=camera,
        rms_px=fit.rms_px,
        heldout_rms_px=heldout_px,
        covariance=covariance[:p, :p],
        frame_covariance=covariance,
        sigma_px=fit.sigma_px,
        views=view_results(observations, fit.state, fit.residuals, fit.kept),
        dropped=dropped,
        outliers=outliers_of(observations, fit),
        candidates=candidates,
        convergence=fit.convergence,
        boards=board_shapes(observations, fit.state.shape, fit.state.unknowns),
        pupil=pupil,
    )


def _covariance(observations: Observations, fit: Fit) -> tuple[FloatArray, Clustered]:
    """Return the covariance (P + 6, P + 6) of the parameters and the boards' mean motion, with images as the
    independent units, and the cluster-robust estimate that it comes from."""
    p = fit.state.camera.parameters.size
    # The boards' warps belong to the shared unknowns: the aspect ratio of a board correlates with that of the pixels.
    n = p + fit.state.shape.basis.shape[-1]
    unit = fit.normal.covariance[0][:n, :n]
    variance = np.diag(unit)
    if not (np.isfinite(unit).all() and (variance[:p] > 0.0).all() and (variance >= 0.0).all()):
        raise not_identifiable(far_camera(fit.state.camera).model)
    prior = (fit.normal.gg - fit.data.gg)[:n, :n]
    known = GlobalCovariance.of(fit.normal, fit.data.products[0], prior, observations.clusters(), fit.sigma_px)
    views = PoseJacobians.alone(len(observations.views))
    return known.of_camera(slice(0, p), [views], fit.state.translation_mm), known.clustered


def outliers_of(observations: Observations, fit: Fit) -> tuple[Outlier, ...]:
    """Return the outliers of a fit."""
    out = []
    for i, j in np.argwhere(observations.present & ~fit.kept).tolist():
        view = observations.views[i]
        column, row = view.grid[j].tolist()
        # NaN where the corner does not project.
        length = float(np.linalg.norm(fit.residuals.px[i, j])) if fit.residuals.valid[i, j] else float("nan")
        out.append(Outlier(view.image, view.board.board_id, column, row, length))
    return tuple(out)


def require_determined(result: Calibration, at_corners_px: FloatArray) -> None:
    """Raise DegenerateError where the views do not determine the lens.

    `at_corners_px` is the uncertainty of the projection at the corners. Its factors for overdispersion and few degrees
    of freedom are taken out: they measure the misfit of the model, not the geometry of the views.
    """
    sigma = float(np.nanmedian(at_corners_px)) if np.isfinite(at_corners_px).any() else np.inf
    sigma /= result.overdispersion * result.widening
    if result.sigma_px > 0.0:
        sigma *= max(result.sigma_px, MIN_RESULT_SIGMA_PX) / result.sigma_px
    if not sigma < UNKNOWN_SHARE * result.camera.size_px[0]:
        raise DegenerateError(
            "calibration: the views do not determine the focal length (all boards nearly parallel to the image, or too "
            "few corners); take views with the board tilted by 20 to 50 degrees about different axes"
        )


def with_solution(
    calibration: Calibration, observations: Observations, state: State, residuals: Residuals, kept: BoolArray
) -> Calibration:
    """Return the calibration with camera, views and boards of another solution, for diagnosis."""
    return replace(
        calibration.with_near(state.camera),
        views=view_results(observations, state, residuals, kept),
        boards=board_shapes(observations, state.shape, state.unknowns),
    )


def view_results(
    observations: Observations, state: State, residuals: Residuals, kept: BoolArray
) -> tuple[ViewResult, ...]:
    """Return the result of each view; residuals of corners that do not project are NaN."""
    px = np.where(residuals.valid[..., None], residuals.px, np.nan)
    return ViewResult.of_views(observations.views, Rigid3.stack(state.rotation, state.translation_mm), px, kept)


def board_shapes(observations: Observations, shape: ShapeModel, unknowns: FloatArray) -> tuple[BoardShape, ...]:
    """Return the shapes of the boards in the views."""
    points, first_row = shape.points(unknowns), observations.first_row
    return tuple(
        BoardShape.of(observations.boards[b], shape.kind, points[first_row[b] : first_row[b + 1]])
        for b in np.unique(observations.board).tolist()
    )
