"""The information of a simulated session about the focal length, with known correlations within each image."""

from __future__ import annotations

from statistics import NormalDist
from typing import NamedTuple

import numpy as np

from helpers.calibration_scenes import BOARD, REACH_DEG, lens, random_views
from rigkit.geometry.rotation import skew

IMAGES = 20
CHANCE = 0.01
LONGER = 1e-3
SESSIONS = 4
LENSES = ("reg", "wide", "fish")


class FocalSigmas(NamedTuple):
    """Relative standard deviations of the focal length: the lower bound (Cramér-Rao), and that of least squares with
    independent corners."""

    least: float
    least_squares: float


def focal_sigmas(name: str, corners_px: float, images_px: float, seed: int) -> FocalSigmas:
    """Return the standard deviations for a session with independent errors of `corners_px` and, in each image, common
    errors of `images_px` in each of five smooth modes."""
    camera, rng = lens(name), np.random.default_rng(seed)
    _, rotations, translations = random_views(camera, IMAGES, rng, reach_deg=REACH_DEG[name], noise_px=0.0)
    x, y = (BOARD.grid() / (np.array(BOARD.size) - 1.0) * 2.0 - 1.0).T
    fields = np.stack([x * x, x * y, y * y, x * x * y, x * y * y], axis=-1)
    noise = np.kron(corners_px**2 * np.eye(len(fields)) + images_px**2 * fields @ fields.T, np.eye(2))
    whiten = np.linalg.inv(np.linalg.cholesky(noise))
    p = camera.parameters.size
    information, normal, scatter = np.zeros((p, p)), np.zeros((p, p)), np.zeros((p, p))
    for rotation, translation in zip(rotations, translations, strict=True):
        turned = BOARD.points() @ rotation.T
        _, _, d_pixels_d_point, by_camera = camera.project_with_jacobians(turned + translation)
        by_pose = np.concatenate([-d_pixels_d_point @ skew(turned), d_pixels_d_point], axis=2).reshape(-1, 6)
        by_lens = by_camera.reshape(len(noise), -1)
        left = _without(whiten @ by_lens, whiten @ by_pose)
        information += left.T @ left
        left = _without(by_lens, by_pose)
        normal += left.T @ left
        scatter += left.T @ noise @ left
    # Parameters differ by many orders of magnitude.
    scale = 1.0 / np.sqrt(np.diag(normal))
    inverse = np.linalg.inv(normal * scale[:, None] * scale) * scale[:, None] * scale
    covariances = np.linalg.inv(information), inverse @ scatter @ inverse
    focal = float(camera.parameters[:2].sum())
    return FocalSigmas(*(float(np.sqrt(c[:2, :2].sum())) / focal for c in covariances))


def best_powers(name: str, corners_px: float, images_px: float) -> tuple[float, float]:
    """Return the power, at significance level CHANCE, of a test for a focal length longer by LONGER: with the least
    standard deviation possible, and with that of least squares."""
    each = [focal_sigmas(name, corners_px, images_px, seed) for seed in range(SESSIONS)]
    normal = NormalDist()
    limit = normal.inv_cdf(1.0 - CHANCE / 2.0)
    away = [LONGER / (np.sqrt(2.0) * float(np.mean(own))) for own in zip(*each, strict=True)]
    least, least_squares = (normal.cdf(a - limit) + normal.cdf(-a - limit) for a in away)
    return least, least_squares


def _without(rows: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Return derivatives with the part that a pose explains projected out."""
    own, _ = np.linalg.qr(pose)
    return np.asarray(rows - own @ (own.T @ rows))
