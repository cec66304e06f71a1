"""What board images or videos show: everything but the scale, which a rule must tell."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from rigkit.core.boards import Board
from rigkit.core.errors import CheckFailed, DegenerateError, InputError
from rigkit.core.patterns.chessboard import Chessboard
from rigkit.core.printing import brief, counted
from rigkit.core.progress import Progress, silent
from rigkit.detection.detect import detect_boards
from rigkit.detection.doubtful import doubtful_grid
from rigkit.detection.duplicate_marks import duplicate_boards
from rigkit.detection.saddles.response import GreyImage, grey_image
from rigkit.detection.unknown import BoardGuess, difference, guess_board
from rigkit.detection.whole_grids import MIN_IMAGES_OF_GUESS
from rigkit.io.boards.board_words import words_of_board
from rigkit.io.media.images import read_image
from rigkit.io.media.video import Video, is_video

ENOUGH_IMAGES = 12
"""Images that are looked at, evenly spread: what more of them show is the same board."""

EXPLAINING_IMAGES = 4
"""Images looked at to say what is wrong with a session."""

MIN_SHARE_OF_IMAGES = 0.5
"""A board is in this part of the images, at least, or something else may be in them."""

FRAME_STRIDE = 10
"""Frames from one that is looked at to the next, of a video that does not say how many it has."""


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class IdentifiedBoard:
    """A board that images show.

    Attributes
    ----------
    board : with squares, or tags, of 1 mm.
    seen, looked_at : names of the images that show it, and of all looked at.
    words : as `--board` takes them, but for the length: "aprilgrid:6x6xMM,spacing=0.3".
    beside : the words of other boards that the images show.
    unreadable : why other images could not be read.
    alike : names of images that show two of these boards: nothing tells whose marks are whose.
    elsewhere : the words of a board that other images show, and their names, as far as they were looked at.
    either_pattern : it may as well be of the other ChArUco pattern (`BoardGuess.either_pattern`).
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

    Raises InputError: no image, or none that can be read; CheckFailed: no board is seen, or none that tells its size:
    the frame cuts a chessboard in every image.
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
    progress("reading", ENOUGH_IMAGES, ENOUGH_IMAGES)
    guess = guess_board(list(images.values()), progress)
    names = tuple(Path(name).name for name in images)
    otherwise = _otherwise(list(images.items()), guess)
    if otherwise is not None:
        raise CheckFailed(otherwise)
    if guess is None:
        if unreadable:
            raise InputError(f"no board is seen in {counted(len(names), 'image')}, and {unreadable[0]}")
        seen = _doubtful(list(images.items())) or "no chessboard, ChArUco board, AprilGrid or grid of circles"
        raise CheckFailed(f"no board is seen in {counted(len(names), 'image')}: {seen}")
    if not guess.determined:
        raise CheckFailed(f"{counted(len(guess.images), 'image')} of {len(names)} show {_partial_board_words(guess)}")
    pictures = list(images.values())
    elsewhere = _elsewhere([(names[k], pictures[k]) for k in range(len(names)) if k not in guess.images])
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


def _elsewhere(rest: Sequence[tuple[str, GreyImage]]) -> tuple[str, tuple[str, ...]] | None:
    """Return the board, in words, that images show which do not show the one told, and their names; None where not most
    of them show one."""
    if len(rest) < MIN_IMAGES_OF_GUESS:
        return None
    guess = guess_board([image for _, image in rest])
    if (
        guess is None
        or not guess.determined
        or len(guess.images) < max(MIN_IMAGES_OF_GUESS, MIN_SHARE_OF_IMAGES * len(rest))
    ):
        return None
    return words_of_board(guess.board), tuple(rest[k][0] for k in guess.images)


def explained(paths: Sequence[Path], boards: Sequence[Board]) -> str | None:
    """Return in words why images do not show the boards declared; None where that is not known."""
    mirrored = _mirrored(paths, [board for board in boards if board.identified])
    if mirrored is not None:
        return mirrored
    guess, *_ = _guess(paths)
    if guess is None or not guess.determined:
        return None
    determined = [difference(seen, board) for board in boards for seen in (guess.board, *guess.beside)]
    words = [one for one in determined if one is not None]
    if len(words) < len(determined) or not words:
        return None
    what, count = guess.board.describe().split(", ")[0], len(guess.images)
    if what in words[0]:
        return f"in {counted(count, 'image')} {words[0]}"
    return f"{what} seen in {counted(count, 'image')}; {words[0]}"


def misread(paths: Sequence[Path], boards: Sequence[Board]) -> str | None:
    """Return in words why corners of boards with marks lie in wrong places; None where that is not known.

    Marks of another board may be at home on the one declared, and those of two boards alike are each other's. Of
    chessboards the size of the grids tells (`rigkit.calibration.views.usable.other_size`).
    """
    if not any(board.identified for board in boards):
        return None
    return explained(paths, boards) or _alike(paths, boards)


def _alike(paths: Sequence[Path], boards: Sequence[Board]) -> str | None:
    """Say that images show two boards with the same marks; None where they do not."""
    for name, image in _pictures(paths, EXPLAINING_IMAGES):
        message = None if isinstance(image, InputError) else duplicate_boards(image, boards)
        if message is not None:
            return f"image '{Path(name).name}': {message}"
    return None


def _mirrored(paths: Sequence[Path], boards: Sequence[Board]) -> str | None:
    """Say that images are mirrored, where boards with marks are seen in them only when they are flipped; None else. A
    chessboard in a mirror is a chessboard: nothing tells."""
    if not boards:
        return None
    names = []
    for name, image in _pictures(paths, EXPLAINING_IMAGES):
        if isinstance(image, InputError):
            continue
        straight, flipped = (
            any(found.board_id is not None for found in detect_boards(seen, boards))
            for seen in (image, _flipped(image))
        )
        if straight:
            return None
        if flipped:
            names.append(name)
    return _in_a_mirror(names[0]) if names else None


def _otherwise(pictures: Sequence[tuple[str, GreyImage]], guess: BoardGuess | None) -> str | None:
    """Say that images are mirrored, where boards with marks are seen in them when that is undone, and without it only
    `guess`, which may be wrong: nothing, few chessboards, or some with something in their squares."""
    if guess is not None and (
        guess.board.pattern.type != Chessboard.type
        or (not guess.marked and len(guess.images) >= MIN_SHARE_OF_IMAGES * len(pictures))
    ):
        return None
    some = pictures[:: max(1, -(-len(pictures) // EXPLAINING_IMAGES))]
    marks = guess_board([_flipped(image) for _, image in some])
    if marks is not None and marks.board.identified and len(marks.images) >= MIN_SHARE_OF_IMAGES * len(some):
        return _in_a_mirror(some[marks.images[0]][0])
    return None


def _doubtful(pictures: Sequence[tuple[str, GreyImage]]) -> str | None:
    """Say what is seen in images that may be a board; None for nothing."""
    for name, image in pictures[:: max(1, -(-len(pictures) // EXPLAINING_IMAGES))]:
        words = doubtful_grid(image)
        if words is not None:
            return f"in '{Path(name).name}' {words}"
    return None


def _flipped(image: GreyImage) -> GreyImage:
    return image[:, ::-1].copy()


def _in_a_mirror(name: str) -> str:
    return (
        f"the images are mirrored: '{Path(name).name}' shows its board only when it is flipped left to right; "
        "switch off mirroring in the camera or the program that writes them, or flip all of them"
    )


@dataclass(frozen=True, slots=True)
class Suggestion:
    """What images show of boards that nobody has described.

    Attributes
    ----------
    words : as `--board` takes them; None where they do not tell.
    part : what they do show, in words, where it is not enough.
    fault : what is wrong with the images, in words.
    doubt : what is seen in them that may be a board, in words.
    """

    words: str | None = None
    part: str | None = None
    fault: str | None = None
    doubt: str | None = None


def suggestion(paths: Sequence[Path], progress: Progress = silent) -> Suggestion:
    """Return the board that images show."""
    guess, pictures, unreadable = _guess(paths, progress)
    if unreadable is not None and not pictures:
        return Suggestion(fault=str(unreadable))
    otherwise = _otherwise(pictures, guess)
    if otherwise is not None:
        return Suggestion(fault=otherwise)
    if guess is None:
        return Suggestion(doubt=_doubtful(pictures))
    if not guess.determined:
        return Suggestion(part=_partial_board_words(guess))
    # Chessboards beside it may hang on a wall.
    boards = [guess.board, *(board for board in guess.beside if board.identified)]
    return Suggestion(" --board ".join(map(words_of_board, boards)))


def _partial_board_words(guess: BoardGuess) -> str:
    """Say what images show of a board, where that is not all: a chessboard that has one of several sizes, or the only
    one at least, a ChArUco board with more rows, or an AprilGrid whose edges are aside of where they were printed."""
    if not guess.sizes:
        either = [guess.board, *filter(None, [guess.either])]
        return (
            "an AprilGrid whose tags look smaller or larger than they are, as too much light or ink runs over: "
            f"{' or '.join(words_of_board(board) for board in either)}, with a spacing that may be off by some "
            "hundredths; take images with less light, or measure a tag and the gap beside it"
        )
    words = " or ".join(f"{columns} x {rows}" for columns, rows in guess.sizes)
    if guess.board.identified:
        return (
            f"a ChArUco board of at least {words} inner corners, {words_of_board(guess.board)}: none shows where its "
            "rows end; count them on the board"
        )
    if len(guess.sizes) > 1:
        return f"a chessboard of {words} inner corners and do not tell which; count them on the board"
    return (
        f"only parts of a chessboard, of at least {words} inner corners: none shows all of its sides; count them on "
        "the board"
    )


def _guess(
    paths: Sequence[Path], progress: Progress = silent
) -> tuple[BoardGuess | None, list[tuple[str, GreyImage]], InputError | None]:
    """Return the board that a few images show, or more of them where those do not tell, what was looked at, and why the
    first of the others cannot be read."""
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
    """Yield the names and grey levels of about `max_images` images, evenly spread over `paths`, or why one cannot be
    read; of those that lie between these.

    Of videos frames are taken.
    """
    step = max(1, -(-len(paths) // max_images))
    for path in paths[step // 2 if between else 0 :: step]:
        try:
            if is_video(path):
                yield from _frames(path, max(1, max_images // len(paths)))
            else:
                yield str(path), grey_image(read_image(path))
        except InputError as error:
            yield str(path), error


def _frames(path: Path, max_images: int) -> Iterator[tuple[str, GreyImage]]:
    """Yield so many frames of a video, evenly spread over it."""
    with Video(path) as video:
        step = max(1, video.count // max_images) if video.count else FRAME_STRIDE
        for k in range(max_images):
            # The middles of equal parts: at its ends a board is on its way in or out.
            frame = video.frame(k * step + step // 2)
            if frame is None:
                return
            yield f"{path} frame {video.next_number - 1}", grey_image(frame)
