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
    """Raise InputError if `boards` is not a sequence of boards, or there is no finder for the pattern of one."""
    if isinstance(boards, (str, Board)) or not all(isinstance(board, Board) for board in boards):
        raise InputError(
            "boards must be a list of rigkit.Board; rigkit.board_of_words makes one of words, such as '9x6x25', or of "
            "a file"
        )
    for board in boards:
        if board.pattern.type not in FINDERS:
            raise InputError(
                f"board '{board.board_id}': images cannot be searched for boards of type '{board.pattern.type}'; "
                f"a Finder for it is missing in rigkit.detection.targets.registry, which has {', '.join(FINDERS)}"
            )
