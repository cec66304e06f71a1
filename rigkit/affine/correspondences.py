"""Point correspondences of any scene, with affinities or directions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rigkit.cameras.base import Camera
from rigkit.core.arrays import Affines, BoolArray, FloatArray, IntArray, Pixels, keep_arrays
from rigkit.core.errors import InputError
from rigkit.core.matches import DirectionPairs, Matches

DEFAULT_SIGMA_PX = 0.5
"""Default standard deviation of points: about that of a good feature detector."""


@dataclass(frozen=True, eq=False, slots=True)
class Correspondences:
    """N points seen in two images.

    Attributes
    ----------
    pixels1, pixels2 : (N, 2)
    A21 : (N, 2, 2) d pixel2 / d pixel1, NaN where unknown; or None.
    directions : corresponding directions at the points, or None.
    sigma_px : (N,) standard deviation of the points per axis, or None.
    sigma_A : (N,) standard deviation of an entry of A21, or None.
    """

    pixels1: Pixels
    pixels2: Pixels
    A21: Affines | None = None
    directions: DirectionPairs | None = None
    sigma_px: FloatArray | None = None
    sigma_A: FloatArray | None = None

    def __post_init__(self) -> None:
        n = len(np.atleast_1d(self.pixels1))
        what = "correspondences, "
        keep_arrays(self, what=what, pixels1=(n, 2), pixels2=(n, 2))
        keep_arrays(self, what=what, optional=True, sigma_px=(n,))
        keep_arrays(self, what=what, optional=True, finite=False, A21=(n, 2, 2), sigma_A=(n,))
        if self.sigma_px is not None and (self.sigma_px <= 0.0).any():
            raise InputError("correspondences, sigma_px: standard deviations must be positive")
        if self.directions is not None and len(self.directions.valid) != n:
            raise InputError(f"correspondences: {n} points but directions at {len(self.directions.valid)}")

    def __len__(self) -> int:
        return len(self.pixels1)

    def select(self, which: BoolArray | IntArray) -> Correspondences:
        """Return the correspondences chosen by a mask or by indices."""
        d = None if self.directions is None else self.directions.select(which)
        A21, sigma_px, sigma_A = (None if v is None else v[which] for v in (self.A21, self.sigma_px, self.sigma_A))
        return Correspondences(self.pixels1[which], self.pixels2[which], A21, d, sigma_px, sigma_A)

    def exchanged(self) -> Correspondences:
        """Return the points with the two images exchanged, without directions; sigma_A is propagated to first order."""
        if self.A21 is None:
            return Correspondences(self.pixels2, self.pixels1, sigma_px=self.sigma_px)
        a, b, c, d = np.moveaxis(self.A21.reshape(-1, 4), -1, 0)
        with np.errstate(divide="ignore", invalid="ignore"):
            A12 = np.stack([d, -b, -c, a], axis=-1).reshape(-1, 2, 2) / (a * d - b * c)[:, None, None]
            sigma_A = None if self.sigma_A is None else self.sigma_A / np.abs(a * d - b * c)
        return Correspondences(self.pixels2, self.pixels1, A12, sigma_px=self.sigma_px, sigma_A=sigma_A)

    def matches(self, camera1: Camera, camera2: Camera) -> tuple[Matches, BoolArray]:
        """Return matches with rays and Jacobians for the points that both cameras see, and which these are (N,)."""
        seen = camera1.unproject(self.pixels1)[1] & camera2.unproject(self.pixels2)[1]
        kept = self.select(seen)
        sigma = np.full(len(kept), DEFAULT_SIGMA_PX) if kept.sigma_px is None else kept.sigma_px
        matches = Matches.from_cameras(
            camera1,
            camera2,
            kept.pixels1,
            kept.pixels2,
            sigma1_px=sigma,
            sigma2_px=sigma,
            A21=kept.A21,
            sigma_A=kept.sigma_A,
        )
        return matches, np.asarray(seen)
