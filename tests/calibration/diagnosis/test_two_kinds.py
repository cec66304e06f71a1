"""Images of two different distortions in one session: named, and not confused with what resembles it."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from helpers.calibration_scenes import BOARD, SIZE, lens, random_views

from rigkit.calibration.calibrate import calibrate
from rigkit.calibration.diagnosis.two_kinds import MIN_PREDICTED, MIN_SHARE_OF_TWO, ImageScores
from rigkit.cameras.base import Camera
from rigkit.core.arrays import FloatArray
from rigkit.core.boards import Board
from rigkit.core.detections import BoardView
from rigkit.core.findings import Severity
from rigkit.core.patterns.charuco import Charuco

NOISE_PX = 0.03
KINDS = "the images form two groups"


def seen(camera: Camera, count: int, rng: np.random.Generator, first: int = 0) -> list[BoardView]:
    views = random_views(camera, count, rng, reach_deg=33.0, noise_px=NOISE_PX)[0]
    return [replace(view, image=f"{first + k:03d}.png") for k, view in enumerate(views)]


def reported(views: list[BoardView], rng: np.random.Generator, model: str = "brown") -> tuple[str, list[str]]:
    """Return the first verdict and all, of images in any order."""
    verdicts = calibrate([views[k] for k in rng.permutation(len(views))], SIZE, model=model, board="flat").verdicts
    assert verdicts[0].severity is not Severity.GOOD
    return verdicts[0].text, [str(verdict) for verdict in verdicts]


def off_the_middle() -> Camera:
    return lens("reg", np.array([790.0, 640.0]))


def without_distortion(view: BoardView, camera: Camera) -> BoardView:
    """Return the view as a program leaves it that undistorts images."""
    rays, _ = camera.unproject(view.pixels)
    pixels = camera.parameters[:2] * rays[:, :2] / rays[:, 2:] + camera.parameters[2:4]
    return on_image(replace(view, pixels=pixels), camera)


def on_image(view: BoardView, camera: Camera) -> BoardView:
    inside = camera.on_image(view.pixels)
    return replace(view, pixels=view.pixels[inside], grid=view.grid[inside], sigma_px=view.sigma_px[inside])


def turned(view: BoardView) -> BoardView:
    return replace(view, pixels=np.array(SIZE) - 1.0 - view.pixels)


def mirrored(view: BoardView) -> BoardView:
    """Return the view of a mirrored picture, in which the board is found from its other side."""
    pixels = np.stack([SIZE[0] - 1.0 - view.pixels[:, 0], view.pixels[:, 1]], axis=-1)
    grid = np.stack([BOARD.columns - 1 - view.grid[:, 0], view.grid[:, 1]], axis=-1)
    return replace(view, pixels=pixels, grid=grid)


def test_some_images_without_their_distortion(rng: np.random.Generator) -> None:
    camera = lens("reg")
    views = [without_distortion(v, camera) if k % 2 == 0 else v for k, v in enumerate(seen(camera, 18, rng))]
    first, _ = reported(views, rng)
    assert f"{KINDS} that need different lens parameters, as those of two cameras: 9 ('" in first
    assert "') and 9 like '" in first
    assert "undistorted" in first and "as if some were" not in first


@pytest.mark.parametrize("flip", ["left to right", "top to bottom"])
def test_some_pictures_mirrored(flip: str, rng: np.random.Generator) -> None:
    """A picture mirrored top to bottom is one mirrored left to right, and turned."""
    views = [mirrored(v) if k % 2 else v for k, v in enumerate(seen(off_the_middle(), 20, rng))]
    if flip == "top to bottom":
        views = [turned(v) if k % 2 else v for k, v in enumerate(views)]
    first, every = reported(views, rng)
    assert "10 of 20 images (such as" in first and f"mirrored {flip}" in first
    assert not any("stabilisation" in verdict or "rolling shutter" in verdict for verdict in every)


def test_pictures_mirrored_about_their_principal_point() -> None:
    """What tells them is the board: it is bent and printed askew, and in a mirror otherwise."""
    x, y = (BOARD.points()[:, :2] / BOARD.points()[:, :2].max()).T
    off = [0.15 * np.sin(7.0 * x + 2.0 * y), 0.15 * np.cos(5.0 * x - 3.0 * y), 0.5 * np.sin(4.0 * x + y)]
    camera, printed = lens("reg", 0.5 * (np.array(SIZE) - 1.0)), BOARD.points() + np.stack(off, axis=-1)
    # No shift of the picture shows here.
    rng = np.random.default_rng(0)
    views, _, _ = random_views(camera, 20, rng, reach_deg=33.0, noise_px=NOISE_PX, points_mm=printed)
    some = [mirrored(v) if k % 4 == 0 else v for k, v in enumerate(views)]
    text = calibrate(some, SIZE, model="brown").verdicts[0].text
    assert "5 of 20 images (such as" in text and "mirrored left to right" in text
    assert "are mirrored" not in str(calibrate(views, SIZE, model="brown").verdicts)


@pytest.mark.parametrize(
    "board", [BOARD, replace(BOARD, pattern=Charuco("DICT_4X4_50", marker_mm=0.7 * BOARD.square_x_mm))]
)
def test_pictures_cropped_left_and_right_are_not_called_mirrored(board: Board, rng: np.random.Generator) -> None:
    """What is left of a lens in the middle has its principal point left and right of the middle, as in a mirror. In a
    mirror markers cannot be read."""
    camera = lens("reg", np.array([815.0, 680.0]))
    whole = [replace(view, board=board) for view in seen(camera, 16, rng)]
    views = [
        on_image(replace(v, pixels=v.pixels + np.array([(-1) ** k * 120.0, 0.0])), camera) for k, v in enumerate(whole)
    ]
    first, _ = reported(views, rng)
    if board.pattern.identified:
        assert "mirrored left" not in first and KINDS in first and "cropped" in first
    else:
        assert "8 of 16 images (such as" in first
        assert re.search(r"cropped on opposite sides \(principal points 2[34]\d px apart\), or mirrored left", first)


@pytest.mark.parametrize("later", [False, True])
@pytest.mark.parametrize("count", [8, 20])
def test_some_pictures_turned(later: bool, count: int, rng: np.random.Generator) -> None:
    """In turns or one half after the other, and from few images, whose principal points are no two clusters."""
    views = seen(off_the_middle(), count, rng)
    half = [turned(v) if (k >= count // 2 if later else k % 2) else v for k, v in enumerate(views)]
    every = [str(verdict) for verdict in calibrate(half, SIZE, model="brown", board="flat").verdicts]
    assert f"{count // 2} of {count} images (such as" in every[0] and "rotated by 180 degrees" in every[0]
    assert not any(
        words in verdict for verdict in every for words in (KINDS, "stabilisation", "second half", "rolling shutter")
    )


@pytest.mark.parametrize("spread", ["normal", "even"])
def test_a_stabilised_picture_is_not_turned(spread: str, rng: np.random.Generator) -> None:
    """Shifts of one direction, of any size: those of one side, turned, would leave a third of the squares and more."""
    camera = lens("reg", 0.5 * (np.array(SIZE) - 1.0))
    for _ in range(3):
        amounts = 20.0 * (rng.normal(size=16) if spread == "normal" else rng.uniform(-1.7, 1.7, size=16))
        views = seen(camera, 16, rng)
        moved = [replace(v, pixels=v.pixels + np.array([far, -far])) for v, far in zip(views, amounts, strict=True)]
        _, every = reported([on_image(v, camera) for v in moved], rng)
        assert not any("180 degrees" in verdict for verdict in every)


@pytest.mark.parametrize("spread", ["normal", "even"])
def test_a_focus_that_wanders_is_of_no_two_kinds(spread: str, rng: np.random.Generator) -> None:
    for _ in range(2):
        views: list[BoardView] = []
        for k in range(20):
            longer = 1.0 + 0.01 * (rng.normal() if spread == "normal" else rng.uniform(-1.7, 1.7))
            camera = lens("reg")
            views += seen(camera.with_parameters(camera.parameters * [longer, longer, *[1.0] * 7]), 1, rng, first=k)
        first, _ = reported(views, rng)
        assert KINDS not in first and "the focal length differs from image to image" in first


def test_boards_left_and_right_before_a_lens_unlike_its_model(rng: np.random.Generator) -> None:
    """What tells the images apart is where the boards were, and that explains it as well."""
    views = seen(lens("reg"), 80, rng)
    order = np.argsort([view.pixels[:, 0].mean() for view in views])
    _, every = reported([views[k] for k in (*order[:12], *order[-12:])], rng, model="pinhole")
    assert not any(KINDS in verdict for verdict in every)


def test_groups_by_a_model_that_fails_at_the_rim_are_not_of_two_cameras() -> None:
    """Eight good images, four left and four right, of a wide lens for which a model has too few terms."""
    views = random_views(lens("wide"), 40, np.random.default_rng(18), reach_deg=55.0, noise_px=NOISE_PX)[0]
    order = np.argsort([view.pixels[:, 0].mean() for view in views])
    chosen = [views[k] for k in (*order[:4], *order[-4:])]
    assert KINDS not in str(calibrate(chosen, SIZE, model="brown", board="flat", folds=0).verdicts)


def test_a_third_of_the_images_contradicts_the_others(rng: np.random.Generator) -> None:
    """So few that the others hold: they are left out, and said to be of another kind; two are mishaps."""
    camera = lens("reg")
    views = seen(camera, 18, rng)
    some = [without_distortion(v, camera) if k % 3 == 0 else v for k, v in enumerate(views)]
    first, every = reported(some, rng)
    assert "but 6 of 18 images are inconsistent with the others and left out" in first and "undistorted" in first
    assert not any("is left out:" in verdict for verdict in every)
    two = [without_distortion(v, camera) if k in (4, 9) else v for k, v in enumerate(views)]
    assert "inconsistent" not in str(calibrate(two, SIZE, model="brown", board="flat").verdicts)


def test_four_images_after_four_others_are_of_two_kinds_as_in_turns(rng: np.random.Generator) -> None:
    """Where all images show one board, no side of it is a cause; fewer images than ten have no halves in time."""
    camera = off_the_middle()
    views = [without_distortion(v, camera) if k > 3 else v for k, v in enumerate(seen(camera, 8, rng))]
    for order in (range(8), (0, 4, 1, 5, 2, 6, 3, 7)):
        session = [replace(views[k], image=f"{i}.png") for i, k in enumerate(order)]
        assert KINDS in calibrate(session, SIZE, model="brown", board="flat").verdicts[0].message


def test_copies_of_images_are_no_kind_of_their_own() -> None:
    """Two pictures that are unlike the six others, saved three times as all are, are two pictures."""
    camera = off_the_middle()
    zoomed = camera.with_parameters(camera.parameters * [1.02, 1.02, *[1.0] * 7])
    for seed in range(5):
        rng = np.random.default_rng(seed)
        views = [*seen(camera, 6, rng), *seen(zoomed, 2, rng, first=6)]
        copies = [replace(view, image=f"{ending} {view.image}") for ending in ("jpg", "JPG", "png") for view in views]
        _, every = reported(copies, rng)
        assert not any(KINDS in verdict for verdict in every)
        assert any("show the board at the pose of another image" in verdict for verdict in every)


def image_scores(
    lenses: FloatArray, rng: np.random.Generator, min_images: int = 1, clear: FloatArray | float = 1.0
) -> ImageScores:
    """Return scores of images of these lenses (N, P), as noisy and as different as those of a session; `clear` (N,) is
    how well each determines its lens."""
    rows = rng.normal(size=(len(lenses), 12, lenses.shape[1])) * np.broadcast_to(clear, len(lenses))[:, None, None]
    score = np.einsum("nkp,nk->np", rows, np.einsum("nkp,np->nk", rows, lenses) + rng.normal(size=rows.shape[:2]))
    information = np.swapaxes(rows, 1, 2) @ rows
    common = np.linalg.solve(information.sum(axis=0), score.sum(axis=0))
    return ImageScores.scaled(information, score - information @ common, np.zeros((4, 4)), min_images)


@pytest.mark.parametrize("count", [1, 2, 7])
def test_images_of_two_lenses_are_parted(count: int, rng: np.random.Generator) -> None:
    second = np.arange(14) < count
    scores = image_scores(second[:, None] * np.array([3.0, 0.0, -2.0, 1.0]), rng)
    found = scores.best_split()
    assert found is not None and ((found[0] == second).all() or (found[0] != second).all())
    assert found[1] > MIN_SHARE_OF_TWO and scores.is_of_two(*found)


def test_halves_of_images_of_two_lenses_tell_the_same(rng: np.random.Generator) -> None:
    """Other errors are not the same in both halves, and found by the search as well as lenses are."""
    second = np.arange(14) % 2 == 0
    lenses = 3.0 * np.where(second[:, None], 1.0, -1.0) * np.array([1.0, 0.0, -1.0, 1.0])
    of_halves = image_scores(np.tile(lenses, (2, 1)), rng)
    assert of_halves.predicted_across(second) > MIN_PREDICTED
    errors = image_scores(np.concatenate([lenses, lenses[rng.permutation(14)]]), rng)
    assert errors.predicted_across(second) < MIN_PREDICTED


@pytest.mark.parametrize("spread", [0.0, 3.0])
def test_images_whose_lenses_scatter_are_of_no_two_groups(spread: float, rng: np.random.Generator) -> None:
    for _ in range(5):
        scores = image_scores(spread * rng.normal(size=(14, 4)), rng)
        found = scores.best_split()
        assert found is not None and found[1] < MIN_SHARE_OF_TWO


def test_lenses_along_a_line_are_of_two_groups_by_chance_only(rng: np.random.Generator) -> None:
    """Where the line is that of the focal length, or the split would be called so."""
    line = np.array([3.0, 0.0, -2.0, 1.0])
    for _ in range(5):
        scores = image_scores(rng.uniform(-1.0, 1.0, (14, 1)) * line, rng)
        found = scores.best_split()
        assert found is not None and found[1] > 0.5
        assert not scores.is_of_two(*found, explained_by_focus=scores.gain_of(found[0]))


def test_changes_of_one_kind_are_of_no_two_groups_where_some_images_show_them_better() -> None:
    """Boards that move before a rolling shutter: their amounts are scattered, with long tails, along one line."""
    called = 0
    for seed in range(6):
        rng = np.random.default_rng(seed)
        lenses = 3.0 * rng.normal(size=(20, 1)) * np.array([1.0, 0.0, -1.0, 0.5])
        scores = image_scores(lenses, rng, clear=np.exp(rng.normal(size=20)))
        found = scores.best_split()
        called += found is not None and found[1] >= MIN_SHARE_OF_TWO and scores.is_of_two(*found)
    # 4 of 40; 32 by draws of amounts that are equally large in all images.
    assert called <= 1


def test_too_few_images_are_not_parted(rng: np.random.Generator) -> None:
    assert image_scores(rng.normal(size=(5, 4)), rng, 3).best_split() is None


@pytest.mark.parametrize(
    ("count", "words"),
    [(6, f"{KINDS} that need different lens parameters"), (1, "another camera seems to have taken 1")],
)
def test_images_of_another_camera_at_other_moments_are_listed(count: int, words: str, rng: np.random.Generator) -> None:
    camera = off_the_middle()
    other = camera.with_parameters(camera.parameters + np.array([3.0, 3.0, 12.0, -9.0, *[0.0] * 5]))
    views = [*seen(camera, 14 - count, rng), *seen(other, count, rng, first=14 - count)]
    first, _ = reported(views, rng)
    assert words in first and all(f"'{view.image}'" in first for view in views[14 - count :])
    assert not any(f"'{view.image}'" in first for view in views[1 : 14 - count]) or count > 2
    assert "principal points 1" in first
