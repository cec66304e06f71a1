"""Clouds as LAS 1.4 for surveying programs and CloudCompare, by laspy (`pip install "rigkit[las]"`)."""

from __future__ import annotations

import io

import numpy as np

from rigkit.core.cloud import OrientedCloud
from rigkit.core.errors import InputError, InstallationError

POINT_FORMAT = 7
"""Format with colours."""
LAS_STEPS = 2.0**30
"""Integer steps of a coordinate over the cloud's extent: LAS stores 32-bit integers."""
LEVELS_OF_16_BITS = 257
"""16-bit levels for one 8-bit level."""
NORMALS = ("NormalX", "NormalY", "NormalZ")
"""CloudCompare's names."""
WKT = (
    'LOCAL_CS["rigkit: x right, y down, z forward",LOCAL_DATUM["camera",0],UNIT["millimetre",0.001],'
    'AXIS["x",OTHER],AXIS["y",OTHER],AXIS["z",OTHER]]'
)
"""Local coordinate system (OGC 01-009) in mm; LAS 1.4 states units in such a record."""


def las_bytes(cloud: OrientedCloud, unit: str = "mm") -> bytes:
    """Return the content of the LAS file, with normals and `sigma_mm` as extra columns; lengths are those of the cloud.

    Lengths in mm are stated in the file's coordinate system; those in another `unit` (baselines, of unknown length) as
    its system identifier only.

    Raises InputError for an empty cloud, InstallationError if laspy is not installed.
    """
    try:
        import laspy
        from laspy.vlrs.known import WktCoordinateSystemVlr
    except ImportError as error:
        raise InstallationError('LAS files need laspy; install it with `pip install "rigkit[las]"`') from error
    if not len(cloud):
        raise InputError("LAS: the cloud has no points")
    size = float(np.ptp(cloud.points_mm, axis=0).max())
    header = laspy.LasHeader(point_format=POINT_FORMAT, version="1.4")
    header.generating_software, header.system_identifier = "rigkit", f"units {unit}"
    if unit == "mm":
        header.vlrs.append(WktCoordinateSystemVlr(WKT))
        header.global_encoding.wkt = True
    header.offsets = cloud.points_mm.min(axis=0)
    header.scales = np.full(3, (size or 1.0) / LAS_STEPS)
    columns = dict(zip((*NORMALS, "sigma_mm"), np.column_stack([cloud.normals, cloud.sigma_mm]).T, strict=True))
    header.add_extra_dims([laspy.ExtraBytesParams(name=name, type=np.float32) for name in columns])
    las = laspy.LasData(header)
    las.x, las.y, las.z = cloud.points_mm.T
    las.red, las.green, las.blue = LEVELS_OF_16_BITS * cloud.colours.astype(np.uint16).T
    for name, values in columns.items():
        las[name] = values.astype(np.float32)
    out = io.BytesIO()
    las.write(out)
    return out.getvalue()
