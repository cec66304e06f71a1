"""The formats that cameras and clouds are written in; nothing here is heavy to import."""

from __future__ import annotations

FOREIGN_ENDINGS = {
    "opencv": ".yaml",
    "kalibr": ".yaml",
    "ros": ".yaml",
    "colmap": ".txt",
    "ocamcalib": ".txt",
    "mrcal": ".cameramodel",
}
"""Other tools' formats of cameras that are written, and how the names of their files end. Readers and writers are in
`rigkit.interop.camera_formats`, which takes too long to load for a help text."""
CAMERA_FORMATS = ("rigkit", *FOREIGN_ENDINGS)
READ_FORMATS = (*CAMERA_FORMATS, "py-ocamcalib", "matlab")
CLOUD_FORMATS = ("ply", "npz", "las", "colmap")
PLY_FORMATS = ("ply", "las")
"""Of a cloud that is there as PLY."""
