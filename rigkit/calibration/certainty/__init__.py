"""The uncertainty of a calibration: of parameters and projection, model inadequacy included."""
