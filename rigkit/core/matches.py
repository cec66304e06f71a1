"""Corresponding points, directions and affinities of a pair of images."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from rigkit.core.arrays import (
    Affines,
    BoolArray,
    FloatArray,
    IntArray,
    Mat3,
    Pixels,
    RayJacobians,
    Rays,
    as_array,
    keep_arrays,
    keep_indices,
)
from rigkit.core.errors import InputError
from rigkit.core.printing import brief


class CentralCamera(Protocol):
    """The part of `rigkit.cameras.base.Camera` that two-view geometry needs."""

    def unproject(self, pixels: Pixels) -> tuple[Rays, BoolArray]:
        """Return unit rays and which of them exist."""

    def ray_jacobian(self, pixels: Pixels) -> RayJacobians:
        """Return d ray / d pixel, (..., 3, 2)."""


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class DirectionPairs:
    """Corresponding image directions at N points, K directions each.

    Attributes
    ----------
    image1, image2 : (N, K, 2) px; direction k of point n in either image. Lengths are meaningful if `scaled`.
    valid : (N, K) bool; every estimator ignores invalid directions.
    scaled : whether |image2| / |image1| is the true local stretch (harmonic lengths on a chessboard).
    kinds : names of the K directions.
    pixels1, pixels2 : (N, 2) positions of the points, or None.
    """

    image1: FloatArray
    image2: FloatArray
    valid: BoolArray
    scaled: bool = True
    kinds: tuple[str, ...] = ("horizontal", "vertical", "diagonal")
    pixels1: Pixels | None = None
    pixels2: Pixels | None = None

    __repr__ = brief

    def __post_init__(self) -> None:
        first = np.asarray(self.image1)
        if first.ndim != 3:
            raise InputError(f"directions: expected shape NxKx2, got {first.shape}")
        n, k = first.shape[:2]
        keep_arrays(self, what="directions in ", finite=False, image1=(n, k, 2), image2=(n, k, 2))
        valid = np.array(self.valid, dtype=bool)
        if valid.shape != (n, k):
            raise InputError(f"directions: valid must be {n}x{k}, got {valid.shape}")
        finite = np.isfinite(self.image1).all(axis=-1) & np.isfinite(self.image2).all(axis=-1)
        valid &= finite
        valid.flags.writeable = False
        object.__setattr__(self, "valid", valid)
        if len(self.kinds) != k:
            raise InputError(f"directions: {k} directions a point but {len(self.kinds)} kinds")
        keep_arrays(self, what="directions' ", optional=True, pixels1=(n, 2), pixels2=(n, 2))

    def select(self, which: BoolArray | IntArray) -> DirectionPairs:
        """Return the directions at points selected by a mask or indices, without their pixels."""
        return replace(
            self,
            image1=self.image1[which],
            image2=self.image2[which],
            valid=self.valid[which],
            pixels1=None,
            pixels2=None,
        )


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Matches:
    """N corresponding points of two images, with the local geometry of both cameras.

    Attributes
    ----------
    pixels1, pixels2 : (N, 2)
    rays1, rays2 : (N, 3) unit rays of those pixels in their camera's frame.
    jacobians1, jacobians2 : (N, 3, 2) d ray / d pixel.
    sigma1_px, sigma2_px : (N,) corner standard deviation per axis.
    board_index : (N,) int, index of the board; -1 for none.
    grid : (N, 2) int, (column, row) on that board.
    K1, K2 : (3, 3) camera matrices of perspective views, else None (raw fisheye).
    A21 : (N, 2, 2) affinity from image 1 to image 2 in these pixels, or None; NaN for points without one.
    sigma_A : (N,) standard deviation of an entry of A21, or None.
    """

    pixels1: Pixels
    pixels2: Pixels
    rays1: Rays
    rays2: Rays
    jacobians1: RayJacobians
    jacobians2: RayJacobians
    sigma1_px: FloatArray
    sigma2_px: FloatArray
    board_index: IntArray
    grid: IntArray
    K1: Mat3 | None = None
    K2: Mat3 | None = None
    A21: Affines | None = None
    sigma_A: FloatArray | None = None

    __repr__ = brief

    def __post_init__(self) -> None:
        n = len(as_array(self.pixels1, (None, 2), "pixels1"))
        keep_arrays(self, pixels1=(n, 2), pixels2=(n, 2), rays1=(n, 3), rays2=(n, 3))
        keep_arrays(self, jacobians1=(n, 3, 2), jacobians2=(n, 3, 2), sigma1_px=(n,), sigma2_px=(n,))
        keep_indices(self, board_index=(n,), grid=(n, 2))
        keep_arrays(self, optional=True, K1=(3, 3), K2=(3, 3))
        keep_arrays(self, optional=True, finite=False, A21=(n, 2, 2), sigma_A=(n,))

    def __len__(self) -> int:
        return len(self.pixels1)

    @classmethod
    def from_cameras(
        cls,
        camera1: CentralCamera,
        camera2: CentralCamera,
        pixels1: Pixels,
        pixels2: Pixels,
        *,
        sigma1_px: FloatArray | None = None,
        sigma2_px: FloatArray | None = None,
        board_index: IntArray | None = None,
        grid: IntArray | None = None,
        A21: Affines | None = None,
        sigma_A: FloatArray | None = None,
    ) -> Matches:
        """Return matches with rays and Jacobians computed from the cameras. K1 and K2 are set for pinhole cameras.

        Raises InputError where a pixel has no ray in its camera, or the pixels are not two arrays (N, 2).
        """
        n = len(as_array(pixels1, (None, 2), "matches' pixels1"))
        as_array(pixels2, (n, 2), "matches' pixels2")
        rays1, valid1 = camera1.unproject(pixels1)
        rays2, valid2 = camera2.unproject(pixels2)
        if not (valid1.all() and valid2.all()):
            lost = int(n - (valid1 & valid2).sum())
            raise InputError(f"matches: {lost} of {n} points lie outside a camera's field of view; remove them first")
        ones = np.ones(n)
        return cls(
            pixels1=pixels1,
            pixels2=pixels2,
            rays1=rays1,
            rays2=rays2,
            jacobians1=camera1.ray_jacobian(pixels1),
            jacobians2=camera2.ray_jacobian(pixels2),
            sigma1_px=ones if sigma1_px is None else sigma1_px,
            sigma2_px=ones if sigma2_px is None else sigma2_px,
            board_index=np.full(n, -1) if board_index is None else board_index,
            grid=np.zeros((n, 2), dtype=np.int64) if grid is None else grid,
            K1=getattr(camera1, "K", None),
            K2=getattr(camera2, "K", None),
            A21=A21,
            sigma_A=sigma_A,
        )

    def with_cameras(self, camera1: CentralCamera, camera2: CentralCamera) -> Matches:
        """Return the matches of the same pixels in other cameras, without affinities."""
        return Matches.from_cameras(
            camera1,
            camera2,
            self.pixels1,
            self.pixels2,
            sigma1_px=self.sigma1_px,
            sigma2_px=self.sigma2_px,
            board_index=self.board_index,
            grid=self.grid,
        )

    def with_affinities(self, A21: Affines, sigma_A: FloatArray | None = None) -> Matches:
        """Return the matches with affinities."""
        return replace(self, A21=A21, sigma_A=sigma_A)

    def select(self, which: BoolArray | IntArray) -> Matches:
        """Return the matches selected by a mask or indices."""
        index: NDArray[Any] = np.asarray(which)
        n = len(self)
        mask = index.dtype == np.bool_ and index.shape == (n,)
        if not mask and (index.dtype.kind not in "iu" or index.ndim != 1 or not ((index >= -n) & (index < n)).all()):
            raise InputError(f"matches: a mask or indices of {n} are needed, got {index.dtype} of {index.shape}")

        every = {f.name: getattr(self, f.name) for f in fields(self) if f.name not in ("K1", "K2")}
        picked: dict[str, Any] = {name: None if array is None else array[index] for name, array in every.items()}
        return replace(self, **picked)
