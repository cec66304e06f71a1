"""Laboratories: a random lens, and images of a board as a user would take them.

Ordinary ones have 960 x 720 pixels and 55 to 75 or 170 to 190 degrees. Odd ones have any number of pixels from 320 x
240 to 2400 x 1800, a lens of 45 to 200 degrees, six to 24 images, sharp or blurred, some of them JPEG.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rigkit.calibration.views.usable import views_of_image
from rigkit.cameras.base import Camera
from rigkit.cameras.kannala_brandt import KannalaBrandt
from rigkit.core.boards import Board
from rigkit.core.detections import BoardView
from rigkit.core.errors import DegenerateError
from rigkit.detection.detect import detect_boards
from rigkit.geometry.rigid3 import Rigid3
from rigkit.synthetic.photometry import Photometry
from rigkit.synthetic.render import Optics, render
from rigkit.synthetic.scene import PlacedBoard, place_board, sees_paper

SIZE_PX = (960, 720)
TARGET = Board("target", 9, 6, 30.0, 30.0)
TARGET_TRIES = 2000
LENSES = {"regular": (800.0, (55.0, 75.0)), "fisheye": (330.0, (170.0, 190.0))}
"""Focal length about, px, and the range of the field of view, degrees."""
ODD_SIZES = ((320, 240), (640, 480), (752, 480), (1280, 720), (1280, 1024), (1600, 1200), (2400, 1800))
ODD_FIELD_DEG, ODD_IMAGES, ODD_BLUR_PX = (45.0, 200.0), (6, 24), (0.4, 1.1)
FISHEYE_FROM_DEG = 120.0
"""Narrower lenses are drawn between rectilinear and equidistant, wider ones about equidistant."""


@dataclass(frozen=True, eq=False, slots=True)
class Laboratory:
    """A lens with its blur, its light, and how many images of the board are taken."""

    kind: str
    camera: Camera
    optics: Optics
    images: int
    jpeg_quality: int | None = None

    @classmethod
    def ordinary(cls, seed: int, images: int, rng: np.random.Generator) -> Laboratory:
        """Return one whose lens has an image radius f (theta + k theta^3 + m theta^5 + ...), off the middle."""
        kind = list(LENSES)[seed % 2]
        focal = LENSES[kind][0] * rng.uniform(0.95, 1.05)
        centre = np.array(SIZE_PX) / 2.0 + rng.normal(0.0, 8.0, 2)
        curvatures = (
            rng.normal(0.0, [0.03, 0.006, 0.0, 0.0])
            if kind == "fisheye"
            else [-0.2 + rng.normal(0.0, 0.05), 0.05, 0, 0]
        )
        camera = KannalaBrandt(SIZE_PX, np.array([focal, focal * (1.0 + rng.normal(0.0, 1e-3)), *centre, *curvatures]))
        blur = rng.uniform(0.5, 0.9)
        field = rng.uniform(*LENSES[kind][1]) if kind == "fisheye" else None
        return cls(kind, camera, Optics(blur, field_deg=field), images)

    @classmethod
    def odd(cls, rng: np.random.Generator) -> Laboratory:
        """Return one of any size, field of view, blur and compression."""
        size = ODD_SIZES[rng.integers(len(ODD_SIZES))]
        field = rng.uniform(*ODD_FIELD_DEG)
        half, reach = np.radians(0.5 * field), 0.5 * float(np.hypot(*size))
        if field < FISHEYE_FROM_DEG:
            # Of tan theta = theta + theta^3 / 3 + ..., part of the terms.
            curvatures = rng.uniform(-0.2, 0.9) * np.array([1 / 3, 2 / 15, 17 / 315, 62 / 2835])
        else:
            curvatures = rng.normal(0.0, [0.03, 0.006, 0.0, 0.0])
        focal = reach / (half + half ** np.array([3, 5, 7, 9]) @ curvatures)
        centre = np.array(size) / 2.0 + 0.01 * size[0] * rng.normal(size=2)
        camera = KannalaBrandt(size, np.array([focal, focal * (1.0 + rng.normal(0.0, 1e-3)), *centre, *curvatures]))
        jpeg = int(rng.integers(70, 98)) if rng.random() < 0.5 else None
        optics = Optics(rng.uniform(*ODD_BLUR_PX), field_deg=field)
        return cls(
            "odd, narrow" if field < FISHEYE_FROM_DEG else "odd, wide",
            camera,
            optics,
            int(rng.integers(ODD_IMAGES[0], ODD_IMAGES[1] + 1)),
            jpeg,
        )

    def light(self, rng: np.random.Generator) -> Photometry:
        """Return the light and the noise of an image."""
        light = Photometry(
            exposure=rng.uniform(0.8, 1.0),
            vignetting=rng.uniform(0.0, 0.4),
            gradient=tuple(rng.normal(0.0, 0.08, 2).tolist()),
            noise_levels=2.0,
        )
        return replace(light, jpeg_quality=self.jpeg_quality)

    def views(self, rng: np.random.Generator) -> list[BoardView]:
        """Return what is seen of the board in a user's images of it."""
        views: list[BoardView] = []
        for k in range(self.images):
            placed = self._target_in_view(k, rng)
            light = self.light(rng)
            image = render([placed], self.camera, Rigid3.identity(), optics=self.optics, photometry=light, rng=rng)
            views += views_of_image(f"{k:02d}.png", detect_boards(image, [TARGET]), [TARGET])[0]
        return views

    def _target_in_view(self, index: int, rng: np.random.Generator) -> PlacedBoard:
        """Return the board where the image has not had one: in turn in the middle and towards the rim, all round."""
        width, height = self.camera.size_px
        for attempt in range(TARGET_TRIES):
            radius = (0.1, 0.3, 0.42)[index % 3] * rng.uniform(0.8, 1.2)
            angle = 2.4 * index + rng.normal(0.0, 0.4)
            spot = np.array([width * (0.5 + radius * np.cos(angle)), height * (0.5 + radius * np.sin(angle))])
            square = height * rng.uniform(0.05, 0.09) * (1.0 - 0.7 * attempt / TARGET_TRIES)
            placed = place_board(TARGET, self.camera, spot, square, 50.0, rng)
            if placed is not None and sees_paper(placed, self.camera, (0.0, 0.0), self.camera.size_px):
                return placed
        raise DegenerateError("honesty: no view of the whole board was found")
