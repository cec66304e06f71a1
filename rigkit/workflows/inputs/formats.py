"""Names of the file formats of cameras and clouds; quick to import."""

from __future__ import annotations

FOREIGN_ENDINGS = {
    "opencv": ".yaml",
    "kalibr": ".yaml",
    "ros": ".yaml",
    "colmap": ".txt",
    "ocamcalib": ".txt",
    "mrcal": ".cameramodel",
}
"""Camera formats of other tools that can be written, with their file endings. Readers and writers are in
`rigkit.interop.camera_formats`, which takes too long to import for a help text."""
CAMERA_FORMATS = ("rigkit", *FOREIGN_ENDINGS)
READ_FORMATS = (*CAMERA_FORMATS, "py-ocamcalib", "matlab")
CLOUD_FORMATS = ("ply", "npz", "las", "colmap")
PLY_FORMATS = ("ply", "npz", "las")
"""Formats that a PLY file can be exported to."""
