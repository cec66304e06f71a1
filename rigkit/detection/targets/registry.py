"""The finder of each pattern. A new one needs a module and a line here."""

from __future__ import annotations

from collections.abc import Sequence

from rigkit.core.boards import Board
from rigkit.core.errors import InputError
from rigkit.core.patterns.aprilgrid import AprilGrid
from rigkit.core.patterns.charuco import Charuco
from rigkit.core.patterns.chessboard import Chessboard
from rigkit.core.patterns.circles import Circles
from rigkit.detection.targets.aprilgrid import AprilGridFinder
from rigkit.detection.targets.base import Finder
from rigkit.detection.targets.charuco import CharucoFinder
from rigkit.detection.targets.chessboard import ChessboardFinder
from rigkit.detection.targets.circles import CirclesFinder

FINDERS: dict[str, Finder] = {
    AprilGrid.type: AprilGridFinder(),
    Charuco.type: CharucoFinder(),
    Circles.type: CirclesFinder(),
    Chessboard.type: ChessboardFinder(),
}
"""In this order: boards with markers first; chessboards, which use the remaining lattices, last."""


def check_searchable(boards: Sequence[Board]) -> None:
    """Raise InputError if there is no finder for the pattern of one of `boards`."""
    for board in boards:
        if board.pattern.type not in FINDERS:
            raise InputError(
                f"board '{board.board_id}': images cannot be searched for boards of type '{board.pattern.type}'; "
                f"a Finder for it is missing in rigkit.detection.targets.registry, which has {', '.join(FINDERS)}"
            )
