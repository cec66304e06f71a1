"""Images without distortion: they were undistorted or rectified before, or rendered without a lens.

The distortion is what is left of the lens after the pinhole camera that fits it best where boards were seen: to first
order a pixel (u, v) of a pinhole that is turned a little is linear in 1, X, Y, XX, XY, YY with X = x / z, Y = y / z of
its ray, where two coefficients of each of u and v are common (those of XX and XY in u are those of XY and YY
in v: pixels are nearly square).
"""

from __future__ import annotations

import numpy as np

from rigkit.calibration.result import Calibration
from rigkit.core.findings import Finding

MAX_DISTORTION_PART = 1e-4
"""Largest distortion, as a part of the corners' distance from their middle, of images without distortion. Lenses sold
as free of distortion have 1e-3, of which the best pinhole camera leaves a third or less (SIMULATED: 2e-4); REAL: 0.04
for bouguet and bumblebee2, 0.0 for both undistorted by OpenCV with the parameters of their own calibration (alpha 0 and
1)."""
MIN_FIELD_DEG = 12.0
"""A lens that is seen less far off its axis may have so little distortion."""
MIN_IMAGES_OF_FIELD = 5
CORNERS_COMPARED = 500
"""Of more corners, every second, third, ... is used: the pinhole camera has eight unknowns."""
MIN_ALONG_AXIS = 0.2
"""Cosine of the angle from the axis that pinhole images hardly reach."""


def undistorted(calibration: Calibration, *, sure: bool) -> list[Finding]:
    """Return a finding if the images show no distortion, over a field in which nearly every lens has some; none unless
    the projection is `sure`: what a few parts of the image do not determine, the smallest model leaves out."""
    if not sure:
        return []
    pixels = calibration.corners.pixels[calibration.corners.kept]
    pixels = pixels[:: max(1, len(pixels) // CORNERS_COMPARED)]
    rays, valid = calibration.camera.unproject(pixels)
    if len({view.image for view in calibration.views}) < MIN_IMAGES_OF_FIELD or not valid.all():
        return []
    forward = float(rays[:, 2].min())
    if not MIN_ALONG_AXIS < forward < np.cos(np.radians(MIN_FIELD_DEG)):
        return []
    x, y = (rays[:, :2] / rays[:, 2:]).T
    zero, one = np.zeros_like(x), np.ones_like(x)
    along = np.stack([one, x, y, zero, zero, zero, x * x, x * y], axis=1)
    across = np.stack([zero, zero, zero, one, x, y, x * y, y * y], axis=1)
    system = np.concatenate([along, across])
    pinhole = system @ np.linalg.lstsq(system, pixels.T.ravel(), rcond=None)[0]
    distortion_px = np.hypot(*(pixels.T.ravel() - pinhole).reshape(2, -1))
    radius_px = np.hypot(*(pixels - pixels.mean(axis=0)).T)
    if distortion_px.max() > MAX_DISTORTION_PART * radius_px.max():
        return []
    angle = np.degrees(np.arccos(forward))
    return [
        Finding.look(
            f"the images show no distortion (at most {distortion_px.max():.2g} px, up to {angle:.0f} deg off axis), "
            "as hardly any lens takes them: they seem undistorted or rectified already, or rendered",
            "calibrate from the camera's own images if there are such; else apply no distortion to these again",
        )
    ]
