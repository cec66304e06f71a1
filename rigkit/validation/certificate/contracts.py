"""What is measured, with what, and how wrong it may be."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import numpy as np

from rigkit.cameras.base import Camera
from rigkit.core.arrays import BoolArray, FloatArray, Pixels, without_nan
from rigkit.core.errors import InputError
from rigkit.core.findings import Finding
from rigkit.geometry.rigid3 import Rigid3
from rigkit.validation.sentinel.evidence import Monitored


class Quantity(StrEnum):
    """What is measured."""

    LENGTH = "length"
    DEPTH = "depth"
    PLANE = "plane"
    ANGLE = "angle"


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Instrument:
    """One camera, or two of a rig, and how well they are known.

    Attributes
    ----------
    names, cameras, cam_from_rig : of one or of two cameras, in this order.
    covariance : (P, P) of the intrinsics, camera by camera; what a lens may do beyond its model is among them
        (`calibration.certainty.displaced`). Of two cameras also of both mounts, six each: left perturbation in rad and
        translation in mm, zero for the camera that is the rig's frame.
    sigma_px : standard deviation of a measured corner per coordinate.
    scale_sigma : relative standard deviation of all lengths, from how well the boards' squares were measured; 0 where
        nobody stated it.
    freedom : degrees of freedom of `covariance`: a dozen images know their own disagreement to a quarter.
    """

    names: tuple[str, ...]
    cameras: tuple[Camera, ...]
    cam_from_rig: tuple[Rigid3, ...]
    covariance: FloatArray
    sigma_px: float
    scale_sigma: float = 0.0
    freedom: float = float("inf")

    def __post_init__(self) -> None:
        if not 1 <= len(self.cameras) == len(self.names) == len(self.cam_from_rig) <= 2:
            raise InputError("certificate: one camera, or two of a rig, each with a name and a place")
        size = self.intrinsic_count + (12 if self.is_rig else 0)
        if np.shape(self.covariance) != (size, size) or not np.isfinite(self.covariance).all():
            raise InputError(f"certificate: a finite covariance of {size} unknowns is needed, got {self.covariance!r}")
        if not (np.isfinite(self.sigma_px) and self.sigma_px > 0.0):
            raise InputError(f"certificate: the corners' sigma must be positive, got {self.sigma_px} px")
        if not self.freedom > 0.0:
            raise InputError(f"certificate: a covariance has degrees of freedom, got {self.freedom}")

    @classmethod
    def of(cls, known: Monitored, pair: tuple[str, str] | None = None) -> Instrument:
        """Return a camera, or two of a rig: its first two, or a `pair` by their names, the one whose image the
        certificate is drawn over first.

        Raises InputError: a name that no camera has, or the same twice.
        """
        names = known.names[:2] if pair is None else pair
        if len(set(names) & set(known.names)) < len(names):
            raise InputError(
                f"certificate: two different cameras of {', '.join(known.names)} are needed, got {' and '.join(names)}"
            )
        order = [known.names.index(name) for name in names]
        layout, covariance = known.layout, known.covariance
        if len(order) == 2:
            place, absent = np.arange(layout.count), np.full(6, -1)
            rows = [place[layout.cameras[k]] for k in order] + [place[layout.mount(k)] if k else absent for k in order]
            kept = np.concatenate(rows)
            free = np.flatnonzero(kept >= 0)
            covariance = np.zeros((len(kept), len(kept)))
            covariance[np.ix_(free, free)] = known.covariance[np.ix_(kept[free], kept[free])]
        return cls(
            names=tuple(names),
            cameras=tuple(known.cameras[k] for k in order),
            cam_from_rig=tuple(known.cam_from_rig[k] for k in order),
            covariance=covariance,
            sigma_px=known.sigma_px,
            scale_sigma=known.scale_sigma,
            freedom=known.freedom,
        )

    @property
    def is_rig(self) -> bool:
        """Whether there are two cameras."""
        return len(self.cameras) == 2

    @property
    def intrinsic_count(self) -> int:
        """How many intrinsics all cameras have together."""
        return sum(camera.parameters.size for camera in self.cameras)


@dataclass(frozen=True, slots=True, kw_only=True)
class Task:
    """What somebody wants to measure.

    Attributes
    ----------
    quantity : a length across the line of sight (the worse of upright and level), a depth along it, how flat a plane
        of `size_mm` x `size_mm` looks that faces the camera (its worst point), or the angle between two edges of
        `size_mm`, one level and one upright.
    size_mm : the length, or the sides.
    distance_mm : from the first camera to the middle of what is measured.
    distance_sigma_mm : with one camera lengths rest on a distance that was measured by other means, this well.
    confidence : probability that the error is within the bound.
    """

    quantity: Quantity
    size_mm: float
    distance_mm: float
    distance_sigma_mm: float = 0.0
    confidence: float = 0.95

    def __post_init__(self) -> None:
        for name, value in (("size", self.size_mm), ("distance", self.distance_mm)):
            if not (np.isfinite(value) and value > 0.0):
                raise InputError(f"certificate: the {name} must be positive, got {value} mm")
        if not (np.isfinite(self.distance_sigma_mm) and self.distance_sigma_mm >= 0.0):
            raise InputError(f"certificate: the distance cannot be known to {self.distance_sigma_mm} mm")
        if not 0.0 < self.confidence < 1.0:
            raise InputError(f"certificate: the confidence must lie between 0 and 1, got {self.confidence}")

    @property
    def unit(self) -> str:
        """Of the error: "mm", or "deg" for angles."""
        return "deg" if self.quantity is Quantity.ANGLE else "mm"


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Certificate:
    """How wrong a measurement may be, over the image of the first camera.

    Attributes
    ----------
    task, instrument : what is measured, with what.
    pixels : (R, C, 2) where the middle of what is measured appears in the first camera.
    in_view : (R, C) whether all of it is seen by all cameras there.
    bound : (R, C) the error that is exceeded with probability 1 - confidence, in `task.unit`; NaN out of view. It
        counts in how well the calibration's covariance is known itself.
    sigma : (R, C) of each cause by name, one standard deviation, in `task.unit`; their squares add up to the whole.
    coarse : (R, C) where the bound is only a lower one: it is derived to first order, and there the error is a good
        part of what is measured, or its points are as uncertain along the lines of sight.
    findings : what is not counted in, and what would halve the worst bound.
    """

    task: Task
    instrument: Instrument
    pixels: Pixels
    in_view: BoolArray
    bound: FloatArray
    sigma: Mapping[str, FloatArray]
    coarse: BoolArray
    findings: tuple[Finding, ...] = ()

    @property
    def worst(self) -> float:
        """The largest bound in view."""
        return float(np.nanmax(self.bound))

    @property
    def median(self) -> float:
        """The bound that half of the view keeps."""
        return float(np.nanmedian(self.bound))

    @property
    def worst_place(self) -> tuple[int, int]:
        """Row and column of the largest bound."""
        row, column = np.unravel_index(int(np.nanargmax(self.bound)), self.bound.shape)
        return int(row), int(column)

    def share_within(self, limit: float) -> float:
        """Return the part of the view whose bound is at most `limit`."""
        return float(np.mean(self.bound[self.in_view] <= limit))

    def shares(self) -> dict[str, float]:
        """Return the part of the variance that each cause has where the bound is worst."""
        row, column = self.worst_place
        variance = {cause: float(sigma[row, column]) ** 2 for cause, sigma in self.sigma.items()}
        whole = sum(variance.values())
        return {cause: value / whole for cause, value in variance.items()}

    def to_dict(self) -> dict[str, Any]:
        """Return what a program needs to know; angles in degrees, places out of view as None."""
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
