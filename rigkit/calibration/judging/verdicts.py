"""What a person should know about a calibration, in sentences: what is wrong, how one can tell, what to do.

The limits are constants here; none depends on the result that it judges.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import replace
from typing import Protocol

import numpy as np

from rigkit.calibration.certainty.uncertainty import FarProjection
from rigkit.calibration.choosing.models_tried import DISAGREES_WITH_VIEWS
from rigkit.calibration.judging.boards import diagnose_boards
from rigkit.calibration.judging.captured import (
    ASKED_DEG,
    SMALL_PX,
    Extent,
    boards_never_rotated,
    diagnose_capture,
    extrapolated,
    few_repeated,
    hardly_tilted,
)
from rigkit.calibration.judging.changing import CHANGES, changing
from rigkit.calibration.judging.mixed import two_cameras
from rigkit.calibration.judging.moved import moment
from rigkit.calibration.judging.neighbours import neighbour_correlation
from rigkit.calibration.judging.pupil import modelled_pupil, moving_pupil
from rigkit.calibration.judging.two_kinds import KINDS_REMEDY, min_of_a_kind
from rigkit.calibration.result import Calibration, ViewResult
from rigkit.calibration.solving.fit import Fit
from rigkit.calibration.views.observations import Observations
from rigkit.calibration.views.repeats import cluster_numbers
from rigkit.calibration.views.usable import OTHER_GRIDS
from rigkit.cameras.base import image_center
from rigkit.core.arrays import BoolArray, FloatArray, IntArray
from rigkit.core.findings import Finding, Severity, worst

CELLS = (4, 3)
"""The image in columns x rows of cells, for coverage."""
CELL_CORNERS = 5
"""A cell with fewer corners than this is empty."""
MAX_RATIO_OF_MEDIANS = 2.5
"""A view whose median residual is this many times the usual one, there in the image."""
ODD_IMAGE_RATIO = 3.5
"""One with more is so unlike the others that nobody knows how good these are. Whose image that is it does not tell: in
15 real captures images of the camera itself have up to 3.9 (bouguet's left08), one of another camera put among those
of bouguet and bumblebee2 has 1.1 to 4.9 in 49 of 50 cases."""
ODD_IMAGE_REMEDY = (
    "look whether the board or the camera moved, another camera took it or a program mirrored it, and retake it"
)
RINGS = 4
"""What is usual is asked of so many rings around the middle of the image: towards the rim all corners scatter more."""
MAX_OUTLIER_SHARE = 0.2
"""A view with this part of its corners outliers."""
NAMED = 3
"""So many images are named one by one."""
PATTERN = 0.35
"""Correlation of residuals of neighbouring corners: noise has 0 (a fitted pose makes it slightly negative)."""
OVERFIT = 1.25
"""Held-out over training RMS."""
UNCERTAIN_PX = 1.0
"""Worst-direction standard deviation of a projection, in the covered part of the image."""
OUTLIER_SHARE = 0.03
NAMES_U = ("left", "centre left", "centre right", "right")
NAMES_V = ("top", "middle", "bottom")


class Judged(Protocol):
    """What has a training error and, perhaps, one on images that took no part."""

    @property
    def rms_px(self) -> float: ...

    @property
    def heldout_rms_px(self) -> float | None: ...


def judge(
    calibration: Calibration,
    also: Sequence[Finding] = (),
    *,
    far: FarProjection | None = None,
    clusters: IntArray | None = None,
    in_force: Collection[str] = (),
    solved: tuple[Observations, Fit] | None = None,
    order: Sequence[str] = (),
) -> tuple[Finding, ...]:
    """Return the verdicts, the headline first.

    Parameters
    ----------
    also : verdicts found elsewhere.
    far, clusters : what `FarProjection.of` and `cluster_numbers` (V,) return, where they are known already.
    in_force : of "model" and "board_shape" those that are "auto" already: no remedy to offer.
    solved, order : what was calibrated, and the names of all images in the order given, those left out too.
    """
    far = FarProjection.of(calibration) if far is None else far
    clusters = _clusters(calibration.views) if clusters is None else clusters
    upright = boards_never_rotated(calibration)
    extent, correlation = Extent.of(calibration), neighbour_correlation(calibration)
    mixed, change = _residuals(calibration, correlation, far, also, clusters, solved)
    # One lens for two cameras: residuals are of no view, board or model, and say nothing else.
    unlike, unclear = ([], []) if mixed else _views(calibration)
    pattern = [] if mixed else _pattern(calibration, correlation, in_force, bool(change))
    effects = _uncertain(calibration, far)
    # Images that contradict each other make a lens unsure, however many there are.
    contradicting = worst(effects) is Severity.BAD
    # Pictures of two kinds are why later ones are of another lens than the first.
    named = bool(mixed) or worst(change) is Severity.BAD
    # What says that nobody knows how good the rest is: then it is not good.
    causes = [
        *_not_converged(calibration, in_force),
        *mixed,
        *_of_another_kind(calibration, order),
        *change,
        *unlike,
        *diagnose_capture(calibration, clusters),
        *(pattern if contradicting else []),
        *upright,
        *extrapolated(calibration, extent, far),
        *(finding for finding in also if finding.severity is Severity.BAD and not named),
    ]
    found = [
        *(finding for finding in also if finding.severity is not Severity.BAD),
        *_left_out(calibration.dropped, calibration.views),
        *few_repeated(calibration, clusters),
        *_coverage(calibration),
    ]
    if not mixed:
        found += [
            *unclear,
            *([] if contradicting else pattern),
            *_overfit(calibration),
            *diagnose_boards(calibration, " if pixels are square" if upright else "", sure=not contradicting),
            *_outliers(calibration, [finding.image for finding in (*unlike, *unclear)]),
        ]
    return (*with_headline(calibration, causes, effects, extent.where), *modelled_pupil(calibration), *found)


def _clusters(views: Sequence[ViewResult]) -> IntArray:
    return cluster_numbers([v.image for v in views], [v.board_id for v in views], [v.pixels for v in views])


def _residuals(
    c: Calibration,
    correlation: float,
    far: FarProjection,
    also: Sequence[Finding],
    clusters: IntArray,
    solved: tuple[Observations, Fit] | None,
) -> tuple[list[Finding], list[Finding]]:
    """Return findings on two cameras that are mixed, and on what else residuals tell of images and lens."""
    if mixed := two_cameras(c, clusters):
        return mixed, []
    # Where it was another lens later on, residuals of one for both are of no motion, of no board, and no second cause.
    but = CHANGES if worst(also) is Severity.BAD else ()
    change = changing(c, correlation, solved, but, clusters)
    if hardly_tilted(c):
        # A lens that such boards leave open gives their images shears and zooms of their own: nobody can tell.
        change = [finding for finding in change if finding.severity is Severity.BAD]
    # A pupil that moves looks a little like a zoom in every image, and what changes never like a pupil.
    return [], change if worst(change) is Severity.BAD else moving_pupil(c, correlation, far) or change


def diagnose_session(
    calibration: Calibration, dropped: Sequence[tuple[str, str]], also: Sequence[Finding] = ()
) -> tuple[Finding, ...]:
    """Return the verdicts of the calibration together with those on images that gave no view at all, and others."""
    found = _left_out(dropped, calibration.views)
    return (*calibration.verdicts[:1], *found, *calibration.verdicts[1:], *also)


def with_headline(
    result: Judged, causes: Sequence[Finding], effects: Sequence[Finding], where: str = ""
) -> list[Finding]:
    """Return the first verdict, and those of `causes` and `effects` that it does not say itself.

    It is as grave as the gravest of them and names the first bad cause, or else the first: what is wrong with the
    images, before what comes of it. `where` says of which part of the image the error is.
    """
    held = result.heldout_rms_px
    error = f"training RMS {result.rms_px:.3f} px" if held is None else f"held-out RMS {held:.3f} px"
    found = [*causes, *effects]
    if not found:
        return [Finding.good(error + where)]
    first = next((cause for cause in causes if cause.severity is Severity.BAD), found[0])
    named = replace(first, severity=worst(found), message=f"{error}{where}, but {first.message}")
    return [named, *(finding for finding in found if finding is not first)]


def _not_converged(c: Calibration, in_force: Collection[str]) -> list[Finding]:
    if c.convergence.converged:
        return []
    other = "" if "model" in in_force else 'try model = "auto", or '
    return [
        Finding.bad(
            f"the solver did not converge ({c.convergence.reason}): the model may not fit this lens",
            f"{other}add views with the board tilted",
        )
    ]


def _contradicting(dropped: Sequence[tuple[str, str]], views: Sequence[ViewResult]) -> list[str]:
    """Return the images that hardly agree with the others in any corner, where these are too many for mishaps."""
    used = {view.image for view in views}
    out = list(dict.fromkeys(i for i, reason in dropped if reason.endswith(DISAGREES_WITH_VIEWS) and i not in used))
    return out if len(out) >= min_of_a_kind(len(used) + len(out)) else []


def _of_another_kind(c: Calibration, order: Sequence[str]) -> list[Finding]:
    """Whatever the error of the rest: so many images are of another lens, setting or board, or the rest is. `order` is
    that of all images."""
    images = _contradicting(c.dropped, c.views)
    if not images:
        return []
    used = {view.image for view in c.views}
    what = f"{len(images)} of {len(used) + len(images)} images contradict the others and are left out, "
    at = moment([image for image in dict.fromkeys(order) if image in used or image in images], images)
    return [Finding.look(what + (f"all {at}" if at else f"'{images[0]}' the first"), KINDS_REMEDY, images[0])]


def _left_out(dropped: Sequence[tuple[str, str]], views: Sequence[ViewResult]) -> list[Finding]:
    """Name the images left out, or how many for each reason. What lies beside a board in an image that is used is no
    cause to look."""
    contradicted = set(_contradicting(dropped, views))
    dropped = [(image, reason) for image, reason in dropped if image not in contradicted]
    used = {view.image for view in views}
    parts = [(image, reason) for image, reason in dropped if image in used and reason != OTHER_GRIDS]
    found = [
        Finding.look(f"of image '{image}' something is left out: {reason}", image=image) for image, reason in parts
    ]
    return [*_images_left_out([(image, reason) for image, reason in dropped if image not in used]), *found[:NAMED]]


def _images_left_out(dropped: Sequence[tuple[str, str]]) -> list[Finding]:
    if len(dropped) <= NAMED:
        return [Finding.look(f"image '{image}' is left out: {reason}", image=image) for image, reason in dropped]
    reasons = Counter(reason for _, reason in dropped)
    first = {reason: image for image, reason in reversed(dropped)}
    return [
        Finding.look(f"{count} images are left out, '{first[reason]}' the first: {reason}")
        if count > 1
        else Finding.look(f"image '{first[reason]}' is left out: {reason}", image=first[reason])
        for reason, count in reasons.most_common(NAMED)
    ]


def _coverage(c: Calibration) -> list[Finding]:
    """Name the cells of the image that no board reached, where the lens has an image at all."""
    width, height = c.camera.size_px
    pixels = c.corners.pixels[c.corners.kept]
    size = np.array([width / CELLS[0], height / CELLS[1]])
    cell = np.clip((pixels / size).astype(np.int64), 0, np.array(CELLS) - 1)
    count = np.bincount(cell[:, 0] * CELLS[1] + cell[:, 1], minlength=CELLS[0] * CELLS[1]).reshape(CELLS)
    if count.min() >= CELL_CORNERS:
        return []
    u, v = np.meshgrid((np.arange(CELLS[0]) + 0.5) * size[0], (np.arange(CELLS[1]) + 0.5) * size[1], indexing="ij")
    rays, valid = c.camera.unproject(np.stack([u, v], axis=-1))
    empty = (count < CELL_CORNERS) & valid & (np.where(valid, rays[..., 2], -1.0) > np.cos(np.radians(ASKED_DEG)))
    if not empty.any():
        return []
    return [Finding.look(f"no corners in the {_in_words(empty)} of the image", "hold the board there, tilted")]


def _in_words(cells: BoolArray) -> str:
    """Return cells (columns, rows) of the image in words, whole rows and columns together."""
    columns, rows = np.asarray(cells.all(axis=1)), np.asarray(cells.all(axis=0))
    names = [f"whole {NAMES_U[i]}" for i in np.flatnonzero(columns)]
    names += [f"whole {NAMES_V[j]}" for j in np.flatnonzero(rows)]
    single = np.asarray(cells & ~columns[:, None] & ~rows[None, :])
    names += [f"{NAMES_V[j]} {NAMES_U[i]}" for i, j in np.argwhere(single)]
    return ", ".join(names)


def _cell(c: Calibration, pixel: FloatArray) -> str:
    """Return in words where a pixel is."""
    i, j = np.clip((pixel / c.camera.size_px * CELLS).astype(np.int64), 0, np.array(CELLS) - 1)
    return f"{NAMES_V[j]} {NAMES_U[i]}"


def _views(c: Calibration) -> tuple[list[Finding], list[Finding]]:
    """Name the views that are unlike the others: those that may be of another camera, and the rest."""
    if len(c.views) < 3:
        return [], []
    lengths = c.corners.count
    out = np.bincount(c.corners.view[~c.corners.kept], minlength=len(lengths))
    # Of all corners: a view that is bad throughout has its worst corners among the outliers.
    residual = np.hypot(*np.nan_to_num(c.corners.residuals_px).T)
    middle = _medians(residual, lengths)
    typical = max(float(np.median(middle)), np.finfo(float).tiny)
    times = middle / typical
    if times.max() > MAX_RATIO_OF_MEDIANS:
        away = c.corners.pixels - image_center(c.camera.size_px)
        there = np.full(len(away), typical)
        for ring in np.array_split(np.argsort((away**2).sum(axis=1)), RINGS):
            there[ring] = max(float(np.median(residual[ring])), typical)
        times = _medians(residual / there, lengths)
    unlike, found = list[Finding](), list[Finding]()
    for i in np.flatnonzero((times > MAX_RATIO_OF_MEDIANS) | (out > MAX_OUTLIER_SHARE * lengths)).tolist():
        view = c.views[i]
        far = int((~view.kept & ~(np.linalg.norm(view.residuals_px, axis=1) <= SMALL_PX)).sum())
        if times[i] > MAX_RATIO_OF_MEDIANS and middle[i] > SMALL_PX:
            what = f"has a median residual of {middle[i]:.3f} px, {times[i]:.1f} times the usual one there"
        elif far > MAX_OUTLIER_SHARE * lengths[i]:
            what = f"has {far} outliers among its {lengths[i]} corners"
        else:
            continue
        (unlike if times[i] > ODD_IMAGE_RATIO and middle[i] > SMALL_PX else found).append(
            Finding.look(f"image '{view.image}' {what}", ODD_IMAGE_REMEDY, view.image)
        )
    return unlike, found


def _medians(values: FloatArray, count: IntArray) -> FloatArray:
    """Return the median of each run of `count` values."""
    padded = np.full((len(count), int(count.max())), np.inf)
    padded[np.arange(padded.shape[1]) < count[:, None]] = values
    padded.sort(axis=1)
    row = np.arange(len(count))
    return np.asarray(0.5 * (padded[row, (count - 1) // 2] + padded[row, count // 2]))


def _pattern(c: Calibration, correlation: float, in_force: Collection[str], named: bool) -> list[Finding]:
    """Residuals of neighbours agree where lens or board are not what the model says, or for a cause `named` already."""
    if correlation < PATTERN:
        return []
    what = f"residuals of neighbouring corners agree (correlation {correlation:.2f}): "
    shapes = "board_shape" in in_force or any(board.kind == "released" for board in c.boards)
    if not shapes:
        return [Finding.look(what + "the board's shape or the lens model does not fit", 'try board_shape = "auto"')]
    if "model" not in in_force:
        return [Finding.look(what + "the lens model, or the board's shape, does not quite fit", 'try model = "auto"')]
    what += "neither the lens models nor the boards' shapes follow all of it, so that something differs between images"
    remedy = "fix focus and stabilisation, hold camera and board still, take a board that does not bend"
    return [] if named else [Finding.look(what, remedy)]


def _overfit(c: Calibration) -> list[Finding]:
    if c.heldout_rms_px is None or c.heldout_rms_px <= OVERFIT * c.rms_px:
        return []
    return [
        Finding.look(
            f"held-out RMS is {c.heldout_rms_px / c.rms_px:.2f} times the training RMS: the images are too few for "
            "this model, or some image is unlike the others",
            "take more",
        )
    ]


def _uncertain(c: Calibration, far: FarProjection) -> list[Finding]:
    typical, worst, inside = far.usual_px, far.worst_px, far.at_corners_px
    if worst <= UNCERTAIN_PX:
        error = c.rms_px if c.heldout_rms_px is None else c.heldout_rms_px
        if typical <= max(error, SMALL_PX):
            return []
        return [
            Finding.look(
                f"the projection is uncertain by {typical:.2f} px (one standard deviation) where the boards were, more "
                f"than the error of {error:.2f} px that the images show",
                "take more views, with the board tilted",
            )
        ]
    what = f"the projection is uncertain by up to {worst:.1f} px (one standard deviation) where the boards were"
    if not np.isfinite(worst):
        return [Finding.bad(what, "take more views, with the board tilted")]
    what += f", most in the {_cell(c, far.corners.pixels[np.nanargmax(inside[far.rays_valid])])} of the image"
    return [Finding.bad(what, "take more views there, with the board tilted")]


def _outliers(c: Calibration, named: Collection[str | None]) -> list[Finding]:
    """Those of images that are `named` have no cause but theirs."""
    far = [outlier for outlier in c.outliers if not (outlier.residual_px <= SMALL_PX or outlier.image in named)]
    share = len(far) / max(len(c.outliers) + c.corner_count, 1)
    if share <= OUTLIER_SHARE:
        return []
    image, count = Counter(outlier.image for outlier in far).most_common(1)[0]
    return [
        Finding.look(
            f"{100 * share:.1f} % of the corners are outliers, most of them ({count}) in '{image}'",
            "check exposure, focus and motion blur there",
        )
    ]
