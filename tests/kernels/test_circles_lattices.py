"""The kernels of blobs and of maps of lattices against their definitions."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from kernels.reference import blobs as blobs_in_numpy
from kernels.reference import circle_maps
from numpy.typing import NDArray

from rigkit.core.arrays import FloatArray
from rigkit.detection.circles.blobs import WINDOW_PX, blob_rules
from rigkit.detection.circles.local_map import local_maps, plane_basis
from rigkit.kernels.circles import find_blobs

RULES = blob_rules()
SAME = 1e-9
"""Of centroids and covariances, px: sums of whole numbers on one side, of floats on the other."""
SAME_MAP = 1e-6
"""Of maps, px: normal equations of few circles are nearly singular."""


def pictures(rng: np.random.Generator) -> dict[str, NDArray[np.float32]]:
    noise = rng.normal(0.0, 1.0, (90, 131)).astype(np.float32)
    spiral = np.zeros((81, 81), np.float32)
    for turn in range(0, 40, 4):
        cv2.rectangle(spiral, (turn, turn), (80 - turn, 80 - turn), 1.0)
    combs = np.zeros((60, 64), np.float32)
    combs[5:20, 4:60:2] = combs[19:21, 4:60] = 1.0
    combs[30:50, 4:60:2] = combs[30:32, 4:60] = -1.0
    discs = np.zeros((120, 120), np.float32)
    for k, (u, v) in enumerate(np.ndindex(6, 6)):
        cv2.ellipse(discs, (10 + 20 * u, 10 + 20 * v), (7, 3 + k % 5), 10.0 * k, 0.0, 360.0, (-1.0) ** k, -1)
    return {
        "noise": noise,
        "smooth noise": np.asarray(cv2.GaussianBlur(noise, (0, 0), 2.0)),
        "spiral": spiral,
        "combs": combs,
        "discs": discs,
        "one colour": np.ones((20, 30), np.float32),
        "one row": noise[:1],
        "one column": noise[:, :1].copy(),
    }


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_blobs(sign: float, rng: np.random.Generator) -> None:
    found = 0
    for name, off in pictures(rng).items():
        off = np.float32(sign) * off
        variance = np.asarray(cv2.blur(off * off, (WINDOW_PX, WINDOW_PX)), np.float32)
        ours, theirs = find_blobs(off, variance, RULES), blobs_in_numpy.find_blobs(off, variance)
        assert ours.shape == theirs.shape, name
        # OpenCV numbers regions in another order.
        ours, theirs = (rows[np.lexsort(np.round(rows, 6).T)] for rows in (ours, theirs))
        assert ours == pytest.approx(theirs, abs=SAME), name
        found += len(ours)
    assert found > 40


def lattice(rng: np.random.Generator, hexagonal: bool) -> tuple[NDArray[np.int64], FloatArray]:
    """Return labels (N, 2) and pixels (N, 2) of a slanted lattice with noise and holes."""
    label = np.stack(np.meshgrid(np.arange(-3, 6), np.arange(7)), axis=-1).reshape(-1, 2)
    label = label[rng.random(len(label)) > 0.1]
    x, y = (label @ plane_basis(hexagonal).T).T
    below = 1.0 + 0.03 * x - 0.02 * y
    pixels = np.stack([40.0 * x + 5.0 * y, 30.0 * y - 4.0 * x], axis=1) / below[:, None] + 200.0
    return label, pixels + 0.02 * (x * y)[:, None] + rng.normal(0.0, 0.05, pixels.shape)


@pytest.mark.parametrize("hexagonal", [False, True])
@pytest.mark.parametrize("leave_out", [False, True])
def test_maps_around_places(hexagonal: bool, leave_out: bool, rng: np.random.Generator) -> None:
    label, pixels = lattice(rng, hexagonal)
    beside = label.max(axis=0) + np.array([[1, 0], [1, 1], [0, 1]])
    places = np.concatenate([label, beside])
    ours, theirs = (
        maps(label, pixels, places, hexagonal=hexagonal, sigma_px=0.05, leave_out=leave_out)
        for maps in (local_maps, circle_maps.local_maps)
    )
    for name in ("pixels", "first", "second", "gain", "slope_gain"):
        assert getattr(ours, name) == pytest.approx(getattr(theirs, name), rel=SAME_MAP, abs=SAME_MAP), name
    assert (ours.support == theirs.support).all() and (ours.surrounded == theirs.surrounded).all()
    assert ours.surrounded.any() and not ours.surrounded.all()


def test_maps_of_places_without_circles_are_not_numbers() -> None:
    label = np.array([[0, 0], [1, 0], [0, 1]])
    around = local_maps(label, 20.0 * label, np.array([[30, 30]]), hexagonal=False, sigma_px=0.1)
    assert around.support[0] == 0 and not around.surrounded[0] and not np.isfinite(around.gain[0])
