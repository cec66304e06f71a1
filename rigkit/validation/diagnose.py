"""Find the probable causes of failed checks: wrong square size, misread length, wrong calibration."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from rigkit.cameras.base import Camera
from rigkit.core.boards import Board
from rigkit.core.detections import BoardDetection
from rigkit.core.errors import DegenerateError, InputError
from rigkit.geometry.board_pose import board_pose
from rigkit.identification.wrong_squares import FittingSquares
from rigkit.validation.check import Check
from rigkit.validation.checks import ValidationReport

CLEARLY_BETTER = 4.0
"""Ratio of residuals from which another calibration fits clearly better. Two calibrations of one lens differ by far
less, two lenses by far more."""
LARGE_RESIDUAL_PX = 0.5
"""Smaller residuals are not blamed on the calibration: corners of a blurred or bent board have as much."""
SAME_RATIO = 0.005
"""Lengths that are wrong by the same factor within half a percent have the same cause."""
ODD_BOARD = 0.003
"""Relative difference to the other boards' squares from which a board was measured wrongly."""
NO_BOARD = 0.2
"""|log(width / height)| from which it is not the board's square: no one measures squares this wrongly."""
UNITS = {"m": 1000.0, "cm": 10.0, "inches": 25.4}
UNIT_RATIO = 0.05
"""Relative tolerance for a length that is wrong by the factor of a unit."""
MIN_CORNERS_TO_DIAGNOSE = 12
MEASURE_SIDES, OR_ASPECT = "measure square_x_mm and square_y_mm", ", or check fx / fy of the calibration"


def camera_fit(camera: Camera, detections: Sequence[BoardDetection], boards: Sequence[Board]) -> float:
    """Return the RMS reprojection error (px, 2-D) of boards of known shape with each board's own pose.

    Only the boards' shape is used: no epipolar geometry, identity or scale. NaN if no board of a known size has enough
    corners; infinite if a corner is outside the camera's field of view.
    """
    square, count = 0.0, 0
    for detection in detections:
        board = _board_of_size(detection, boards)
        if board is None or len(detection.grid) < MIN_CORNERS_TO_DIAGNOSE:
            continue
        # A quarter turn if the board's columns are the image's rows; its sense does not matter to the shape.
        seen = detection if board.size == (detection.columns, detection.rows) else detection.turned(1)
        rays, valid = camera.unproject(seen.pixels)
        if not valid.all():
            return float("inf")
        try:
            rms = board_pose(rays, board.points(seen.grid)).rms_rad
        except (DegenerateError, InputError):
            return float("inf")
        square += len(seen.grid) * (rms * camera.focal_px) ** 2
        count += len(seen.grid)
    return float(np.sqrt(square / count)) if count else float("nan")


def diagnose_cameras(
    pair_id: str,
    declared: tuple[str, str],
    detections: tuple[Sequence[BoardDetection], Sequence[BoardDetection]],
    boards: Sequence[Board],
    cameras: Mapping[str, Camera],
) -> tuple[str, ...]:
    """Return messages about wrong calibrations of a pair; empty if they fit.

    Parameters
    ----------
    pair_id : for the message.
    declared : names of the cameras of image 1 and image 2.
    detections : boards found in image 1 and image 2; names are not needed.
    boards : that may be in the images.
    cameras : all calibrated cameras of the data set, by name; only those of the declared one's image size are tried.
    """
    fits = []
    for found, own in zip(detections, declared, strict=True):
        fit = {own: camera_fit(cameras[own], found, boards)}
        if fit[own] > LARGE_RESIDUAL_PX:
            others = {n: c for n, c in cameras.items() if n != own and c.size_px == cameras[own].size_px}
            fit |= {name: camera_fit(camera, found, boards) for name, camera in others.items()}
        fits.append(fit)
    better = [_clearly_better(fit, name) for fit, name in zip(fits, declared, strict=True)]
    one, two = declared
    if one != two and better == [two, one]:
        return (
            f"pair '{pair_id}': image 1 fits camera '{two}' ({fits[0][two]:.2f} px, '{one}' {fits[0][one]:.2f} px) and "
            f"image 2 fits '{one}': the two images, or camera1 and camera2, are swapped",
        )
    out = []
    for number, (fit, name, other) in enumerate(zip(fits, declared, better, strict=True), start=1):
        if other is not None:
            out.append(
                f"pair '{pair_id}': image {number} fits camera '{other}' ({fit[other]:.2f} px), not the declared "
                f"'{name}' ({fit[name]:.2f} px): wrong camera in the manifest?"
            )
        elif fit[name] > LARGE_RESIDUAL_PX:
            aspect, left = _best_stretch(cameras[name], detections[number - 1], boards)
            cause = "; was the lens changed or refocused after the calibration?"
            if left * CLEARLY_BETTER < fit[name]:
                cause = f", {left:.2f} px with squares {_aspect_words(aspect)}; {MEASURE_SIDES}{OR_ASPECT}"
            out.append(
                f"pair '{pair_id}': image {number} does not fit the calibration of '{name}': poses of single boards "
                f"leave a reprojection error of {fit[name]:.2f} px{cause}"
            )
    return tuple(out)


def _best_stretch(camera: Camera, detections: Sequence[BoardDetection], boards: Sequence[Board]) -> tuple[float, float]:
    """Return the width over height of all squares, relative to the declared, that fits best, and the RMS error, px."""
    # Imported here: only where an image does not fit.
    from scipy.optimize import minimize_scalar

    def misfit(log_aspect: float) -> float:
        narrower = float(np.exp(-log_aspect))
        return camera_fit(camera, detections, [replace(b, square_y_mm=b.square_y_mm * narrower) for b in boards])

    found = minimize_scalar(misfit, bounds=(-NO_BOARD, NO_BOARD), method="bounded", options={"xatol": 1e-4})
    return float(np.exp(found.x)), float(found.fun)


def diagnose_squares(fitting: Sequence[FittingSquares]) -> tuple[str, ...]:
    """Return a message about a board that was not identified because its squares have another size; empty if none."""
    sizes = []
    for one in fitting:
        ids, declared_mm = [f"'{board.board_id}'" for board in one.boards], one.boards[0].square_x_mm
        of = f"board {ids[0]}" if len(ids) == 1 else f"one of {', '.join(ids)}, {one.where} in image 1,"
        sizes.append(
            f"{of} would be consistent with the others with squares of {one.factor * declared_mm:.1f} mm "
            f"({declared_mm:g} is declared)"
        )
    return (f"{', or '.join(sizes)}; measure them again",) if sizes else ()


def diagnose(reports: Sequence[ValidationReport], *, agreed: bool = True) -> tuple[str, ...]:
    """Return the probable causes of failed checks in a data set, from one report for each pair, and whether all
    independent methods `agreed`: where they did not, wrong boards are a cause even if all measurements pass."""
    if all(report.passed for report in reports):
        return () if agreed else tuple(_diagnose_boards(reports))
    # A wrong prior changes the whole result: it explains all other failures of that pair.
    free = [report for report in reports if not _contradicted(report)]
    out = [f"pair '{r.pair_id}': {_contradicted(r)}" for r in reports if _contradicted(r)]
    out += [] if agreed and all(report.passed for report in free) else _diagnose_free(free)
    return tuple(dict.fromkeys(out))


def _contradicted(report: ValidationReport) -> str:
    """Return a message about the declarations of the pose that the images contradict; "" if none."""
    off = [check.name for check in report.checks if check.kind in ("pose type", "level") and not check.passed]
    remedy = (
        "declare the pose type that the message names, or a larger level sigma; other failures of this pair may "
        "follow from it"
    )
    return f"the images contradict the declared {' and '.join(off)}: {remedy}" if off else ""


def _diagnose_free(reports: Sequence[ValidationReport]) -> list[str]:
    """Return the probable causes of failed checks in pairs whose declared pose is not contradicted."""
    out = _diagnose_boards(reports)
    odd = _longest_by_boards(reports)
    failed = [(r.pair_id, c) for r in reports for c in r.checks if c.kind in ("baseline", "distance") and not c.passed]
    # Lengths that wrong boards cannot explain have another cause, which comes first.
    failed = [(pair, c) for pair, c in failed if abs(c.difference) > c.measured * odd + c.limit_k * c.combined_sigma]
    if failed:
        out = [*_diagnose_lengths(failed, reports), *out]
    for report in reports:
        out += _diagnose_angles(report)
    return out


def _board_of_size(detection: BoardDetection, boards: Sequence[Board]) -> Board | None:
    sizes = (detection.columns, detection.rows), (detection.rows, detection.columns)
    return next((board for size in sizes for board in boards if board.size == size), None)


def _clearly_better(fit: Mapping[str, float], declared: str) -> str | None:
    known = {name: value for name, value in fit.items() if np.isfinite(value)}
    if not known or np.isnan(fit[declared]):
        return None
    best = min(known, key=lambda name: known[name])
    worse = fit[declared] > LARGE_RESIDUAL_PX and fit[declared] > CLEARLY_BETTER * known[best]
    return best if worse and best != declared else None


@dataclass(frozen=True, eq=False, slots=True)
class _SquareSizes:
    """Reconstructed over declared squares of a board (medians over pairs): their size relative to that of the other
    boards (1 if there are fewer than three boards), and their width over height."""

    board: Board
    size: float
    aspect: float

    @property
    def implausible(self) -> bool:
        return bool(abs(np.log(self.aspect)) > NO_BOARD)

    @property
    def stretched(self) -> bool:
        return not self.implausible and abs(self.aspect - 1.0) > ODD_BOARD

    @property
    def fitting_words(self) -> str:
        x_mm, y_mm = np.array(self.board.squares_mm) * self.size * self.aspect ** np.array([0.5, -0.5])
        declared_x_mm, declared_y_mm = self.board.squares_mm
        if not self.stretched and declared_x_mm == declared_y_mm:
            return f"{x_mm:.2f} mm would fit, {declared_x_mm:g} is declared"
        return f"{x_mm:.2f} x {y_mm:.2f} mm would fit, {declared_x_mm:g} x {declared_y_mm:g} is declared"


def _diagnose_boards(reports: Sequence[ValidationReport]) -> list[str]:
    """Return messages about boards whose squares disagree with those of the others, or that are mirrored: one each."""
    found = _squares(reports)
    mirrored = [b.board.board_id for r in reports for b in r.boards if not b.right_handed]
    out = [
        f"board '{i}' is reconstructed mirrored: its corners are numbered in the opposite direction" for i in mirrored
    ]
    out += [
        f"board '{name}' is reconstructed with an impossible shape: corners of different boards were matched (is a "
        "board of this kind not listed?), or the pose is wrong"
        for name, squares in found.items()
        if squares.implausible
    ]
    aspects = [squares.aspect for squares in found.values() if squares.stretched]
    all_alike = len(aspects) == len(found) and np.ptp(aspects) < ODD_BOARD
    measure_sides = f"{MEASURE_SIDES}{OR_ASPECT}" if all_alike else MEASURE_SIDES
    if all_alike and len(found) > 1:
        names = ", ".join(f"'{name}'" for name in found)
        words = f"boards {names}: their squares are reconstructed {_aspect_words(float(np.median(aspects)))}"
        return [*out, f"{words}; {measure_sides}"]
    for name, squares in found.items():
        if squares.stretched:
            out.append(
                f"board '{name}': its squares are reconstructed {_aspect_words(squares.aspect)} "
                f"({squares.fitting_words}); {measure_sides}"
            )
        elif abs(squares.size - 1.0) > ODD_BOARD and not squares.implausible:
            out.append(
                f"board '{name}': its squares are {100.0 * (squares.size - 1.0):+.1f} % off relative to the other "
                f"boards; measure them again ({squares.fitting_words})"
            )
    return out


def _longest_by_boards(reports: Sequence[ValidationReport]) -> float:
    """Return the largest relative length error that wrong boards can explain; infinite for boards not as listed."""
    found = _squares(reports).values()
    if any(squares.implausible for squares in found) or not all(b.right_handed for r in reports for b in r.boards):
        return float("inf")
    off = [float(np.exp(abs(np.log(part)))) - 1.0 for squares in found for part in (squares.size, squares.aspect)]
    return max((part for part in off if part > ODD_BOARD), default=0.0)


def _squares(reports: Sequence[ValidationReport]) -> dict[str, _SquareSizes]:
    """Return the reconstructed sizes of the squares of each board, by its id."""
    seen: dict[str, list[tuple[Board, float, float]]] = {}
    for report in reports:
        middle = float(np.median([b.size_ratio for b in report.boards])) if len(report.boards) >= 3 else None
        for b in report.boards:
            size = 1.0 if middle is None else b.size_ratio / middle
            seen.setdefault(b.board.board_id, []).append((b.board, size, b.square_x_ratio / b.square_y_ratio))
    return {
        name: _SquareSizes(
            some[0][0], float(np.median([s for _, s, _ in some])), float(np.median([a for *_, a in some]))
        )
        for name, some in seen.items()
    }


def _aspect_words(aspect: float) -> str:
    longer, other = ("wider", "high") if aspect > 1.0 else ("higher", "wide")
    return f"{100.0 * (max(aspect, 1.0 / aspect) - 1.0):.1f} % {longer} than {other} relative to the declaration"


def _diagnose_lengths(failed: Sequence[tuple[str, Check]], reports: Sequence[ValidationReport]) -> list[str]:
    """Return messages about wrong lengths: wrong squares change all by one factor, else single ones were misread."""
    ratios = np.array([check.ours / check.measured for _, check in failed])
    lengths = [c for r in reports for c in r.checks if c.kind in ("baseline", "distance")]
    common = float(np.average(ratios, weights=[check.measured**2 for _, check in failed]))
    # A length that passed but would not with other squares shows that the squares are right.
    agree = [abs(c.ours / c.measured - common) * c.measured <= c.limit_k * c.combined_sigma for c in lengths]
    board = reports[0].boards[0].board
    squares = f"{board.square_x_mm / common:.2f} mm instead of {board.square_x_mm:g}"
    percent = 100.0 * (common - 1.0)
    unit = next((u for u, factor in UNITS.items() if (np.abs(ratios / factor - 1.0) < UNIT_RATIO).all()), None)
    if unit is not None:
        names = ", ".join(dict.fromkeys(f"pair '{pair}': {check.name}" for pair, check in failed))
        return [f"{names}: written in {unit}? Lengths are in mm; or the squares are {squares}"]
    sigma = max(check.combined_sigma / check.measured for _, check in failed)
    if len(lengths) > 1 and all(agree) and np.ptp(ratios) < SAME_RATIO + 4.0 * sigma:
        return [
            f"square size: all {len(lengths)} lengths are off by {percent:+.1f} %: the squares are {squares}, or every "
            "length was misread by this factor, as with one wrong rule; the images cannot tell which, so measure both "
            "again with another rule"
        ]
    if len(lengths) == 1:
        return [
            f"pair '{failed[0][0]}': {failed[0][1].name} is off by {percent:+.1f} %: it was misread, or the squares "
            f"are {squares}"
        ]
    exchanged = [
        f"pairs '{one}' and '{two}': each {a.name} matches the measurement of the other pair: they were probably "
        "exchanged"
        for (one, a), (two, b) in combinations(failed, 2)
        if a.name == b.name and one != two and _within_limit(a, b.measured) and _within_limit(b, a.measured)
    ]
    return exchanged or [
        f"pair '{pair}': {check.name} is off by {100.0 * (check.ours / check.measured - 1.0):+.1f} % while other "
        "lengths agree: it was probably misread"
        for pair, check in failed
    ]


def _within_limit(check: Check, measured: float) -> bool:
    return abs(check.ours - measured) <= check.limit_k * check.combined_sigma


def _diagnose_angles(report: ValidationReport) -> list[str]:
    failed = [check for check in report.checks if check.kind == "angle" and not check.passed]
    if not failed:
        return []
    names = [check.name.removeprefix("angle ") for check in failed]
    radians = [c for c in failed if abs(c.ours / np.degrees(c.measured) - 1.0) < UNIT_RATIO]
    if radians:
        message = ", ".join(c.name.removeprefix("angle ") for c in radians)
        return [f"pair '{report.pair_id}': {message}: written in radians? Angles are in degrees"]
    supplement = [c for c in failed if abs(180.0 - c.ours - c.measured) <= c.limit_k * c.combined_sigma]
    if supplement:
        return [
            f"pair '{report.pair_id}': {c.name} is {c.ours:.2f} deg, the supplement of the measurement: write the "
            "angle between the printed faces, on the cameras' side"
            for c in supplement
        ]
    ids = [result.board.board_id for result in report.boards]
    involved = {
        c.name: [b for b in ids if b in name.split("-") or name.startswith(f"{b}-")]
        for c, name in zip(failed, names, strict=True)
    }
    counts = Counter(b for boards in involved.values() for b in boards)
    common = [b for b, count in counts.items() if count == len(failed)]
    if len(failed) > 1 and common:
        words = f"board '{common[0]}' is not at the measured angles; measure it again, or check the calibration"
        return [f"pair '{report.pair_id}': {', '.join(names)}: {words}"]
    return [
        f"pair '{report.pair_id}': {name}: {_single_angle(report, c)}" for c, name in zip(failed, names, strict=True)
    ]


def _single_angle(report: ValidationReport, check: Check) -> str:
    """Return the probable cause of a single failed angle: misread, if all other evidence supports ours."""
    angle = next(a for a in report.angles if check.name == f"angle {a.a}-{a.b}" or check.name == f"angle {a.b}-{a.a}")
    if angle.lattice_deg is not None and abs(angle.lattice_deg - check.ours) > 0.5 * abs(check.difference):
        return (
            f"planes through the points give {check.ours:.2f} deg, the boards' known squares {angle.lattice_deg:.2f}: "
            "a board is bent, or the calibration does not fit; look at the residuals"
        )
    others = [c for c in report.checks if c.kind == "angle" and c is not check]
    support = [] if angle.lattice_deg is None else [f"the boards' known squares also give {angle.lattice_deg:.2f} deg"]
    support += ["the other angles agree"] if others and all(c.passed for c in others) else []
    misread = f"{check.measured:g} was probably misread" if support else f"the boards are not at {check.measured:g} deg"
    why = f" ({', and '.join(support)})" if support else ""
    return f"{misread}: the images show {check.ours:.2f} deg{why}; measure it again"
