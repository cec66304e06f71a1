"""What is printed on a board: chessboards, ChArUco boards, AprilGrids; one file a pattern, one registry."""
