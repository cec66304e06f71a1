"""A dense cloud as a page: it turns in any browser, and what it needs is inside."""

from __future__ import annotations

import base64
from collections.abc import Mapping

import numpy as np

from rigkit.core.cloud import OrientedCloud
from rigkit.report.render import render

MAX_DRAWN = 150_000
"""Points of a page: of more, every second, third, ... is shown."""
REACH_QUANTILE = 0.95
"""Of the points' distances from their middle: a few far ones do not make the others small."""
SPACING_SAMPLES = 2000
POINT_SIDE = 2.0
"""Side of a drawn point, in distances to its nearest neighbour: surfaces look closed."""


def build_cloud_page(title: str, cloud: OrientedCloud, provenance: Mapping[str, str], *, unit: str) -> str:
    """Return the page of a cloud of at least two points as text; lengths are in `unit`."""
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
