"""Files: manifests, calibrations, corners, clouds, images. Whole or not at all."""
