"""Standard stereo with rows that are not known to correspond."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.epipolar_scenes import REGULAR, pair, pixel_fundamental
from helpers.tolerances import EXACT_REL

from rigkit.core.errors import DegenerateError
from rigkit.core.matches import Matches
from rigkit.relative_pose.solvers.estimate import EpipolarEstimate
from rigkit.relative_pose.solvers.standard import RowsSolver

SLOPE, SHIFT_PX = 0.93, 41.0
"""Row of image 2 = SLOPE * row of image 1 + SHIFT_PX: another focal length and another principal point."""


def with_other_rows(m: Matches) -> Matches:
    """The same pair where the second image came with vertical intrinsics that nobody knows."""
    pixels2 = m.pixels2 * [1.0, SLOPE] + [0.0, SHIFT_PX]
    A21 = None if m.A21 is None else m.A21 * np.array([[1.0], [SLOPE]])
    return Matches.from_cameras(
        REGULAR, REGULAR, m.pixels1, pixels2, sigma1_px=m.sigma1_px, sigma2_px=m.sigma2_px, A21=A21, sigma_A=m.sigma_A
    )


def relation(estimate: EpipolarEstimate) -> tuple[float, float]:
    """Slope and shift of a v2 + b v1 + c = 0."""
    F21 = pixel_fundamental(estimate)
    assert np.abs(F21[[0, 0, 0, 1, 1, 2], [0, 1, 2, 0, 1, 0]]).max() < EXACT_REL * np.abs(F21).max()
    return -F21[2, 1] / F21[1, 2], -F21[2, 2] / F21[1, 2]


@pytest.mark.parametrize("weights", ["points", "noise", "auto", "equal"])
def test_the_rows_relation_of_exact_data(rng, weights):
    m, _, _ = pair(rng, 6, "standard", sigma_A=0.0)
    estimate = RowsSolver().solve(with_other_rows(m), weights)
    assert relation(estimate) == pytest.approx((SLOPE, SHIFT_PX), rel=1e-9)


def test_one_affinity_is_enough(rng):
    """A point and the two rows of its affinity are three equations for two unknowns."""
    m, _, _ = pair(rng, 6, "standard", sigma_A=0.0)
    one = with_other_rows(m).select(np.arange(1))
    assert relation(RowsSolver().solve(one)) == pytest.approx((SLOPE, SHIFT_PX), rel=1e-9)


def test_affinities_help_by_what_their_noise_says(rng):
    """Rms over 200 pairs of eight points: the slope is better with affinities than without, by far."""
    errors = []
    for _ in range(200):
        m = with_other_rows(pair(rng, 8, "standard", noise_px=1.0, sigma_A=1e-3)[0])
        errors.append([relation(RowsSolver().solve(m, rule))[0] - SLOPE for rule in ("noise", "points")])
    with_affinities, points = np.sqrt(np.mean(np.square(errors), axis=0))
    # Affinities alone: 1e-3 / sqrt(8); points alone: a pixel and a half over the scatter of eight rows.
    assert with_affinities < 1.5e-3 / np.sqrt(8.0)
    assert points > 2.0 * with_affinities


def test_what_the_rows_relation_cannot_be_found_from(rng):
    m = with_other_rows(pair(rng, 6, "standard")[0])
    row = np.array([[1.0, 0.0]])
    flat = Matches.from_cameras(
        REGULAR, REGULAR, m.pixels1 * row + [0.0, 700.0], m.pixels2 * row + [0.0, 650.0],
        sigma1_px=m.sigma1_px, sigma2_px=m.sigma2_px,
    )  # fmt: skip
    with pytest.raises(DegenerateError, match="one row"):
        RowsSolver().solve(flat)
