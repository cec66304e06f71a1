"""Test whether boards that were declared independent are mounted to each other: declaring it improves a calibration."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

from rigkit.calibration.result import Calibration
from rigkit.calibration.rig.joint import solve_jointly
from rigkit.calibration.rig.views.board_places import board_places
from rigkit.calibration.rig.views.board_sizes import board_size_conflicts
from rigkit.calibration.rig.views.observations import FrameObservations, RigViews, frame_observations
from rigkit.core.detections import BoardView
from rigkit.core.errors import DegenerateError, InputError
from rigkit.core.findings import Finding
from rigkit.core.progress import silent

MIN_IMAGES_OF_TIE = 3
"""Two images can agree by chance; boards with the same relative pose in three are mounted."""
TIED_SIGMAS = 10.0
"""Cost of sharing one pose, in standard deviations of a corner: a few for boards on one mount (up to 3.5 for paper that
is not flat), some tens for boards that moved by a millimetre against each other."""
LIKE_BOARDS = "{0} boards of {1}x{2} corners"


def suggest_rigid_boards(views: Sequence[BoardView], calibration: Calibration) -> tuple[Finding, ...]:
    """Return a finding if boards kept their relative poses in all images that show several of them, or would have with
    other sizes of their squares.

    `views` are those of the calibration, with their boards.
    """
    images = Counter(view.image for view in calibration.views)
    if sum(n > 1 for n in images.values()) < MIN_IMAGES_OF_TIE:
        return ()
    seen = _by_size([(view.image, view) for view in views], calibration)
    boards = {entry.board_id: entry.view.board for entry in seen.values()}
    often = Counter(board for image, board in seen if images[image] > 1)
    group = [name for name, count in often.items() if count >= MIN_IMAGES_OF_TIE]
    if len(group) < 2:
        return ()
    # Flat boards are enough for this test.
    flat = replace(calibration, boards=tuple(replace(b, kind="flat") for b in calibration.boards))
    try:
        named, notes = board_places([group], RigViews(["camera"], [seen], (flat,), {}), boards)
        if sizes := board_size_conflicts(named):
            return sizes
        joint = solve_jointly(named, silent)
    except (InputError, DegenerateError):
        return ()
    if notes or joint.left_out or joint.shared_count < MIN_IMAGES_OF_TIE or joint.cost_sigmas > TIED_SIGMAS:
        return ()
    alike = not {b.board_id for b in calibration.boards}.issuperset(group)
    size = boards[group[0]]
    words = LIKE_BOARDS.format(len(group), size.columns, size.rows) if alike else f"boards {', '.join(group)}"
    how = "give each a board file with an id of its own, and write" if alike else "write"
    listed = ", ".join(f'"{name}"' for name in group) if not alike else "..."
    return (
        Finding.look(
            f"the {words} kept their relative poses in {joint.shared_count} images: they may be rigidly mounted",
            f"{how} [[rigid_boards]] with boards = [{listed}] in the session: this lowers the camera's uncertainty "
            "and yields the boards' relative poses",
        ),
    )


def _by_size(views: Sequence[tuple[str, BoardView]], calibration: Calibration) -> FrameObservations:
    """Return the camera's observations, with boards that occur only once named by their size and number in the
    image."""
    out: FrameObservations = {}
    count: Counter[tuple[str, str]] = Counter()
    often = Counter(view.board.board_id for _, view in views)
    for entry in frame_observations(views, calibration).values():
        board = entry.view.board
        name = board.board_id
        if often[name] == 1:
            kind = f"{board.columns}x{board.rows}"
            count[entry.frame, kind] += 1
            name = f"{kind} number {count[entry.frame, kind]}"
            board = replace(board, board_id=name)
        key = (entry.frame, name)
        out[key] = replace(entry, view=replace(entry.view, board=board), key=key)
    return out
