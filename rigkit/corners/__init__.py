"""Finding chessboards and their corners, telling boards apart, directions at corners."""
