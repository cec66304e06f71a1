"""Lattices of blobs: which blobs are neighbours, and the place of each in a square or a hexagonal lattice.

The distance of two blobs is measured in radii of the mean of their two ellipses. To second order in the distance it
does not depend on slant, perspective and distortion: it is the ratio of pitch and radius everywhere on a grid, so that
neither pitch nor radius in pixels need be known.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray, IntArray
from rigkit.detection.circles.blobs import Blobs

NEAREST_BLOBS = 16
"""Number of nearest blobs evaluated: at 75 degrees of slant nine others are nearer than the next one uphill."""
PITCHES = (2.02, 9.0)
"""Range of the distance of neighbours, in radii: circles do not touch, and are not tiny."""
ALIKE_BLOBS = 2.0
"""Largest ratio of the areas of neighbours, and of their axes where they differ most: the ratio of areas is 1.5 for
circles whose distances from the camera differ by a seventh."""
EQUAL_STEPS = 1.25
"""Largest ratio of the distances of one blob to its neighbours; the next ones of a square lattice have 1.41."""
MIN_LABELLED = 6
OFF_STEP = 0.3
"""Largest distance of a neighbour from a whole number of steps, in steps."""
TRUST = 0.5
"""Weight of a basis taken from neighbours, relative to a link."""


@dataclass(frozen=True, eq=False, slots=True)
class LabelledBlobs:
    """Blobs in a lattice.

    Attributes
    ----------
    index : (N,) of the blobs.
    label : (N, 2) whole steps along the two directions of the lattice; the second is clockwise (from u to v) of the
        first, by 90 degrees of the sheet, or by 60.
    hexagonal : whether by 60.
    """

    index: IntArray
    label: IntArray
    hexagonal: bool

    @property
    def whole(self) -> bool:
        """Whether they are a rectangle without gaps."""
        return not self.hexagonal and len(self.label) == int((np.ptp(self.label, axis=0) + 1).prod())


@dataclass(frozen=True, eq=False, slots=True)
class _Neighbours:
    """Links between neighbours, each in both directions."""

    source: IntArray
    target: IntArray
    vector: FloatArray


def blob_lattices(blobs: Blobs) -> list[LabelledBlobs]:
    """Return the lattices of `blobs`, in no particular order; a blob is in at most one."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    if len(blobs) < MIN_LABELLED:
        return []
    links = _links(blobs)
    count, member = connected_components(
        coo_array((np.ones(len(links.source)), (links.source, links.target)), shape=(len(blobs),) * 2), directed=False
    )
    sizes = np.bincount(member, minlength=count)
    out = []
    for number in np.flatnonzero(sizes >= MIN_LABELLED):
        here = member[links.source] == number
        own = _Neighbours(links.source[here], links.target[here], links.vector[here])
        found = _labelled(blobs, own)
        if found is not None:
            out.append(found)
    return out


def _links(blobs: Blobs) -> _Neighbours:
    from scipy.sparse import coo_array
    from scipy.spatial import cKDTree

    near = min(NEAREST_BLOBS + 1, len(blobs))
    _, index = cKDTree(blobs.pixels).query(blobs.pixels, k=near)
    source, target = np.repeat(np.arange(len(blobs)), near - 1), index[:, 1:].ravel()
    vector = blobs.pixels[target] - blobs.pixels[source]
    # Matrices of two rows are inverted by hand: numpy takes ten times as long.
    u, v = vector.T
    square = (blobs.shape @ blobs.shape).reshape(-1, 4)[:, [0, 1, 3]].T
    (su, suv, sv), (tu, tuv, tv) = square[:, source], square[:, target]
    mu, muv, mv = 0.5 * (su + tu), 0.5 * (suv + tuv), 0.5 * (sv + tv)
    distance = np.sqrt((mv * u * u - 2.0 * muv * u * v + mu * v * v) / (mu * mv - muv * muv))
    # Largest and smallest ratio of the squared axes of two ellipses, from the trace and the determinant.
    own = su * sv - suv * suv
    trace, det = (sv * tu - 2.0 * suv * tuv + su * tv) / own, (tu * tv - tuv * tuv) / own
    top = 0.5 * (trace + np.sqrt(np.maximum(trace**2 - 4.0 * det, 0.0)))
    low = det / np.maximum(top, 1e-12)
    alike = (
        (top < ALIKE_BLOBS**2)
        & (low > ALIKE_BLOBS**-2)
        & (np.abs(np.log(np.maximum(det, 1e-12))) < 2.0 * np.log(ALIKE_BLOBS))
    )
    alike &= blobs.sign[source] == blobs.sign[target]
    alike &= (distance > PITCHES[0]) & (distance < PITCHES[1])
    steps = np.where(alike, distance, np.inf).reshape(len(blobs), -1)
    # The second nearest, so that a single speck beside a circle does not hide its neighbours.
    limit = EQUAL_STEPS * np.sort(steps, axis=1)[:, min(1, near - 2)]
    fair = alike & (distance < limit[source]) & (distance < limit[target])
    one = coo_array((np.ones(int(fair.sum())), (source[fair], target[fair])), shape=(len(blobs),) * 2).tocsr()
    both = coo_array(one.multiply(one.T))
    return _Neighbours(both.row, both.col, blobs.pixels[both.col] - blobs.pixels[both.row])


def _labelled(blobs: Blobs, links: _Neighbours) -> LabelledBlobs | None:
    """Return the blobs of one component with their places, or None if they form no lattice."""
    index, flat = np.unique(np.concatenate([links.source, links.target]), return_inverse=True)
    source, target = flat.reshape(2, -1)
    count = len(index)
    hexagonal = _triangular(source, target, count)
    basis0, seed = _seed(blobs.shape[index], source, target, links.vector, count, hexagonal)
    if basis0 is None:
        return None
    label = np.zeros((count, 2), np.int64)
    basis = np.zeros((count, 2, 2))
    known = np.zeros(count, bool)
    basis[seed], known[seed] = basis0, True
    while True:
        ahead = np.flatnonzero(known[source] & ~known[target])
        if not len(ahead):
            break
        step, fits = _steps(basis[source[ahead]], links.vector[ahead], hexagonal)
        ahead, step = ahead[fits], step[fits]
        if not len(ahead):
            break
        reached, first = np.unique(target[ahead], return_index=True)
        label[reached] = label[source[ahead[first]]] + step[first]
        basis[reached] = basis[source[ahead[first]]]
        _refine(basis, reached, source, links.vector, hexagonal)
        known[reached] = True
    agreed = _agreed(label, known, basis, source, target, links.vector, hexagonal)
    if agreed.sum() < MIN_LABELLED:
        return None
    return LabelledBlobs(index[agreed], label[agreed], hexagonal)


def _triangular(source: IntArray, target: IntArray, count: int) -> bool:
    """Return whether most links are sides of triangles, as in a hexagonal lattice; in a square one none is."""
    from scipy.sparse import coo_array

    linked = coo_array((np.ones(len(source)), (source, target)), shape=(count, count)).tocsr()
    sides = (linked @ linked).multiply(linked)
    return bool(2 * sides.nnz > linked.nnz)


def _seed(
    shape: FloatArray, source: IntArray, target: IntArray, vector: FloatArray, count: int, hexagonal: bool
) -> tuple[FloatArray | None, int]:
    """Return the basis (2, 2), with steps as columns, of the blob with the most links, and that blob's index."""
    degree = np.bincount(source, minlength=count)
    # Of several the one whose neighbours have many links themselves, in the middle.
    weight = degree + np.bincount(source, degree[target].astype(np.float64), count) / 100.0
    seed = int(weight.argmax())
    own = vector[source == seed]
    level = np.linalg.solve(shape[seed], own.T).T
    angle = np.arctan2(level[:, 1], level[:, 0])
    wanted = np.pi / 3.0 if hexagonal else np.pi / 2.0
    turn = np.mod(angle[None, :] - angle[:, None], 2.0 * np.pi)
    off = np.abs(turn - wanted)
    first, second = np.unravel_index(off.argmin(), off.shape)
    if off[first, second] > 0.35 * wanted:
        return None, seed
    return np.stack([own[first], own[second]], axis=1), seed


def _steps(basis: FloatArray, vector: FloatArray, hexagonal: bool) -> tuple[IntArray, BoolArray]:
    """Return the steps (N, 2) of vectors, and whether each is one to a neighbour."""
    (a, b), (c, d), (u, v) = basis[:, 0].T, basis[:, 1].T, vector.T
    det = a * d - b * c
    fine = np.abs(det) > 1e-9
    parts = np.stack([d * u - b * v, a * v - c * u], axis=1) / np.where(fine, det, 1.0)[:, None]
    step = np.rint(parts)
    near = (np.abs(parts - step) < OFF_STEP).all(axis=1)
    total = np.abs(step).sum(axis=1)
    # Steps of 60 degrees: the third direction is the second minus the first.
    neighbour = (total == 1) | (hexagonal & (total == 2) & (step.sum(axis=1) == 0) & (step[:, 0] != 0))
    return step.astype(np.int64), fine & near & neighbour


def _refine(basis: FloatArray, which: IntArray, source: IntArray, vector: FloatArray, hexagonal: bool) -> None:
    """Fit the bases of the blobs `which` to their own links, in place."""
    mine = np.isin(source, which)
    at = source[mine]
    step, fits = _steps(basis[at], vector[mine], hexagonal)
    at, step, own = at[fits], step[fits].astype(np.float64), vector[mine][fits]
    normal = np.zeros((len(basis), 2, 2))
    right = np.zeros((len(basis), 2, 2))
    np.add.at(normal, at, step[:, :, None] * step[:, None, :])
    np.add.at(right, at, own[:, :, None] * step[:, None, :])
    normal = normal[which] + TRUST * np.eye(2)
    right = right[which] + TRUST * basis[which]
    basis[which] = right @ np.linalg.inv(normal)


def _agreed(
    label: IntArray,
    known: BoolArray,
    basis: FloatArray,
    source: IntArray,
    target: IntArray,
    vector: FloatArray,
    hexagonal: bool,
) -> BoolArray:
    """Return which blobs have a unique place on which most of their links agree."""
    count = len(label)
    inside = known[source] & known[target]
    step, fits = _steps(basis[source], vector, hexagonal)
    same = inside & fits & (label[source] + step == label[target]).all(axis=1)
    good, all_links = (np.bincount(source[part], minlength=count) for part in (same, inside))
    fine = known & (2 * good > all_links)
    # Of two blobs in one place the one with more links is kept.
    order = np.lexsort((-good, label[:, 1], label[:, 0], ~fine))
    ranked = label[order]
    again = np.zeros(count, bool)
    again[1:] = (ranked[1:] == ranked[:-1]).all(axis=1)
    fine[order[again]] = False
    return fine
