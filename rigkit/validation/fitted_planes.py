"""Angles and normals of planes fitted to both images, and the choice of the planes that checks use."""

from __future__ import annotations

from dataclasses import dataclass

from rigkit.core.arrays import FloatArray
from rigkit.core.choices import Planes
from rigkit.core.errors import InputError
from rigkit.reconstruction.board_planes import BoardPlanes
from rigkit.reconstruction.reconstruct import Reconstruction
from rigkit.validation.planes import NormalErrors, normal_errors


@dataclass(frozen=True, slots=True, kw_only=True)
class AngleResult:
    """The angle between two boards' faces, its standard deviation, and the measured angle or None, degrees.

    `angle_deg` is that of planes through the triangulated points. `coplanar_deg` and `lattice_deg` are those of
    maximum-likelihood planes with coplanar points and with the known lattice; None if not computed.
    """

    a: str
    b: str
    angle_deg: float
    sigma_deg: float
    measured_deg: float | None
    coplanar_deg: float | None = None
    coplanar_sigma_deg: float | None = None
    lattice_deg: float | None = None
    lattice_sigma_deg: float | None = None

    @property
    def error_deg(self) -> float | None:
        """|angle - measured|, the orthogonality error if a right angle was measured; None without a measurement."""
        return self._error(self.angle_deg)

    @property
    def coplanar_error_deg(self) -> float | None:
        """|coplanar angle - measured|; None if one of them is not known."""
        return self._error(self.coplanar_deg)

    @property
    def lattice_error_deg(self) -> float | None:
        """|lattice angle - measured|; None if one of them is not known."""
        return self._error(self.lattice_deg)

    def _error(self, angle_deg: float | None) -> float | None:
        return None if self.measured_deg is None or angle_deg is None else abs(angle_deg - self.measured_deg)


@dataclass(frozen=True, eq=False, slots=True)
class FittedPlanes:
    """The boards' planes fitted to both images, None if not fitted, and `planes`: which of them the checks use.

    Raises InputError if those were not fitted.
    """

    coplanar: BoardPlanes | None = None
    lattice: BoardPlanes | None = None
    planes: Planes = "free"

    def __post_init__(self) -> None:
        if self.planes != "free" and self.constrained is None:
            raise InputError(f"validate: {self.planes} planes were not fitted and cannot be used for checks")

    @property
    def constrained(self) -> BoardPlanes | None:
        """The planes that the checks of angles, normals and baseline use; None: those through the points."""
        return {"free": None, "coplanar": self.coplanar, "lattice": self.lattice}[self.planes]

    def angle(self, a: str, b: str, free: tuple[float, float], measured_deg: float | None) -> AngleResult:
        """Return the angle of two boards by all planes; `free` is that of planes through the points, with its sigma."""
        coplanar, lattice = (_angle(planes, a, b) or (None, None) for planes in (self.coplanar, self.lattice))
        return AngleResult(
            a=a,
            b=b,
            angle_deg=free[0],
            sigma_deg=free[1],
            measured_deg=measured_deg,
            coplanar_deg=coplanar[0],
            coplanar_sigma_deg=coplanar[1],
            lattice_deg=lattice[0],
            lattice_sigma_deg=lattice[1],
        )

    def checked_angle(self, a: str, b: str, free: tuple[float, float]) -> tuple[float, float] | None:
        """Return the angle to check and its sigma; None if one of the boards has no such plane."""
        return free if self.constrained is None else _angle(self.constrained, a, b)

    def checked_normals(self) -> dict[str, FloatArray]:
        """Return the boards' normals to check against, by id; empty for planes through the points."""
        planes = self.constrained
        return {} if planes is None else {name: planes.normal(name) for name in planes.board_ids}


def _angle(planes: BoardPlanes | None, a: str, b: str) -> tuple[float, float] | None:
    return planes.angle_deg(a, b) if planes is not None and {a, b} <= set(planes.board_ids) else None


def normal_errors_against(reconstruction: Reconstruction, planes: BoardPlanes | None) -> dict[str, NormalErrors]:
    """Return the errors of a cloud's normals against those of the boards' planes, by board; empty without planes."""
    cloud = reconstruction.cloud
    if planes is None:
        return {}
    of = {name: cloud.normals[cloud.on_board(name)] for name in planes.board_ids if name in cloud.board_ids}
    return {name: normal_errors(own, planes.normal(name)) for name, own in of.items() if len(own)}
