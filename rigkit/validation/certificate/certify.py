"""Compute a certificate: the bound on the error of a measurement over the image, its causes, and how to halve it.

The calibration's covariance is estimated from about a dozen images, to about a quarter of itself. So a bound of 95 % is
not 1.96 standard deviations but Student's quantile with effective degrees of freedom (Welch-Satterthwaite; JCGM 100
"GUM", annex G.4). The standard deviations of the other causes count as known.

How a lens departs from its model is partly known: the images tell its mean error b at each place, which is not
corrected, and a standard deviation s about it. The root of b^2 + s^2 is what is stated as the lenses' sigma; but an
error of known size does not vary, so the bound U is not a multiple of that root:

    P(|b + s t| <= U) = confidence,     t of Student's distribution.

It is 1.96 s without a mean error, and |b| + 1.64 s where that is large (GUM, F.2.4.5, on corrections not applied).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
from scipy.special import ndtr, ndtri, stdtr, stdtrit

from rigkit.cameras.compare import grid_pixels
from rigkit.core.arrays import TINY, FloatArray
from rigkit.core.errors import DegenerateError, InputError
from rigkit.core.findings import Finding
from rigkit.core.measurement_task import Quantity, Task
from rigkit.validation.certificate.propagation import (
    MAP_CELLS,
    OF_CORNERS,
    OF_DISTANCE,
    OF_LENSES,
    OF_MOUNTS,
    OF_SCALE,
    gradients,
    measured_points,
    systematic,
    variances,
)
from rigkit.validation.certificate.result import Certificate
from rigkit.validation.monitoring.evidence import Monitored

MAX_SHARE = 0.3
"""Largest bound, and uncertainty of points, relative to the measured size (for angles to a radian), at which the bound
is relied upon. SIMULATED corner noise, lengths, depths, planes and angles: up to 0.5 94 to 96 % of the errors lie
within a bound of 95 %, beyond 1 97 to 100 % (2026-11-29). Propagation is to the second order."""
AS_NORMAL = 1e6
"""Degrees of freedom from which Student's distribution counts as normal."""
BISECTIONS = 50
"""Of the interval of a bound: to rounding."""


def certify(instrument: Monitored, task: Task, *, cells: tuple[int, int] = MAP_CELLS) -> Certificate:
    """Return the bound on the error of `task` over the image of the first camera of an `instrument_of` a calibration.

    Raises InputError for a depth, plane or angle with one camera, or corners without a standard deviation;
    DegenerateError if all cameras see the measured object nowhere.
    """
    if not (np.isfinite(instrument.sigma_px) and instrument.sigma_px > 0.0):
        raise InputError(f"certificate: the corners' sigma must be positive, got {instrument.sigma_px} px")
    if not instrument.is_rig and task.quantity is not Quantity.LENGTH:
        raise InputError(
            f"certificate: one camera measures no {task.quantity}; give a rig, or a length at a known distance"
        )
    first = instrument.cameras[0]
    pixels = grid_pixels(first.size_px, cells)
    shape = pixels.shape[:2]
    rays, valid = first.unproject(pixels.reshape(-1, 2))
    points, weights = measured_points(np.where(valid[:, None], rays, [0.0, 0.0, 1.0]), task, instrument.is_rig)
    found = gradients(instrument.cameras, instrument.cam_from_rig, points, weights)
    seen = found.seen & valid
    if not seen.any():
        raise DegenerateError(
            f"certificate: nowhere is a {task.quantity} of {task.size_mm:g} mm at {task.distance_mm:g} mm in view of "
            f"{' and '.join(instrument.names)}; give a shorter length or another distance"
        )
    variance = variances(instrument, task, points, found)
    square = systematic(instrument, found.by_calibration)
    # Of several orientations the worst counts: an error of known size needs less than its share of the variance.
    whole = np.sqrt(np.maximum(sum(variance.values()) - square, TINY))
    upper = float(ndtri(0.5 + 0.5 * task.confidence))
    worst = np.argmax(whole * _reached(np.sqrt(square) / whole, upper, task.confidence, ndtr), axis=1)
    chosen = np.arange(len(worst))
    # Radians become degrees only here.
    factor = np.rad2deg(1.0) if task.quantity is Quantity.ANGLE else 1.0
    sigma = {
        cause: np.where(seen, factor * np.sqrt(value[chosen, worst]), np.nan).reshape(shape)
        for cause, value in variance.items()
    }
    expected = factor * np.sqrt(square[chosen, worst]).reshape(shape)
    bound, quantile = bound_of(sigma, expected, instrument.freedom, task.confidence)
    full_size = factor * (1.0 if task.quantity is Quantity.ANGLE else task.size_mm)
    # Largest displacement of any of the points by an error of one pixel, mm.
    farthest = np.linalg.norm(found.points_by_pixel, ord=2, axis=(-2, -1)).max(axis=1)
    uncertain = quantile * instrument.sigma_px * farthest.reshape(shape) > MAX_SHARE * task.size_mm
    in_view = seen.reshape(shape)
    certificate = Certificate(
        task=task,
        instrument=instrument,
        pixels=pixels,
        in_view=in_view,
        bound=bound,
        sigma=sigma,
        coarse=in_view & (uncertain | (bound > MAX_SHARE * full_size)),
    )
    return replace(certificate, findings=tuple(_findings(certificate)))


def bound_of(
    sigma: Mapping[str, FloatArray], expected: FloatArray, freedom: float, confidence: float
) -> tuple[FloatArray, FloatArray]:
    """Return the bound (R, C) at each place, and the quantile of Student's distribution, from the standard deviations
    by each cause and the size of the `expected` error, which is a part of the lenses'."""
    square = np.sum([s**2 for s in sigma.values()], axis=0)
    whole = np.maximum(square - expected**2, TINY)
    calibration = np.sum([sigma[cause] ** 2 for cause in (OF_LENSES, OF_MOUNTS) if cause in sigma], axis=0)
    calibration = np.maximum(calibration - expected**2, TINY)
    known = np.full(whole.shape, AS_NORMAL)
    if np.isfinite(freedom):
        known = np.minimum(freedom * (whole / calibration) ** 2, AS_NORMAL)
    quantile = stdtrit(known, 0.5 + 0.5 * confidence)
    spread = np.sqrt(whole)
    reached = _reached(expected / spread, quantile, confidence, lambda x: np.asarray(stdtr(known, x)))
    return spread * reached, quantile


def _reached(
    shift: FloatArray, quantile: FloatArray | float, confidence: float, below: Callable[[FloatArray], FloatArray]
) -> FloatArray:
    """Return U with P(|shift + t| <= U) = confidence, for t with the distribution function `below`, whose `quantile` is
    U without a shift."""
    low, high = np.zeros_like(shift), shift + quantile
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        enough = below(middle - shift) - below(-middle - shift) >= confidence
        low, high = np.where(enough, low, middle), np.where(enough, middle, high)
    return high


def _findings(certificate: Certificate) -> list[Finding]:
    """Return the causes that the bound does not include, and how to halve the worst bound."""
    instrument, task = certificate.instrument, certificate.task
    found = []
    if coarse := certificate.coarse_share:
        share = "less than 1" if coarse < 0.01 else f"{100.0 * coarse:.0f}"
        kind = Finding.bad if coarse == 1.0 else Finding.look
        found.append(
            kind(
                f"in {share} % of the view no bound is certified: points are uncertain there by more than "
                f"{100.0 * MAX_SHARE:g} % of what is measured",
                "measure elsewhere in the image, nearer, or with a longer baseline"
                if instrument.is_rig
                else "come nearer, or calibrate with more images",
            )
        )
    if instrument.is_rig and instrument.scale_sigma == 0.0 and OF_SCALE in certificate.sigma:
        found.append(
            Finding.look(
                "the uncertainty of the boards' square size is not stated: the scale is treated as exact",
                "give square_sigma_mm in the board's file and calibrate again",
            )
        )
    if not instrument.is_rig and task.distance_sigma_mm == 0.0:
        found.append(
            Finding.look("the distance is treated as exact", "give its standard deviation as --distance-sigma")
        )
    found.append(Finding.good(f"to halve the worst error: {_how_to_halve(certificate.shares(), certificate)}"))
    return found


def _how_to_halve(shares: Mapping[str, float], certificate: Certificate) -> str:
    """Return the remedies, for the largest cause first, until a quarter of the variance is left."""
    scale = 100.0 * certificate.instrument.scale_sigma
    steps: list[str] = []
    left, target = 1.0, 0.25
    for cause, share in sorted(shares.items(), key=lambda item: -item[1]):
        if left <= target or share <= 0.0:
            break
        # This cause must shrink to the rest of the target, but at most to a ninth.
        allowed = max(target - (left - share), share / 9.0)
        factor = share / allowed
        left -= share - allowed
        steps.append(_remedy(cause, factor, share, scale))
    return "; ".join(steps)


def _remedy(cause: str, factor: float, share: float, scale_percent: float) -> str:
    verb = "makes" if cause in (OF_SCALE, OF_DISTANCE) else "make"
    part = f"{cause} {verb} {100.0 * share:.0f} % of the variance"
    times = f"{int(np.ceil(factor)):d} times"
    root = f"{np.sqrt(factor):.1f} times"
    remedies: dict[str, str] = {
        OF_CORNERS: f"average {times[:-6]} measurements, come nearer, or use a longer baseline",
        OF_LENSES: f"calibrate with {times} as many images, with boards also where the bound is largest",
        OF_MOUNTS: f"calibrate with {times} as many images of boards that both cameras see",
        OF_SCALE: f"measure the square size {root} more precisely than the {scale_percent:.3g} % stated, over the "
        "whole board",
        OF_DISTANCE: f"measure the distance {root} more precisely",
    }
    return f"{part}: {remedies[cause]}"
