"""Calibration of a rig: all intrinsics and mounts are solved together, from synchronous views of boards.

The rig's frame is that of its first camera. Not every camera must see every board in every frame: it is enough that the
cameras are connected by targets that two of them see at once. Boards may move between frames, each on its own, or
together if they are mounted to each other (`rigid_boards`): then their poses on the target are solved for as well. One
camera with such a target is a rig, too. The held-out error is by cross-validation over frames.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial

import numpy as np

from rigkit.calibration.calibrate import FOLDS, calibrate_together
from rigkit.calibration.choosing.candidate_fits import CandidateFits, camera_named_in_errors
from rigkit.calibration.choosing.choice import MIN_IMAGES_OF_FIT
from rigkit.calibration.choosing.models_tried import Request
from rigkit.calibration.diagnosis.pupil import pupil_is_significant
from rigkit.calibration.posed import posed_calibration
from rigkit.calibration.result import Calibration
from rigkit.calibration.rig.assemble import assemble_rig
from rigkit.calibration.rig.certainty.frame_covariance import residual_sigma
from rigkit.calibration.rig.joint import BAD_COST_SIGMAS, JointRig, solve_jointly
from rigkit.calibration.rig.result import RigCalibration
from rigkit.calibration.rig.solving.known import KnownCameras
from rigkit.calibration.rig.solving.lags import TIMINGS, cost_of_own_times
from rigkit.calibration.rig.solving.shutters import readout_steps, with_longer_readouts
from rigkit.calibration.rig.solving.solver import refine_frames, solve_rig
from rigkit.calibration.rig.solving.state import RigObservations
from rigkit.calibration.rig.verdicts import diagnose_rig
from rigkit.calibration.rig.views.board_places import board_places
from rigkit.calibration.rig.views.copies import with_copies_matched
from rigkit.calibration.rig.views.mispaired import (
    MIN_FRAMES_OF_PART,
    duplicate_images,
    mixup_of_all_frames,
    mixups_of_frames,
    slipped_camera,
)
from rigkit.calibration.rig.views.observations import FrameObservations, RigViews, frame_observations
from rigkit.calibration.solving.solver import FROM_OPTIMUM
from rigkit.calibration.solving.state import weighted_squares
from rigkit.calibration.with_pupil import require_known
from rigkit.core.boards import Board
from rigkit.core.detections import BoardView
from rigkit.core.errors import DegenerateError, InputError
from rigkit.core.findings import Finding
from rigkit.core.progress import Progress, silent

Views = Mapping[str, Sequence[tuple[str, BoardView]]]


def calibrate_rig(
    views: Views,
    sizes_px: Mapping[str, tuple[int, int]],
    *,
    model: str | Mapping[str, str] = "scaramuzza",
    degree: int | Mapping[str, int | None] | None = None,
    board: str = "flat",
    rigid_boards: Sequence[Sequence[str]] = (),
    known: KnownCameras | None = None,
    folds: int = FOLDS,
    pupil: str = "auto",
    candidate_fits: Sequence[CandidateFits] = (),
    progress: Progress = silent,
) -> RigCalibration:
    """Return the calibration of a rig.

    Parameters
    ----------
    views : camera name -> (frame, view) pairs; images taken at the same moment have the same frame.
    sizes_px : camera name -> (width, height).
    model, degree : as for `calibrate`, one for all cameras or one for each.
    board : as for `calibrate`; where a camera alone finds boards warped or released, their shape is solved for jointly.
    rigid_boards : groups of ids of boards that are mounted to each other. Boards of a group that look alike may have
        any ids and orientations in the views; both are found from their arrangement.
    known : lenses, or lenses and mounts, that are held; their covariance is part of all covariances.
    folds : number of folds of the cross-validations, of each camera alone and of the rig; 0 for none.
    pupil : whether entrance pupils may move, as for `calibrate`: decided for each camera alone, solved jointly.
    candidate_fits : earlier fits of single cameras, reused for the same views.

    Raises
    ------
    InputError
        Fewer than two cameras and no rigid boards, cameras that share no board in any frame, rigid boards never seen
        together; two images of a frame by one camera; a camera without views, size or model; an unknown pupil.
    DegenerateError
        As for `calibrate`, with the name of the camera; or the cameras disagree on most of what they share.
    """
    if not views or (len(views) < 2 and not rigid_boards):
        raise InputError(f"rig: {len(views)} camera; a rig has at least two, or boards that are mounted to each other")
    require_known(pupil)
    _require_entries(views, sizes_px=sizes_px, model=model, degree=degree)
    _require_one_image(views)
    _require_known(views, sizes_px, known)
    models = {name: model if isinstance(model, str) else model[name] for name in views}
    degrees = {name: degree[name] if isinstance(degree, Mapping) else degree for name in views}
    requests = {
        n: Request(size_px=sizes_px[n], model=models[n], degree=degrees[n], board=board, folds=folds, pupil=pupil)
        for n in views
    }
    each_alone = partial(_each_alone, requests=requests, known=known, candidate_fits=candidate_fits, progress=progress)
    same = duplicate_images(views)
    every, notes = _matched(views, rigid_boards, each_alone, shaped=board != "flat")
    with _mistakes_named(every):
        joint, heldout = _best_timing(every, known, folds, progress)
    rig, far = assemble_rig(joint, heldout)
    notes = (*same, *_mistakes(rig, every, joint.cost_sigmas), *notes, *joint.notes)
    in_force = [n for n, v in (("model", set(models.values())), ("board_shape", {board})) if v == {"auto"}]
    return replace(rig, verdicts=diagnose_rig(rig, far, notes, in_force=in_force))


def _best_timing(
    every: RigViews, known: KnownCameras | None, folds: int, progress: Progress
) -> tuple[JointRig, tuple[float | None, tuple[float | None, ...]]]:
    """Return the joint solution and its held-out errors, as `heldout_rms`. Rolling shutters, and then lags, are a part
    of it unless held-out frames are predicted better without them; without held-out errors, where significant."""
    joint = solve_jointly(every, progress, known)
    best = heldout_rms(joint, folds)
    for timing in TIMINGS[: TIMINGS.index(joint.timing)][::-1]:
        if best[0] is None:
            break
        simpler = solve_jointly(every, progress, known, timing=timing)
        heldout = heldout_rms(simpler, folds)
        if heldout[0] is not None and heldout[0] < best[0]:
            joint, best = simpler, heldout
    return joint, best


def _matched(
    views: Views, groups: Sequence[Sequence[str]], each_alone: Callable[[Views], RigViews], *, shaped: bool
) -> tuple[RigViews, tuple[Finding, ...]]:
    """Return the views with boards that look alike told apart by their arrangement, and findings: those of the `groups`
    of rigid boards identified and oriented or, without groups, copies in a frame matched between the cameras; `shaped`:
    whether the boards' shapes were solved for."""
    alone = each_alone(views)
    if not groups:
        return with_copies_matched(alone), ()
    boards = _boards(views, groups)
    every, notes = board_places(groups, alone, boards)
    if shaped and _renamed(alone.seen, every.seen):
        # The boards' shapes were found from mixed-up boards.
        views = {n: [(e.frame, e.view) for e in own.values()] for n, own in zip(views, every.seen, strict=True)}
        every, notes = board_places(groups, each_alone(views), boards)
    return every, notes


@contextmanager
def _mistakes_named(views: RigViews) -> Iterator[None]:
    """Add to errors the file mix-up that makes the cameras disagree, if one is found."""
    try:
        yield
    except DegenerateError as error:
        cause = mixup_of_all_frames(views)
        raise error if cause is None else DegenerateError(f"rig: {cause.text} ({error})") from error


def _mistakes(rig: RigCalibration, views: RigViews, cost_sigmas: float) -> list[Finding]:
    """Return findings on file mix-ups that explain the frames left out, or all frames if most of them disagree, and on
    cameras whose own images contradict each other; without either, on a camera that slipped."""
    disagree = cost_sigmas > BAD_COST_SIGMAS
    if disagree and (cause := mixup_of_all_frames(views)):
        return [cause]
    mounts, left_out = [camera.cam_from_rig for camera in rig.cameras], [key[:2] for key in rig.left_out]
    found = mixups_of_frames(views, mounts, left_out)
    for name, single in zip(views.names, views.single, strict=True):
        if (how := single.verdicts[0].contradiction) is not None:
            found.append(replace(single.verdicts[0], message=f"camera '{name}': {how}", contradiction=None))
    if not found and (disagree or len(left_out) >= MIN_FRAMES_OF_PART):
        found += filter(None, [slipped_camera(views)])
    return found


def _require_entries(views: Views, **given: object) -> None:
    """Raise InputError where an option given by camera has no entry for one of them."""
    for what, entries in given.items():
        missing = [name for name in views if isinstance(entries, Mapping) and name not in entries]
        if missing:
            raise InputError(f"rig: {what} has no entry for camera '{missing[0]}'")


def _require_one_image(views: Views) -> None:
    """Raise InputError where a camera shows a board twice in a frame, or one image in two frames."""
    for name, own in views.items():
        shown: set[tuple[str, str]] = set()
        frames: dict[str, str] = {}
        for frame, view in own:
            board = view.board.board_id
            if (frame, board) in shown:
                raise InputError(
                    f"rig: camera '{name}' shows board '{board}' twice in frame '{frame}'; a frame is one image of "
                    "each camera, and boards have names of their own"
                )
            shown.add((frame, board))
            if frames.setdefault(view.image, frame) != frame:
                raise InputError(
                    f"rig: camera '{name}': image '{view.image}' is of frame '{frame}' and of '{frames[view.image]}'; "
                    "give images names of their own"
                )


def _require_known(views: Views, sizes_px: Mapping[str, tuple[int, int]], known: KnownCameras | None) -> None:
    """Raise InputError where a known camera has no views or another size, or the one that defines the frame is not the
    first."""
    if known is None:
        return
    for name, (camera, _) in known.cameras.items():
        if name not in views:
            raise InputError(f"rig: the known camera '{name}' has no views; there are {', '.join(views)}")
        if tuple(camera.size_px) != tuple(sizes_px[name]):
            raise InputError(
                f"camera '{name}': the known lens is of {camera.size_px[0]}x{camera.size_px[1]} px, the images are "
                f"{sizes_px[name][0]}x{sizes_px[name][1]}; give the calibration of such images"
            )
    if known.mounted and known.mounted[0] != next(iter(views)):
        raise InputError(f"rig: camera '{known.mounted[0]}', in whose frame the mounts are known, has to be the first")


def _each_alone(
    views: Views,
    requests: Mapping[str, Request],
    known: KnownCameras | None,
    candidate_fits: Sequence[CandidateFits],
    progress: Progress,
) -> RigViews:
    """Return the views with the calibration of each camera alone; errors contain the camera's name."""
    found: dict[str, Calibration] = {}
    asked: list[tuple[str, Sequence[BoardView], Request]] = []
    for name, own in views.items():
        alone, request = [view for _, view in own], requests[name]
        if known is None or name not in known.cameras:
            asked.append((name, alone, request))
            continue
        lens, _ = known.cameras[name]
        with camera_named_in_errors(name, ()):
            found[name] = posed_calibration(alone, lens, known.of_lens(name), board=request.board, folds=request.folds)
    names = [name for name, _, _ in asked]
    found |= dict(zip(names, calibrate_together(asked, known=candidate_fits, progress=progress), strict=True))
    if any(found[name].pupil is not None for name in names):
        central = {name: one for name, one in found.items() if one.pupil is None}
        found |= _with_pupils_too([one for one in asked if one[2].pupil == "auto" and one[0] in central], central)
    seen = [frame_observations(own, found[name]) for name, own in views.items()]
    return RigViews(list(views), seen, tuple(found[name] for name in views), {})


def _with_pupils_too(
    cameras: Sequence[tuple[str, Sequence[BoardView], Request]], central: Mapping[str, Calibration]
) -> dict[str, Calibration]:
    """Return the calibrations with a moving pupil of those cameras for which it is significant, against their `central`
    ones. If other cameras of the rig have a moving pupil, no improvement of the held-out error is required."""
    out = {}
    for name, views, request in cameras:
        try:
            (moving,) = calibrate_together([(name, views, replace(request, pupil="moving"))])
        except DegenerateError:
            continue
        if pupil_is_significant(moving, central[name]):
            out[name] = moving
    return out


def _boards(views: Views, groups: Sequence[Sequence[str]]) -> dict[str, Board]:
    """Return the boards seen, by id; raises InputError where a group names one that was not seen."""
    boards = {view.board.board_id: view.board for own in views.values() for _, view in own}
    for name in (name for group in groups for name in group):
        if name not in boards:
            raise InputError(
                f"rigid boards: no image shows board '{name}', only {', '.join(sorted(boards))}; add images of it, or "
                "leave it out of [[rigid_boards]]"
            )
    return boards


def _renamed(before: Sequence[FrameObservations], after: Sequence[FrameObservations]) -> bool:
    """Return whether any board has another name or first corner than before."""
    return any(
        old.keys() != new.keys() or any(old[key].view is not new[key].view for key in old)
        for old, new in zip(before, after, strict=True)
    )


def heldout_rms(joint: JointRig, folds: int) -> tuple[float | None, tuple[float | None, ...]]:
    """Return the 2-D RMS over held-out frames, of all cameras together and of each: cameras, mounts, places and shapes
    of boards are from the other folds, only one pose for each target is fitted, jointly to all cameras. Readouts of
    rolling shutters, too, are corrected to first order to those of the other folds. The images' own times are those of
    the solution; what it costs to predict them instead (`cost_of_own_times`) is in the first error. With fewer frames
    than folds each is a fold. None with less than MIN_IMAGES_OF_FIT frames, or where a camera's mount is determined by
    the frames of one fold alone.

    Unlike the held-out errors of single cameras it includes disagreement between cameras. Residuals are weighted as in
    the solution.
    """
    observations, state = joint.observations, joint.solution.state
    nothing = None, (None,) * len(observations.cameras)
    if folds < 2 or int(joint.frames.max()) + 1 < MIN_IMAGES_OF_FIT:
        return nothing
    fold = joint.folds(folds)
    squared, count = np.zeros(len(observations.cameras)), np.zeros(len(observations.cameras))
    sigma, own_times = residual_sigma(observations, joint.solution, joint.sigma_px), 0.0
    for k in range(int(fold.max()) + 1):
        test = fold == k
        train = observations.subset(~test)
        if not _is_connected(train):
            return nothing
        solved = solve_rig(train, state, joint.sigma_px, FROM_OPTIMUM).state
        part, start = observations.subset(test), solved.with_frames(state)
        if joint.timing == "readouts":
            part = with_longer_readouts(part, start, readout_steps(train, solved)[0])
        found = refine_frames(part, start)
        own_times += cost_of_own_times(part, found, sigma)
        for c, (own, weight) in enumerate(zip(part.cameras, part.weights, strict=True)):
            squared[c] += float(weighted_squares(found.of_camera(c, part), own, weight).sum())
            count[c] += float((weight > 0.0).sum())
    each = tuple(float(np.sqrt(s / n)) if n else None for s, n in zip(squared, count, strict=True))
    return float(np.sqrt((squared.sum() + own_times) / count.sum())), each


def _is_connected(observations: RigObservations) -> bool:
    """Return whether all cameras are connected by shared poses."""
    poses = [set(own.tolist()) for own in observations.frame]
    linked, rest = poses[0], poses[1:]
    while rest:
        near = [own for own in rest if own & linked]
        if not near:
            return False
        linked, rest = linked.union(*near), [own for own in rest if not own & linked]
    return True
