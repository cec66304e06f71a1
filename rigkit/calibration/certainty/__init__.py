"""How sure a calibration is, over the image and beyond its model."""
