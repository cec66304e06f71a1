"""Targets of rectification show the field of view that was asked for."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.cameras import sample_cameras

from rigkit.core.errors import InputError
from rigkit.rectification.targets import PROJECTIONS, Projection, target_camera

CAMERAS = sample_cameras()


@pytest.mark.parametrize("projection", PROJECTIONS)
@pytest.mark.parametrize("hfov_deg", [40.0, 120.0, 169.0])
@pytest.mark.parametrize("size_px", [None, (800, 300)])
def test_edges_are_at_half_the_field_of_view(
    projection: Projection, hfov_deg: float, size_px: tuple[int, int] | None
) -> None:
    target = target_camera(CAMERAS["kannala_brandt"], projection, hfov_rad=np.radians(hfov_deg), size_px=size_px)
    width, height = target.size_px
    assert size_px is None or target.size_px == size_px
    middle = (height - 1) / 2.0
    rays, valid = target.unproject(np.array([[-0.5, middle], [width - 0.5, middle], [(width - 1) / 2.0, middle]]))
    assert valid.all()
    assert np.degrees(np.arctan2(rays[:, 0], rays[:, 2])) == pytest.approx([-hfov_deg / 2, hfov_deg / 2, 0.0], abs=1e-9)


def test_defaults_keep_the_resolution_and_the_field_of_view() -> None:
    narrow = CAMERAS["pinhole"]
    target = target_camera(narrow)
    assert target.size_px[0] == pytest.approx(narrow.size_px[0], rel=0.02)
    assert target.focal_px == pytest.approx(narrow.focal_px, rel=0.01)
    fisheye = CAMERAS["kannala_brandt"]
    assert target_camera(fisheye, "cylindrical").parameters[0] == pytest.approx(fisheye.focal_px, rel=1e-3)


def test_impossible_fields_of_view_are_refused() -> None:
    for projection, hfov_deg in (("perspective", 175.0), ("cylindrical", 361.0), ("equirectangular", 0.0)):
        with pytest.raises(InputError, match="field of view"):
            target_camera(CAMERAS["pinhole"], projection, hfov_rad=np.radians(hfov_deg))  # type: ignore[arg-type]
    with pytest.raises(InputError, match="unknown"):
        target_camera(CAMERAS["pinhole"], "conic")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="positive"):
        target_camera(CAMERAS["pinhole"], size_px=(0, 10))
