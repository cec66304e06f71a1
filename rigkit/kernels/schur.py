"""The call of the kernel in schur.c: a damped step of normal equations over globals and poses."""

from __future__ import annotations

import numpy as np

from rigkit.core.arrays import FloatArray
from rigkit.kernels import kernels
from rigkit.kernels.calls import Struct, structure


@structure("normal_equations_t")
class _BlockSystem(Struct):
    """Blocks of the normal equations."""


def schur_step(
    gg: FloatArray, gp: FloatArray, pp: FloatArray, g: FloatArray, p: FloatArray, damping: float
) -> tuple[FloatArray, FloatArray, float] | None:
    """Return the step of globals (G,) and poses (V, 6) with `damping` times the diagonal (times one where that
    vanishes) added to it, and the decrease of the cost that the undamped quadratic model promises for it; None where
    the damped system is not positive definite.

    Parameters
    ----------
    gg, gp, pp : (G, G), (V, G, 6) and (V, 6, 6) of J^T W J: globals, globals with poses, poses.
    g, p : (G,) and (V, 6) of J^T W r.
    """
    gg, gp, pp, g, p = (np.ascontiguousarray(block, np.float64) for block in (gg, gp, pp, g, p))
    views, count, _ = gp.shape
    normal = _BlockSystem.of(gg=gg, gp=gp, pp=pp, g=g, p=p, globals=count, views=views)
    step_g, step_p, predicted = np.empty(count), np.empty((views, 6)), np.empty(1)
    memory = np.empty(kernels().schur_memory(count, views))
    if not kernels().solve_schur(normal, damping, memory, step_g, step_p, predicted):
        return None
    return step_g, step_p, float(predicted[0])
