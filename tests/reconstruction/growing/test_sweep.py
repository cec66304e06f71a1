"""A plane sweep fills the gaps between patches, with true sigmas."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest
from helpers.textured_scene import CAM2_FROM_CAM1, SMALL_LENSES, SMALL_SIZE, Corner, texture
from numpy.typing import NDArray

from rigkit.affine.correspondences import Correspondences
from rigkit.affine.features import match_affine_features
from rigkit.cameras.pinhole import Pinhole
from rigkit.geometry.rigid3 import Rigid3
from rigkit.kernels.sweep import swept_costs, swept_surfaces
from rigkit.reconstruction.growing import sweep as sweep_module
from rigkit.reconstruction.growing.dense import grow_scene
from rigkit.reconstruction.growing.grow import (
    EpipolarConstraint,
    GrowingView,
    GrownPatches,
    PosedViews,
    grow_in_both_directions,
)
from rigkit.reconstruction.growing.surface import NodeMeasurements, PairRays
from rigkit.reconstruction.growing.sweep import fill_by_sweep
from rigkit.reconstruction.scene import reconstruct_scene
from rigkit.reconstruction.scene_pose import KnownPose
from rigkit.relative_pose.solvers.pose import essential_from_pose

STEP = 3
HOLE = np.s_[25:55, 35:75]
"""Nodes that patches are taken from."""
FLAT = np.s_[45:70, 190:230]
"""Pixels of image 1 without any texture."""


@cache
def grown_with_hole(lens: str) -> tuple[GrownPatches, NodeMeasurements, PosedViews, Corner]:
    rng = np.random.default_rng(5)
    corner, camera = Corner.of_a_room(), SMALL_LENSES[lens]
    images: list[NDArray[np.generic]] = [
        np.asarray(corner.image(camera, pose, rng)) for pose in (Rigid3.identity(), CAM2_FROM_CAM1)
    ]
    greys = [image if image.ndim == 2 else image.mean(axis=2).astype(np.uint8) for image in images]
    greys[0] = greys[0].copy()
    greys[0][FLAT] = 90
    view1, view2 = (GrowingView.of(grey, camera) for grey in greys)
    pixels = np.stack(np.meshgrid(np.arange(20.0, 300.0, 20.0), np.arange(20.0, 220.0, 20.0)), axis=-1).reshape(-1, 2)
    pixels2, seen = camera.project(CAM2_FROM_CAM1.apply(corner.surface(camera, pixels)[0]))
    near = [camera.project(CAM2_FROM_CAM1.apply(corner.surface(camera, pixels + d)[0]))[0] for d in np.eye(2)]
    A21 = np.stack([each - pixels2 for each in near], axis=-1)
    seeds = Correspondences(pixels, pixels2, A21, None, None, None).select(seen)
    known = EpipolarConstraint(essential_from_pose(CAM2_FROM_CAM1), 0.7, 0.1, 0.01)
    grown = grow_in_both_directions(view1, view2, seeds, step=STEP, known=known).centred()
    keep = np.ones(grown.valid.shape, dtype=bool)
    keep[HOLE] = False
    grown = grown.where(keep)
    measured = PairRays.of(grown, camera, camera).measured(CAM2_FROM_CAM1)
    return grown, measured, PosedViews(view1, view2, CAM2_FROM_CAM1), corner


@pytest.mark.parametrize("lens", SMALL_LENSES)
def test_gaps_between_patches_are_filled_to_the_stated_accuracy(lens: str) -> None:
    grown, measured, views, corner = grown_with_hole(lens)
    done, _ = fill_by_sweep(grown, measured, views)
    # Only beside the seams of the walls the sweep contradicts patches.
    assert (done.swept & grown.valid).sum() < 0.005 * grown.valid.sum()
    kept = grown.valid & ~done.swept
    np.testing.assert_array_equal(done.pixels2[kept], grown.pixels2[kept])
    hole = np.zeros(done.valid.shape, dtype=bool)
    hole[HOLE] = True
    camera = SMALL_LENSES[lens]
    place, _ = camera.project(CAM2_FROM_CAM1.apply(corner.surface(camera, views.view1.nodes(STEP)[hole])[0]))
    inside = ((place > 10.0) & (place < np.array(SMALL_SIZE) - 11.0)).all(axis=1)
    filling = done.swept & hole
    assert inside.sum() > 400
    assert filling[hole][inside].mean() > 0.9
    expected, _ = camera.project(CAM2_FROM_CAM1.apply(corner.surface(camera, done.pixels1[filling])[0]))
    off = np.linalg.norm(done.pixels2[filling] - expected, axis=1)
    sigma = np.sqrt(done.covariance[filling, 0, 0])
    assert np.median(off) < 0.5
    # Of one component the median is 0.67 standard deviations.
    assert 0.3 < np.median(off / sigma) < 1.2
    assert np.mean(off > 3.0) < 0.02


def test_pairs_that_the_sweep_contradicts_give_way_to_its_own() -> None:
    grown, measured, views, corner = grown_with_hole("pinhole")
    wrong = np.zeros(grown.valid.shape, dtype=bool)
    wrong[30:50, 80:95] = True
    wrong &= grown.valid
    # By three pixels along the epipolar line.
    z = measured.z.copy()
    z[wrong, 0] += 3.0 / measured.slope[wrong]
    done, sweep = fill_by_sweep(grown, replace(measured, z=z), views)
    assert wrong.sum() > 200 and sweep is not None
    assert done.swept[wrong].mean() > 0.95
    expected, _ = SMALL_LENSES["pinhole"].project(
        CAM2_FROM_CAM1.apply(corner.surface(SMALL_LENSES["pinhole"], done.pixels1[wrong])[0])
    )
    assert np.median(np.linalg.norm(done.pixels2[wrong] - expected, axis=1)) < 0.5
    # Nor is a plane there distinct, whatever lies in it.
    at = wrong & np.isfinite(measured.z[..., 0])
    reported = []
    for printed in (measured.z, z):
        plane = np.asarray(np.linalg.solve(measured.frame[at], printed[at][..., None])[..., 0], np.float64)
        reported.append(sweep.distinct(grown.pixels1[at], plane, measured.slope[at], np.ones(at.sum())).mean())
    assert reported[0] > 0.95 and reported[1] < 0.05


def test_nothing_is_filled_where_there_is_no_texture() -> None:
    grown, measured, views, _ = grown_with_hole("pinhole")
    done, _ = fill_by_sweep(grown, measured, views)
    rows, columns = (np.arange(n) * STEP for n in done.valid.shape)
    inside = np.zeros(done.valid.shape, dtype=bool)
    v, u = FLAT
    # Patches of the middle do not reach the border.
    middle = (rows > v.start + 8) & (rows < v.stop - 8), (columns > u.start + 8) & (columns < u.stop - 8)
    inside[np.ix_(*middle)] = True
    assert inside.sum() > 10
    assert not done.valid[inside].any()


def test_a_sweep_that_contradicts_the_patches_is_not_believed() -> None:
    grown, measured, views, _ = grown_with_hole("pinhole")
    unrelated = np.random.default_rng(1).uniform(0.0, 255.0, views.view2.grey.shape)
    other = replace(views.view2, grey=unrelated.astype(np.uint8))
    done, sweep = fill_by_sweep(grown, measured, views._replace(view2=other))
    assert done is grown
    assert sweep is None


def test_a_wall_at_one_range_is_swept_without_a_fault() -> None:
    """All that grew says the same range: the sweep still has levels around it."""
    grown, measured, views, _ = grown_with_hole("pinhole")
    same = measured.z.copy()
    same[..., 0] = np.where(np.isfinite(same[..., 0]), np.nanmedian(same[..., 0]), np.nan)
    with np.errstate(all="raise", under="ignore"):
        done, _ = fill_by_sweep(grown, replace(measured, z=same), views)
    assert done.valid.sum() >= grown.valid.sum()


CARD_MM, WALL_MM = 800.0, 1300.0
CARD_HALF_MM = 110.0
BESIDE_PX = 2.0
"""From the card's edge: nearer, a sample shows both."""


def card_before_a_wall(pose: Rigid3, camera: Pinhole, rng: np.random.Generator) -> NDArray[np.uint8]:
    """What a camera at `pose` from camera 1 sees: a bright card before a wall of little contrast."""
    width, height = camera.size_px
    u, v = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64))
    rays, _ = camera.unproject(np.stack([u, v], axis=-1))
    back = pose.inverse()
    origin, directions = back.translation_mm, rays @ back.rotation.T
    brightness = []
    for depth, dull, seed in ((WALL_MM, 0.15, 1), (CARD_MM, 0.6, 2)):
        at = origin[:2] + directions[..., :2] * ((depth - origin[2]) / directions[..., 2])[..., None]
        inside = (np.abs(at) < CARD_HALF_MM).all(axis=-1)
        x, y = (np.ascontiguousarray(at[..., k] + 1024.0, np.float32) for k in (0, 1))
        pattern = cv2.remap(texture(np.random.default_rng(seed)), x, y, cv2.INTER_LINEAR)
        brightness.append((60.0 if depth == WALL_MM else 150.0) + dull * (pattern - 127.0))
    image = np.where(inside, brightness[1], brightness[0])
    return np.clip(image + rng.normal(0.0, 1.0, image.shape), 0, 255).astype(np.uint8)


def cloud_of_the_card() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Depths of the points, and how far beyond the card's edge they are in image 1, px."""
    camera, rng = Pinhole((400, 300), np.array([380.0, 380.0, 199.5, 149.5])), np.random.default_rng(3)
    pose = Rigid3(np.eye(3), np.array([-90.0, -20.0, 0.0]))
    images = [card_before_a_wall(p, camera, rng) for p in (Rigid3.identity(), pose)]
    seeds = match_affine_features(*images)
    length = float(np.linalg.norm(pose.translation_mm))
    known = KnownPose(pose)
    sparse = reconstruct_scene(seeds, camera, camera, baseline_mm=length, known_pose=known, image1=images[0])
    r = grow_scene(sparse, seeds, *images, pose_is_known=True).scene.reconstruction
    half = CARD_HALF_MM / CARD_MM * 380.0
    outside = np.abs(r.pixels1 - np.array([199.5, 149.5])).max(axis=1) - half
    return r.cloud.points_mm[:, 2], outside


def test_a_wall_too_dull_for_patches_is_not_as_near_as_the_card_before_it(monkeypatch: pytest.MonkeyPatch) -> None:
    depth, outside = cloud_of_the_card()
    for limit in ("MAX_OF_RIVAL", "MAX_FROM_WINNER_PX"):
        monkeypatch.setattr(sweep_module, limit, np.inf)
    all_depths, all_outside = cloud_of_the_card()
    near, all_near = (np.abs(z / CARD_MM - 1.0) < 0.2 for z in (depth, all_depths))
    # Nothing but the card itself grows, and the sweep goes on from there.
    before = (all_near & (all_outside > BESIDE_PX)).sum()
    assert before > 300
    assert (near & (outside > BESIDE_PX)).sum() < 0.05 * before
    assert (outside < -BESIDE_PX).sum() > 0.95 * (all_outside < -BESIDE_PX).sum()


@pytest.mark.parametrize("seed", [0, 1])
def test_two_images_that_have_nothing_in_common_show_no_surface(seed: int) -> None:
    rng = np.random.default_rng(seed)
    texels = [cv2.GaussianBlur(rng.normal(size=(300, 400)), (0, 0), 0.6) for _ in range(2)]
    images = [np.rint(120.0 + 40.0 * t / t.std()).clip(0.0, 255.0).astype(np.float32) for t in texels]
    levels, spacing, shape = 40, 8, images[0].shape
    coarse = np.stack(np.meshgrid(*(np.arange(0.0, n + spacing, spacing) for n in reversed(shape))), axis=-1)
    table = np.stack([coarse - [k, 0.0] for k in range(levels)]).astype(np.float32)
    costs = swept_costs(images[1], images[0], table, spacing)
    best, _ = swept_surfaces(
        costs,
        levels,
        images[0],
        bend=sweep_module.CURVATURE_COST,
        jump=sweep_module.JUMP_COST,
        even=sweep_module.EVEN_LEVELS,
    )
    sweep = sweep_module.Sweep(
        inverse=np.arange(float(levels)),
        step_px=1.0,
        pixels1=np.zeros((*shape, 2), np.float32),
        rays1=np.zeros((*shape, 3)),
        samples1=images[0],
        costs=costs,
        winners=best.astype(np.float64),
        seen=np.ones(shape, dtype=bool),
        reliable=np.ones(shape, dtype=bool),
    )
    inside = (best > 0) & (best < levels - 1)
    agreed = np.where(np.arange(shape[1]) < 20, sweep.winners, np.nan)
    assert sweep_module._reliable(sweep, inside, np.full(shape, np.nan)).mean() < 0.002
    # As many are as large as surfaces are.
    assert sweep_module._reliable(sweep, inside, agreed)[:, :20].mean() > 0.02


def test_no_light_falls_around_the_circle_of_a_fisheye_but_does_on_its_dark_spots() -> None:
    v, u = np.indices((240, 320))
    around = np.hypot(u - 160.0, v - 120.0) > 110.0
    spot = np.hypot(u - 180.0, v - 100.0) < 12.0
    rng = np.random.default_rng(3)
    image = np.where(around | spot, 0.0, 120.0) + rng.uniform(0.0, 5.0, around.shape)
    lit = sweep_module._image_circle(GrowingView.of(image.astype(np.uint8), SMALL_LENSES["fisheye"]))
    np.testing.assert_array_equal(lit == 0.0, around)
