"""SVG drawings for the page of a validation: box plots of normal errors, residuals of the corners."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from rigkit.core.arrays import FloatArray
from rigkit.geometry.rotation import angle_between
from rigkit.geometry.triangulation import correct_rays_px
from rigkit.reconstruction.reconstruct import Reconstruction
from rigkit.report import svg
from rigkit.report.pictures.figures import board_colour
from rigkit.validation.checks import ValidationReport

WHISKER = 1.5
"""Whiskers extend to the last value within this many interquartile ranges, as in the paper's figures."""

BOXES_WIDTH, BOXES_HEIGHT = 1100.0, 300.0
BOXES_LEFT, BOXES_BOTTOM, BOXES_TOP = 60.0, 46.0, 26.0

RESIDUAL_LENGTH = 0.04
"""Drawn length of the RMS residual, as a fraction of the image's width."""


def normal_errors_svg(reconstructions: Mapping[str, Reconstruction], reports: Sequence[ValidationReport]) -> str:
    """Draw box plots of the angles between normals and their planes, by board and estimator."""
    groups: list[tuple[str, list[tuple[str, FloatArray]]]] = []
    for report in reports:
        cloud = reconstructions[report.affine_method].cloud
        boxes = []
        for board in report.boards:
            on = cloud.on_board(board.board.board_id)
            normal = report.checked_normals.get(board.board.board_id, board.plane.normal)
            errors = np.rad2deg(angle_between(cloud.normals[on], normal))
            boxes.append((board.board.board_id, errors))
        groups.append((report.affine_method, boxes))
    return boxplot_svg(groups, "angle between normal and plane, deg")


def boxplot_svg(groups: Sequence[tuple[str, Sequence[tuple[str, FloatArray]]]], label: str) -> str:
    """Draw groups of named samples as boxes (median, quartiles, whiskers, outliers) with one colour a name."""
    names = list(dict.fromkeys(name for _, boxes in groups for name, _ in boxes))
    highest = max((float(np.max(v)) for _, boxes in groups for _, v in boxes if len(v)), default=1.0)
    top = svg.round_up(highest)
    plot = BOXES_HEIGHT - BOXES_BOTTOM - BOXES_TOP
    step = (BOXES_WIDTH - BOXES_LEFT - 10.0) / max(len(groups), 1)
    slot = step * 0.8 / max(len(names), 1)

    def y(value: float) -> float:
        return BOXES_TOP + plot * (1.0 - value / top)

    out = [svg.opening_tag(label, f"0 0 {BOXES_WIDTH:g} {BOXES_HEIGHT:g}", size=12)]
    for tick in np.linspace(0.0, top, 5):
        ends = f'x1="{BOXES_LEFT}" x2="{BOXES_WIDTH - 10}" y1="{y(tick):.1f}" y2="{y(tick):.1f}"'
        out.append(f'<line {ends} stroke="{svg.GRID_COLOUR}"/>')
        out.append(svg.label(BOXES_LEFT - 6, y(tick) + 4, f"{tick:.3g}", "end"))
    for g, (group, boxes) in enumerate(groups):
        start = BOXES_LEFT + g * step + 0.1 * step
        out.append(svg.label(start + 0.4 * step, BOXES_HEIGHT - BOXES_BOTTOM + 18, group, "middle"))
        for name, values in boxes:
            index = names.index(name)
            out += _box(start + slot * (index + 0.5), 0.7 * slot, values, board_colour(index), y)
    for index, name in enumerate(names):
        x = BOXES_LEFT + 110.0 * index
        out.append(f'<rect x="{x}" y="{BOXES_HEIGHT - 18}" width="10" height="10" fill="{board_colour(index)}"/>')
        out.append(svg.label(x + 15, BOXES_HEIGHT - 9, name, "start"))
    out.append(svg.label(BOXES_LEFT, 14, label, "start"))
    return "".join([*out, "</svg>"])


def residuals_svg(reconstruction: Reconstruction) -> str:
    """Draw the magnified corrections of corners in both images after which their two rays intersect."""
    camera1, camera2 = reconstruction.camera1, reconstruction.camera2
    rays1, rays2, *jacobians = reconstruction.measured_rays()
    _, _, moved1, moved2 = correct_rays_px(rays1, rays2, reconstruction.E21, *jacobians)
    rms = float(np.sqrt(np.mean(np.concatenate([moved1, moved2]) ** 2) * 2.0))
    width = 540.0
    height = max(width * c.size_px[1] / c.size_px[0] for c in (camera1, camera2))
    scale_of_arrows = RESIDUAL_LENGTH * width / max(rms, 1e-12)
    words = f"residuals, {rms:.4f} px rms, magnified {scale_of_arrows * camera1.size_px[0] / width:.0f} times"
    out = [svg.opening_tag(words, f"0 0 {2 * width + 20:g} {height + 30:g}", size=12)]
    for offset, camera, pixels, moved in (
        (0.0, camera1, reconstruction.pixels1, moved1),
        (width + 20, camera2, reconstruction.pixels2, moved2),
    ):
        zoom = width / camera.size_px[0]
        out.append(
            f'<rect x="{offset:.1f}" y="0" width="{width}" height="{zoom * camera.size_px[1]:.1f}" fill="none" '
            f'stroke="{svg.RIM_COLOUR}"/>'
        )
        for q, d, board in zip(pixels, moved, reconstruction.matches.board_index, strict=True):
            x, y = offset + zoom * q[0], zoom * q[1]
            ex, ey = x + scale_of_arrows * d[0], y + scale_of_arrows * d[1]
            colour = board_colour(int(board))
            out.append(f'<line x1="{x:.1f}" y1="{y:.1f}" x2="{ex:.1f}" y2="{ey:.1f}" stroke="{colour}"/>')
            out.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="1.6" fill="{colour}"/>')
    out.append(svg.label(0.0, height + 20, words, "start"))
    return "".join([*out, "</svg>"])


def _box(x: float, width: float, values: FloatArray, colour: str, y: Callable[[float], float]) -> list[str]:
    if not len(values):
        return []
    low, middle, high = np.quantile(values, [0.25, 0.5, 0.75])
    reach = WHISKER * (high - low)
    inside = values[(values >= low - reach) & (values <= high + reach)]
    left, right = x - width / 2, x + width / 2
    out = [
        f'<line x1="{x:.1f}" x2="{x:.1f}" y1="{y(inside.max()):.1f}" y2="{y(inside.min()):.1f}" stroke="{colour}"/>',
        f'<rect x="{left:.1f}" y="{y(high):.1f}" width="{width:.1f}" height="{max(y(low) - y(high), 0.5):.1f}" '
        f'fill="{colour}" fill-opacity="0.25" stroke="{colour}"/>',
        f'<line x1="{left:.1f}" x2="{right:.1f}" y1="{y(middle):.1f}" y2="{y(middle):.1f}" stroke="{colour}" '
        'stroke-width="2"/>',
    ]
    outside = values[(values < low - reach) | (values > high + reach)]
    return [*out, *(f'<circle cx="{x:.1f}" cy="{y(v):.1f}" r="1.3" fill="{colour}"/>' for v in outside)]
