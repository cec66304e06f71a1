"""Differences of cameras: a rotation is free, the rest is measured in px."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.cameras import sample_cameras

from rigkit.cameras.base import Camera
from rigkit.cameras.compare import compare_cameras
from rigkit.cameras.kannala_brandt import KannalaBrandt
from rigkit.cameras.pinhole import Pinhole
from rigkit.cameras.registry import camera_model
from rigkit.core.errors import DegenerateError, InputError
from rigkit.geometry.rotation import rotation_angle

CAMERAS = sample_cameras()
NOTHING_PX = 1e-8
"""Two descriptions of one camera: only rounding is left."""


@pytest.mark.parametrize("label", sorted(CAMERAS))
def test_a_camera_does_not_differ_from_itself(label: str) -> None:
    found = compare_cameras(CAMERAS[label], CAMERAS[label])
    assert found.coverage > 0.85
    assert found.max_px < NOTHING_PX
    assert found.rotation_deg < NOTHING_PX


def test_the_same_lens_in_another_model() -> None:
    unified = CAMERAS["ucm"]
    p = unified.parameters
    enhanced = camera_model("eucm")(unified.size_px, np.append(p, 1.0))
    assert compare_cameras(unified, enhanced).max_px < NOTHING_PX


def test_shifted_centre_of_a_narrow_lens_is_a_rotation_at_first_order() -> None:
    """Pinhole, f = 3000: moving the centre by 3 px is a turn by 3/3000 rad up to the second order of the angle."""
    a = Pinhole((640, 480), np.array([3000.0, 3000.0, 319.5, 239.5]))
    b = a.with_parameters([3000.0, 3000.0, 322.5, 239.5])
    found = compare_cameras(a, b)
    assert np.radians(found.rotation_deg) == pytest.approx(3.0 / 3000.0, rel=0.01)
    assert found.max_px < 0.05
    plain = compare_cameras(a, b, fit_rotation=False)
    assert plain.rms_px == pytest.approx(3.0, abs=1e-9)
    assert plain.rotation_deg == 0.0


def test_focal_length_shows_as_a_radial_difference() -> None:
    a = Pinhole((641, 481), np.array([500.0, 500.0, 320.0, 240.0]))
    b = a.with_parameters([505.0, 505.0, 320.0, 240.0])
    found = compare_cameras(a, b)
    expected = np.linalg.norm(found.pixels - [320.0, 240.0], axis=-1) * 0.01
    assert np.abs(found.map_px - expected).max() < 1e-6
    assert found.max_px == pytest.approx(4.0, abs=1e-6)
    assert rotation_angle(found.b_from_a) < 1e-8


def test_the_rotation_found_is_the_best(rng: np.random.Generator) -> None:
    a = CAMERAS["kannala_brandt"]
    b = a.with_parameters(a.parameters * (1.0 + 1e-3 * rng.normal(size=8)))
    found = compare_cameras(a, b)
    from rigkit.geometry.rotation import exp_so3

    rays, seen = a.unproject(found.pixels)

    def rms(turn: np.ndarray) -> float:
        projected, valid = b.project(rays @ (exp_so3(turn) @ found.b_from_a).T)
        return float(np.sqrt(np.mean(np.sum((projected - found.pixels)[valid & seen] ** 2, axis=-1))))

    assert rms(np.zeros(3)) == pytest.approx(found.rms_px, rel=1e-12)
    for axis in np.eye(3):
        for sign in (-1e-4, 1e-4):
            assert rms(sign * axis) > found.rms_px


def test_mask_and_weights() -> None:
    a, b = CAMERAS["kannala_brandt"], CAMERAS["kannala_brandt_folding"]
    mask = np.zeros((45, 60), dtype=bool)
    mask[15:30, 20:40] = True
    inside = compare_cameras(a, b, mask=mask)
    assert inside.covered.sum() == mask.sum()
    assert inside.rms_px < compare_cameras(a, b).rms_px
    weighted = compare_cameras(a, b, weights=np.where(mask, 1.0, 1e-12))
    assert weighted.map_px[mask].max() == pytest.approx(inside.max_px, rel=1e-3)


def test_cameras_of_different_sizes_or_fields_of_view_are_not_compared() -> None:
    a = CAMERAS["kannala_brandt"]
    with pytest.raises(InputError, match="one image size"):
        compare_cameras(a, KannalaBrandt((640, 480), a.parameters))
    with pytest.raises(InputError, match="mask"):
        compare_cameras(a, a, mask=np.ones((3, 3), dtype=bool))
    with pytest.raises(DegenerateError, match="share"):
        compare_cameras(a, a, mask=np.zeros((45, 60), dtype=bool))
    narrow: Camera = Pinhole((1280, 960), np.array([1e5, 1e5, 1e6, 1e6]))
    found = compare_cameras(narrow, narrow)
    assert found.max_px < 1e-3


@pytest.mark.parametrize(
    "grid", [(20.5, 15), (0, 15), (-1, -1), (20,), (np.nan, 15), ("a", "b"), (True, True), (10**9, 2), 20]
)
def test_an_empty_grid_is_refused(grid: object) -> None:
    with pytest.raises(InputError, match="grid"):
        compare_cameras(CAMERAS["pinhole"], CAMERAS["pinhole"], grid=grid)  # type: ignore[arg-type]
