"""A dense cloud as a self-contained page with an interactive view."""

from __future__ import annotations

import base64
from collections.abc import Mapping

import numpy as np

from rigkit.core.cloud import OrientedCloud
from rigkit.report.render import render

MAX_DRAWN = 150_000
"""Maximum number of points on the page; larger clouds are subsampled."""
REACH_QUANTILE = 0.95
"""Quantile of the points' distances from their median that scales the view: a few far points do not shrink it."""
SPACING_SAMPLES = 2000
POINT_SIDE = 2.0
"""Side of a drawn point, in distances to its nearest neighbour, so that surfaces look closed."""


def build_cloud_page(title: str, cloud: OrientedCloud, provenance: Mapping[str, str], *, unit: str) -> str:
    """Return the page of a cloud of two points or more; lengths are in `unit`."""
    from scipy.spatial import cKDTree

    shown = cloud.select(np.arange(len(cloud)) % (1 + (len(cloud) - 1) // MAX_DRAWN) == 0)
    middle = np.median(shown.points_mm, axis=0)
    reach = float(np.quantile(np.linalg.norm(shown.points_mm - middle, axis=1), REACH_QUANTILE)) or 1.0
    places = (shown.points_mm - middle) / reach
    some = places[:: 1 + len(places) // SPACING_SAMPLES]
    nearest, _ = cKDTree(places).query(some, k=2)
    packed = b"".join(
        values.tobytes()
        for values in (places.astype("<f4"), np.rint(127.0 * shown.normals).astype(np.int8), shown.colours)
    )
    summary = f"{len(cloud)} points, half of them known to {np.nanmedian(cloud.sigma_mm):.3g} {unit} or better"
    return render(
        "cloud.html",
        title=title,
        lead=summary if len(shown) == len(cloud) else f"{summary}; {len(shown)} are shown",
        count=len(shown),
        spacing=f"{POINT_SIDE * float(np.median(nearest[:, 1])):.3g}",
        packed=base64.b64encode(packed).decode(),
        provenance=provenance,
    )
