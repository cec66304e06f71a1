"""Files of points in images: corners of boards, correspondences of any scene."""
