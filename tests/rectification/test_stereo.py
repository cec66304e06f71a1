"""Rectified pairs: the same point in the same row, whatever the two lenses and the baseline."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.cameras import sample_cameras
from helpers.tolerances import ROUND_TRIP_PX

from rigkit.cameras.pinhole import Pinhole
from rigkit.core.errors import DegenerateError, InputError
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3
from rigkit.rectification.stereo import StereoRectification, rectify_pair

CAMERAS = sample_cameras()
SIDE = Rigid3(exp_so3(np.array([0.05, -0.1, 0.08])), np.array([-300.0, 12.0, 25.0]))
FORWARD = Rigid3(exp_so3(np.array([0.02, 0.03, -0.05])), np.array([5.0, -8.0, -200.0]))


def _rows(pair: StereoRectification, motion: Rigid3, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels of points in both rectified images, where both see them on the target."""
    images = []
    for remap, seen in ((pair.map1, points), (pair.map2, motion.apply(points))):
        pixels, valid = remap.camera.project(seen)
        there, also = remap.pixels(np.where(valid[..., None], pixels, np.nan))
        images.append((there, valid & also & remap.target.on_image(there)))
    both = images[0][1] & images[1][1]
    assert both.sum() > 100
    return images[0][0][both], images[1][0][both]


@pytest.mark.parametrize("projection", ["perspective", "cylindrical", "equirectangular"])
@pytest.mark.parametrize(
    ("label1", "label2"),
    [("brown", "brown"), ("kannala_brandt", "brown"), ("scaramuzza", "double_sphere"), ("eucm", "pinhole")],
)
def test_same_row(label1: str, label2: str, projection: str, rng: np.random.Generator) -> None:
    pair = rectify_pair(CAMERAS[label1], CAMERAS[label2], SIDE, projection=projection)  # type: ignore[arg-type]
    points = rng.uniform([-900.0, -700.0, 300.0], [900.0, 700.0, 2500.0], (3000, 3))
    first, second = _rows(pair, SIDE, points)
    assert np.abs(first[:, 1] - second[:, 1]).max() < 10.0 * ROUND_TRIP_PX
    # Camera 2 is to the right: near things move to the left.
    assert (first[:, 0] > second[:, 0]).all()
    assert pair.baseline_mm == pytest.approx(np.linalg.norm(SIDE.translation_mm), rel=1e-12)
    assert pair.rect2_from_rect1.translation_mm == pytest.approx([-pair.baseline_mm, 0.0, 0.0], abs=1e-9)


def test_camera_2_on_the_left_is_not_turned_upside_down() -> None:
    pair = rectify_pair(CAMERAS["kannala_brandt"], CAMERAS["kannala_brandt"], SIDE.inverse())
    assert pair.rect2_from_rect1.translation_mm[0] > 0.0
    assert (np.diag(pair.map1.target_from_cam) > 0.8).all()


@pytest.mark.parametrize("projection", ["cylindrical", "equirectangular"])
def test_forward_motion_around_the_baseline(projection: str, rng: np.random.Generator) -> None:
    fisheye = CAMERAS["scaramuzza"]
    pair = rectify_pair(fisheye, fisheye, FORWARD, projection=projection)  # type: ignore[arg-type]
    points = rng.uniform([-900.0, -700.0, -100.0], [900.0, 700.0, 900.0], (3000, 3))
    first, second = _rows(pair, FORWARD, points)
    assert np.abs(first[:, 1] - second[:, 1]).max() < 10.0 * ROUND_TRIP_PX


def test_images_of_a_wall_meet_after_rectification() -> None:
    """A wall far away looks the same to both: the two rectified pictures of it agree."""
    cameras = [CAMERAS["kannala_brandt"], CAMERAS["brown"]]
    pair = rectify_pair(cameras[0], cameras[1], Rigid3(SIDE.rotation, 1e-3 * SIDE.translation_mm))
    pictures = []
    for remap, turn in ((pair.map1, np.eye(3)), (pair.map2, SIDE.rotation)):
        columns, rows = remap.camera.size_px
        grid = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1).astype(float)
        rays = np.nan_to_num(remap.camera.unproject(grid)[0]) @ turn
        pictures.append(
            remap.image(100.0 + 50.0 * np.sin(20.0 * rays[..., 0]) * np.cos(20.0 * rays[..., 1]), fill=-1.0)
        )
    seen = (pictures[0] >= 0.0) & (pictures[1] >= 0.0)
    assert seen.mean() > 0.2
    assert np.quantile(np.abs(pictures[0] - pictures[1])[seen], 0.99) < 0.5


def test_pairs_that_cannot_be_rectified_are_refused() -> None:
    fisheye, narrow = CAMERAS["kannala_brandt"], CAMERAS["pinhole"]
    with pytest.raises(DegenerateError, match="equirectangular"):
        rectify_pair(fisheye, fisheye, FORWARD)
    with pytest.raises(DegenerateError, match="same centre"):
        rectify_pair(fisheye, fisheye, Rigid3(SIDE.rotation, np.zeros(3)))
    with pytest.raises(InputError, match="unknown"):
        rectify_pair(fisheye, fisheye, SIDE, projection="conic")  # type: ignore[arg-type]
    looks_away = Rigid3(exp_so3(np.array([2.0, 0.0, 0.0])), np.array([-300.0, 0.0, 0.0]))
    with pytest.raises(DegenerateError, match="stereo rectification"):
        rectify_pair(narrow, narrow, looks_away)


@pytest.mark.parametrize("projection", ["perspective", "cylindrical"])
def test_the_target_has_the_columns_of_either_and_the_rows_of_both_at_their_resolution(projection: str) -> None:
    one = Pinhole((640, 480), np.array([600.0, 600.0, 300.0, 250.0]))
    two = Pinhole((640, 480), np.array([600.0, 600.0, 340.0, 260.0]))
    # Squinting inwards, and the second camera a little up.
    pose = Rigid3(exp_so3(np.array([-0.05, 0.2, 0.02])), [-120.0, 4.0, 15.0])
    pair = rectify_pair(one, two, pose, projection=projection)  # type: ignore[arg-type]
    steps = np.linspace(0.0, 1.0, 301)
    edge = np.concatenate(
        [np.stack([steps, np.full(301, k)], axis=1) for k in (0.0, 1.0)]
        + [np.stack([np.full(301, k), steps], axis=1) for k in (0.0, 1.0)]
    )
    ends = []
    for remap in (pair.map1, pair.map2):
        there, valid = remap.pixels(edge * [639.0, 479.0])
        assert valid.all()
        ends.append((there.min(axis=0), there.max(axis=0)))
        assert np.median(remap.scale(edge * [639.0, 479.0])) == pytest.approx(1.0, abs=0.1)
    low, high = np.array(ends).swapaxes(0, 1)
    size = np.array(pair.map1.target.size_px) - 1.0
    # The extent is that of samples of the images; the size is rounded up.
    np.testing.assert_allclose([low[:, 0].min(), low[:, 1].max()], 0.0, atol=1.0)
    np.testing.assert_allclose([high[:, 0].max(), high[:, 1].min()], size, atol=2.0)
    assert np.ptp(low, axis=0).min() > 5.0 and np.ptp(high, axis=0).min() > 5.0
