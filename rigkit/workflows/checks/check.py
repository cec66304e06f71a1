"""Does a calibration, or a rig, still hold? A check with fresh images of boards, or of any textured scene."""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from rigkit.calibration.certainty.displaced import lens_of
from rigkit.calibration.pupil import SolvedPupil
from rigkit.calibration.solving.clustered import with_block
from rigkit.calibration.views.usable import other_size, views_of_image, without_lookalikes, without_parts
from rigkit.cameras.base import Camera
from rigkit.cameras.moving_pupil import far_camera
from rigkit.core.boards import Board
from rigkit.core.detections import BoardDetection
from rigkit.core.errors import DegenerateError, InputError
from rigkit.core.findings import Finding
from rigkit.core.printing import brief
from rigkit.core.progress import Progress, silent
from rigkit.detection.detect import detect_boards
from rigkit.detection.unknown import difference
from rigkit.io.calibrations.calibration_file import (
    camera_to_json,
    findings_to_json,
    load_calibration,
    pupil_from_json,
    pupil_to_json,
)
from rigkit.io.calibrations.history_file import HistoryEntry, add_entry, ensure_register, path_from_register
from rigkit.io.calibrations.rig_file import is_rig_file, load_saved_rig
from rigkit.io.disk.json_reader import json_text
from rigkit.io.disk.reading import about, paths_of, read_text
from rigkit.io.disk.writing import ensure_writable, write_together
from rigkit.io.media.images import read_image_of
from rigkit.report.pages.check_page import check_facts, check_page
from rigkit.report.pages.page_facts import PageFacts
from rigkit.validation.monitoring.baseline import check_since
from rigkit.validation.monitoring.copies import with_copies_shared
from rigkit.validation.monitoring.epipolar import evidence_of_matches, matches_of_scenes
from rigkit.validation.monitoring.evidence import SAME_BOARD, FreshView, Monitored, evidence_of
from rigkit.validation.monitoring.flipped import consistently_numbered, flipped_pictures
from rigkit.validation.monitoring.verdict import CalibrationCheck, Look, check_views, evaluate_evidence
from rigkit.validation.monitoring.watch import monitored_camera, monitored_rig
from rigkit.workflows.calibration.next_pictures import length_goals
from rigkit.workflows.inputs.camera_files import require_covariance, warn_if_bad
from rigkit.workflows.inputs.identify_board import why_not_detected
from rigkit.workflows.moments import ImagesByMoment, moments_of
from rigkit.workflows.options.boards import CheckOptions
from rigkit.workflows.outputs.provenance import (
    digest_line,
    digest_of,
    digest_of_images,
    is_one_of,
    software_facts,
)

OWN_IMAGE = "the calibration was made from it, and fits it even if the camera has changed"
NO_PARTNER = "the other cameras have no image of its name or number"
OWN_PARTNER = "another camera's image of that moment is one of those from which the calibration was made"
_log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class CheckedPictures:
    """The verdict, the contents of its page, images without a board with the reason, unusable images (truncated, of
    another size), and the files that were written."""

    check: CalibrationCheck
    facts: PageFacts
    left_out: tuple[tuple[str, str], ...]
    unreadable: tuple[str, ...]
    written: tuple[Path, ...]

    __repr__ = brief


def check_pictures(
    path: str | Path,
    images: str | Path | Sequence[str | Path],
    options: CheckOptions | None = None,
    *,
    progress: Progress = silent,
) -> CheckedPictures:
    """Check a calibration or a rig with fresh images, or folders of them; for a rig as for `moments_of`.

    An unreadable image is skipped; its error is raised only where no other image is left.

    Raises InputError: no covariance, no images, none with a board, boards of another size, images of two cameras
    exchanged, or a file that cannot be written; DegenerateError: images without information about the camera.
    """
    options, source = options or CheckOptions(), Path(path)
    monitored, known = load_monitored(source)
    warn_if_bad(source)
    if not images:
        raise InputError("check: give new images, or a folder of them")
    now, single = moments_of(monitored.names, paths_of(images), options.frames)
    before, alone = moments_of(monitored.names, options.before, options.frames) if options.before else ([], [])
    inputs = [source, *(image for frame in (*now, *before) for image in frame)]
    ensure_writable((options.fix, options.report), force=options.force, inputs=inputs)
    if options.history is not None:
        ensure_register(options.history, inputs, options.temperature_c)
    both = {path for frame in now for path in frame} & {path for frame in before for path in frame}
    if both:
        raise InputError(f"check: '{min(both)}' is given both as a new image and with --before")
    own = _own_images(source, now)
    goals = [] if options.length is None else length_goals(monitored.cameras, monitored.cam_from_rig, options.length)
    boards = _replaced_by_known(options.boards, known) or known
    pictures = _Pictures(source=source, monitored=monitored, boards=boards, known=known, own=own, progress=progress)
    pictures.left_out.extend((f"{path}", NO_PARTNER) for path in (*single, *alone))
    look, views = pictures.seen(now, scene=options.scene)
    then = pictures.seen(before, scene=options.scene)[0] if before else None
    with about(source):
        if then is not None:
            check = check_since(monitored, then, look, goals)
        else:
            check = evaluate_evidence(monitored, look, goals)
        if views and not check.holds:
            check = replace(check, flipped=flipped_pictures(check.monitored, views))
            _require_right_order(check, views)
    pictures.left_out.extend((f"{path}", OWN_IMAGE) for path in own)
    files = _files(source, check, options, now, pictures.left_out)
    write_together(files, force=options.force)
    if options.history is not None:
        _register(options.history, source, check, before, options.temperature_c)
    written = (*files, *([options.history] if options.history is not None else []))
    return CheckedPictures(
        check=check,
        facts=check_facts(check),
        left_out=tuple(pictures.left_out),
        unreadable=tuple(pictures.unreadable),
        written=written,
    )


def _own_images(source: Path, frames: ImagesByMoment) -> list[Path]:
    """Return the images from which the calibration in `source` was made.

    Raises InputError where these are all images, or all of a camera for a file that does not list its images.
    """
    stated = json.loads(read_text(source)).get("made")
    made = stated if isinstance(stated, dict) else {}
    known = list(made["inputs"].values()) if isinstance(made.get("inputs"), dict) else []
    own = [path for frame in frames for path in frame if is_one_of(path, made)]
    every = len(own) == sum(map(len, frames))
    if every or any(_digest_alone(sorted(camera)) in known for camera in zip(*frames, strict=True)):
        raise InputError(
            f"check: '{source}' was made from these very images, which fit it even if the camera has changed; "
            "give new ones"
        )
    return own


def _digest_alone(images: Sequence[Path]) -> str:
    """Return the digest of images without the words on how it was computed; "" if none is readable."""
    return (digest_of_images(images) or "").rpartition(": ")[2]


def _files(
    source: Path,
    check: CalibrationCheck,
    options: CheckOptions,
    frames: ImagesByMoment,
    left_out: Sequence[tuple[str, str]],
) -> dict[Path, str | bytes]:
    """Return the contents of the files to write, by path: the corrected calibration, and the page, which names the
    images of the `frames`, and those `left_out`."""
    files: dict[Path, str | bytes] = {}
    # No correction where it holds or where nothing explains the images; flipped images are themselves the error.
    right = check.holds or check.unexplained or bool(check.flipped)
    if options.fix is not None and check.change is not None and not right:
        files[options.fix] = fixed_text(source, check)
    if options.report is not None:
        facts = {source.name: digest_line(source), **software_facts()}
        facts["images given"] = ", ".join(" + ".join(path.name for path in frame) for frame in frames)
        facts |= {f"left out: {Path(name).name}": reason for name, reason in left_out}
        files[options.report] = check_page(check, f"Check of {source.name}", facts)
    return files


def _register(
    register: Path, source: Path, check: CalibrationCheck, before: Sequence[Sequence[Path]], temperature_c: float | None
) -> None:
    since = _digest_alone([image for frame in before for image in frame])
    place = path_from_register(register, source)
    entry = HistoryEntry.of_check(check, place, digest=digest_of(source), baseline=since, temperature_c=temperature_c)
    add_entry(register, entry)


def load_monitored(source: Path) -> tuple[Monitored, tuple[Board, ...]]:
    """Return the calibration or rig in a file, to check, and the complete boards that it describes.

    Raises InputError for another file, or one without a covariance.
    """
    require_covariance(source)
    if not is_rig_file(source):
        known = load_calibration(source)
        with about(source):
            boards = without_parts(shape.board for shape in known.boards)
        return monitored_camera(known, source.stem), boards
    rig = load_saved_rig(source)
    with about(source):
        return replace(monitored_rig(rig), boards_mm=rig.boards_mm), without_parts(rig.boards)


def _replaced_by_known(boards: Sequence[Board], known: Sequence[Board]) -> tuple[Board, ...]:
    """Return the boards, replaced by the calibration's own where it has them, under any name and orientation."""
    out: list[Board] = []
    for board in boards:
        alike = [
            own for own in known if difference(own, board) is None and _same_square_size(own, board) and own not in out
        ]
        named = [own for own in alike if own.board_id == board.board_id]
        out.append((named or alike or [board])[0])
        if known and not alike:
            _log.warning(
                "board '%s' is not one of the calibration: it is assumed flat, with squares as declared; any departure "
                "looks like a change",
                board.board_id,
            )
    return tuple(out)


def _same_square_size(one: Board, other: Board) -> bool:
    sides = np.array([sorted(one.squares_mm), sorted(other.squares_mm)])
    return bool((np.abs(sides[0] / sides[1] - 1.0) < SAME_BOARD).all())


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class _Pictures:
    """Images of the monitored cameras, the boards that may be in them, those `known` from the file `source`, its `own`
    images, which are not used, and so far the images left out and the unusable ones."""

    source: Path
    monitored: Monitored
    boards: Sequence[Board]
    known: Sequence[Board]
    own: Sequence[Path]
    progress: Progress
    left_out: list[tuple[str, str]] = field(default_factory=list)
    unreadable: list[str] = field(default_factory=list)

    def seen(self, frames: Sequence[Sequence[Path]], *, scene: bool) -> tuple[Look, list[FreshView]]:
        """Return the evidence of frames as a function of the cameras, and the boards in them; no boards for a scene."""
        if scene:
            if not self.monitored.is_rig:
                raise InputError("check: --scene needs a rig; one camera needs images of a board")
            read = [self._read(frame) for frame in frames]
            matches = matches_of_scenes(self.monitored, [images for images in read if images], progress=self.progress)
            return (lambda now: evidence_of_matches(now, matches)), []
        if not self.boards:
            raise InputError(f"check: '{self.source}' does not say what boards there are; give --board 9x6x25")
        found = self._boards_seen(frames)
        wrong = self._other_size(found)
        if wrong is not None:
            # In some images a larger board passes for a declared one: it is counted where none is declared.
            wrong = self._other_size(replace(self, boards=())._boards_seen(frames)) or wrong
            raise InputError(f"check: {wrong}; give the board in the images with --board")
        views = _views(self.monitored, frames, found, self.boards, self.left_out)
        if not views:
            raise InputError(f"check: {_nothing_to_check(self.left_out, self.unreadable, self.boards)}")
        return (lambda now: evidence_of(now, views)), views

    def _other_size(self, found: Sequence[Mapping[str, Sequence[BoardDetection]]]) -> str | None:
        """Return `other_size` of the detections of each camera."""
        return other_size({name: own for each in found for name, own in each.items()}, self.boards, self.known)

    def _read(self, frame: Sequence[Path]) -> list[Any]:
        """Return the images of a moment, [] where one is unusable: the reason goes to `unreadable` or `left_out`."""
        if any(path in self.own for path in frame):
            self.left_out.extend((f"{path}", OWN_PARTNER) for path in frame if path not in self.own)
            return []
        images = [self._image(camera, path) for camera, path in zip(self.monitored.cameras, frame, strict=True)]
        return [] if any(image is None for image in images) else images

    def _image(self, camera: Camera, path: Path) -> Any:
        """Return an image of the camera; None where it is unusable, with the reason in `unreadable`, or the
        calibration's own."""
        if path in self.own:
            return None
        try:
            return read_image_of(path, camera.size_px, self.source)
        except InputError as error:
            self.unreadable.append(str(error))
            return None

    def _boards_seen(self, frames: Sequence[Sequence[Path]]) -> list[dict[str, Sequence[BoardDetection]]]:
        """Return for every camera the detections in its images; the reasons of unusable ones go to `unreadable`."""
        total, cameras = sum(len(frame) for frame in frames), self.monitored.cameras
        found: list[dict[str, Sequence[BoardDetection]]] = [{} for _ in cameras]
        for k, frame in enumerate(frames):
            for c, path in enumerate(frame):
                self.progress("corners", k * len(frame) + c, total)
                image = self._image(cameras[c], path)
                if image is not None:
                    found[c][str(path)] = detect_boards(image, self.boards, camera=far_camera(cameras[c]))
        self.progress("corners", total, total)
        return found


def _views(
    monitored: Monitored,
    frames: Sequence[Sequence[Path]],
    seen: Sequence[Mapping[str, Sequence[BoardDetection]]],
    boards: Sequence[Board],
    left_out: list[tuple[str, str]],
) -> list[FreshView]:
    """Return the boards in all images; an image without any goes to `left_out`, with the reason."""
    every: list[FreshView] = []
    own = [without_lookalikes(found, boards) for found in seen]
    whose = monitored.names if monitored.is_rig else (None,)
    for k, frame in enumerate(frames):
        name = f"{k:04d}"
        for c, path in enumerate(frame):
            if str(path) not in own[c]:
                continue
            views, reason = views_of_image(path.name, own[c][str(path)], boards, whose[c])
            every += [FreshView(name, c, view) for view in views]
            if reason is not None:
                left_out.append((str(path), reason))
    out: list[FreshView] = []
    for fresh in with_copies_shared(monitored, every):
        out.append(consistently_numbered(monitored, fresh, out))
    return out


def _nothing_to_check(left_out: Sequence[tuple[str, str]], unreadable: Sequence[str], boards: Sequence[Board]) -> str:
    """Return a message on why no image shows a board."""
    if not left_out:
        return unreadable[0]
    total = len(left_out) + len(unreadable)
    where = "the image" if total == 1 else f"any of {total} images"
    shown = why_not_detected([Path(name) for name, _ in left_out], boards)
    why = f"; {shown}" if shown else f": {left_out[0][1]}; take sharp pictures of the whole board"
    return f"no board was found in {where}{why}"


def _require_right_order(check: CalibrationCheck, views: Sequence[FreshView]) -> None:
    """Raise InputError where a rig's calibration holds for the images of two cameras exchanged, or a change explains
    them exchanged but not as given: with equal lenses, the cameras may have changed places instead."""
    names = check.monitored.names
    for i, j in combinations(range(len(names)), 2):
        other = {i: j, j: i}
        trial = [replace(view, camera=other.get(view.camera, view.camera)) for view in views]
        try:
            exchanged = check_views(check.monitored, trial)
        except (DegenerateError, InputError):
            continue
        if exchanged.holds or (check.unexplained and not exchanged.unexplained):
            # Two cameras with equal lenses, both turned upside down, look as if exchanged.
            how = f"exchanged, or {check.flipped}" if check.flipped else "exchanged"
            undone = "they fit" if exchanged.holds else "a change explains them"
            raise InputError(
                f"check: the images of '{names[i]}' and '{names[j]}' are {how}: undoing that, {undone}; give them in "
                f"the rig's order, {', '.join(names)}"
            )


def fixed_text(source: Path, check: CalibrationCheck) -> str:
    """Return the text of the file `source` with the change that explains the images, and a finding that reports it."""
    data: dict[str, Any] = json.loads(source.read_text(encoding="utf-8"))
    monitored = load_monitored(source)[0]
    # Relative to images from before, only the change since then.
    fixed, own = monitored.changed(check.step), monitored.of_models
    since = "" if check.baseline is None else f" and {check.baseline.frames} earlier ones"
    message = Finding.look(
        f"corrected from {check.frames} new frames{since}: {check.change}; views and residuals are those of the "
        "original",
        "calibrate again when possible",
    )
    # The file states the inadequacy of the models separately; no hypothesis changes a pupil.
    covariance = np.array(data["covariance"]) + (check.covariance - check.monitored.covariance)[np.ix_(own, own)]
    if "cameras" in data:
        for entry, camera, pose in zip(data["cameras"], fixed.cameras, fixed.cam_from_rig, strict=True):
            entry["camera"] = camera_to_json(lens_of(far_camera(camera)))
            entry["cam_from_rig"] = pose.matrix()[:3].tolist()
    else:
        data["camera"] = camera_to_json(lens_of(far_camera(fixed.cameras[0])))
        frame = np.array(data["frame_covariance"], dtype=np.float64)
        if "pupil" in data:
            pupil = pupil_from_json(data["pupil"])
            frame, pupil = SolvedPupil.split(pupil.terms, with_block(pupil.joint(frame), covariance, 1.0))
            data |= {"frame_covariance": frame.tolist(), "pupil": pupil_to_json(pupil)}
        else:
            data["frame_covariance"] = with_block(frame, covariance, 1.0).tolist()
    data["covariance"] = covariance.tolist()
    data["verdicts"] = [*findings_to_json([message]), *data.get("verdicts", [])]
    return json_text(data)
