"""Circle grids: all lattices of circles in the image, on the grids of the boards that they fit."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from rigkit.core.boards import Board
from rigkit.core.detections import BoardDetection
from rigkit.detection.circles.blobs import COARSE_PIXELS
from rigkit.detection.circles.place import boards_meant, lone_part
from rigkit.detection.circles.search import CircleSearch
from rigkit.detection.circles.through_lens import seen_through
from rigkit.detection.targets.base import Finder, Search


class CirclesFinder(Finder):
    """A grid is identified if its place on one board is unique, and no other board and no other grid fits."""

    def find(self, search: Search, boards: Sequence[Board]) -> list[BoardDetection]:
        """Return the detections. In a large image, a search for large circles that names all boards is enough: it tries
        each place beside the circles found, whatever the size there. A quick search may miss faint circles: if it finds
        no board, a full one follows."""
        look, ways = CircleSearch(search.grey), (True, False) if search.quick else (False,)
        found: list[BoardDetection] = []
        for coarse in (True, False) if search.grey.size > COARSE_PIXELS else (False,):
            for quick in ways:
                found = self._seen(search, look, boards, quick=quick, coarse=coarse)
                if found:
                    break
            if coarse and {item.board_id for item in found} >= {board.board_id for board in boards}:
                break
        return found

    @staticmethod
    def _seen(
        search: Search, look: CircleSearch, boards: Sequence[Board], *, quick: bool, coarse: bool = False
    ) -> list[BoardDetection]:
        fewest = min([search.min_corners, *(board.corner_count for board in boards)])
        out: list[BoardDetection] = []
        names: list[str | None] = []
        for grid in look.grids(fewest, quick=quick, coarse=coarse):
            fits = boards_meant(grid, boards)
            if fits:
                board, placed = fits[0]
                camera = search.camera
                out.append(placed if camera is None else seen_through(search.grey, grid, placed, board, camera))
                names.append(board.board_id if len(fits) == 1 else None)
                continue
            parts = [part for board in boards if (part := lone_part(grid, board)) is not None]
            if parts:
                out.append(parts[0])
                names.append(None)
        often = Counter(names)
        return [
            item if name is None or often[name] > 1 else item.named(name) for item, name in zip(out, names, strict=True)
        ]
