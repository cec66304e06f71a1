"""Calibrations from two halves of the images, and how well they agree if sigmas are true."""

from __future__ import annotations

import zlib
from collections.abc import Sequence

import numpy as np

from halves.captures import Views
from rigkit.calibration.calibrate import calibrate
from rigkit.calibration.certainty.coverage import covered_by_boards
from rigkit.calibration.certainty.uncertainty import projection_design
from rigkit.calibration.compare import CalibrationComparison
from rigkit.calibration.result import Calibration
from rigkit.calibration.solving.clustered import reduced_by_cluster
from rigkit.calibration.solving.linearise import view_products
from rigkit.calibration.solving.state import State
from rigkit.calibration.views.observations import Observations
from rigkit.cameras.compare import grid_pixels

DRAWS = 4000
"""Sessions drawn anew, for the scatter of a ratio."""


def seeds_of(name: str, seed: int) -> list[int]:
    """Return the seeds of a set's random numbers: other ones for each name and each `seed`."""
    return [seed, zlib.crc32(name.encode())]


def two_parts(views: Views, rng: np.random.Generator, images: int | None = None) -> tuple[Views, Views]:
    """Return the images, split at random: in halves, or so many `images` and all others."""
    names = rng.permutation(sorted(views)).tolist()
    parts = (names[::2], names[1::2]) if images is None else (names[:images], names[images:])
    return tuple({name: views[name] for name in sorted(part)} for part in parts)  # type: ignore[return-value]


def calibrated(views: Views, size_px: tuple[int, int], model: str) -> Calibration:
    return calibrate([view for own in views.values() for view in own], size_px, model=model)


def in_words(what: str, found: CalibrationComparison) -> str:
    return (
        f"{what}: {found.difference.rms_px:.4f} px, expected {found.predicted_px:.4f} px, ratio {found.ratio:.2f}, "
        f"chance {found.chance:.4f}: {found.verdict}"
    )


def own_scatter(views: Views, size_px: tuple[int, int], splits: int, model: str, seeds: Sequence[int]) -> np.ndarray:
    """Return the 2.5th, 50th and 97.5th percentile of the geometric mean ratio of these splits where sigmas are true.

    At first order: image i pulls the parameters by a score s_i of variance H_i, its information after its own pose.
    What the calibrations know of their own disagreement scatters, too: with one degree of freedom less than images.
    """
    found = calibrated(views, size_px, model)
    names = sorted({view.image for view in found.views})
    used = [view for name in names for view in views[name]]
    poses = {(view.image, view.board_id): view.cam_from_board for view in found.views}
    used = [view for view in used if (view.image, view.board.board_id) in poses]
    own = [poses[view.image, view.board.board_id] for view in used]
    observations = Observations.from_views(used)
    rotation, shift = np.array([pose.rotation for pose in own]), np.array([pose.translation_mm for pose in own])
    state = State.start(found.camera, rotation, shift, observations)
    cluster = np.array([names.index(view.image) for view in used])
    p = found.camera.parameters.size
    products = view_products(observations, state, observations.weight * observations.present)
    information, _ = reduced_by_cluster(products, p, cluster)
    pixels = grid_pixels(size_px, (20, 15))
    pixels = pixels[covered_by_boards(found, pixels)]
    rays, valid = found.camera.unproject(pixels)
    design = projection_design(found.camera, rays[valid]).transpose(2, 0, 1).reshape(-1, p + 3)
    turn = np.linalg.qr(design[:, p:])[0]
    sigmas = np.maximum(found.parameter_sigmas, np.finfo(float).tiny)
    seen = (design[:, :p] - turn @ (turn.T @ design[:, :p])) * sigmas
    information = information * sigmas[:, None] * sigmas
    rng, drawn = np.random.default_rng(seeds), np.random.default_rng(0)
    values, axes = np.linalg.eigh(information)
    roots = axes * np.sqrt(np.maximum(values, 0.0))[:, None]
    scores = np.einsum("nij,njd->nid", roots, drawn.normal(size=(len(names), p, DRAWS)))
    logs = np.zeros(DRAWS)
    for _ in range(splits):
        difference = np.zeros((p, DRAWS))
        of_all = sorted(views)
        order = [of_all[k] for k in rng.permutation(len(of_all))]
        for sign, part in ((1.0, order[::2]), (-1.0, order[1::2])):
            chosen = [names.index(name) for name in part if name in names]
            difference += (
                sign * np.linalg.pinv(information[chosen].sum(axis=0), hermitian=True) @ scores[chosen].sum(axis=0)
            )
        size = np.linalg.norm(seen @ difference, axis=0)
        logs += np.log(size / np.median(size)) / splits
    logs -= 0.5 * np.log(drawn.chisquare(len(names) - 1, DRAWS) / (len(names) - 1))
    return np.exp(np.quantile(logs, [0.025, 0.5, 0.975]))
