"""`rigkit calibrate` for one camera or a rig, and the pictures to take next."""
