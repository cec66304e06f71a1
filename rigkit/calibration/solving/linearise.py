"""Derivatives of all corners, block by block, and the normal equations from them.

For a corner X of a board with pose (R, t): q = R X, p = q + t, pixel = project(p; k). With J = d pixel / d p,

    d pixel / d k = the model's,  d pixel / d w = q x J (row by row),  d pixel / d t = J,  d pixel / d X = J R.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rigkit.calibration.solving.normal_equations import NormalEquations, Residuals
from rigkit.calibration.solving.state import State, lost_px
from rigkit.calibration.views.observations import Observations
from rigkit.core.arrays import FloatArray
from rigkit.kernels.linearise import BoardViews, ViewSums

CORNERS_AT_A_TIME = 8192
"""Corners linearised at a time: their derivatives stay in the cache, and memory does not grow with the views."""


def normal_equations(
    observations: Observations,
    state: State,
    weight: FloatArray | None = None,
    loss_px: float | None = None,
    *,
    lens_held: bool = False,
) -> NormalEquations:
    """Return the normal equations and the cost at `state`, without priors.

    `weight` (V, C) multiplies the residuals, by default the observations' own; `loss_px` is the scale of the Cauchy
    loss, None for least squares. With `lens_held` the camera's parameters are no unknowns.
    """
    weight = observations.weight if weight is None else weight
    views, corners = weight.shape
    camera, shape = state.camera, state.shape
    parameters = 0 if lens_held else camera.parameters.size
    count = parameters + shape.basis.shape[-1]
    sums = ViewSums.of(_board_views(observations, state, weight, loss_px), count + 7)
    step = max(1, CORNERS_AT_A_TIME // max(corners, 1))
    d_pixels_d_point = d_pixels_d_parameters = np.empty((2, 0, 0))
    for first in range(0, views, step):
        lever, points = sums.seen.placed(first, min(first + step, views))
        if d_pixels_d_point.shape[-1] != lever.shape[-1]:
            d_pixels_d_point, d_pixels_d_parameters = observations.workspace.derivatives(parameters, lever.shape[-1])
        x, y, z = points
        sums.add(
            first,
            d_pixels_d_point,
            d_pixels_d_parameters,
            camera.derivatives(x, y, z, d_pixels_d_point, None if lens_held else d_pixels_d_parameters),
            lever,
        )
    products, shared = sums.products, sums.products[:, :count].sum(axis=0)
    normal = NormalEquations(
        gg=shared[:, :count],
        gp=products[:, :count, count:-1],
        pp=products[:, count:-1, count:-1],
        g=shared[:, -1],
        p=products[:, count:-1, -1],
        costs=sums.costs,
        # Coordinates first in memory: every later step uses u and v separately.
        residuals=(Residuals(sums.residuals.transpose(1, 2, 0), sums.valid),),
        products=(products,),
    )
    return _with_released(normal, sums) if shape.kind == "released" else normal


def view_products(observations: Observations, state: State, weight: FloatArray) -> FloatArray:
    """Return `NormalEquations.products` (V, K, K) of every view, with released corners held."""
    return normal_equations(observations, state.with_corners_held(), weight).products[0]


def _board_views(observations: Observations, state: State, weight: FloatArray, loss_px: float | None) -> BoardViews:
    """Return the kernel's input: views, board shapes and loss."""
    shape = state.shape
    place = np.full(len(shape.flat), -1)
    if shape.kind == "released":
        place[shape.released] = np.arange(len(shape.released))
    return BoardViews.of(
        rotation=state.rotation,
        translation=state.translation_mm,
        table=shape.points(state.unknowns),
        warp=shape.basis,
        place=place,
        point=observations.corner,
        pixels=observations.pixels,
        weight=weight,
        released=len(shape.released),
        loss_px=loss_px or 0.0,
        lost_px=lost_px(state.camera),
    )


def _with_released(normal: NormalEquations, sums: ViewSums) -> NormalEquations:
    """Return the normal equations with three coordinates of each released point after the other unknowns; a corner
    depends on those of its own point only."""
    points, p = len(sums.own), len(normal.g)
    total = p + 3 * points
    gg, g = np.zeros((total, total)), np.zeros(total)
    gg[:p, :p], g[:p] = normal.gg, normal.g
    gg[p:, :p] = sums.own[..., :p].reshape(-1, p)
    gg[:p, p:] = gg[p:, :p].T
    blocks = gg[p:, p:].reshape(points, 3, points, 3)
    blocks[np.arange(points), :, np.arange(points), :] = sums.own[..., p + 7 :]
    g[p:] = sums.own[..., p + 6].reshape(-1)
    gp = np.concatenate([normal.gp, sums.poses.reshape(len(normal.pp), -1, 6)], axis=1)
    return replace(normal, gg=gg, gp=gp, g=g, points_from=p)
