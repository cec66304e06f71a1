"""What is known of the points of a board, for everything that is built on its plane."""

from __future__ import annotations

from typing import Literal, get_args

Planes = Literal["free", "coplanar", "lattice"]
"""Nothing; that they share a plane; where on it each of them is."""
PLANE_CHOICES: tuple[Planes, ...] = get_args(Planes)
