"""Guided detection with a known camera: more corners, no false ones, each with a true sigma."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from detection_bench.scenes import BENCH_PHOTOMETRY, BenchScene, one_board

from rigkit.cameras.base import Camera
from rigkit.core.boards import Board
from rigkit.core.detections import BoardDetection
from rigkit.core.errors import InputError
from rigkit.detection.detect import detect_boards
from rigkit.detection.guided.board_guide import BoardState
from rigkit.detection.guided.guided import _fitted_jointly, complete_boards
from rigkit.detection.saddles.response import grey_image
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3
from rigkit.synthetic.photometry import develop
from rigkit.synthetic.render import Optics
from rigkit.synthetic.scene import Panel

BOARD = Board("b", 9, 6, 30.0, 30.0)
FALSE_SIGMAS, FALSE_PX = 6.0, 0.1
"""A corner farther from the truth than both is false."""


def ruler_scene(rng: np.random.Generator, lens: str) -> BenchScene:
    """Return a board with a ruler of two thirds to one and a half squares across it, near its end."""
    scene = one_board(rng, lens=lens, board=BOARD)
    placed = scene.boards[0]
    spot = np.array([rng.uniform(0.0, 2.5), rng.uniform(0.0, 5.0)]) * 30.0
    turn = exp_so3(np.array([0.0, 0.0, rng.uniform(0.3, 1.3)]))
    pose = placed.world_from_board @ Rigid3(turn, np.array([*spot, -1.0]))
    return replace(scene, occluders=(Panel(pose, 500.0, rng.uniform(20.0, 45.0), rng.uniform(0.1, 0.8)),))


def hidden(scene: BenchScene) -> np.ndarray:
    """Return which corners (rows, columns) the occluders hide."""
    points = scene.boards[0].points()
    out = np.zeros(len(points), bool)
    for panel in scene.occluders:
        panel_from_cam = panel.world_from_panel.inverse()
        eye, ends = panel_from_cam.apply(np.zeros(3)), panel_from_cam.apply(points)
        share = eye[2] / (eye[2] - ends[:, 2])
        at = eye + (ends - eye) * share[:, None]
        out |= (np.abs(at[:, 0]) < panel.width_mm / 2.0) & (np.abs(at[:, 1]) < panel.height_mm / 2.0)
    return out.reshape(BOARD.rows, BOARD.columns)


def judged(found: BoardDetection, scene: BenchScene) -> tuple[int, int, np.ndarray]:
    """Return how many corners are right, how many false, and the right ones' errors in sigmas.

    The board's colours tell its first corner up to which of the two is black, so the truth may be turned.
    """
    truth = scene.truth()[0]
    choices = [truth, truth.turned(2)]
    errors = [found.pixels - t.lattice()[found.grid[:, 1], found.grid[:, 0]] for t in choices]
    which = int(np.argmin([np.nanmedian(np.abs(e)) for e in errors]))
    covered = hidden(scene)
    covered = covered[::-1, ::-1] if which else covered
    error = errors[which]
    limit = np.maximum(FALSE_SIGMAS * found.sigma_px, FALSE_PX)
    false = covered[found.grid[:, 1], found.grid[:, 0]] | (np.linalg.norm(error, axis=1) > limit)
    return int((~false).sum()), int(false.sum()), (error / found.sigma_px[:, None])[~false].ravel()


def whole(found: tuple[BoardDetection, ...]) -> BoardDetection | None:
    return next((d for d in found if (d.columns, d.rows) == BOARD.size), None)


@pytest.mark.parametrize("lens", ["regular", "fisheye"])
def test_a_ruler_across_a_board_hides_only_what_it_covers(lens: str) -> None:
    counts = {"plain": [0, 0], "board": [0, 0], "camera": [0, 0]}
    sigmas = []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        scene = ruler_scene(rng, lens)
        image = scene.render(supersample=2, noise_levels=2.0, rng=rng)
        for name, found in (
            ("plain", detect_boards(image)),
            ("board", detect_boards(image, [BOARD])),
            ("camera", detect_boards(image, [BOARD], camera=scene.camera)),
        ):
            board = whole(found)
            right, false, errors = judged(board, scene) if board is not None else (0, 0, np.zeros(0))
            counts[name][0] += right
            counts[name][1] += false
            if name == "camera":
                sigmas.append(errors)
    assert counts["board"][0] > counts["plain"][0]
    assert counts["camera"][0] > 1.3 * counts["plain"][0]
    assert counts["camera"][1] == 0
    assert 0.75 < np.sqrt((np.concatenate(sigmas) ** 2).mean()) < 1.25


def missing(found: BoardDetection, drop: np.ndarray) -> BoardDetection:
    return replace(found, grid=found.grid[~drop], pixels=found.pixels[~drop], sigma_px=found.sigma_px[~drop])


@pytest.mark.parametrize("camera_known", [True, False])
def test_corners_forgotten_are_found_again(camera_known: bool, rng: np.random.Generator) -> None:
    scene = one_board(rng, lens="fisheye", board=BOARD)
    image = scene.render(supersample=2, noise_levels=2.0, rng=rng)
    found = whole(detect_boards(image, [BOARD]))
    assert found is not None
    assert found.complete
    part = missing(found, (found.grid[:, 0] >= 6) | ((found.grid[:, 0] == 2) & (found.grid[:, 1] == 2)))
    assert len(part.grid) == 35
    (again,) = complete_boards(image, [part], [BOARD], scene.camera if camera_known else None)
    assert again.complete
    assert judged(again, scene)[:2] == (54, 0)


def test_a_wrong_camera_is_left_aside(rng: np.random.Generator) -> None:
    scene = one_board(rng, lens="fisheye", board=BOARD, square_px=28.0)
    other: Camera = one_board(rng, lens="regular", board=BOARD).camera
    image = scene.render(supersample=2, noise_levels=2.0, rng=rng)
    plain, with_other = detect_boards(image, [BOARD]), detect_boards(image, [BOARD], camera=other)
    assert len(plain) == len(with_other) == 1
    assert np.array_equal(plain[0].pixels, with_other[0].pixels)


def test_boards_of_other_sizes_come_back_as_they_are(rng: np.random.Generator) -> None:
    scene = one_board(rng, board=BOARD)
    image = scene.render(supersample=2, noise_levels=2.0, rng=rng)
    found = detect_boards(image)
    assert complete_boards(image, found, [Board("other", 7, 5, 30.0, 30.0)], scene.camera) == found
    with pytest.raises(InputError, match="image:"):
        complete_boards(np.zeros((4, 4)), found, [BOARD])


@pytest.mark.parametrize("camera_known", [True, False])
def test_what_is_covered_stays_missing(camera_known: bool, rng: np.random.Generator) -> None:
    """Two blots with edges of their own over corners of the last columns; the third corner forgotten is in sight."""
    scene = one_board(rng, board=BOARD, square_px=34.0, max_tilt_deg=20.0)
    image = scene.render(supersample=2, noise_levels=2.0, rng=rng)
    found = whole(detect_boards(image, [BOARD]))
    assert found is not None
    assert found.complete
    blots = {(7, 1): (12, 9), (8, 4): (4, 3)}
    for (column, row), (across, down) in blots.items():
        u, v = np.round(found.lattice()[row, column] + np.array([across // 3, down // 3])).astype(int)
        image[v - down : v + down, u - across : u + across] = 120
    dropped = np.array([tuple(cell) in {*blots, (3, 3)} for cell in found.grid.tolist()])
    part = missing(found, dropped)
    (again,) = complete_boards(image, [part], [BOARD], scene.camera if camera_known else None)
    cells = {tuple(cell) for cell in again.grid.tolist()}
    assert (3, 3) in cells
    assert not cells & set(blots)


class Cut:
    """A camera whose model ends at a column of the image: what lies beyond is not projected."""

    def __init__(self, camera: Camera, limit_px: float) -> None:
        self.camera, self.limit_px = camera, limit_px

    def __getattr__(self, name: str) -> object:
        return getattr(self.camera, name)

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        pixels, valid = self.camera.project(points)
        valid = valid & (pixels[..., 0] < self.limit_px)
        return np.where(valid[..., None], pixels, np.nan), valid


def test_corners_at_the_end_of_the_lens_model_stay_as_they_are(rng: np.random.Generator) -> None:
    scene = one_board(rng, lens="fisheye", board=BOARD)
    image = scene.render(supersample=2, noise_levels=2.0, rng=rng)
    (found,) = detect_boards(image, [BOARD])
    camera = Cut(scene.camera, np.quantile(found.pixels[:, 0], 0.8))
    (again,) = complete_boards(image, [found], [BOARD], camera)  # type: ignore[arg-type]
    assert again.complete
    assert judged(again, scene)[:2] == (54, 0)


def test_a_blurred_board_is_placed_together_with_a_camera_too() -> None:
    scene = one_board(np.random.default_rng(1), lens="fisheye", board=BOARD)
    photometry = replace(BENCH_PHOTOMETRY, noise_levels=2.0)
    image = develop(scene.radiance(Optics(4.0)), photometry, np.random.default_rng(1))
    plain, guided = (whole(detect_boards(image, [BOARD], camera=camera)) for camera in (None, scene.camera))
    assert plain is not None
    assert guided is not None
    assert judged(guided, scene)[:2] == judged(plain, scene)[:2] == (54, 0)
    off, best = (
        np.sqrt(np.mean((judged(found, scene)[2] * found.sigma_px.repeat(2)) ** 2)) for found in (guided, plain)
    )
    # Fitted alone, corners have 1.9 times the error of those placed together in a regular lens, 3.5 times here.
    assert off < 1.1 * best
    assert np.sqrt(np.mean(judged(guided, scene)[2] ** 2)) < 1.3


def test_corners_are_judged_by_those_beside_them() -> None:
    state = BoardState.unfitted(np.zeros((6, 9, 2)), np.ones((6, 9)))
    shade = np.where(np.arange(9) < 4, 0.25, 1.0) * np.ones((6, 1))
    state = replace(state, contrast=120.0 * shade, residual=2.0 * shade, sigma_px=0.1 / shade)
    missing = np.zeros((6, 9), bool)
    missing[2:4, [0, 8]] = True
    contrast, residual, sigma_px = state.without(missing).typical_near(missing)
    assert np.array_equal(contrast, [30.0, 120.0, 30.0, 120.0])
    assert np.array_equal(residual, [0.5, 2.0, 0.5, 2.0])
    assert np.array_equal(sigma_px, [0.4, 0.1, 0.4, 0.1])


def test_a_corner_without_a_fit_of_its_own_does_not_spoil_the_others() -> None:
    scene = one_board(np.random.default_rng(1), board=BOARD)
    image = develop(scene.radiance(Optics(4.0)), BENCH_PHOTOMETRY, np.random.default_rng(1))
    pixels = scene.truth()[0].lattice()
    row, column = np.indices(pixels.shape[:2])
    every = np.ones(pixels.shape[:2])
    state = BoardState(
        pixels,
        100.0 * every,
        20.0 * every,
        every,
        0.05 * every,
        4.0 * every,
        signs=np.where((row + column) % 2, 1.0, -1.0),
    )
    state.sigma_px[2, 4] = state.blur[2, 4] = np.nan
    placed = _fitted_jointly(grey_image(image), BOARD, state)
    assert placed.jointly
    assert np.argwhere(~placed.known).tolist() == [[2, 4]]
