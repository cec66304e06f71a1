"""`rigkit calibrate`: of one camera, of a rig, and what to photograph next for it."""
