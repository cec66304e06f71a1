"""Reconstruct an oriented point cloud in mm from board corners or correspondences of two images."""
