"""What the kernels of linearise.c compute, corner by corner: rows of derivatives and sums of their products."""

from __future__ import annotations

from typing import Any

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray, IntArray


def placed(rotation: FloatArray, translation: FloatArray, board: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return lever arms and points (V, C, 3) of the boards' points (V, C, 3)."""
    lever = np.einsum("vij,vcj->vci", rotation, board)
    return lever, lever + translation[:, None]


def rows_of_corner(
    d_pixels_d_point: FloatArray,
    d_pixels_d_parameters: FloatArray,
    rotation: FloatArray,
    warp: FloatArray,
    lever: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Return the rows (2, K - 1) of a corner and its derivatives by the board's point (2, 3)."""
    by_board = d_pixels_d_point @ rotation
    turn = np.cross(lever, d_pixels_d_point)
    return np.concatenate([d_pixels_d_parameters, by_board @ warp, turn, d_pixels_d_point], axis=1), by_board


def sums(
    seen: dict[str, Any],
    d_pixels_d_point: FloatArray,
    d_pixels_d_parameters: FloatArray,
    pixels: FloatArray,
    valid: BoolArray,
) -> dict[str, FloatArray]:
    """Return residuals, costs and products by their names in api.h, from derivatives (V, C, 2, .) and pixels (V, C, 2)
    of the corners."""
    point: IntArray = seen["point"]
    views, corners = point.shape
    across = d_pixels_d_parameters.shape[-1] + seen["warp"].shape[-1] + 7
    count = int(seen["place"].max(initial=-1)) + 1
    lever, _ = placed(seen["rotation"], seen["translation"], seen["table"][point])
    out = {
        "residuals": np.where(valid[..., None], seen["pixels"] - pixels, seen["lost_px"]),
        "costs": np.zeros(views),
        "products": np.zeros((views, across, across)),
        "own": np.zeros((count, 3, across + 3)),
        "poses": np.zeros((views, count, 3, 6)),
    }
    for v, c in np.ndindex(views, corners):
        weight, residual = seen["weight"][v, c], out["residuals"][v, c]
        squared = weight**2 * residual @ residual
        if seen["loss_px"]:
            squared /= seen["loss_px"] ** 2
            weight /= np.sqrt(1.0 + squared)
            squared = seen["loss_px"] ** 2 * np.log1p(squared)
        out["costs"][v] += squared
        if not valid[v, c]:
            continue
        j = point[v, c]
        rows, by_board = rows_of_corner(
            d_pixels_d_point[v, c], d_pixels_d_parameters[v, c], seen["rotation"][v], seen["warp"][j], lever[v, c]
        )
        rows = weight * np.concatenate([rows, residual[:, None]], axis=1)
        out["products"][v] += rows.T @ rows
        place = seen["place"][j]
        if place >= 0:
            with_all = weight * by_board.T @ np.concatenate([rows, weight * by_board], axis=1)
            out["own"][place] += with_all
            out["poses"][v, place] = with_all[:, across - 7 : across - 1]
    return out
