"""Files of calibrations: of a camera, of a rig, and of either over months."""
