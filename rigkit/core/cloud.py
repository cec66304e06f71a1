"""Oriented point clouds."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rigkit.core.arrays import BoolArray, FloatArray, IntArray, Normals, Points, keep_arrays, keep_indices
from rigkit.core.errors import InputError
from rigkit.core.printing import brief


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class OrientedCloud:
    """Points with normals, in the frame of camera 1.

    Attributes
    ----------
    points_mm : (N, 3)
    normals : (N, 3) unit, facing camera 1 (n . x < 0).
    colours : (N, 3) uint8, red green blue.
    board_index : (N,) int, index into `board_ids`; -1 where the point is on no board.
    grid : (N, 2) int, (column, row) on the board.
    sigma_mm : (N,) predicted standard deviation of the point (root of the covariance's largest eigenvalue).
    normal_sigma_rad : (N,) predicted rms angle of the normal.
    board_ids : names of the boards.
    calibration_in_sigmas : whether the sigmas include the uncertainty of the cameras' calibrations, besides that of the
        corners and the relative pose.
    from_origin : whether all points were seen from the origin, as those of one pair: the lines to them are free space.
    """

    points_mm: Points
    normals: Normals
    colours: NDArray[np.uint8]
    board_index: IntArray
    grid: IntArray
    sigma_mm: FloatArray
    normal_sigma_rad: FloatArray
    board_ids: tuple[str, ...]
    calibration_in_sigmas: bool = False
    from_origin: bool = False

    __repr__ = brief

    def __post_init__(self) -> None:
        n = len(np.asarray(self.points_mm))
        keep_arrays(self, points_mm=(n, 3), normals=(n, 3))
        keep_indices(self, board_index=(n,), grid=(n, 2))
        keep_arrays(self, sigma_mm=(n,), normal_sigma_rad=(n,), finite=False)
        for name in ("calibration_in_sigmas", "from_origin"):
            if not isinstance(value := getattr(self, name), bool | np.bool_):
                raise InputError(f"{name}: True or False is needed, got {value!r}")
        colours = np.array(self.colours, dtype=np.uint8)
        if colours.shape != (n, 3):
            raise InputError(f"colours: expected {n}x3, got {colours.shape}")
        colours.flags.writeable = False
        object.__setattr__(self, "colours", colours)

    def __len__(self) -> int:
        return len(self.points_mm)

    def select(self, mask: BoolArray) -> OrientedCloud:
        """Return the points at a mask (N,)."""
        rows = ("points_mm", "normals", "colours", "board_index", "grid", "sigma_mm", "normal_sigma_rad")
        return replace(self, **{name: getattr(self, name)[mask] for name in rows})

    def on_board(self, board_id: str) -> NDArray[np.bool_]:
        """Return the mask of the points on one board."""
        return np.asarray(self.board_index == self.board_ids.index(board_id))
