"""Prior knowledge about the positions of a board's points."""

from __future__ import annotations

from typing import Literal, get_args

Planes = Literal["free", "coplanar", "lattice"]
"""None; that the points are coplanar; that they are a known lattice in a plane."""
PLANE_CHOICES: tuple[Planes, ...] = get_args(Planes)
