"""How wrong a measurement with a calibrated camera or rig may be, over the image."""
