"""Candidate chessboard corners: image preparation, saddle points, the ring test."""
