"""Camera and rig calibration from views of boards."""
