"""Checks of a calibration: against fresh images, another calibration or its register; and its certificate."""
