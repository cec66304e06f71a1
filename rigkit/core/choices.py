"""Choices of the reconstruction that options, manifests and results share."""

from __future__ import annotations

from typing import Literal, get_args

Planes = Literal["free", "coplanar", "lattice"]
"""Prior knowledge about the positions of a board's points: none; that they are coplanar; that they are a known lattice
in a plane."""
PLANE_CHOICES: tuple[Planes, ...] = get_args(Planes)

Support = Literal["chord", "neighbours", "line", "patch"]
"""What the directions at a corner are estimated from (`rigkit.affine.directions`)."""
SUPPORTS: tuple[Support, ...] = get_args(Support)
