"""Input and output types of the affine estimators: epipolar normals, direction noise, affinities with covariance.

Conventions: A21 = d pixel2 / d pixel1 along the surface, vec(A) = (a11, a12, a21, a22), row by row. Source: L. Hajder,
"Affine Correspondences in Stereo Vision: Theory, Practice, and Limitations".
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from rigkit.core.arrays import Affines, BoolArray, FloatArray, Mat3, Pixels, RayJacobians, Rays, as_array, as_floats
from rigkit.core.errors import InputError
from rigkit.core.matches import DirectionPairs, Matches
from rigkit.core.printing import brief
from rigkit.geometry.sampson import epipolar_normals

STEP_OF_DIRECTION = 1e-6
"""Step of the central differences over the length of a direction: rounding and second order are both negligible."""


@dataclass(frozen=True, eq=False, slots=True)
class EpipolarNormals:
    """Normals of the epipolar lines at N corresponding pixels, on one common scale: A21^T n2 + n1 = 0.

    Attributes
    ----------
    n1, n2 : (N, 2) per px; not normalised, since the ratio of their lengths matters. Zero at an epipole.

    Notes
    -----
    n1 = B1^T E^T f2 and n2 = B2^T E f1 with unit rays f and ray Jacobians B, for any central camera. For pinholes these
    are, up to one scale per point, (F^T q2)[:2] and (F q1)[:2].
    """

    n1: FloatArray
    n2: FloatArray

    __repr__ = brief

    def __post_init__(self) -> None:
        n = len(np.asarray(self.n1))
        object.__setattr__(self, "n1", as_array(self.n1, (n, 2), "epipolar normals in image 1", finite=False))
        object.__setattr__(self, "n2", as_array(self.n2, (n, 2), "epipolar normals in image 2", finite=False))

    def __len__(self) -> int:
        return len(self.n1)

    @classmethod
    def from_rays(
        cls, rays1: Rays, ray_jacobians1: RayJacobians, rays2: Rays, ray_jacobians2: RayJacobians, E21: Mat3
    ) -> EpipolarNormals:
        """Build from unit rays (N, 3), ray Jacobians (N, 3, 2) and the essential matrix: any central camera."""
        _, n1, n2 = epipolar_normals(E21, rays1, rays2, ray_jacobians1, ray_jacobians2)
        return cls(n1, n2)

    @classmethod
    def of_matches(cls, m: Matches, E21: Mat3) -> EpipolarNormals:
        """Build from the rays of matches and the essential matrix."""
        return cls.from_rays(m.rays1, m.jacobians1, m.rays2, m.jacobians2, E21)

    @classmethod
    def from_F(cls, F21: Mat3, pixels1: Pixels, pixels2: Pixels) -> EpipolarNormals:
        """Build from a fundamental matrix and pixels (N, 2) of perspective images without distortion."""
        f = as_array(F21, (3, 3), "F21")
        q1, q2 = as_floats(pixels1, (2,), "pixels1"), as_floats(pixels2, (2,), "pixels2")
        return cls(q2 @ f[:2, :2] + f[2, :2], q1 @ f[:2, :2].T + f[:2, 2])


@dataclass(frozen=True, eq=False, slots=True)
class DirectionNoise:
    """First-order noise of N x K directions in either image.

    Attributes
    ----------
    covariance1, covariance2 : (N, 2K, 2K) px^2, joint covariances of the stacked K directions. Directions that share
        corners are correlated; the diagonal of a chessboard is the sum of its edges.
    """

    covariance1: FloatArray
    covariance2: FloatArray

    __repr__ = brief

    def __post_init__(self) -> None:
        shape = np.asarray(self.covariance1).shape
        if len(shape) != 3 or shape[1] != shape[2] or shape[1] % 2:
            raise InputError(f"direction noise: expected covariances of shape Nx2Kx2K, got {shape}")
        for name in ("covariance1", "covariance2"):
            object.__setattr__(self, name, as_array(getattr(self, name), shape, f"direction {name}", finite=False))

    @classmethod
    def independent(cls, covariance1: FloatArray, covariance2: FloatArray) -> DirectionNoise:
        """Build from (N, K, 2, 2) covariances of independent directions."""
        return cls(_block_diagonal(covariance1), _block_diagonal(covariance2))

    @classmethod
    def angular(cls, directions: DirectionPairs, sigma1_rad: ArrayLike, sigma2_rad: ArrayLike) -> DirectionNoise:
        """Build for independent rotations of all directions, as in the paper's synthetic study.

        `sigma1_rad` and `sigma2_rad`, the standard deviations of the angles, broadcast to (N, K).
        """

        def turned(d: FloatArray, sigma: ArrayLike) -> FloatArray:
            across = np.stack([-d[..., 1], d[..., 0]], axis=-1) * np.broadcast_to(sigma, d.shape[:2])[..., None]
            return np.asarray(across[..., :, None] * across[..., None, :])

        return cls.independent(turned(directions.image1, sigma1_rad), turned(directions.image2, sigma2_rad))

    @classmethod
    def isotropic(cls, directions: DirectionPairs, sigma1_px: ArrayLike, sigma2_px: ArrayLike) -> DirectionNoise:
        """Build for independent noise of `sigma` px per axis of the end of every direction; broadcasts to (N, K)."""

        def round_blob(d: FloatArray, sigma: ArrayLike) -> FloatArray:
            return np.asarray(np.broadcast_to(sigma, d.shape[:2])[..., None, None] ** 2 * np.eye(2))

        return cls.independent(round_blob(directions.image1, sigma1_px), round_blob(directions.image2, sigma2_px))

    @classmethod
    def of_board(
        cls,
        covariance1: FloatArray,
        covariance2: FloatArray,
        shared1: FloatArray | None = None,
        shared2: FloatArray | None = None,
    ) -> DirectionNoise:
        """Build for a chessboard's horizontal, vertical and diagonal, the diagonal being the sum of the two.

        Parameters
        ----------
        covariance1, covariance2 : (N, 3, 2, 2) px^2, of the three directions in either image.
        shared1, shared2 : (N, 2, 2) px^2, cov(h, v). None: its symmetric part, from cov(d) = cov(h) + cov(v) +
            cov(h, v) + cov(v, h).
        """
        joint = []
        for covariance, shared in ((covariance1, shared1), (covariance2, shared2)):
            c = np.asarray(covariance, dtype=np.float64)
            if c.ndim != 4 or c.shape[1:] != (3, 2, 2):
                raise InputError(f"direction noise of a board: expected Nx3x2x2, got {c.shape}")
            edges = _block_diagonal(c[:, :2])
            edges[:, :2, 2:] = 0.5 * (c[:, 2] - c[:, 0] - c[:, 1]) if shared is None else shared
            edges[:, 2:, :2] = np.swapaxes(edges[:, :2, 2:], 1, 2)
            joint.append(edges)
        return cls(*joint).with_sum(0, 1)

    def with_sum(self, first: int, second: int) -> DirectionNoise:
        """Return the noise with a further direction, the exact sum of `first` and `second` (a chessboard diagonal)."""
        k2 = self.covariance1.shape[1]
        build = np.zeros((k2 + 2, k2))
        build[:k2] = np.eye(k2)
        for axis in (0, 1):
            build[k2 + axis, 2 * first + axis] += 1.0
            build[k2 + axis, 2 * second + axis] += 1.0
        return DirectionNoise(build @ self.covariance1 @ build.T, build @ self.covariance2 @ build.T)


def propagated(
    solve: Callable[[DirectionPairs], Affines], directions: DirectionPairs, noise: DirectionNoise
) -> FloatArray:
    """Return the first-order covariance (N, 4, 4) of vec(A21), by central differences of the estimator `solve`.

    Directions that are not valid are ignored; their noise may be NaN.
    """
    n, k = directions.valid.shape
    unused = np.repeat(~directions.valid, 2, axis=1)
    ignore = unused[:, :, None] | unused[:, None, :]
    total = np.zeros((n, 4, 4))
    for image, covariance in (("image1", noise.covariance1), ("image2", noise.covariance2)):
        d = getattr(directions, image)
        length = np.linalg.norm(d, axis=-1)
        step = STEP_OF_DIRECTION * np.where(directions.valid & (length > 0.0), length, 1.0)
        by = np.zeros((n, 4, k, 2))
        for j, axis in np.ndindex(k, 2):
            move = np.zeros_like(d)
            move[:, j, axis] = step[:, j]
            ahead, back = (solve(replace(directions, **{image: d + sign * move})) for sign in (1.0, -1.0))
            by[:, :, j, axis] = (ahead - back).reshape(n, 4) / (2.0 * step[:, j, None])
        flat = by.reshape(n, 4, 2 * k)
        total += flat @ np.where(ignore, 0.0, covariance) @ np.swapaxes(flat, 1, 2)
    return total


def _block_diagonal(blocks: FloatArray) -> FloatArray:
    c = np.asarray(blocks, dtype=np.float64)
    if c.ndim != 4 or c.shape[2:] != (2, 2):
        raise InputError(f"direction noise: expected covariances of shape NxKx2x2, got {c.shape}")
    n, k = c.shape[:2]
    out = np.zeros((n, k, 2, k, 2))
    index = np.arange(k)
    out[:, index, :, index, :] = np.moveaxis(c, 1, 0)
    return out.reshape(n, 2 * k, 2 * k)


@dataclass(frozen=True, eq=False, slots=True)
class Affinities:
    """Affine transformations of N corners.

    Attributes
    ----------
    A21 : (N, 2, 2), NaN where invalid.
    valid : (N,) bool.
    conditioning : (N,) smallest singular value of the estimator's system of unit directions. With two perpendicular
        directions and an epipolar geometry it is min |unit(d2) . unit(n2)|, 0 for a direction along its epipolar line.
        NaN with too few directions.
    covariance : (N, 4, 4) of vec(A21), row by row; NaN where invalid. None without noise.
    """

    A21: Affines
    valid: BoolArray
    conditioning: FloatArray
    covariance: FloatArray | None = None

    def __len__(self) -> int:
        return len(self.A21)

    @property
    def sigma_A(self) -> FloatArray | None:
        """(N,) root mean square standard deviation of the four entries of A21, or None."""
        if self.covariance is None:
            return None
        return np.asarray(np.sqrt(np.trace(self.covariance, axis1=-2, axis2=-1) / 4.0))
