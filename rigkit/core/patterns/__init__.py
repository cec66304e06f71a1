"""Patterns of boards: chessboards, ChArUco boards, AprilGrids, circle grids; one file for each, and a registry."""
