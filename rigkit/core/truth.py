"""Ground truth that a person measured with a rule, a square or a level, with standard deviations."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from rigkit.core.errors import InputError
from rigkit.core.printing import brief

FEATURE = re.compile(r"^(?P<board>.+?)(?:\[\s*(?P<column>\d+)\s*,\s*(?P<row>\d+)\s*\]|(?P<centre>\.centre))?$")


@dataclass(frozen=True, slots=True)
class Feature:
    """A point or plane of a board that measurements refer to.

    Written "plane1[0,5]" for the corner in column 0 and row 5, "plane1.centre" for the middle of the corner grid, and
    "plane1" for the board's whole plane.

    >>> Feature.parse("plane1[7,0]")
    Feature(board_id='plane1', grid=(7, 0), centre=False)
    >>> str(Feature.parse("floor.centre"))
    'floor.centre'
    """

    board_id: str
    grid: tuple[int, int] | None = None
    centre: bool = False

    @classmethod
    def parse(cls, text: str) -> Feature:
        """Return the feature written as `text`; raises InputError for invalid text."""
        match = FEATURE.match(text.strip())
        if match is None:
            raise InputError(f"'{text}' names nothing on a board; write plane1[0,5], plane1.centre or plane1")
        grid = None if match["column"] is None else (int(match["column"]), int(match["row"]))
        return cls(match["board"], grid, match["centre"] is not None)

    @property
    def is_plane(self) -> bool:
        return self.grid is None and not self.centre

    def __str__(self) -> str:
        if self.grid is not None:
            return f"{self.board_id}[{self.grid[0]},{self.grid[1]}]"
        return f"{self.board_id}.centre" if self.centre else self.board_id


@dataclass(frozen=True, slots=True)
class MeasuredLength:
    """A length in mm with its standard deviation and how it was measured."""

    value_mm: float
    sigma_mm: float
    how: str

    def __post_init__(self) -> None:
        _check("length", self.value_mm, self.sigma_mm, "mm")


@dataclass(frozen=True, slots=True)
class MeasuredAngle:
    """The angle between the faces of boards `a` and `b` as a protractor measures it, 0 to 180 degrees.

    It is 180 degrees minus the angle between the normals that face the camera: a corner of a room that opens wider than
    a right angle is more than 90 degrees.
    """

    a: str
    b: str
    value_deg: float
    sigma_deg: float
    how: str

    def __post_init__(self) -> None:
        if self.a == self.b:
            raise InputError(f"angle: '{self.a}' has no angle with itself; name two boards")
        _check(self.name, self.value_deg, self.sigma_deg, "deg")
        if self.value_deg > 180.0:
            raise InputError(f"{self.name}: {self.value_deg} deg is more than 180; write the angle itself")

    @property
    def name(self) -> str:
        return f"angle {self.a}-{self.b}"


@dataclass(frozen=True, slots=True)
class MeasuredDistance:
    """The distance in mm between two features of boards; from a point to a plane it is perpendicular."""

    a: Feature
    b: Feature
    value_mm: float
    sigma_mm: float
    how: str

    def __post_init__(self) -> None:
        # A point may lie in the plane of another board.
        near = self.a.is_plane or self.b.is_plane
        _check(self.name, self.value_mm, self.sigma_mm, "mm", near_zero=near)
        if self.a.is_plane and self.b.is_plane:
            raise InputError(f"{self.name}: two planes have no one distance; name a corner of one")

    @property
    def name(self) -> str:
        return f"distance {self.a} to {self.b}"


@dataclass(frozen=True, slots=True)
class PairTruth:
    """All measurements of one pair, each quantity once by one means; empty if nothing was measured."""

    baseline: MeasuredLength | None = None
    angles: tuple[MeasuredAngle, ...] = ()
    distances: tuple[MeasuredDistance, ...] = ()

    __repr__ = brief

    def __post_init__(self) -> None:
        # A copied row would count as two independent checks.
        known: set[object] = set()
        measured: tuple[MeasuredAngle | MeasuredDistance, ...] = (*self.angles, *self.distances)
        for one in measured:
            fact = (type(one), frozenset((str(one.a), str(one.b))), one.how)
            if fact in known:
                raise InputError(f"{one.name} is stated twice; keep one, or say how each was measured")
            known.add(fact)

    @property
    def count(self) -> int:
        """Number of measurements."""
        return (self.baseline is not None) + len(self.angles) + len(self.distances)


def _check(what: str, value: float, sigma: float, unit: str, *, near_zero: bool = False) -> None:
    if not (np.isfinite(value) and value > 0.0):
        raise InputError(f"{what}: a measured value must be positive, got {value} {unit}")
    if not (np.isfinite(sigma) and sigma > 0.0):
        raise InputError(
            f"{what}: sigma must be positive, got {sigma} {unit}; say how far off the measurement may well be"
        )
    if sigma >= value and not near_zero:
        # Every result would agree with it: the check could not fail. Angles between faces are never near 0.
        raise InputError(
            f"{what}: {value:g} {unit} with a sigma of {sigma:g} {unit} is no measurement; give the value, then "
            "its sigma, in one unit: were both exchanged?"
        )
