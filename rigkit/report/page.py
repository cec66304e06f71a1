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
from rigkit.report.render import data_uri, render, shown_table
from rigkit.report.scene_view import DEPTH, camera_pyramid, rounded

__all__ = ["PairSection", "build_page", "scene_of"]


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
    passed: bool,
    summary: Sequence[Table],
    pairs: Sequence[PairSection],
    provenance: Mapping[str, str],
) -> str:
    """Return the page as text; everything it needs is inside it."""
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
        passed=passed,
        summary=[shown_table(table) for table in summary],
        pairs=shown,
        provenance=provenance,
    )


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
