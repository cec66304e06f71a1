"""What the detector asks the kernels of growth.c for, in numpy; arguments as those of `rigkit.kernels.growth`.

The tolerances of growth are those of the detector, whatever the rules say.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from kernels.reference.front import read_rings
from kernels.reference.links import NO_THRESHOLDS, edge_contrast, quads, to_level
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from rigkit.core.arrays import BoolArray, FloatArray, IntArray
from rigkit.detection.lattice.grow import (
    CENTRE,
    FIT_RADIUS,
    GROWTH_REACH,
    LINE_SINE,
    MAX_RING_PX,
    MAX_SADDLES_TRIED,
    MIN_AREA_PX2,
    MIN_RING_PX,
    ODD,
    RING,
)
from rigkit.detection.lattice.lattice import Lattice
from rigkit.detection.lattice.links import (
    CONTRAST_RATIO,
    LATERAL_LENGTHS,
    MAX_LATERAL_PX,
    MIN_EDGE_PLACES,
    MIN_LATERAL_PX,
    Links,
)
from rigkit.detection.lattice.local_fit import FLEXIBLE, MIN_PREDICTING, PREDICTION_WIDTH, STIFF, LocalFit, _local_fit
from rigkit.detection.saddles.response import Level
from rigkit.kernels.growth import FitRules, GridBuckets, GrowthRules

POWERS = ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2), (3, 0), (2, 1), (1, 2), (0, 3))


TERMS_OF_DEGREE = {1: 3, 2: 6, 3: 10}

GRID_DIRECTIONS = np.array([[1, 0], [0, 1], [-1, 0], [0, -1]])
"""(column, row) of the four grid directions."""


def fit(lattice: FloatArray, cells: BoolArray, rules: FitRules) -> FloatArray:
    degree, radius, width, ridge = rules.degree, rules.radius, rules.width, tuple(rules.ridge)
    side = 2 * radius + 1
    step_r, step_c = (a.ravel() - radius for a in np.divmod(np.arange(side * side), side))
    powers = POWERS[: TERMS_OF_DEGREE[degree]]
    design = np.stack([step_c**i * step_r**j for i, j in powers], axis=-1).astype(np.float64)
    weight = np.exp(-0.5 * (step_c**2 + step_r**2) / width**2)
    if rules.leave_out:
        weight[step_c**2 + step_r**2 == 0] = 0.0
    padded = np.pad(lattice, ((radius, radius), (radius, radius), (0, 0)), constant_values=np.nan)
    row, column = np.nonzero(cells)
    near = padded[row[:, None] + step_r + radius, column[:, None] + step_c + radius]
    known = np.isfinite(near[..., 0]) & (weight > 0.0)
    weights = np.where(known, weight, 0.0)
    near = np.where(known[..., None], near, 0.0)
    total = np.maximum(weights.sum(axis=1), 1e-12)
    centre = (weights[..., None] * near).sum(axis=1) / total[:, None]
    size = len(powers)
    products = (design[:, :, None] * design[:, None, :]).reshape(len(design), -1)
    normal = (weights @ products).reshape(-1, size, size)
    pull = np.array([(1e-12, 1e-9, ridge[0], ridge[1])[i + j] for i, j in powers])
    normal = normal + np.diag(pull)
    right = np.swapaxes(weights[..., None] * (near - centre[:, None]), 1, 2) @ design
    constant = np.zeros((len(row), size, 1))
    constant[:, 0] = 1.0
    solved = np.linalg.solve(normal, np.concatenate([np.swapaxes(right, 1, 2), constant], axis=2))
    solution = np.swapaxes(solved[..., :2], 1, 2)
    gain = np.sqrt(((weights * (solved[..., 2] @ design.T)) ** 2).sum(axis=1))
    zero = np.zeros((len(row), 2))
    curvature_column, curvature_row = (2.0 * solution[..., k] if degree > 1 else zero for k in (3, 5))
    position = solution[..., 0] + centre
    single = np.stack([known.sum(axis=1), gain], axis=1)
    return np.hstack([position, solution[..., 1], solution[..., 2], curvature_column, curvature_row, single])


def grown(
    pixels: FloatArray,
    contrast: FloatArray,
    sign: float,
    image: np.ndarray,
    scale: float,
    offset: float,
    saddles: GridBuckets,
    rules: GrowthRules,
    rings: int,
) -> int:
    lattice, level = Lattice(pixels, contrast, sign > 0.0), Level(image, NO_THRESHOLDS, scale, offset)
    assert rules.tried == MAX_SADDLES_TRIED
    points = saddles._kept["points"]
    due = np.ones((2, *lattice.contrast.shape), bool)
    for left in range(rings, 0, -1):
        # A new look at corners that have changed.
        lattice = replace(lattice)
        known = lattice.known
        if known[0].any() or known[-1].any() or known[:, 0].any() or known[:, -1].any():
            return left
        for way, (degree, ridge) in enumerate((STIFF, FLEXIBLE)):
            cells = _beside(known) & due[way]
            due[way] &= ~cells
            prediction = _local_fit(
                fit(lattice.pixels, cells, FitRules(degree, FIT_RADIUS, False, PREDICTION_WIDTH, ridge))
            )
            added = _added(lattice, np.argwhere(cells), prediction, points, level)
            if added.any():
                break
        else:
            return -1
        # What failed before may be foretold otherwise now, within the reach of the fits.
        due |= _widened(added)
    return -1


def components_of(links: IntArray) -> tuple[int, IntArray, IntArray, IntArray, IntArray]:
    label, grid, turn = _components(Links(links))
    members = np.argsort(label, kind="stable")[np.count_nonzero(label < 0) :]
    return int(label.max(initial=-1)) + 1, label, grid, turn, members


def _nearest(saddles: FloatArray, pixels: FloatArray, reach_px: FloatArray) -> tuple[IntArray, BoolArray]:
    """Return the MAX_SADDLES_TRIED nearest saddles of each of `pixels` (M, 2), and which lie within `reach_px`."""
    if not len(saddles) or not len(pixels):
        none = (len(pixels), MAX_SADDLES_TRIED)
        return np.zeros(none, np.int64), np.zeros(none, bool)
    distance, index = cKDTree(saddles).query(pixels, k=MAX_SADDLES_TRIED)
    found = distance <= reach_px[:, None]
    return np.where(found, index, 0), found


def _widened(cells: BoolArray) -> BoolArray:
    """Return the cells within FIT_RADIUS of `cells`."""
    rows, columns = cells.shape
    padded = np.pad(cells, FIT_RADIUS)
    windows = np.lib.stride_tricks.sliding_window_view(padded, (2 * FIT_RADIUS + 1, 2 * FIT_RADIUS + 1))
    widened: BoolArray = windows.any(axis=(2, 3)).reshape(rows, columns)
    return widened


def _added(lattice: Lattice, cell: IntArray, fit: LocalFit, saddles: FloatArray, level: Level) -> BoolArray:
    """Fill those of the cells `cell` (M, 2) of `lattice`, predicted by `fit`, that can be; return which (R, C)."""
    added = np.zeros(lattice.known.shape, bool)
    height, width = level.smooth.shape
    place = to_level(level, fit.pixels)
    usable = (fit.support >= MIN_PREDICTING) & (place > 0.0).all(axis=1) & (place < [width - 1, height - 1]).all(axis=1)
    index, found = _nearest(saddles, fit.pixels, np.where(usable, GROWTH_REACH * _longest(fit), 0.0))
    owner, slot = np.nonzero(found & usable[:, None])
    pixels = saddles[index[owner, slot]]
    distance = _in_cells(fit, owner, pixels)
    near = distance < GROWTH_REACH
    owner, pixels, distance = owner[near], pixels[near], distance[near]
    if not len(owner):
        return added
    contrast, good = _fits(lattice, level, fit, cell, owner, pixels)
    owner, pixels, distance, contrast = owner[good], pixels[good], distance[good], contrast[good]
    order = np.lexsort((distance, owner))
    chosen, first = np.unique(owner[order], return_index=True)
    best = order[first]
    row, column = cell[chosen].T
    lattice.pixels[row, column], lattice.contrast[row, column] = pixels[best], contrast[best]
    added[row, column] = True
    return added


def _beside(known: BoolArray) -> BoolArray:
    """Return the empty cells next to known ones."""
    beside = np.zeros_like(known)
    beside[1:] |= known[:-1]
    beside[:-1] |= known[1:]
    beside[:, 1:] |= known[:, :-1]
    beside[:, :-1] |= known[:, 1:]
    return beside & ~known


def _longest(fit: LocalFit) -> FloatArray:
    longest: FloatArray = np.maximum(np.linalg.norm(fit.along_column, axis=1), np.linalg.norm(fit.along_row, axis=1))
    return longest


def _in_cells(fit: LocalFit, owner: IntArray, pixels: FloatArray) -> FloatArray:
    """Return how far `pixels` lie from the predictions of the cells `owner`, in cells (infinite for folded cells)."""
    off = pixels - fit.pixels[owner]
    a, b, area = fit.along_column[owner], fit.along_row[owner], fit.areas()[owner]
    safe = np.where(area > MIN_AREA_PX2, area, np.nan)
    column = (off[:, 0] * b[:, 1] - off[:, 1] * b[:, 0]) / safe
    row = (a[:, 0] * off[:, 1] - a[:, 1] * off[:, 0]) / safe
    return np.nan_to_num(np.hypot(column, row), nan=np.inf)


def _fits(
    lattice: Lattice, level: Level, fit: LocalFit, cell: IntArray, owner: IntArray, pixels: FloatArray
) -> tuple[FloatArray, BoolArray]:
    """Return the contrast at `pixels` and whether they can be the corners of the cells `owner`."""
    local = to_level(level, pixels)
    height = fit.areas()[owner] / np.maximum(_longest(fit)[owner], 1e-9) / level.scale
    rings = read_rings(level.smooth, local, np.clip(RING * height, MIN_RING_PX, MAX_RING_PX), ODD, CENTRE)
    sign = lattice.signs()[cell[owner, 0], cell[owner, 1]]
    a, b = fit.along_column[owner], fit.along_row[owner]
    first = np.where((sign > 0)[:, None], a, b)
    second = np.where((sign > 0)[:, None], b, a)
    good = rings.valid & _parallel(rings.angles[:, 0], first) & _parallel(rings.angles[:, 1], second)
    # Few pass, so only theirs are the edges that are read.
    good[good] = _edges_seen(lattice, level, cell[owner[good]], local[good], sign[good], rings.contrast[good])
    return rings.contrast, good


def _edges_seen(
    lattice: Lattice, level: Level, cell: IntArray, local: FloatArray, sign: FloatArray, contrast: FloatArray
) -> BoolArray:
    """Return whether the edges from `local` (M, 2), in the cells `cell` (M, 2), to all known neighbours are there."""
    beside = cell[:, None] + GRID_DIRECTIONS[:, ::-1]
    inside = ((beside >= 0) & (beside < lattice.known.shape)).all(axis=2)
    row, column = np.moveaxis(np.where(inside[..., None], beside, 0), 2, 0)
    which, direction = np.nonzero(inside & lattice.known[row, column])
    end = to_level(level, lattice.pixels[row, column][which, direction])
    length = np.linalg.norm(end - local[which], axis=1)
    side = np.where(direction % 2 == 0, sign[which], -sign[which])
    lateral = np.clip(LATERAL_LENGTHS * length, MIN_LATERAL_PX, MAX_LATERAL_PX)
    difference = edge_contrast(level.smooth, local[which], end, side, lateral)
    weakest = CONTRAST_RATIO * np.minimum(lattice.contrast[row, column][which, direction], contrast[which])
    seen = np.ones(len(cell), np.bool_)
    seen[which[(difference > weakest[:, None]).sum(axis=1) < MIN_EDGE_PLACES]] = False
    return seen


def _parallel(angle: FloatArray, vector: FloatArray) -> BoolArray:
    """Return whether lines at `angle` run along `vector` (M, 2)."""
    cross = np.cos(angle) * vector[:, 1] - np.sin(angle) * vector[:, 0]
    parallel: BoolArray = np.abs(cross) < LINE_SINE * np.linalg.norm(vector, axis=1)
    return parallel


def _components(links: Links) -> tuple[IntArray, IntArray, IntArray]:
    """Return per corner its lattice (-1 alone), its (column, row), and the arm that points to +column."""
    bound = quads(links)
    return _walk(Links(np.where(bound, links.state, -1)))


def _walk(links: Links) -> tuple[IntArray, IntArray, IntArray]:
    """Return per corner its component (-1 alone), its (column, row), and the arm that points to +column."""
    count = len(links.corner)
    start, arm = np.nonzero(links.corner >= 0)
    end = links.corner[start, arm]
    graph = coo_matrix((np.ones(len(start), np.int8), (start, end)), shape=(count, count))
    _, label = connected_components(graph, directed=False)
    linked = np.asarray((links.corner >= 0).any(axis=1), dtype=np.bool_)
    _, component = np.unique(np.where(linked, label, -1), return_inverse=True)
    component = component - (0 if linked.all() else 1)
    grid, turn = np.zeros((count, 2), np.int64), np.zeros(count, np.int64)
    degree = (links.corner >= 0).sum(axis=1)
    order = np.lexsort((-degree, component))
    order = order[component[order] >= 0]
    _, first = np.unique(component[order], return_index=True)
    frontier = order[first]
    done = ~linked
    done[frontier] = True
    while len(frontier):
        who, arm = np.nonzero(links.corner[frontier] >= 0)
        start = frontier[who]
        end, back = links.corner[start, arm], links.arm[start, arm]
        fresh = ~done[end]
        start, arm, end, back = start[fresh], arm[fresh], end[fresh], back[fresh]
        end, first = np.unique(end, return_index=True)
        start, arm, back = start[first], arm[first], back[first]
        direction = (arm - turn[start]) % 4
        grid[end] = grid[start] + GRID_DIRECTIONS[direction]
        turn[end] = (back - direction - 2) % 4
        done[end] = True
        frontier = end
    return component, grid, turn
