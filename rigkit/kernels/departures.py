"""Calls of the kernels in departures.c: displacements of a lens beyond its model, and their estimation from images."""

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
        """Return the structure of N corners, view by view, `counts` (V,) per view.

        Parameters
        ----------
        d_pixels_d_point, d_pixels_d_parameters : (2, 3, N) px/mm and (2, P, N), as from `Camera.derivatives`.
        sigmas : (P,) units of the parameters.
        lever : (3, N) from the board's origin to the corner, in the camera frame, mm.
        pixels : u and v, (N,) each, of the projected corners.
        residuals, usable : (N, 2) px, and (N,) which corners are used.
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

    def products(self) -> FloatArray:
        """Return the products (V, K + 6, K + 6) of the columns of the usable corners' rows, view by view.

        The columns are, in this order: the pose (w, t), the P parameters in units of `sigmas`, the displacements, the
        residual.
        """
        return np.asarray(kernels().lens_products(self))


def averaged_amounts(information: FloatArray, score: FloatArray, sizes: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the posterior means of a a^T (J, J) and of a (J,) for the amounts a of displacements, px, from information
    (J, J) and score (J,) of images.

    The prior of a is normal with mean zero, with one of the `sizes` (S,) as standard deviation of radial displacements
    and one of the others; all pairs have equal prior probability and are averaged by their posterior probability.
    """
    second, mean = kernels().average_amounts(information, score, sizes)
    return np.asarray(second), np.asarray(mean)


def displacements(pixels: Pixels, size_px: tuple[int, int]) -> FloatArray:
    """Return J basis displacements (2, J, M) at pixels (M, 2), px, of about one px in the corners of the image.

    They are powers of the radius, decentring (tangential distortion), thin prisms, these two times the square of the
    radius, aspect ratio and shear.
    """
    return np.asarray(kernels().displace_pixels(pixels[:, 0], pixels[:, 1], *size_px))


def displacement(u: FloatArray, v: FloatArray, amounts: FloatArray, size_px: tuple[int, int]) -> FloatArray:
    """Return the displacement (2, M), px, of pixels u, v (M,) by `amounts` (J,) of the basis displacements.

    Beyond the circle through the corners of the image it is that on the circle.
    """
    return np.asarray(kernels().displace_by(u, v, *size_px, amounts))
