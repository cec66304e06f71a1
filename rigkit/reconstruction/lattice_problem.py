"""Residuals of boards of known lattice in two views, and their minimum: the problem behind `lattice_planes`."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rigkit.cameras.base import Camera
from rigkit.core.arrays import BoolArray, FloatArray, Points, Rays
from rigkit.geometry.board_pose import point_residuals
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import skew
from rigkit.optim.levenberg_marquardt import DenseProblem
from rigkit.reconstruction.board_planes import MIN_CORNERS_OF_BOARD, OUTLIER_ROUNDS, likeliest, near_the_rest


@dataclass(frozen=True, eq=False, kw_only=True)
class LatticeView:
    """The corners of one board in one view.

    Attributes
    ----------
    board, second : which board, and whether it is the second view.
    pixels, sigma_px, points : (N, 2), (N,), and on the lattice (N, 3).
    rays, bases : (N, 3), and rows (N, 2, 3) perpendicular to them that make residuals in sigmas.
    """

    board: int
    second: bool
    pixels: FloatArray
    sigma_px: FloatArray
    points: Points
    rays: Rays
    bases: FloatArray

    @classmethod
    def of(
        cls, camera: Camera, board: int, second: bool, pixels: FloatArray, sigma_px: FloatArray, points: Points
    ) -> LatticeView:
        """Return the corners as a camera sees them."""
        bases = np.linalg.pinv(camera.ray_jacobian(pixels)) / sigma_px[:, None, None]
        return cls(
            board=board,
            second=second,
            pixels=pixels,
            sigma_px=sigma_px,
            points=points,
            rays=camera.unproject(pixels)[0],
            bases=np.asarray(bases),
        )

    def by(self, camera: Camera) -> LatticeView:
        """Return the same corners by another camera."""
        return LatticeView.of(camera, self.board, self.second, self.pixels, self.sigma_px, self.points)

    def select(self, which: BoolArray) -> LatticeView:
        names = ("pixels", "sigma_px", "points", "rays", "bases")
        return replace(self, **{name: getattr(self, name)[which] for name in names})


@dataclass(frozen=True, eq=False)
class PlacedLattices:
    """cam2_from_cam1, the boards' poses in camera 1, and the logarithms (K,) of their sizes over the declared ones."""

    pose: Rigid3
    boards: tuple[Rigid3, ...]
    log_sizes: FloatArray

    def moved(self, step: FloatArray) -> PlacedLattices:
        count = len(self.boards)
        by_pose, *by_board = step[: 6 * (count + 1)].reshape(-1, 6)
        boards = tuple(board.moved(part) for board, part in zip(self.boards, by_board, strict=True))
        return PlacedLattices(self.pose.moved(by_pose), boards, self.log_sizes + step[6 * (count + 1) :])


def free_parameters(sigma: FloatArray) -> BoolArray:
    """Return which parameters are unknown: a board's size only where a sigma of it is stated."""
    return np.concatenate([np.ones(6 * (len(sigma) + 1), dtype=bool), sigma > 0.0])


def residuals_of(view: LatticeView, state: PlacedLattices) -> tuple[FloatArray, FloatArray]:
    """Return residuals (N, 2) of one board in one view, and their derivatives (N, 2, P)."""
    k, count = view.board, len(state.boards)
    turned = np.exp(state.log_sizes[k]) * view.points @ state.boards[k].rotation.T
    x = turned + state.boards[k].translation_mm
    jacobian = np.zeros((len(x), 2, 7 * count + 6))
    if view.second:
        around = x @ state.pose.rotation.T
        residual, by_x2 = point_residuals(view.rays, view.bases, around + state.pose.translation_mm)
        jacobian[:, :, :3], jacobian[:, :, 3:6] = -by_x2 @ skew(around), by_x2
        by_x = by_x2 @ state.pose.rotation
    else:
        residual, by_x = point_residuals(view.rays, view.bases, x)
    start = 6 * (k + 1)
    jacobian[:, :, start : start + 3], jacobian[:, :, start + 3 : start + 6] = -by_x @ skew(turned), by_x
    jacobian[:, :, 6 * (count + 1) + k] = (by_x @ turned[:, :, None])[..., 0]
    return residual, jacobian


def linearised(views: list[LatticeView], state: PlacedLattices, sigma: FloatArray) -> DenseProblem:
    """Return all residuals in sigmas, those of the sizes' prior last, and their derivatives by what is unknown."""
    parts = [residuals_of(view, state) for view in views]
    stated = sigma > 0.0
    prior = np.zeros((int(stated.sum()), 7 * len(sigma) + 6))
    prior[:, 6 * (len(sigma) + 1) :] = np.diag(1.0 / np.where(stated, sigma, 1.0))[stated]
    residual = np.concatenate([*(r.ravel() for r, _ in parts), state.log_sizes[stated] / sigma[stated]])
    jacobian = np.concatenate([*(J.reshape(-1, J.shape[-1]) for _, J in parts), prior])
    return DenseProblem(residual, jacobian[:, free_parameters(sigma)])


def minimum(views: list[LatticeView], state: PlacedLattices, sigma: FloatArray) -> PlacedLattices:
    """Return the state of maximum likelihood near `state`."""

    def linearise(at: PlacedLattices) -> DenseProblem:
        return linearised(views, at, sigma)

    return likeliest(state, linearise, PlacedLattices.moved, free_parameters(sigma))


def fit_without_outliers(
    views: list[LatticeView], state: PlacedLattices, sigma: FloatArray
) -> tuple[list[LatticeView], PlacedLattices]:
    """Return the views without gross outliers, and the minimum for what is left."""
    for _ in range(OUTLIER_ROUNDS):
        state = minimum(views, state, sigma)
        near = _near(views, state)
        if all(which.all() for which in near):
            return views, state
        views = [view.select(which) for view, which in zip(views, near, strict=True)]
    return views, minimum(views, state, sigma)


def _near(views: list[LatticeView], state: PlacedLattices) -> list[BoolArray]:
    """Return which corners of each view are no gross outliers, by the median of all residuals."""
    off = [np.linalg.norm(residuals_of(view, state)[0], axis=1) for view in views]
    near = np.split(near_the_rest(np.concatenate(off)), np.cumsum([len(one) for one in off])[:-1])
    enough = all(which.sum() >= MIN_CORNERS_OF_BOARD for which in near)
    return near if enough else [np.ones(len(one), dtype=bool) for one in off]
