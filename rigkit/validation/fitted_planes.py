"""Planes fitted to both images at once, beside those through the points: angles, normals, and which of them judges."""

from __future__ import annotations

from dataclasses import dataclass

from rigkit.core.arrays import FloatArray
from rigkit.core.errors import InputError
from rigkit.core.planes import Planes
from rigkit.reconstruction.board_planes import BoardPlanes
from rigkit.reconstruction.reconstruct import Reconstruction
from rigkit.validation.planes import NormalErrors, normal_errors


@dataclass(frozen=True, slots=True, kw_only=True)
class AngleResult:
    """The angle between two boards' faces, degrees, its sigma, and the measured angle where there is one.

    `angle_deg` is that of planes through the triangulated points; `coplanar_deg` of planes of maximum likelihood on
    which the points of a board lie, `lattice_deg` where they lie on its known lattice; None where not computed.
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
        """|angle - measured|: the orthogonality error where a right angle was measured; None where nothing was."""
        return self._error(self.angle_deg)

    @property
    def coplanar_error_deg(self) -> float | None:
        """|angle of coplanar points' planes - measured|; None where one of them is not known."""
        return self._error(self.coplanar_deg)

    @property
    def lattice_error_deg(self) -> float | None:
        """|lattice angle - measured|; None where one of them is not known."""
        return self._error(self.lattice_deg)

    def _error(self, angle_deg: float | None) -> float | None:
        return None if self.measured_deg is None or angle_deg is None else abs(angle_deg - self.measured_deg)


@dataclass(frozen=True, eq=False, slots=True)
class FittedPlanes:
    """The boards' planes by what is known of their points, None where not fitted, and which of them judges.

    Raises InputError where the one that judges was not fitted.
    """

    coplanar: BoardPlanes | None = None
    lattice: BoardPlanes | None = None
    planes: Planes = "free"

    def __post_init__(self) -> None:
        if self.planes != "free" and self.judge is None:
            raise InputError(f"validate: {self.planes} planes were not fitted and can judge nothing")

    @property
    def judge(self) -> BoardPlanes | None:
        """The planes that angles, normals and the baseline are judged by; None: those through the points."""
        return {"free": None, "coplanar": self.coplanar, "lattice": self.lattice}[self.planes]

    def angle(self, a: str, b: str, free: tuple[float, float], measured_deg: float | None) -> AngleResult:
        """Return the angle of two boards by all planes; `free` is that of those through the points, with its sigma."""
        coplanar, lattice = (_angle(planes, a, b) for planes in (self.coplanar, self.lattice))
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

    def judged_angle(self, a: str, b: str, free: tuple[float, float]) -> tuple[float, float] | None:
        """Return the angle that is judged, and its sigma; None where the planes that judge have none."""
        if self.judge is None:
            return free
        return self.judge.angle_deg(a, b) if {a, b} <= set(self.judge.board_ids) else None

    def judged_normals(self) -> dict[str, FloatArray]:
        """Return the normals that estimated ones are judged by where they are not those through the points."""
        return {} if self.judge is None else {name: self.judge.normal(name) for name in self.judge.board_ids}


def _angle(planes: BoardPlanes | None, a: str, b: str) -> tuple[float | None, float | None]:
    known = planes is not None and {a, b} <= set(planes.board_ids)
    return planes.angle_deg(a, b) if known and planes is not None else (None, None)


def normal_errors_against(reconstruction: Reconstruction, planes: BoardPlanes | None) -> dict[str, NormalErrors]:
    """Return the errors of a cloud's normals against those of the boards' planes, by board; none without planes."""
    cloud = reconstruction.cloud
    if planes is None:
        return {}
    of = {name: cloud.normals[cloud.on_board(name)] for name in planes.board_ids if name in cloud.board_ids}
    return {name: normal_errors(own, planes.normal(name)) for name, own in of.items() if len(own)}
