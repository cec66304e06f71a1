"""The order of a rig's unknowns: in a solution, in the covariance of its result, and in its file."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import accumulate, pairwise, starmap

from rigkit.cameras.base import Camera


@dataclass(frozen=True, eq=False, slots=True)
class Layout:
    """Slices of the globals: intrinsics of all cameras, mounts of all but the first, poses on their target of boards
    that do not define it, lags of all cameras but the first, the boards' shape."""

    cameras: tuple[slice, ...]
    mounts: tuple[slice | None, ...]
    boards: tuple[slice | None, ...]
    lags: slice
    shape: slice

    @classmethod
    def of(cls, sizes: Sequence[int], places: Sequence[bool], shape: int, lags: int = 0) -> Layout:
        """Return the layout for cameras with so many parameters each, boards with an unknown place or not, and numbers
        of unknowns of the shape and of lags."""
        ends = accumulate([*sizes, *[6] * (len(sizes) - 1), *[6] * sum(places), lags, shape], initial=0)
        runs = starmap(slice, pairwise(ends))
        cameras = tuple(next(runs) for _ in sizes)
        mounts = (None, *(next(runs) for _ in sizes[1:]))
        boards = tuple(next(runs) if place else None for place in places)
        return cls(cameras, mounts, boards, next(runs), next(runs))

    @classmethod
    def of_cameras(cls, cameras: Iterable[Camera]) -> Layout:
        """Return the layout of cameras and mounts alone, that of a rig's covariance."""
        return cls.of([camera.parameters.size for camera in cameras], (), 0)

    def mount(self, k: int) -> slice:
        """Return the slice of the mount of camera `k` > 0."""
        run = self.mounts[k]
        assert run is not None
        return run

    @property
    def count(self) -> int:
        """Number of globals."""
        return int(self.shape.stop)
