"""Findings about a calibration, in sentences: what is wrong, how it was found, what to do.

All limits are constants; none depends on the result that is judged.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace
from typing import Protocol

import numpy as np

from rigkit.calibration.certainty.uncertainty import FarProjection
from rigkit.calibration.diagnosis.boards import diagnose_boards
from rigkit.calibration.diagnosis.captured import (
    ASKED_DEG,
    SMALL_PX,
    Extent,
    boards_never_rotated,
    cropped_images,
    diagnose_capture,
    extrapolated,
    few_repeated,
    hardly_tilted,
    stretched_images,
    undistorted,
)
from rigkit.calibration.diagnosis.changing import CHANGES, changing, not_as_its_model
from rigkit.calibration.diagnosis.moved import moment, two_cameras
from rigkit.calibration.diagnosis.pupil import modelled_pupil, moving_pupil
from rigkit.calibration.diagnosis.two_kinds import KINDS_REMEDY, listed, min_of_a_kind
from rigkit.calibration.diagnosis.view_evidence import view_evidence
from rigkit.calibration.result import Calibration, ViewResult
from rigkit.calibration.solving.fit import Fit
from rigkit.calibration.views.observations import Observations
from rigkit.calibration.views.usable import OTHER_GRIDS
from rigkit.cameras.base import image_center
from rigkit.core.arrays import BoolArray, FloatArray, IntArray
from rigkit.core.findings import Finding, Severity, worst

CELLS = (4, 3)
"""Columns and rows of cells of the image, for coverage."""
CELL_CORNERS = 5
"""A cell with fewer corners is empty."""
MAX_RATIO_OF_MEDIANS = 2.5
"""Median residual of a view over that of all views in the same part of the image, from which it is reported."""
ODD_IMAGE_RATIO = 3.5
"""The same from which the calibration is not called good. It does not tell whether the image is of another camera: in
15 REAL captures images of the camera itself have up to 3.9 (bouguet's left08); an image of another camera among those
of bouguet and bumblebee2 has 1.1 to 4.9 in 49 of 50 cases."""
ODD_IMAGE_REMEDY = "look for motion blur, a moved board, another camera or a mirrored image, and retake it"
RINGS = 4
"""Number of rings about the image centre in which residuals are compared: all corners scatter more towards the rim."""
MAX_OUTLIER_SHARE = 0.2
"""Part of a view's corners that may be outliers."""
NAMED = 3
"""Maximal number of images that are listed one by one."""
PATTERN = 0.35
"""Correlation of residuals of neighbouring corners: that of noise is 0 (slightly negative after fitting a pose)."""
OVERFIT = 1.25
"""Held-out over training RMS."""
UNCERTAIN_PX = 1.0
"""Standard deviation of the projection in the worst direction, in the covered part of the image."""
OUTLIER_SHARE = 0.03
NAMES_U = ("left", "centre left", "centre right", "right")
NAMES_V = ("top", "middle", "bottom")


class Diagnosed(Protocol):
    """A result with a training error and, if there were enough images, a held-out error."""

    @property
    def rms_px(self) -> float: ...

    @property
    def heldout_rms_px(self) -> float | None: ...


def diagnose(
    calibration: Calibration,
    also: Sequence[Finding] = (),
    *,
    far: FarProjection | None = None,
    in_force: Collection[str] = (),
    solved: tuple[Observations, Fit] | None = None,
    order: Sequence[str] = (),
    may_move: bool = True,
) -> tuple[Finding, ...]:
    """Return the verdicts, the headline first.

    Parameters
    ----------
    also : findings from elsewhere.
    far : result of `FarProjection.of`, if known.
    in_force : those of "model" and "board_shape" that were "auto", so that this is no remedy.
    solved, order : observations and fit of the calibration, if known, and the names of all images in the order given.
    may_move : whether the entrance pupil may move, by `pupil.may_move`.
    """
    far = FarProjection.of(calibration) if far is None else far
    upright = list(boards_never_rotated(calibration))
    stretched = list(stretched_images(calibration, upright=bool(upright)))
    extent = Extent.of(calibration)
    mixed, change = _residuals(calibration, far, also, solved, may_move=may_move)
    # With the images of two cameras mixed, residuals are not informative about views, boards and model.
    unlike, unclear = ([], []) if mixed else _views(calibration)
    pattern = [] if mixed else list(_pattern(calibration, in_force, bool(change)))
    effects = list(_uncertain(calibration, far))
    another_kind = _too_many_for_accidents(calibration)
    # Images that contradict each other make the lens uncertain: where some were turned, they look stretched. A cause
    # found already explains a later other lens, too.
    contradicting, named = worst(effects) is Severity.BAD, bool(mixed) or worst(change) is Severity.BAD
    # Findings that make the quality of the calibration unknown: it is not called good.
    causes = [
        *_not_converged(calibration, in_force),
        *mixed,
        *_of_another_kind(calibration, another_kind, order),
        *change,
        *cropped_images(calibration),
        *([] if mixed else undistorted(calibration, sure=far.worst_px <= UNCERTAIN_PX)),
        *([] if contradicting else stretched),
        *unlike,
        *diagnose_capture(calibration),
        *([*pattern, *stretched] if contradicting else []),
        *upright,
        *extrapolated(calibration, extent, far),
        *(finding for finding in also if finding.severity is Severity.BAD and not named),
    ]
    found = _about_images(calibration, also, another_kind)
    if not mixed:
        found += [
            *unclear,
            *([] if contradicting else pattern),
            *_overfit(calibration),
            *diagnose_boards(calibration, " if pixels are square" if upright else "", sure=not contradicting),
            *_outliers(calibration, [finding.image for finding in (*unlike, *unclear)]),
        ]
    return (*with_headline(calibration, causes, effects, extent.where), *modelled_pupil(calibration), *found)


def _about_images(c: Calibration, also: Sequence[Finding], named: Collection[str]) -> list[Finding]:
    """Return findings that are no causes, of images left out, but those `named` already, repeated or missing, after
    those of `also`."""
    minor = [finding for finding in also if finding.severity is not Severity.BAD]
    others = [(image, reason) for image, reason in c.dropped if image not in named]
    return [*minor, *_left_out(others, c.views), *few_repeated(c), *_coverage(c)]


def _residuals(
    c: Calibration,
    far: FarProjection,
    also: Sequence[Finding],
    solved: tuple[Observations, Fit] | None,
    *,
    may_move: bool,
) -> tuple[list[Finding], list[Finding]]:
    """Return findings on two cameras mixed, and on other causes of the residuals."""
    if mixed := list(two_cameras(c, c.clusters, solved)):
        return mixed, []
    # If the lens changed at some image, the residuals of a common lens are no evidence for another change.
    but = CHANGES if worst(also) is Severity.BAD else ()
    change = changing(c, solved, but)
    if hardly_tilted(c):
        # Such boards do not determine the lens, and its errors look like shears and zooms that differ between images.
        change = [finding for finding in change if finding.severity is Severity.BAD]
    # A moving pupil looks a little like a zoom in every image, but no change between images looks like a pupil.
    pupil = list(moving_pupil(c, far)) if may_move and worst(change) is not Severity.BAD else []
    return [], pupil or change


def diagnose_session(
    calibration: Calibration, dropped: Sequence[tuple[str, str]], also: Sequence[Finding] = ()
) -> tuple[Finding, ...]:
    """Return the verdicts of the calibration, with findings on images without a view and those of `also` added."""
    found = _left_out(dropped, calibration.views)
    return (*calibration.verdicts[:1], *found, *calibration.verdicts[1:], *also)


def with_headline(
    result: Diagnosed, causes: Sequence[Finding], effects: Sequence[Finding], where: str = ""
) -> list[Finding]:
    """Return the headline, and the `causes` and `effects` that it does not contain.

    The headline has the severity of the worst of them and contains the first bad cause, or else the first finding, so
    that causes come before effects. `where` are words for the part of the image that the error holds for.
    """
    held = result.heldout_rms_px
    error = f"training RMS {result.rms_px:.3f} px" if held is None else f"held-out RMS {held:.3f} px"
    found = [*causes, *effects]
    if not found:
        return [Finding.good(error + where)]
    first = next((cause for cause in causes if cause.severity is Severity.BAD), found[0])
    named = replace(first, severity=worst(found), message=f"{error}{where}, but {first.message}")
    return [named, *(finding for finding in found if finding is not first)]


def _not_converged(c: Calibration, in_force: Collection[str]) -> Iterator[Finding]:
    if c.convergence.converged:
        return
    other = "" if "model" in in_force else 'try model = "auto", or '
    yield Finding.bad(
        f"the solver did not converge ({c.convergence.reason}): the model may not fit this lens",
        f"{other}add images with the board tilted",
    )


def _too_many_for_accidents(c: Calibration) -> list[str]:
    """Return the unused images that disagree with the others, if they are too many to be accidents."""
    used = {view.image for view in c.views}
    out = [image for image in dict.fromkeys(c.disagreeing) if image not in used]
    return out if len(out) >= min_of_a_kind(len(used) + len(out)) else []


def _of_another_kind(c: Calibration, images: Sequence[str], order: Sequence[str]) -> Iterator[Finding]:
    """Yield a finding if many `images` contradict the others: one of the groups is of another lens, setting or board.
    `order` are the names of all images."""
    if not images:
        return
    used = {view.image for view in c.views}
    what = f"{len(images)} of {len(used) + len(images)} images are inconsistent with the others and left out, "
    at = moment([image for image in dict.fromkeys(order) if image in used or image in images], images)
    yield Finding.look(
        what + (f"all {at}" if at else f"as those of another camera would be: {listed(images)}"),
        KINDS_REMEDY,
        images[0],
    )


def _left_out(dropped: Sequence[tuple[str, str]], views: Sequence[ViewResult]) -> list[Finding]:
    """Return findings on the images left out, or their number for each reason. Grids beside a board in a used image are
    not reported."""
    used = {view.image for view in views}
    parts = [(image, reason) for image, reason in dropped if image in used and reason != OTHER_GRIDS]
    found = [Finding.left_out(f"image '{image}' is partly left out", reason, image) for image, reason in parts]
    return [*_images_left_out([(image, reason) for image, reason in dropped if image not in used]), *found[:NAMED]]


def _images_left_out(dropped: Sequence[tuple[str, str]]) -> list[Finding]:
    if len(dropped) <= NAMED:
        return [Finding.left_out(f"image '{image}' is left out", reason, image) for image, reason in dropped]
    reasons = Counter(reason for _, reason in dropped)
    first = {reason: image for image, reason in reversed(dropped)}
    return [
        Finding.left_out(f"{count} images are left out, the first of them '{first[reason]}'", reason)
        if count > 1
        else Finding.left_out(f"image '{first[reason]}' is left out", reason, first[reason])
        for reason, count in reasons.most_common(NAMED)
    ]


def _coverage(c: Calibration) -> Iterator[Finding]:
    """Yield a finding with the cells of the image without corners, where the lens has an image."""
    width, height = c.camera.size_px
    pixels = c.corners.pixels[c.corners.kept]
    size = np.array([width / CELLS[0], height / CELLS[1]])
    cell = np.clip((pixels / size).astype(np.int64), 0, np.array(CELLS) - 1)
    count = np.bincount(cell[:, 0] * CELLS[1] + cell[:, 1], minlength=CELLS[0] * CELLS[1]).reshape(CELLS)
    if count.min() >= CELL_CORNERS:
        return
    u, v = np.meshgrid((np.arange(CELLS[0]) + 0.5) * size[0], (np.arange(CELLS[1]) + 0.5) * size[1], indexing="ij")
    rays, valid = c.camera.unproject(np.stack([u, v], axis=-1))
    empty = (count < CELL_CORNERS) & valid & (np.where(valid, rays[..., 2], -1.0) > np.cos(np.radians(ASKED_DEG)))
    if empty.any():
        yield Finding.look(f"no corners in {_in_words(empty)} of the image", "take images with the board there, tilted")


def _in_words(cells: BoolArray) -> str:
    """Return cells (columns, rows) of the image in words, whole rows and columns together."""
    columns, rows = np.asarray(cells.all(axis=1)), np.asarray(cells.all(axis=0))
    names = [f"the {NAMES_U[i]} quarter" for i in np.flatnonzero(columns)]
    names += [f"the {NAMES_V[j]} third" for j in np.flatnonzero(rows)]
    single = np.asarray(cells & ~columns[:, None] & ~rows[None, :])
    names += [f"the {NAMES_V[j]} {NAMES_U[i]}" for i, j in np.argwhere(single)]
    return " and ".join(filter(None, (", ".join(names[:-1]), names[-1])))


def _cell(c: Calibration, pixel: FloatArray) -> str:
    """Return in words where a pixel is."""
    i, j = np.clip((pixel / c.camera.size_px * CELLS).astype(np.int64), 0, np.array(CELLS) - 1)
    return f"{NAMES_V[j]} {NAMES_U[i]}"


def _views(c: Calibration) -> tuple[list[Finding], list[Finding]]:
    """Return findings on views with large residuals: those that may be of another camera, and the others."""
    if len(c.views) < 3:
        return [], []
    lengths = c.corners.count
    out = np.bincount(c.corners.view[~c.corners.kept], minlength=len(lengths))
    # With outliers: a view that is bad throughout has its worst corners among them.
    residual = np.hypot(*np.nan_to_num(c.corners.residuals_px).T)
    middle = _medians(residual, lengths)
    typical = max(float(np.median(middle)), np.finfo(float).tiny)
    times = middle / typical
    if times.max() > MAX_RATIO_OF_MEDIANS:
        offset = c.corners.pixels - image_center(c.camera.size_px)
        expected = np.full(len(offset), typical)
        for ring in np.array_split(np.argsort((offset**2).sum(axis=1)), RINGS):
            expected[ring] = max(float(np.median(residual[ring])), typical)
        times = _medians(residual / expected, lengths)
    unlike, found = list[Finding](), list[Finding]()
    for i in np.flatnonzero((times > MAX_RATIO_OF_MEDIANS) | (out > MAX_OUTLIER_SHARE * lengths)).tolist():
        view = c.views[i]
        far = int((~view.kept & ~(np.linalg.norm(view.residuals_px, axis=1) <= SMALL_PX)).sum())
        if times[i] > MAX_RATIO_OF_MEDIANS and middle[i] > SMALL_PX:
            what = f"has a median residual of {middle[i]:.3f} px, {times[i]:.1f} times that of the other images there"
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


def _pattern(c: Calibration, in_force: Collection[str], named: bool) -> Iterator[Finding]:
    """Yield a finding where residuals of neighbours are correlated: an error of the lens or board model, unless a
    cause is `named` already."""
    correlation = c.corners.neighbour_correlation
    if correlation < PATTERN:
        return
    what = f"residuals of neighbouring corners are correlated ({correlation:.2f}): "
    shapes = "board_shape" in in_force or any(board.kind == "released" for board in c.boards)
    if not shapes:
        yield Finding.look(what + "the board is not flat, or the lens model does not fit", 'try board_shape = "auto"')
    elif "model" not in in_force:
        yield Finding.look(what + "the lens model or the board shape does not fit", 'try model = "auto"')
    elif not named and (common := not_as_its_model(c, view_evidence(c))):
        yield from common
    elif not named:
        yield Finding.look(
            what + "no lens model or board shape explains it, so something changes between images",
            "fix the focus, switch stabilisation off, hold camera and board still, use a stiff board, and leave out "
            "images of another camera",
        )


def _overfit(c: Calibration) -> Iterator[Finding]:
    if c.heldout_rms_px is not None and c.heldout_rms_px > OVERFIT * c.rms_px:
        yield Finding.look(
            f"held-out RMS is {c.heldout_rms_px / c.rms_px:.2f} times the training RMS (overfitting): too few images "
            "for this model, or an image inconsistent with the others",
            "take more images",
        )


def _uncertain(c: Calibration, far: FarProjection) -> Iterator[Finding]:
    typical, worst, inside = far.typical_px, far.worst_px, far.at_corners_px
    if worst <= UNCERTAIN_PX:
        error = c.rms_px if c.heldout_rms_px is None else c.heldout_rms_px
        if typical <= max(error, SMALL_PX):
            return
        yield Finding.look(
            f"the projection uncertainty where boards were seen, {typical:.2f} px (one standard deviation), "
            f"exceeds the reprojection error, {error:.2f} px",
            "take more images, with the board tilted",
        )
        return
    what = f"the projection uncertainty reaches {worst:.1f} px (one standard deviation) where boards were seen"
    if not np.isfinite(worst):
        yield Finding.bad(what, "take more images, with the board tilted")
        return
    what += f", most in the {_cell(c, far.corners.pixels[np.nanargmax(inside[far.rays_valid])])} of the image"
    yield Finding.bad(what, "take more images there, with the board tilted")


def _outliers(c: Calibration, named: Collection[str | None]) -> Iterator[Finding]:
    """Yield a finding about many outliers, not counting those of images that are `named` already."""
    far = [outlier for outlier in c.outliers if not (outlier.residual_px <= SMALL_PX or outlier.image in named)]
    share = len(far) / max(len(c.outliers) + c.corner_count, 1)
    if share <= OUTLIER_SHARE:
        return
    image, count = Counter(outlier.image for outlier in far).most_common(1)[0]
    yield Finding.look(
        f"{100 * share:.1f} % of the corners are outliers, most ({count}) in image '{image}'",
        "check exposure, focus and motion blur there",
    )
