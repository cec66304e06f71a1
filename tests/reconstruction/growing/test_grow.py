"""Correspondences that grow over textured walls: places, normals and stated errors against the exact surface."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from helpers.epipolar_scenes import pose_errors_deg
from helpers.textured_scene import CAM2_FROM_CAM1, LENSES, SMALL_LENSES, Corner

from rigkit.affine.correspondences import Correspondences
from rigkit.affine.features import TILTS, match_affine_features
from rigkit.affine.refine_patches import FLOOR_PX
from rigkit.cameras.pinhole import Pinhole
from rigkit.cameras.uncertain import UncertainCamera
from rigkit.core.progress import silent
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import angle_between, log_so3
from rigkit.reconstruction.growing.dense import DenseScene, grow_scene
from rigkit.reconstruction.growing.grow import EpipolarConstraint, GrowingView, grow, grow_in_both_directions
from rigkit.reconstruction.growing.surface import PairRays
from rigkit.reconstruction.scene import SceneReconstruction, reconstruct_scene
from rigkit.reconstruction.scene_pose import KnownPose
from rigkit.workflows.reconstruction.reconstruct_scene import _grown

BASELINE_MM = float(np.linalg.norm(CAM2_FROM_CAM1.translation_mm))
SEAM_PX = 12.0
"""Nodes nearer to where two walls meet have them both in their patches."""
LENS_OF = LENSES | {"small": SMALL_LENSES["pinhole"]}
"""The last has less than half of the pixels, for tests of the quick run."""


@cache
def matched_corner(lens: str) -> tuple[Corner, list[np.ndarray], Correspondences]:
    rng, corner = np.random.default_rng(5), Corner.of_a_room()
    images = [corner.image(LENS_OF[lens], pose, rng) for pose in (Rigid3.identity(), CAM2_FROM_CAM1)]
    return corner, images, match_affine_features(*images, tilts=TILTS)


@cache
def grown_corner(lens: str) -> tuple[SceneReconstruction, DenseScene, Corner]:
    camera = LENSES[lens]
    corner, images, seeds = matched_corner(lens)
    sparse = reconstruct_scene(seeds, camera, camera, baseline_mm=BASELINE_MM, image1=images[0])
    return sparse, grow_scene(sparse, seeds, *images), corner


def off_the_seams(corner: Corner, lens: str, pixels: np.ndarray) -> np.ndarray:
    """Which pixels see one wall for SEAM_PX around."""
    camera, same = LENSES[lens], np.ones(len(pixels), dtype=bool)
    plane = corner.hit(np.zeros(3), camera.unproject(pixels)[0])[1]
    for angle in np.arange(0.0, 2.0 * np.pi, np.pi / 8.0):
        beside = pixels + SEAM_PX * np.array([np.cos(angle), np.sin(angle)])
        same &= corner.hit(np.zeros(3), camera.unproject(beside)[0])[1] == plane
    return same


@pytest.mark.parametrize("lens", LENSES)
def test_a_corner_is_grown_densely_and_its_errors_are_as_stated(lens: str) -> None:
    sparse, dense, corner = grown_corner(lens)
    r = dense.scene.reconstruction
    cloud = r.cloud
    assert len(cloud) > 10 * len(sparse.reconstruction.cloud)
    assert len(cloud) == len(r.matches) == len(dense.nodes) == len(dense.scene.kept)
    assert max(pose_errors_deg(r.cam2_from_cam1, CAM2_FROM_CAM1)) < 0.1
    same = off_the_seams(corner, lens, r.pixels1)
    assert same.sum() > 2000
    points, normals = corner.surface(LENSES[lens], r.pixels1)
    off = np.abs(np.linalg.norm(cloud.points_mm, axis=1) - np.linalg.norm(points, axis=1))
    turned = angle_between(cloud.normals, normals)
    assert np.median(off[same] / np.linalg.norm(points, axis=1)[same]) < 1.0e-3
    assert np.degrees(np.median(turned[same])) < 1.0
    # Half of the deviations of two normal distributions are within this.
    assert 0.5 < np.median(turned[same] / cloud.normal_sigma_rad[same]) / 0.8326 < 2.0
    np.testing.assert_array_equal(r.pixels1, dense.grown.pixels1.reshape(-1, 2)[dense.nodes])
    # The grid's own planes are the cloud.
    np.testing.assert_allclose(dense.surface.points.reshape(-1, 3)[dense.nodes], cloud.points_mm)


def test_texture_does_not_make_a_patch_surer_than_its_interpolation() -> None:
    _, dense, _ = grown_corner("pinhole")
    camera, grown = LENSES["pinhole"], dense.grown
    measured = PairRays.of(grown, camera, camera).measured(dense.scene.reconstruction.cam2_from_cam1)
    sigma_px = np.sqrt(measured.covariance[..., 0, 0]) * measured.slope
    patches = grown.valid & ~grown.swept & np.isfinite(sigma_px)
    stated = np.sqrt(np.einsum("nii->ni", grown.covariance[patches])[:, :2].max(axis=1))
    assert np.median(stated) < 0.5 * FLOOR_PX
    assert sigma_px[patches].min() >= FLOOR_PX
    # Along the epipolar line, as the direction of the largest is not known here.
    assert np.all(sigma_px[patches] <= 1.01 * np.hypot(np.sqrt(2.0) * stated, FLOOR_PX * 2.0 ** grown.coarser[patches]))


@pytest.mark.parametrize("lens", LENSES)
def test_grown_pairs_do_not_cross_to_another_surface(lens: str) -> None:
    """Pairs are where the exact surface projects to; hardly any is elsewhere."""
    _, dense, corner = grown_corner(lens)
    at = dense.grown.valid
    points, _ = corner.surface(LENSES[lens], dense.grown.pixels1[at])
    expected, seen = LENSES[lens].project(CAM2_FROM_CAM1.apply(points))
    off = np.linalg.norm(dense.grown.pixels2[at] - expected, axis=1)
    assert seen.all()
    assert np.median(off) < 0.1
    swept = dense.grown.swept[at]
    assert np.mean(off[~swept] > 1.0) < 0.01
    # Those of a sweep are good to a third of a pixel, and mostly beside edges.
    assert np.mean(off[swept] > 3.0) < 0.05


def test_windows_of_curved_maps_do_not_shift_the_surface() -> None:
    """Between fisheyes an affine warp is off by 0.033 px at the middle of a window, everywhere to the same side."""
    camera = LENSES["fisheye"]
    rng = np.random.default_rng(11)
    corner = Corner.of_a_room()
    images = [corner.image(camera, pose, rng) for pose in (Rigid3.identity(), CAM2_FROM_CAM1)]
    seeds = match_affine_features(*images)
    exact = KnownPose(CAM2_FROM_CAM1)
    sparse = reconstruct_scene(seeds, camera, camera, known_pose=exact, image1=images[0])
    dense = grow_scene(sparse, seeds, *images, pose_is_known=True)
    pixels1, pixels2 = (p[dense.grown.valid] for p in (dense.grown.pixels1, dense.grown.pixels2))
    same = off_the_seams(corner, "fisheye", pixels1)
    assert same.sum() > 5000
    true, _ = camera.project(CAM2_FROM_CAM1.apply(corner.surface(camera, pixels1)[0]))
    shift = np.median((pixels2 - true)[same], axis=0)
    np.testing.assert_allclose(shift, 0.0, atol=0.01)


def test_no_place_of_image_2_is_grown_from_two_places_of_image_1() -> None:
    """A texture that image 1 shows twice and image 2 once: growing one way takes both, both ways one of them."""
    rng = np.random.default_rng(3)
    block = rng.uniform(0.0, 255.0, (90, 90))
    image1, image2 = rng.uniform(0.0, 255.0, (2, 150, 300))
    image1[30:120, 20:110] = image1[30:120, 180:270] = image2[30:120, 170:260] = block
    camera = Pinhole((300, 150), np.array([300.0, 300.0, 149.5, 74.5]))
    views = GrowingView.of(image1, camera), GrowingView.of(image2, camera)
    seeds = Correspondences(
        np.array([[65.0, 75.0], [225.0, 75.0]]), np.full((2, 2), [215.0, 75.0]), np.broadcast_to(np.eye(2), (2, 2, 2))
    )
    anywhere = EpipolarConstraint(np.zeros((3, 3)), np.inf)
    twice = grow(*views, seeds, step=3, known=anywhere)
    once = grow_in_both_directions(*views, seeds, step=3, known=anywhere)
    assert len(twice) > 1000
    assert 0.45 < len(once) / len(twice) < 0.55
    places = once.pixels2[once.valid]
    apart = np.linalg.norm(places[:, None] - places[None], axis=-1)
    assert apart[~np.eye(len(places), dtype=bool)].min() > 1.5


@pytest.mark.parametrize("compared", [False, True], ids=["alone", "and what it is without"])
def test_calibration_uncertainty_is_in_the_sigmas(compared: bool) -> None:
    """A camera whose focal length and centre are one standard deviation off, of its covariance."""
    corner, images, seeds = matched_corner("small")
    true = LENS_OF["small"]
    sigmas = np.array([4.0, 4.0, 3.0, 3.0])
    camera = true.with_parameters(true.parameters + np.array([1.0, 1.0, -1.0, 1.0]) * sigmas)
    sparse = reconstruct_scene(seeds, camera, camera, baseline_mm=BASELINE_MM)
    in_sigmas = {}
    stated = (UncertainCamera(camera, np.diag(sigmas**2)), None)
    for calibrations in (None, stated) if compared else (stated,):
        r = grow_scene(sparse, seeds, *images, calibrations=calibrations).scene.reconstruction
        declared = calibrations is not None
        assert r.cloud.calibration_in_sigmas == declared and r.pose_covariance is not None
        turn = log_so3(CAM2_FROM_CAM1.rotation @ r.cam2_from_cam1.rotation.T)
        pose = np.sqrt(turn @ np.linalg.solve(r.pose_covariance[:3, :3], turn) / 3.0)
        points, _ = corner.surface(true, r.pixels1)
        off = np.abs(np.linalg.norm(r.cloud.points_mm, axis=1) - np.linalg.norm(points, axis=1))
        in_sigmas[declared] = pose, np.median(off / r.cloud.sigma_mm)
    # Four parameters at one sigma each.
    assert in_sigmas[True][0] < 2.0
    assert 0.2 < in_sigmas[True][1] < 2.0
    if compared:
        assert in_sigmas[False][0] > 2.0
        assert in_sigmas[False][1] > 2.0 * in_sigmas[True][1]


def test_where_nothing_grows_the_sparse_cloud_stays_and_says_why() -> None:
    _, images, seeds = matched_corner("small")
    camera = LENS_OF["small"]
    sparse = reconstruct_scene(seeds, camera, camera, baseline_mm=BASELINE_MM, image1=images[0])
    flat = [np.full(images[0].shape[:2], 90, dtype=np.uint8)] * 2
    scene, left, maps = _grown(sparse, seeds, (flat[0], flat[1]), silent, pose_is_known=False, of=None)
    assert left is seeds and not maps
    assert scene.reconstruction.cloud is sparse.reconstruction.cloud
    assert "no dense cloud: only 0 pairs grow" in scene.reconstruction.notes[-1]
