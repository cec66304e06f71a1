"""Does a calibration still hold? Against fresh images, another one, its register; and what it can measure."""
