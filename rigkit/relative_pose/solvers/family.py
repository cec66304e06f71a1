"""Motions whose essential matrices form a linear family: least squares over its coefficients by a singular vector.

Pure translation: E = [t]x, linear in t. Standard stereo and forward motion, t along x or z: E is fixed up to the sign
of t, which cheirality determines. Forward motion along the optical axis with a rotation by psi about it, the roll:
E = [[a, b, 0], [-b, a, 0], [0, 0, 0]] with a = -sin psi and b = -cos psi. Standard stereo with unknown vertical
intrinsics is `standard.RowsSolver`.

Reference: L. Hajder, "Affine Correspondences in Stereo Vision": forward motion, F = [e]x with the epipole e in the
principal point. The rows are those of `rows`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rigkit.core.arrays import FloatArray, Mat3
from rigkit.core.errors import DegenerateError
from rigkit.core.matches import Matches
from rigkit.geometry.rotation import skew
from rigkit.relative_pose.solvers.estimate import EpipolarEstimate, check_baseline, check_count, finish, reweighted
from rigkit.relative_pose.solvers.rows import LinearRows, right_singular
from rigkit.relative_pose.solvers.weights import RowWeights, WeightRule

UNDETERMINED = 1e-12
"""Smallest singular value over the largest row weight that is not rounding, for unit rays."""


@dataclass(frozen=True, eq=False, slots=True)
class FamilySolver:
    """The least squares E of a linear family.

    Attributes
    ----------
    motion : name of the motion, for messages.
    family : (K, 9), vec(E) = x family, row-major.
    undetermined : message of the DegenerateError raised if more than one member of the family fits.
    """

    motion: str
    family: FloatArray
    undetermined: str = ""

    @property
    def degrees_of_freedom(self) -> int:
        return len(self.family) - 1

    def solve(self, matches: Matches, weights: WeightRule | None = None) -> EpipolarEstimate:
        """Return E21 of the family; see FundamentalSolver. Raises DegenerateError if it is not determined."""
        rows = LinearRows.of(matches, self.family)

        def best(row_weights: RowWeights) -> Mat3:
            check_count(matches, row_weights, self.degrees_of_freedom, self.motion)
            s, vt = right_singular(rows.weighted(row_weights))
            if (s[:-1] < UNDETERMINED * row_weights.points.max()).any():
                raise DegenerateError(self.undetermined)
            return np.asarray((vt[-1] @ self.family).reshape(3, 3))

        check_baseline(matches)
        E21, used = reweighted(matches, weights, best)
        return finish(matches, E21, E21, used)


TRANSLATIONS = np.array([skew(axis).ravel() for axis in np.eye(3)])
STANDARD = FamilySolver("standard stereo", TRANSLATIONS[:1])
FORWARD = FamilySolver("forward motion", TRANSLATIONS[2:])
FREE_TRANSLATION = FamilySolver(
    "pure translation",
    TRANSLATIONS,
    "the translation is not determined: the two images have the same rays (no baseline); take them from different "
    "places",
)
FORWARD_WITH_ROLL = FamilySolver(
    "forward motion with a free roll",
    np.array([[1.0, 0, 0, 0, 1, 0, 0, 0, 0], [0, 1, 0, -1, 0, 0, 0, 0, 0]]),
    "the roll is not determined: all points lie on the optical axis; take images with points all over",
)
