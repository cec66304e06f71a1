"""Display of results (verdict and 3D scene) and progress in notebooks."""

from __future__ import annotations

import importlib
import time
from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

import numpy as np

from rigkit.calibration.result import Calibration
from rigkit.calibration.rig.result import RigCalibration
from rigkit.core.arrays import FloatArray, sampling_step
from rigkit.core.findings import Finding, Severity, most_severe_first, worst
from rigkit.core.printing import counted
from rigkit.core.progress import Progress, silent
from rigkit.geometry.rotation import exp_so3
from rigkit.reconstruction.reconstruct import Reconstruction
from rigkit.reconstruction.scene import SceneReconstruction
from rigkit.report import svg
from rigkit.report.pictures.scene_view import boards_scene, rig_scene, scene_of
from rigkit.report.rig_tables import rig_reach
from rigkit.report.tables import measured_words

SCENE_WIDTH, SCENE_HEIGHT, SCENE_RIM = 420.0, 300.0, 14.0
MAX_DRAWN_POINTS = 600
"""Maximum number of points drawn; larger clouds are subsampled."""
SHADES = ("#e6550d", "#1f77b4", "#2ca02c", "#9467bd", "#b79a00", "#17becf", "#e377c2", "#7f7f7f")
COLOUR_OF = {Severity.GOOD: "#1a7f42", Severity.LOOK: "#8a5f00", Severity.BAD: "#b3261e"}
VIEWED_FROM = exp_so3(np.array([0.45, 0.0, 0.0])) @ exp_so3(np.array([0.0, 0.45, 0.0]))
"""View from above and from the side, as the initial 3D view of pages."""
REDRAW_AFTER_S = 0.1


def html_of(result: Calibration | RigCalibration | Reconstruction | SceneReconstruction) -> str:
    """Return a result as HTML for a notebook: summary, verdicts, and a drawing of its 3D scene."""
    if isinstance(result, Calibration):
        scene = boards_scene(result.views, result.boards)
        return _result_html(repr(result), most_severe_first(result.verdicts)[:2], scene)
    if isinstance(result, RigCalibration):
        return _result_html(
            f"{result!r}\n  {rig_reach(result, ())}", most_severe_first(result.verdicts)[:2], rig_scene(result)
        )
    metric = not isinstance(result, SceneReconstruction) or result.metric
    result = result.reconstruction if isinstance(result, SceneReconstruction) else result
    boards = f"{counted(len(result.boards), 'board')}, " if result.boards else ""
    baseline = measured_words(result.baseline_mm, result.baseline_sigma_mm, 2)
    lengths = f"baseline {baseline} mm" if metric else "lengths in baselines"
    words = (
        f"Reconstruction of '{result.pair_id}', {result.pose_type}, {result.affine_method}: {len(result.cloud)} "
        f"points, {boards}{lengths}, Sampson rms "
        f"{result.sampson_rms_px:.3f} px"
    )
    return _result_html(words, (), scene_of(result))


def _result_html(words: str, findings: Sequence[Finding], scene: Mapping[str, Any]) -> str:
    colour = COLOUR_OF[worst(findings)] if findings else "#1f5fa8"
    lines = [line.strip() for line in words.splitlines()]
    lines = [*(line for line in lines if line not in {str(f) for f in findings}), *(str(f) for f in findings)]
    body = "<br>".join(escape(line) for line in lines)
    return (
        f'<div style="border-left: 4px solid {colour}; padding-left: 10px; max-width: 60em">{body}<br>'
        f"{scene_svg(scene)}</div>"
    )


def scene_svg(scene: Mapping[str, Any]) -> str:
    """Return an orthographic drawing (SVG) of a 3D scene of the page viewer."""
    cameras = [np.array(camera["corners"]) for camera in scene["cameras"]]
    planes = [np.array(plane["corners"]) for plane in scene["planes"]]
    points = np.array(scene["points"]).reshape(-1, 3)
    everything = np.concatenate([*cameras, *planes, points]) @ VIEWED_FROM.T
    low, high = everything[:, :2].min(axis=0), everything[:, :2].max(axis=0)
    zoom = float(min((np.array([SCENE_WIDTH, SCENE_HEIGHT]) - 2.0 * SCENE_RIM) / np.maximum(high - low, 1e-9)))

    def drawn(places: FloatArray) -> FloatArray:
        return np.asarray((places @ VIEWED_FROM.T)[:, :2] - low) * zoom + SCENE_RIM

    height = zoom * (high[1] - low[1]) + 2.0 * SCENE_RIM
    shown = f'width="{SCENE_WIDTH:g}" style="background: #fff"'
    out = [svg.opening_tag("cameras and boards", f"0 0 {SCENE_WIDTH:g} {height:.0f}", size=11, more=shown)]
    for plane, corners in zip(scene["planes"], planes, strict=True):
        colour = SHADES[plane["board"] % len(SHADES)]
        outline = svg.line(drawn(corners))
        out.append(f'<path d="{outline}Z" fill="{colour}" fill-opacity="0.08" stroke="{colour}" stroke-opacity="0.6"/>')
    step = sampling_step(len(points), MAX_DRAWN_POINTS)
    board = np.array(scene["board"], dtype=np.int64)
    for index in np.unique(board[::step]).tolist():
        path = svg.dots(drawn(points[::step][board[::step] == index]))
        out.append(f'<path d="{path}" stroke="{SHADES[index % len(SHADES)]}" stroke-width="3" stroke-linecap="round"/>')
    for camera, corners in zip(scene["cameras"], cameras, strict=True):
        tip, *base = drawn(corners)
        below = max(float(y) for _, y in (tip, *base)) + SCENE_RIM - 3.0
        wire = svg.line(np.array(base)) + "Z" + "".join(svg.line(np.array([tip, corner])) for corner in base)
        out.append(f'<path d="{wire}" fill="none" stroke="#333"/>')
        out.append(svg.label(tip[0], below, camera["name"]))
    return "".join([*out, "</svg>"])


def notebook_progress() -> Progress:
    """Return a progress callback that shows a bar below the notebook's cell; silent outside of notebooks."""
    try:
        display, html = (getattr(importlib.import_module("IPython.display"), name) for name in ("display", "HTML"))
        shell = importlib.import_module("IPython").get_ipython()
    except ImportError:
        return silent
    if shell is None:
        return silent
    handles: dict[str, Any] = {}
    drawn: dict[str, float] = {}

    def show(what: str, done: int, total: int) -> None:
        now = time.monotonic()
        if done < total and now - drawn.get(what, 0.0) < REDRAW_AFTER_S:
            return
        drawn[what] = now
        words = escape(f"{what}: {done} of {total}")
        bar = html(f'<label>{words} <progress value="{done}" max="{max(total, 1)}"></progress></label>')
        if what in handles:
            handles[what].update(bar)
        else:
            handles[what] = display(bar, display_id=True)
        if done >= total:
            handles.pop(what)

    return show
