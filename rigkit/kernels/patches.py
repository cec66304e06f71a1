"""Calls of the kernels in patches.c and patch_growth.c: alignment of patches of two images, and growth over
surfaces."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rigkit.core.arrays import Affines, FloatArray, Mat3, Pixels
from rigkit.kernels import kernels
from rigkit.kernels.calls import Struct, make_struct, structure
from rigkit.kernels.declarations import header
from rigkit.kernels.front import ImageOf

MAX_LEVELS = header().constants["MAX_LEVELS"]
PATCH_COLUMNS = header().constants["PATCH_COLUMNS"]
UPPER = np.triu_indices(6)


@structure("pyramid_t")
class Pyramid(Struct):
    """An image pyramid, float32."""

    @classmethod
    def make(cls, levels: Sequence[NDArray[np.float32]]) -> Pyramid:
        images = [ImageOf.of(brightness=level) for level in levels[:MAX_LEVELS]]
        blank = ImageOf.of(brightness=np.zeros((1, 1), np.float32))
        out = cls.of(levels=(ImageOf * MAX_LEVELS)(*images, *[blank] * (MAX_LEVELS - len(images))), count=len(images))
        out._kept["images"] = images, blank
        return out


@structure("patch_rules_t", half="MAX_HALF")
class PatchRules(Struct):
    """Parameters of the alignment of patches, and of their tests."""


@structure("epipolar_t")
class EpipolarKnowledge(Struct):
    """The rays of image 2, an essential matrix, and tolerances of pairs."""

    @classmethod
    def make(
        cls, rays2: FloatArray, spacing: float, E21: Mat3, *, sigma: float, sigma_A: float, max_distance: float
    ) -> EpipolarKnowledge:
        """Return it for the rays (R, C, 3) at the pixels `spacing` * (column, row), NaN where undefined."""
        return cls.of(
            rays2=rays2,
            spacing=float(spacing),
            E21=tuple(E21.reshape(9)),
            sigma=sigma,
            sigma_A=sigma_A,
            max_distance=max_distance,
        )


class PatchTable(NamedTuple):
    """N patches; NaN where the alignment failed.

    Attributes
    ----------
    pixels2 : (N, 2); A21 : (N, 2, 2); correlation : (N,); noise : (N,) variance of the brightness a sample.
    coarser : (N,) pyramid levels by which the patch was aligned more coarsely than the resolution of the images.
    covariance : (N, 6, 6) of (u2, v2, a11, a12, a21, a22).
    """

    pixels2: Pixels
    A21: Affines
    correlation: FloatArray
    noise: FloatArray
    coarser: FloatArray
    covariance: FloatArray


def _table(out: FloatArray) -> PatchTable:
    covariance = np.empty((len(out), 6, 6))
    covariance[:, UPPER[0], UPPER[1]] = covariance[:, UPPER[1], UPPER[0]] = out[:, 9:]
    return PatchTable(out[:, :2], out[:, 2:6].reshape(-1, 2, 2), out[:, 6], out[:, 7], out[:, 8], covariance)


def starts_of(pixels1: Pixels, pixels2: Pixels, A21: Affines) -> FloatArray:
    """Return the initial values (N, 8) of alignments."""
    return np.concatenate([pixels1, pixels2, A21.reshape(-1, 4)], axis=1)


def aligned(first: Pyramid, second: Pyramid, rules: PatchRules, starts: FloatArray) -> PatchTable:
    """Return the patches (N,) aligned from `starts` (N, 8)."""
    return _table(kernels().align_patches(first, second, rules, starts))


def grown(
    first: Pyramid,
    second: Pyramid,
    epipolar: EpipolarKnowledge,
    rules: PatchRules,
    rays1: FloatArray,
    jacobians1: FloatArray,
    step: int,
    max_tries: int,
    seeds: FloatArray,
) -> PatchTable:
    """Return the patches (R * C,) grown from `seeds` (S, 8) over the nodes of rays (R, C, 3), `step` pixels apart."""
    out = np.empty((*rays1.shape[:2], PATCH_COLUMNS))
    grid = make_struct("patch_grid_t", rays1=rays1, jacobians1=jacobians1, out=out, step=step, max_tries=max_tries)
    kernels().grow_patches(first, second, epipolar, rules, grid, seeds)
    return _table(out.reshape(-1, PATCH_COLUMNS))
