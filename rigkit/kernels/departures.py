"""Calls of the kernels in departures.c: what a lens may do beyond its model, and what its images say of that."""

from __future__ import annotations

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray, IntArray, Pixels
from rigkit.kernels import kernels
from rigkit.kernels.calls import Struct, structure
from rigkit.kernels.declarations import header

DISPLACEMENTS = header().constants["DISPLACEMENTS"]
POSE = header().constants["POSE"]


@structure("lens_corners_t")
class LensCorners(Struct):
    """Corners of boards, view after view, with their derivatives."""

    @classmethod
    def make(
        cls,
        d_pixels_d_point: FloatArray,
        d_pixels_d_parameters: FloatArray,
        sigmas: FloatArray,
        lever: FloatArray,
        pixels: tuple[FloatArray, FloatArray],
        residuals: FloatArray,
        usable: BoolArray,
        counts: IntArray,
        size_px: tuple[int, int],
    ) -> LensCorners:
        """Return them: N corners, so many of each view (V,) as `counts` say.

        Parameters
        ----------
        d_pixels_d_point, d_pixels_d_parameters : (2, 3, N) px/mm and (2, P, N), as of `Camera.derivatives`.
        sigmas : (P,) units in which parameters count.
        lever : (3, N) from the board's origin to the corner, in the camera frame, mm.
        pixels : u and v, (N,) each, where the corners project.
        residuals, usable : (N, 2) px, and (N,) which corners tell anything.
        """
        return cls.of(
            d_pixels_d_point=d_pixels_d_point,
            d_pixels_d_parameters=d_pixels_d_parameters,
            sigmas=sigmas,
            lever=lever,
            u=pixels[0],
            v=pixels[1],
            residuals=residuals,
            usable=usable,
            counts=counts,
            width=size_px[0],
            height=size_px[1],
        )

    def products(self) -> tuple[FloatArray, FloatArray]:
        """Return the sums of products of the corners' rows that tell: of every view those of all K + 6 with its pose
        (V, K + 6, 6), and over all views those of the others (K, K).

        With rows in this order: the pose (w, t), the P parameters in units of `sigmas`, the displacements, the
        residual.
        """
        products: tuple[FloatArray, FloatArray] = kernels().lens_products(self)
        return products


def averaged_amounts(information: FloatArray, score: FloatArray, sizes: FloatArray) -> FloatArray:
    """Return E[a a^T] (J, J) of the amounts a of displacements, px, of which images give the information (J, J) and the
    score (J,).

    Beforehand a is normal with mean zero, those along the radius of one of the `sizes` (S,), the others of one, all
    pairs alike; each counts as far as the images bear it out.
    """
    return np.asarray(kernels().average_amounts(information, score, sizes))


def displacements(pixels: Pixels, size_px: tuple[int, int]) -> FloatArray:
    """Return the displacements (2, J, M) at pixels (M, 2), px: of about one px in the corners of the image.

    Powers of the radius, decentring (tangential distortion), thin prisms, these again with the square of the radius,
    aspect ratio and shear.
    """
    return np.asarray(kernels().displace_pixels(pixels[:, 0], pixels[:, 1], *size_px))


def displacement(u: FloatArray, v: FloatArray, amounts: FloatArray, size_px: tuple[int, int]) -> FloatArray:
    """Return how far amounts (J,) of the displacements move pixels u, v (M,), (2, M) px; beyond the corners of the
    image as on the circle through them."""
    return np.asarray(kernels().displace_by(u, v, *size_px, amounts))
