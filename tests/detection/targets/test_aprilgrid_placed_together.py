"""Places of lattices by all of their tags, which are too blurred to be read one by one."""

from __future__ import annotations

import numpy as np
import pytest

from rigkit.detection.tags.placing import place_together


@pytest.mark.parametrize("declared", [4, 12])
def test_a_place_with_which_one_row_agrees_is_none(declared: int) -> None:
    # Tags are numbered row by row: on a board of 4 x 2 tags those of 12 x 2, but for its first row, are elsewhere.
    row, column = (part.ravel() for part in np.indices((2, 6)))
    excess = np.zeros((12, 4 * 24))
    excess[np.arange(12), 4 * (12 * row + column)] = 40.0
    codes_at = 4 * np.arange(2 * declared).reshape(2, declared)
    place = place_together(excess, np.stack([column, row], axis=1), (7, 3), codes_at)
    if declared == 4:
        assert place is None
    else:
        assert place is not None and place[:2] == (12, 0) and place[2].tolist() == [0, 0]
