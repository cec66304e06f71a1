"""The unified camera: a sphere seen from a point off its centre.

Reference: C. Mei, P. Rives, "Single view point omnidirectional camera calibration from planar grids", ICRA 2007, here
with alpha = xi / (1 + xi) and fx = gamma_x / (1 + xi), which keeps the focal length that of the image's centre.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from rigkit.cameras.eucm import EUCM


@dataclass(frozen=True, eq=False, slots=True, repr=False)
class UCM(EUCM):
    """m = (x, y) / (alpha |X| + (1 - alpha) z); u = fx m_x + cx, v = fy m_y + cy: the enhanced model with beta = 1.

    Parameters are fx, fy, cx, cy in px, alpha in [0, 1].
    """

    model: ClassVar[str] = "ucm"
    shape_names: ClassVar[tuple[str, ...]] = ("alpha",)
    shape_starts: ClassVar[tuple[tuple[float, ...], ...]] = ((0.1,), (0.5,), (0.6,), (0.7,))

    def _shape(self) -> tuple[float, float]:
        return float(self.parameters[4]), 1.0
