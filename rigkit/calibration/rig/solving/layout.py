"""Where the numbers of a rig stand: in a solution, in the covariance of its result, and in its file."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import accumulate, pairwise, starmap

from rigkit.cameras.base import Camera


@dataclass(frozen=True, eq=False, slots=True)
class Layout:
    """Where each kind of unknown stands among the globals: intrinsics of all cameras, mounts of all but the first, the
    boards that have a place of their own on their target, lags of all cameras but the first, the boards' shape."""

    cameras: tuple[slice, ...]
    mounts: tuple[slice | None, ...]
    boards: tuple[slice | None, ...]
    lags: slice
    shape: slice

    @classmethod
    def of(cls, sizes: Sequence[int], places: Sequence[bool], shape: int, lags: int = 0) -> Layout:
        """Lay out cameras of so many parameters each, boards that have a place to find or not, lags, and the shape."""
        ends = accumulate([*sizes, *[6] * (len(sizes) - 1), *[6] * sum(places), lags, shape], initial=0)
        runs = starmap(slice, pairwise(ends))
        cameras = tuple(next(runs) for _ in sizes)
        mounts = (None, *(next(runs) for _ in sizes[1:]))
        boards = tuple(next(runs) if place else None for place in places)
        return cls(cameras, mounts, boards, next(runs), next(runs))

    @classmethod
    def of_cameras(cls, cameras: Iterable[Camera]) -> Layout:
        """Lay out cameras and their mounts alone, as the covariance of a rig has them."""
        return cls.of([camera.parameters.size for camera in cameras], (), 0)

    def mount(self, k: int) -> slice:
        """Return where the mount of camera `k` > 0 stands."""
        run = self.mounts[k]
        assert run is not None
        return run

    @property
    def count(self) -> int:
        """Number of globals."""
        return int(self.shape.stop)
