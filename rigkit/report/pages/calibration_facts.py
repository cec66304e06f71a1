"""The facts on the page of a calibration, of one camera or of a rig."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from rigkit.calibration.certainty.coverage import covered_by_boards
from rigkit.calibration.certainty.uncertainty import FarProjection, uncertainty_map
from rigkit.calibration.result import Calibration
from rigkit.calibration.rig.result import RigCalibration
from rigkit.core.arrays import FloatArray
from rigkit.core.errors import InputError
from rigkit.core.findings import Severity, most_severe_first, worst
from rigkit.core.printing import digits
from rigkit.core.tables import Cell, Table, cells, columns
from rigkit.planning.plan import Plan
from rigkit.report.pages.calibration_drawings import MAP_GRID
from rigkit.report.pages.page_facts import PageFacts
from rigkit.report.pages.plan_page import plan_table, plan_words
from rigkit.report.rig_tables import rig_basis, rig_reach, rig_tables
from rigkit.report.tables import rounded_parameters, rounded_words
from rigkit.validation.check import Check

FOCAL_STEP = 1e-3
"""Step of the numerical derivatives of the focal length, in standard deviations; the rounding error is about 1e-7."""
IN_PX = ("fx", "fy", "cx", "cy")
MAX_RATIO_BEYOND = 3.0
"""If the uncertainty outside of the boards is below so many times its maximum inside, the whole image can be used."""
BADGE_WORDS = {"good": "good", "look": "usable, with care", "bad": "do not use"}
PASSED = {Severity.GOOD: True, Severity.LOOK: None, Severity.BAD: False}
IMAGES_KEY, LEFT_OUT_KEY, NEXT_KEY = "images", "left-out", "plan"
"""Keys of tables that pages show with pictures."""


def camera_facts(c: Calibration, plan: Plan | None = None) -> PageFacts:
    """Return the facts of one camera; `plan` has the pictures to take next."""
    tables = [_parameters(c), _candidates(c), _boards(c), _images(c)]
    if c.dropped:
        tables.append(
            Table(LEFT_OUT_KEY, "Left out", columns("image | why"), tuple(cells(*entry) for entry in c.dropped))
        )
    sentences = [*map(str, most_severe_first(c.verdicts))]
    if plan is not None:
        sentences += [next_words(plan), *plan_words(plan)]
        tables.append(plan_table(plan))
    severity = worst(c.verdicts)
    return PageFacts(
        headline=_coverage_words(c),
        badge=BADGE_WORDS[severity],
        passed=PASSED[severity],
        sentences=tuple(sentences),
        basis=_basis(c),
        tables=tuple(tables),
    )


def rig_facts(rig: RigCalibration, checks: Sequence[Check], cameras: Mapping[str, PageFacts]) -> PageFacts:
    """Return the facts of a rig, with those of its `cameras` as parts."""
    severity = worst(rig.verdicts)
    return PageFacts(
        headline=rig_reach(rig, checks),
        badge=BADGE_WORDS[severity],
        passed=PASSED[severity],
        sentences=tuple(map(str, most_severe_first(rig.verdicts))),
        basis=rig_basis(rig),
        tables=rig_tables(rig, checks),
        parts=cameras,
    )


def next_words(plan: Plan) -> str:
    """Return the heading of the pictures to take next."""
    return f"Next {len(plan.views)} images to take: they would reduce the error by {100.0 * plan.gain:.0f} %"


def training_note(rms_px: float, heldout_rms_px: float | None) -> str:
    """Return an explanation if the training RMS exceeds the held-out RMS, which looks like a mistake; else ""."""
    if heldout_rms_px is None or rms_px <= heldout_rms_px:
        return ""
    return "equal weights; the held-out RMS weights corners by their sigmas"


def _basis(c: Calibration) -> str:
    width, height = c.camera.size_px
    return (
        f"{c.camera.model} camera, {width} x {height} px, {c.corner_count} corners in {len(c.views)} views of "
        f"{len({v.image for v in c.views})} images, {len(c.outliers)} corners and {c.images_left_out} images left out; "
        f"corner noise {c.sigma_px:.3f} px per axis; solver: {c.convergence.reason} after {c.convergence.iterations} "
        "steps."
    )


def _coverage_words(c: Calibration) -> str:
    """Return the uncertainty of the projection where boards were and outside, in words."""
    far = FarProjection.of(c)
    if not np.isfinite(far.worst_px):
        return ""
    grid = uncertainty_map(c, grid=MAP_GRID)
    beyond = grid.worst_px[np.isfinite(grid.worst_px) & ~covered_by_boards(c, grid.pixels)]
    words = (
        f"Projection of distant points: ±{digits(far.typical_px)} px where boards were seen (at worst "
        f"±{digits(far.worst_px)} px; one standard deviation)"
    )
    if not beyond.size:
        return words + "."
    words += f", at worst ±{digits(beyond.max())} px elsewhere (extrapolated by the lens model)"
    if worst(c.verdicts) is Severity.BAD:
        return words + "."
    if beyond.max() < MAX_RATIO_BEYOND * far.worst_px:
        return words + ": all of the image can be used."
    words += ": use the part inside the dashed line only, or add images"
    return words + " with the board at the border, tilted by 30 degrees."


def focal_words(c: Calibration) -> str:
    """Return the focal length on the optical axis with its standard deviation, px a radian, in words.

    Only in some models is it fx and fy: in a narrow double sphere these may be several times smaller.
    """
    p, sigmas, here = c.camera.parameters, c.parameter_sigmas, c.camera.focal_px
    # Steps far below the standard deviations, where the focal length is linear.
    steps = np.where(sigmas > 0.0, FOCAL_STEP * sigmas, FOCAL_STEP * np.maximum(np.abs(p), 1.0))

    def moved(k: int, step: float) -> tuple[float, float]:
        """Return the changes of focal length and parameter k; both 0 outside of the model's domain."""
        try:
            return c.camera.with_parameters(p + step * (np.arange(p.size) == k)).focal_px - here, step
        except InputError:
            return 0.0, 0.0

    # At the edge of a model's domain, such as eucm with alpha = 0, the difference is one-sided.
    sides = np.array([np.subtract(moved(k, step), moved(k, -step)) for k, step in enumerate(steps.tolist())])
    gradient = sides[:, 0] / np.maximum(sides[:, 1], np.finfo(float).tiny)
    sigma = c.widening * float(np.sqrt(max(gradient @ c.covariance @ gradient, 0.0)))
    return rounded_words(here, sigma)


def _parameters(c: Calibration) -> Table:
    named = rounded_parameters(c.camera, c.parameter_sigmas).items()
    rows = (
        cells("focal length on the axis", focal_words(c), "px"),
        *(cells(name, words, "px" if name in IN_PX else "") for name, words in named),
    )
    heads = columns("name | value and standard deviation | unit")
    return Table("parameters", "Parameters", heads, rows, "Rounded; the calibration file has all digits.")


def _candidates(c: Calibration) -> Table:
    rows = tuple(
        cells(
            option.name,
            option.parameter_count or None,
            Cell(option.heldout_rms_px, best=option.chosen),
            option.rms_px,
            "chosen" if option.chosen else "",
            option.reason,
        )
        for option in c.candidates
    )
    none = cells("only what was requested", None, None, None, "", "")
    heads = columns("tried | parameters .0 | held-out RMS [px] .4 | training RMS [px] .4 | chosen | why")
    note = "Models are compared with boards taken as flat, then board shapes with the chosen model."
    return Table("candidates", "Models and board shapes tried", heads, rows or (none,), note if rows else "")


def _boards(c: Calibration) -> Table:
    rows = tuple(cells(b.board_id, b.kind, b.bow_mm, 100.0 * b.aspect) for b in c.boards)
    heads = columns("board | shape | flatness error [mm] | squares longer in x than in y by [%]")
    return Table("boards", "Solved board shapes", heads, rows)


def _images(c: Calibration) -> Table:
    """Return the table of views: error, corners, and distance and tilt of the board."""
    middle_mm = {board.board_id: board.points_mm.mean(axis=0) for board in c.boards}
    rows = []
    for view in c.views:
        remarks = " ".join(found.text for found in c.verdicts if found.image == view.image)
        upright = float(np.clip(abs(view.cam_from_board.rotation[2, 2]), 0.0, 1.0))
        far: FloatArray = view.cam_from_board.apply(middle_mm[view.board_id])
        figures = (view.kept.sum(), (~view.kept).sum(), np.linalg.norm(far), np.degrees(np.arccos(upright)))
        rms = Cell(view.rms_px, failed=bool(remarks))
        rows.append(cells(view.image, view.board_id, rms, *map(float, figures), remarks))
    heads = columns(
        "image | board | RMS [px] | corners used .0 | left out .0 | distance [mm] .0 | tilt [deg] .0 | remark"
    )
    return Table(IMAGES_KEY, "Images", heads, tuple(rows), "Tilt: between the board and the image plane.")
