"""Files of image points: corners of boards, and correspondences."""
