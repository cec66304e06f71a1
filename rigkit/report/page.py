"""The HTML report: one page without network access, with an interactive 3D view of every pair."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from rigkit.core.arrays import FloatArray
from rigkit.core.tables import Table
from rigkit.geometry.rigid3 import Rigid3
from rigkit.reconstruction.reconstruct import Reconstruction
from rigkit.report.page_facts import PageFacts
from rigkit.report.render import data_uri, render, shown_table
from rigkit.report.scene_view import DEPTH, camera_pyramid, rounded
from rigkit.report.validation_verdict import ValidationVerdict


@dataclass(frozen=True, eq=False, slots=True)
class PairSection:
    """What the page shows of one pair."""

    pair_id: str
    lead: str
    tables: tuple[Table, ...]
    images: tuple[tuple[str, str, bytes], ...]
    """(caption, MIME type, bytes)."""
    scene: Mapping[str, Any] | None
    notes: tuple[str, ...] = ()


def build_page(
    title: str,
    lead: str,
    verdict: ValidationVerdict,
    summary: Sequence[Table],
    pairs: Sequence[PairSection],
    provenance: Mapping[str, str],
    remarks: Sequence[str] = (),
) -> str:
    """Return the page as text; everything it needs is inside it. Its 3D view is of the first pair that fails, or of the
    first; `remarks` stand below the tables of the `summary`."""
    shown = [
        {
            "pair_id": pair.pair_id,
            "lead": pair.lead,
            "tables": [shown_table(table) for table in pair.tables],
            "images": [(caption, data_uri(mime, data)) for caption, mime, data in pair.images],
            "scene": pair.scene,
            "notes": pair.notes,
        }
        for pair in pairs
    ]
    return render(
        "validation.html",
        title=title,
        lead=lead,
        passed=verdict.passed,
        verdict=_first_screen(verdict, pairs),
        remarks=remarks,
        summary=[shown_table(table) for table in summary],
        pairs=shown,
        provenance=provenance,
    )


def validation_facts(
    lead: str,
    verdict: ValidationVerdict,
    summary: Sequence[Table],
    pairs: Sequence[PairSection],
    remarks: Sequence[str] = (),
) -> PageFacts:
    """Return what the page of a validation says."""
    return PageFacts(
        headline=verdict.headline,
        badge=verdict.badge,
        passed=verdict.passed,
        sentences=(*verdict.sentences, *remarks),
        basis=lead,
        tables=tuple(summary),
        parts={p.pair_id: PageFacts(headline=p.lead, sentences=p.notes, tables=p.tables) for p in pairs},
    )


def _first_screen(verdict: ValidationVerdict, pairs: Sequence[PairSection]) -> dict[str, Any]:
    failed = {fact.pair_id for fact in verdict.failed}
    seen = [pair for pair in pairs if pair.scene is not None]
    shown = next((pair for pair in seen if pair.pair_id in failed), seen[0] if seen else None)
    return {
        "words": verdict.badge,
        "colour": "pass" if verdict.passed else "fail",
        "headline": verdict.headline,
        "fineness": verdict.fineness,
        "failed": verdict.failed,
        "causes": verdict.causes,
        "shown": "" if shown is None else shown.pair_id,
        "scene": None if shown is None else shown.scene,
    }


def scene_of(reconstruction: Reconstruction) -> dict[str, Any]:
    """Return the oriented cloud, the cameras and the board planes as the page's 3D view reads them."""
    cloud = reconstruction.cloud
    depth = DEPTH * float(np.median(np.linalg.norm(cloud.points_mm, axis=1)))
    frames = ((Rigid3.identity(), "camera 1"), (reconstruction.cam2_from_cam1.inverse(), "camera 2"))
    planes = [
        {"board": index, "corners": rounded(_outline(cloud.points_mm[cloud.board_index == index]), 2)}
        for index in range(len(cloud.board_ids))
        if (cloud.board_index == index).sum() >= 3
    ]
    return {
        "points": rounded(cloud.points_mm, 2),
        "normals": rounded(cloud.normals, 4),
        "board": [int(b) for b in cloud.board_index],
        "boards": list(cloud.board_ids),
        "cameras": [camera_pyramid(name, frame, depth) for frame, name in frames],
        "planes": planes,
        "square_mm": float(np.mean([b.square_x_mm for b in reconstruction.boards])),
    }


def _outline(points: FloatArray) -> FloatArray:
    """Return the corners of the smallest box, along the principal axes, around points that lie in a plane."""
    centre = points.mean(axis=0)
    axes = np.linalg.svd(points - centre, full_matrices=False)[2][:2]
    local = (points - centre) @ axes.T
    (x0, y0), (x1, y1) = local.min(axis=0), local.max(axis=0)
    return np.asarray(centre + np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]]) @ axes)
