"""A certificate: the instrument, and the error bound of a measurement with it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from rigkit.cameras.uncertain import UncertainRig
from rigkit.core.arrays import BoolArray, FloatArray, Pixels, without_nan
from rigkit.core.errors import InputError
from rigkit.core.findings import Finding, Severity
from rigkit.core.measurement_task import Task
from rigkit.geometry.rigid3 import Rigid3
from rigkit.validation.monitoring.evidence import Monitored


def instrument_of(known: Monitored, pair: tuple[str, str] | None = None) -> Monitored:
    """Return the camera, or two of a rig in the frame of the first: the rig's first two, or a `pair` of names.

    The certificate is drawn over the image of the first. Raises InputError for an unknown name, or the same twice.
    """
    names = known.names[:2] if pair is None else pair
    if len(set(names) & set(known.names)) < len(names):
        raise InputError(
            f"certificate: two different cameras of {', '.join(known.names)} are needed, got {' and '.join(names)}"
        )
    chosen = [known.names.index(name) for name in names]
    cameras = tuple(known.cameras[k] for k in chosen)
    both = (known.covariance, known.mean_products)
    poses: tuple[Rigid3, ...] = (Rigid3.identity(),)
    if len(chosen) == 1:
        own = known.layout.cameras[0]
        covariance, expected = (part[own, own] for part in both)
    else:
        rigs = [
            UncertainRig(cameras=known.cameras, cam_from_rig=known.cam_from_rig, covariance=part).pair(*chosen)
            for part in both
        ]
        poses = (*poses, rigs[0].posed.cam2_from_cam1)
        covariance, expected = (pair.covariance for pair in rigs)
    return replace(
        known,
        names=tuple(names),
        cameras=cameras,
        cam_from_rig=poses,
        covariance=covariance,
        expected=expected,
        warped=(),
    )


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Certificate:
    """The error bound of a measurement over the image of the first camera.

    Attributes
    ----------
    task : of the measurement.
    instrument : one camera, or two in the frame of the first.
    pixels : (R, C, 2) image of the object's middle in the first camera.
    in_view : (R, C) mask of the places where all cameras see the whole object.
    bound : (R, C) the error that is exceeded with probability 1 - confidence, in `task.unit`; NaN out of view. It
        includes the uncertainty of the calibration's covariance.
    sigma : (R, C) standard deviation by each cause, in `task.unit`; their squares add up to the variance.
    coarse : (R, C) mask of the places where the bound is not certified: the error, or the uncertainty of the points
        along the lines of sight, is too large for its propagation.
    findings : causes that are not included, and how to halve the worst bound.
    """

    task: Task
    instrument: Monitored
    pixels: Pixels
    in_view: BoolArray
    bound: FloatArray
    sigma: Mapping[str, FloatArray]
    coarse: BoolArray
    findings: tuple[Finding, ...] = ()

    @property
    def places(self) -> BoolArray:
        """Mask (R, C) of the places that the figures below are of: where the bound is certified; if it is so nowhere,
        all in view."""
        return self.in_view & ~self.coarse if self.coarse_share < 1.0 else self.in_view

    @property
    def worst(self) -> float:
        """The largest bound at these `places`."""
        return float(np.max(self.bound[self.places]))

    @property
    def median(self) -> float:
        """The median bound at these `places`."""
        return float(np.median(self.bound[self.places]))

    @property
    def worst_place(self) -> tuple[int, int]:
        """Row and column of the largest bound at these `places`."""
        row, column = np.unravel_index(int(np.argmax(np.where(self.places, self.bound, -1.0))), self.bound.shape)
        return int(row), int(column)

    @property
    def coarse_share(self) -> float:
        """The fraction of the view in which the bound is not certified."""
        return float(np.mean(self.coarse[self.in_view]))

    @property
    def is_bad(self) -> bool:
        """Whether a finding says that the bound must not be trusted."""
        return any(finding.severity is Severity.BAD for finding in self.findings)

    def share_within(self, limit: float) -> float:
        """Return the fraction of the view with a certified bound of at most `limit`."""
        return float(np.mean(((self.bound <= limit) & ~self.coarse)[self.in_view]))

    def passes(self, limit: float | None) -> bool | None:
        """Return whether the bound is at most `limit` everywhere in view; None without a limit.

        False, too, if it is not certified somewhere in view, or a finding is BAD.
        """
        if self.is_bad:
            return False
        return None if limit is None else self.share_within(limit) == 1.0

    def shares(self) -> dict[str, float]:
        """Return the fraction of the variance by each cause at the worst place."""
        row, column = self.worst_place
        variance = {cause: float(sigma[row, column]) ** 2 for cause, sigma in self.sigma.items()}
        whole = sum(variance.values())
        return {cause: value / whole for cause, value in variance.items()}

    def to_dict(self) -> dict[str, Any]:
        """Return plain numbers, strings and lists; angles in degrees, None out of view."""
        task = self.task
        return {
            "schema": "rigkit.certificate/1",
            "quantity": str(task.quantity),
            "size_mm": task.size_mm,
            "distance_mm": task.distance_mm,
            "confidence": task.confidence,
            "cameras": list(self.instrument.names),
            "unit": task.unit,
            "worst": self.worst,
            "median": self.median,
            "in_view": float(self.in_view.mean()),
            "coarse": self.coarse_share,
            "shares_where_worst": self.shares(),
            "findings": [str(finding) for finding in self.findings],
            "u_px": self.pixels[0, :, 0].tolist(),
            "v_px": self.pixels[:, 0, 1].tolist(),
            "bound": without_nan(self.bound.tolist()),
            "sigma": {cause: without_nan(sigma.tolist()) for cause, sigma in self.sigma.items()},
        }

    def __repr__(self) -> str:
        t = self.task
        return (
            f"Certificate({t.quantity} of {t.size_mm:g} mm at {t.distance_mm:g} mm: {100 * t.confidence:g} % within "
            f"{self.median:.3g} {t.unit} in the middle of the field, {self.worst:.3g} {t.unit} at worst)"
        )
