"""Identification of the board in images or videos, up to scale."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from rigkit.core.arrays import sampling_step
from rigkit.core.boards import Board
from rigkit.core.errors import CheckFailed, DegenerateError, InputError
from rigkit.core.patterns.aprilgrid import AprilGrid
from rigkit.core.patterns.base import Pattern
from rigkit.core.patterns.chessboard import Chessboard
from rigkit.core.patterns.circles import STAGGERS, Circles
from rigkit.core.printing import brief, counted
from rigkit.core.progress import Progress, silent
from rigkit.detection.detect import detect_boards
from rigkit.detection.doubtful import doubtful_grid
from rigkit.detection.duplicate_marks import duplicate_boards
from rigkit.detection.saddles.response import GreyImage, grey_image
from rigkit.detection.unknown import BoardGuess, difference, guess_board
from rigkit.detection.whole_grids import MIN_IMAGES_OF_GUESS
from rigkit.io.boards.board_words import words_of_board
from rigkit.io.disk.reading import about
from rigkit.io.media.images import read_image
from rigkit.io.media.video import Video, is_video

_suggested: dict[frozenset[tuple[Path, int]], Board] = {}
"""The last images of which the board was suggested, and that board."""

ENOUGH_IMAGES = 12
"""Images that are searched, evenly spread: more of them show the same board."""

EXPLAINING_IMAGES = 4
"""Images that are searched to explain what is wrong with a session."""

MIN_SHARE_OF_IMAGES = 0.5
"""Fraction of the images that must show a board for it to be the one."""

FRAME_STRIDE = 10
"""Step between searched frames of a video of unknown length."""


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class IdentifiedBoard:
    """A board that images show.

    Attributes
    ----------
    board : the board, with squares or tags of 1 mm.
    seen, looked_at : names of the images that show it, and of all searched.
    words : the argument of `--board`, with MM for the length: "aprilgrid:6x6xMM,spacing=0.3".
    beside : arguments of `--board` for other boards in the same images.
    unreadable : errors of images that cannot be read.
    alike : names of images that show two copies of the board, whose marks cannot be told apart.
    elsewhere : the argument of `--board` for a board that other images show, and the names of these images.
    either_pattern : both ChArUco patterns fit (`BoardGuess.either_pattern`).
    """

    board: Board
    seen: tuple[str, ...]
    looked_at: tuple[str, ...]
    words: str
    beside: tuple[str, ...] = ()
    unreadable: tuple[InputError, ...] = ()
    alike: tuple[str, ...] = ()
    elsewhere: tuple[str, tuple[str, ...]] | None = None
    either_pattern: bool = False

    __repr__ = brief


def identify_board(paths: Sequence[str | Path], *, progress: Progress = silent) -> IdentifiedBoard:
    """Return the board that images, or frames of videos, show.

    Raises InputError: no image, or none that can be read; CheckFailed: no board is seen, or its size is undetermined
    because every image cuts it.
    """
    if not paths:
        raise InputError("board identify: no images; give some, or a folder")
    images: dict[str, GreyImage] = {}
    unreadable: list[InputError] = []
    for k, (name, image) in enumerate(_pictures([Path(path) for path in paths], ENOUGH_IMAGES)):
        progress("reading", k, ENOUGH_IMAGES)
        if isinstance(image, InputError):
            unreadable.append(image)
        else:
            images[name] = image
    if not images:
        raise unreadable[0]
    progress("reading", len(images), len(images))
    guess = guess_board(list(images.values()), progress)
    names = tuple(Path(name).name for name in images)
    mirrored = _mirrored_where_doubtful(guess, list(images.items()), progress)
    if mirrored is not None:
        raise CheckFailed(mirrored)
    if guess is None:
        if unreadable:
            raise InputError(f"no board is seen in {counted(len(names), 'image')}, and {unreadable[0]}")
        seen = _doubtful(list(images.items()), progress) or "no chessboard, ChArUco board, AprilGrid or grid of circles"
        raise CheckFailed(f"no board is seen in {counted(len(names), 'image')}: {seen}")
    if not guess.determined:
        raise CheckFailed(f"{counted(len(guess.images), 'image')} of {len(names)} show {_partial_board_words(guess)}")
    pictures = list(images.values())
    elsewhere = _other_board([(names[k], pictures[k]) for k in range(len(names)) if k not in guess.images], progress)
    twice = tuple(names[k] for k in guess.images if duplicate_boards(pictures[k], [guess.board]) is not None)
    return IdentifiedBoard(
        board=guess.board,
        seen=tuple(names[k] for k in guess.images),
        looked_at=names,
        words=words_of_board(guess.board),
        beside=tuple(words_of_board(board) for board in guess.beside),
        unreadable=tuple(unreadable),
        alike=twice,
        elsewhere=elsewhere,
        either_pattern=guess.either_pattern,
    )


def _other_board(rest: Sequence[tuple[str, GreyImage]], progress: Progress) -> tuple[str, tuple[str, ...]] | None:
    """Return the board in words that most of the remaining images show, and their names; None if there is none."""
    if len(rest) < MIN_IMAGES_OF_GUESS:
        return None
    guess = guess_board([image for _, image in rest], _named(progress, "searching for another board"))
    if (
        guess is None
        or not guess.determined
        or len(guess.images) < max(MIN_IMAGES_OF_GUESS, MIN_SHARE_OF_IMAGES * len(rest))
    ):
        return None
    return words_of_board(guess.board), tuple(rest[k][0] for k in guess.images)


def _named(progress: Progress, what: str) -> Progress:
    """Return a callback that names every step `what`."""
    return lambda _, done, total: progress(what, done, total)


def why_not_detected(paths: Sequence[Path], boards: Sequence[Board], progress: Progress = silent) -> str | None:
    """Return in words why images do not show the declared boards; None if unknown."""
    mirrored = _mirrored(paths, [board for board in boards if board.identified or _handed(board)])
    if mirrored is not None:
        return mirrored
    stamps = _stamps(paths)
    if any(stamps <= seen for seen, known in _suggested.items() if all(difference(known, b) is None for b in boards)):
        return None
    guess, *_ = _guess(paths, _named(progress, "checking which board it is"))
    if guess is None or not guess.determined:
        return None
    determined = [difference(seen, board) for board in boards for seen in (guess.board, *guess.beside)]
    words = [one for one in determined if one is not None]
    if len(words) < len(determined) or not words:
        return None
    what, count = guess.board.describe().split(", ")[0], len(guess.images)
    # The keys of another type differ, too.
    same_type = any(board.pattern.type == guess.board.pattern.type for board in boards)
    whole = "" if same_type else f", as in --board {words_of_board(guess.board)}"
    if what in words[0]:
        return f"in {counted(count, 'image')} {words[0]}{whole}"
    return f"{what} seen in {counted(count, 'image')}; {words[0]}{whole}"


def why_misplaced(paths: Sequence[Path], boards: Sequence[Board], progress: Progress = silent) -> str | None:
    """Return in words why corners of boards with marks are misplaced; None if unknown.

    The images may show another board with the same marks, or two copies of the board. Chessboards are checked by their
    size (`rigkit.calibration.views.usable.other_size`).
    """
    if not any(board.identified for board in boards):
        return None
    return why_not_detected(paths, boards, progress) or _duplicate_board(paths, boards)


def _duplicate_board(paths: Sequence[Path], boards: Sequence[Board]) -> str | None:
    """Return a message if an image shows two boards with the same marks, else None."""
    for name, image in _pictures(paths, EXPLAINING_IMAGES):
        message = None if isinstance(image, InputError) else duplicate_boards(image, boards)
        if message is not None:
            return f"image '{Path(name).name}': {message}"
    return None


def _handed(board: Board) -> bool:
    """Return whether a mirrored grid of circles is another grid: with an odd number of staggered rows it is the same,
    rotated by 180 degrees."""
    return isinstance(board.pattern, Circles) and board.pattern.staggered and board.rows % 2 == 0


def _mirrored(paths: Sequence[Path], boards: Sequence[Board]) -> str | None:
    """Return a message if boards with marks, or handed grids, are only seen in flipped images, else None.

    A mirrored chessboard is a chessboard: it does not show.
    """
    if not boards:
        return None
    seen: list[tuple[str, str]] = []
    for name, image in _pictures(paths, EXPLAINING_IMAGES):
        if isinstance(image, InputError):
            continue
        if any(found.board_id is not None for found in detect_boards(image, boards)):
            return None
        flipped = detect_boards(_flipped(image), boards)
        seen += [(name, found.board_id) for found in flipped if found.board_id is not None]
    if not seen:
        return None
    name, board_id = seen[0]
    (board,) = (board for board in boards if board.board_id == board_id)
    return _mirror_message(name, board.pattern)


def _mirrored_where_doubtful(
    guess: BoardGuess | None, pictures: Sequence[tuple[str, GreyImage]], progress: Progress
) -> str | None:
    """Return a message if the flipped images show boards with marks and `guess` is doubtful, else None.

    A guess is doubtful if it is None, a chessboard in few images, or one with marks in its squares.
    """
    if guess is not None and (
        guess.board.pattern.type != Chessboard.type
        or (not guess.marked and len(guess.images) >= MIN_SHARE_OF_IMAGES * len(pictures))
    ):
        return None
    some = pictures[:: sampling_step(len(pictures), EXPLAINING_IMAGES)]
    marks = guess_board([_flipped(image) for _, image in some], _named(progress, "checking for mirrored images"))
    if marks is not None and marks.board.identified and len(marks.images) >= MIN_SHARE_OF_IMAGES * len(some):
        return _mirror_message(some[marks.images[0]][0], marks.board.pattern)
    return None


def _doubtful(pictures: Sequence[tuple[str, GreyImage]], progress: Progress) -> str | None:
    """Return a description of the first doubtful grid in images, or None."""
    some = pictures[:: sampling_step(len(pictures), EXPLAINING_IMAGES)]
    for k, (name, image) in enumerate(some):
        progress("searching for doubtful boards", k, len(some))
        words = doubtful_grid(image)
        if words is not None:
            return f"in '{Path(name).name}' {words}"
    return None


def _flipped(image: GreyImage) -> GreyImage:
    return image[:, ::-1].copy()


def _mirror_message(name: str, pattern: Pattern) -> str:
    words = f"the images are mirrored: '{Path(name).name}' shows its board only when it is flipped left to right; "
    if isinstance(pattern, Circles):
        (other,) = {*STAGGERS} - {pattern.stagger}
        words = f'{words}if the board itself is printed so, set stagger = "{other}"; otherwise '
    return f"{words}switch off mirroring in the camera or the program that writes them, or flip all of them"


@dataclass(frozen=True, slots=True)
class Suggestion:
    """The boards that images show, as far as they determine them.

    Attributes
    ----------
    words : argument of `--board`; None if undetermined.
    beside : arguments for chessboards in the same images, which may be background.
    part : description of a board that is only partly determined.
    fault : what is wrong with the images.
    doubt : description of what may be a board.
    """

    words: str | None = None
    beside: tuple[str, ...] = ()
    part: str | None = None
    fault: str | None = None
    doubt: str | None = None


def suggestion(paths: Sequence[Path], progress: Progress = silent) -> Suggestion:
    """Return the board that images show, which `why_not_detected` then need not look for in these images."""
    guess, pictures, unreadable = _guess(paths, progress)
    _suggested.clear()
    if guess is not None and guess.determined and not guess.beside:
        _suggested[_stamps(paths)] = guess.board
    if unreadable is not None and not pictures:
        return Suggestion(fault=str(unreadable))
    mirrored = _mirrored_where_doubtful(guess, pictures, progress)
    if mirrored is not None:
        return Suggestion(fault=mirrored)
    if guess is None:
        return Suggestion(doubt=_doubtful(pictures, progress))
    if not guess.determined:
        return Suggestion(part=_partial_board_words(guess))
    # Other chessboards may be background. A tag is on one board of a rig: a board with the same is of other images.
    boards = [guess.board]
    boards += [board for board in guess.beside if board.identified and not any(_share_tags(board, b) for b in boards)]
    beside = tuple(words_of_board(board) for board in guess.beside if not board.identified)
    return Suggestion(" --board ".join(map(words_of_board, boards)), beside)


def _share_tags(one: Board, other: Board) -> bool:
    """Return whether two AprilGrids have tags of the same numbers."""
    numbers = [set(p.numbers(*b.size).flat) for b in (one, other) if isinstance(p := b.pattern, AprilGrid)]
    return len(numbers) == 2 and not numbers[0].isdisjoint(numbers[1])


def _partial_board_words(guess: BoardGuess) -> str:
    """Return a description of a board that is only partly determined.

    It is a chessboard of one of several sizes or of a minimum size, a ChArUco board with an unknown number of rows, or
    an AprilGrid whose printed or exposed edges are displaced.
    """
    if not guess.sizes:
        boards = [guess.board, *filter(None, [guess.other_border])]
        return (
            "an AprilGrid whose tags look smaller or larger than they are (overexposure, or ink that spreads): "
            f"{' or '.join(words_of_board(board) for board in boards)}, with a spacing that may be off by some "
            "hundredths; take images with less light, or measure a tag and the gap beside it"
        )
    words = " or ".join(f"{columns} x {rows}" for columns, rows in guess.sizes)
    if guess.board.identified:
        return (
            f"a ChArUco board of at least {words} inner corners, {words_of_board(guess.board)}: no image shows "
            "all of its rows; count them on the board"
        )
    if len(guess.sizes) > 1:
        return f"a chessboard of {words} inner corners and do not tell which; count them on the board"
    return (
        f"only parts of a chessboard, of at least {words} inner corners: none shows all of its sides; count them on "
        "the board"
    )


def _stamps(paths: Sequence[Path]) -> frozenset[tuple[Path, int]]:
    """Return the files with their times of change (0 if there is none), which differ where a file was replaced."""
    return frozenset((path.absolute(), path.stat().st_mtime_ns if path.exists() else 0) for path in paths)


def _guess(
    paths: Sequence[Path], progress: Progress = silent
) -> tuple[BoardGuess | None, list[tuple[str, GreyImage]], InputError | None]:
    """Return the board that a few images show (more images if those do not determine it), the images searched, and the
    error of the first image that cannot be read."""
    guess: BoardGuess | None = None
    unreadable: InputError | None = None
    pictures: list[tuple[str, GreyImage]] = []
    for max_images, between in ((EXPLAINING_IMAGES, False), (ENOUGH_IMAGES, False), (ENOUGH_IMAGES, True)):
        # Every second one of a session may be of something else.
        if between and (guess is not None or len(paths) <= max_images):
            break
        pictures = []
        for name, one in _pictures(paths, max_images, between):
            if isinstance(one, InputError):
                unreadable = unreadable or one
            else:
                pictures.append((name, one))
        try:
            guess = guess_board([image for _, image in pictures], progress)
        except (InputError, DegenerateError):
            return None, [], None
        # Where some do not show it, more are asked.
        determined = guess is not None and guess.determined and 1 < len(guess.images) == len(pictures)
        if determined or (len(paths) <= max_images and not any(map(is_video, paths))):
            break
    return guess, pictures, unreadable


def _pictures(
    paths: Sequence[Path], max_images: int, between: bool = False
) -> Iterator[tuple[str, GreyImage | InputError]]:
    """Yield (name, grey image or error) of about `max_images` images, evenly spread over `paths`; `between`: of those
    halfway between these. Videos give frames."""
    step = sampling_step(len(paths), max_images)
    for path in paths[step // 2 if between else 0 :: step]:
        try:
            if is_video(path):
                yield from _frames(path, max(1, max_images // len(paths)))
            else:
                with about(path):
                    image = grey_image(read_image(path))
                yield str(path), image
        except InputError as error:
            yield str(path), error


def _frames(path: Path, max_images: int) -> Iterator[tuple[str, GreyImage]]:
    """Yield `max_images` frames of a video, evenly spread."""
    with Video(path) as video:
        step = max(1, video.count // max_images) if video.count else FRAME_STRIDE
        for k in range(max_images):
            # The middles of equal parts: at its ends a board is on its way in or out.
            frame = video.frame(k * step + step // 2)
            if frame is None:
                return
            yield f"{path} frame {video.next_number - 1}", grey_image(frame)
